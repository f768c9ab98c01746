"""Effects in the cells as the estimator follows them: through steps of the current, and for currents in dispute."""

from __future__ import annotations

import pytest

from gz_onboard.estimator.cells import CellEffects
from gz_onboard.model.battery import Health
from gz_onboard.vehicle import read_vehicle

VEHICLE = read_vehicle("reference", 75.0)
PACK, MODEL = VEHICLE.pack, VEHICLE.model
COLD, WARM, SOC, DT = -5.0, 25.0, 0.7, 0.1  # degC, degC, 1, s
HARD, GENTLY = 5.0, 1.0  # A of a cell: pulling away, rolling


def followed(currents, temperature=COLD):
    """The effects after cell `currents` [A], `DT` each, and their overpotential [V] at each."""
    effects, volts = CellEffects(MODEL, PACK), []
    for before, current in zip([currents[0], *currents[:-1]], currents, strict=True):
        effects.step(PACK, DT, (before + current) / 2, SOC, temperature)
        volts.append(effects.overpotential)
    return effects, volts


def test_a_current_that_has_just_begun_takes_no_more_than_has_built_up():
    """A step to 5 A: the charge transfer of 3 s has hardly begun, whoever reports the current."""
    _, volts = followed([0.1] * 100 + [HARD] * 3)
    effects, _ = followed([0.1] * 100)
    effects.supposed("pack", 0.0, 0.1)
    for k, truth in enumerate(volts[-3:]):
        assert effects.supposed("pack", DT * (k + 1), HARD) == pytest.approx(truth, abs=2e-3)


def test_a_current_that_is_long_another_than_the_one_followed_has_its_own_overpotential():
    """The pack's sensor is stuck at nothing for half a minute, the inverter's shows what flows."""
    effects, _ = followed([0.0] * 10)
    for k in range(300):
        effects.step(PACK, DT, 0.0, SOC, COLD)
        shown = effects.supposed("inverter", DT * k, HARD)
    assert effects.overpotential == pytest.approx(0.0, abs=1e-9)
    assert shown == pytest.approx(followed([HARD] * 400)[1][-1], rel=0.01)


def test_a_resistance_learned_from_quick_changes_says_nothing_of_what_takes_half_an_hour():
    """The reaction of a cell with half as much resistance more loses more, and slow relaxation what the file says."""
    assert {"charge_transfer", "slow_relaxation"} <= {effect.name for effect in MODEL.effects}
    aged = PACK.aged(Health(0.8, 1.5))
    lost = {}
    for name, pack in (("new", PACK), ("aged", aged)):
        effects = CellEffects(MODEL, pack)
        effects.step(pack, 1e5, GENTLY, SOC, WARM)
        lost[name] = effects.states
        settled = MODEL.overpotential(pack)
        assert settled is not None
        assert settled(GENTLY, SOC, WARM, 1.0) == pytest.approx(effects.overpotential)
        assert effects.supposed("inverter", 0.0, GENTLY) == pytest.approx(effects.overpotential)
    assert lost["aged"]["slow_relaxation"] == pytest.approx(lost["new"]["slow_relaxation"], rel=0.03)
    assert lost["aged"]["charge_transfer"] > 1.4 * lost["new"]["charge_transfer"]
