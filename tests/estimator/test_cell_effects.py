"""Effects in the cells as the estimator follows them: through steps of the current, and for currents in dispute."""

from __future__ import annotations

import numpy as np
import pytest

from gz_onboard.estimator.cells import CellEffects
from gz_onboard.events import Group
from gz_onboard.model.battery import Health
from gz_onboard.offline.series import advanced
from gz_onboard.vehicle import read_vehicle
from tests.events import EventEstimator
from tests.support import cell_voltage

VEHICLE = read_vehicle("reference", 75.0)
PACK, MODEL = VEHICLE.pack, VEHICLE.model
COLD, WARM, SOC, DT = -5.0, 25.0, 0.7, 0.1  # degC, degC, 1, s
HARD, GENTLY = 5.0, 1.0  # A of a cell: pulling away, rolling
GROUPS = [
    Group("Pack", ("pack_voltage", "pack_current"), DT),
    Group("Motor", ("motor_speed",), DT),
    Group("Cells", ("cell_temperature", "ambient_temperature"), 1.0),
]


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


def test_a_current_that_nobody_asked_for_in_a_while_is_followed_anew():
    effects, _ = followed([0.0] * 10)
    for k in range(300):
        effects.supposed("inverter", DT * k, HARD)
    assert effects.supposed("inverter", 3600.0, HARD) == effects.overpotential


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


def bursts(seconds):
    """Events of a cold pack of the vehicle's own model: 4 s at 60 A in every 12 s."""
    p, soc, v1, effects, before = VEHICLE.parameters, SOC, 0.0, CellEffects(MODEL, PACK), 1.2
    effects.step(PACK, 60.0, before / PACK.cells_parallel, soc, COLD)  # it has stood with its lights on
    for step in range(round(seconds / DT)):
        t = step * DT
        current = 1.2 if t < 10 or t % 12 > 4 else 60.0
        cell = current / PACK.cells_parallel
        effects.step(PACK, DT, (before + current) / 2 / PACK.cells_parallel, soc, COLD)
        soc, v1 = advanced(PACK, DT, soc, v1, (before + current) / 2 / PACK.cells_parallel, COLD)
        before = current
        volts = PACK.pack_voltage(cell_voltage(PACK, soc, v1, cell, COLD) - effects.overpotential, current)
        yield t, 0, (volts + p["pack_voltage_offset"], p["pack_current_gain"] * current + p["pack_current_offset"])
        yield t + 0.01, 1, (0.0 if t < 10 else 20.0,)
        if step % 10 == 0:
            yield t + 0.02, 2, (COLD, COLD)


def test_steps_of_the_current_leave_no_error_and_the_sag_that_there_is(monkeypatch):
    e = EventEstimator(GROUPS, PACK, MODEL, VEHICLE.riding)
    errors, cell_error = [], e.pack.cell_error

    def kept(*arguments):
        errors.append(cell_error(*arguments))
        return errors[-1]

    monkeypatch.setattr(e.pack, "cell_error", kept)
    for event in bursts(120.0):
        e.handle(event)
    late = np.array([x for x in errors if x is not None][60:])
    assert np.abs(late).max() < 0.006  # in windows with a step
    assert e.electrical.sag.ratio == pytest.approx(1.0, abs=0.03)
