"""Charge transfer out of pulse tests: of a plant whose double layer is charged by a current that goes as sinh."""

from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest

from gz_onboard.calibration import pulse
from gz_onboard.calibration.cell import cell_test
from gz_onboard.calibration.circuit import NO_REACTION, follow_profile
from tests.calibration.cells import Plant, pulse_test
from tests.calibration.test_pulse import slow

PLANTED = 0.015


@cache
def found(reaction):
    tests = [pulse_test(t, 6, seed=k, reaction=reaction)[0] for k, t in enumerate((-10.0, 10.0, 25.0))]
    return pulse.calibrate_cell(tests, *slow())


def test_it_is_found_with_its_temperature_and_time():
    result = found(PLANTED)
    assert result.effects["charge_transfer"]
    values = {name: result.parameters[f"charge_transfer_{name}"] for name in ("resistance", "activation", "time")}
    assert values["resistance"].value == pytest.approx(PLANTED, rel=0.15)
    assert values["activation"].value == pytest.approx(4500, rel=0.15)
    assert values["time"].value == pytest.approx(3.0, rel=0.5)
    assert all(0 < x.sd < 0.2 * x.value for x in values.values())


def test_a_load_that_no_fit_has_seen_is_followed_better_with_it(monkeypatch):
    pieces = [(0.0, 60, 1), *[(i, 8.0, 1) for _ in range(12) for i in (4.0, 0.5, 2.0, -1.0, 0.0, 3.0)]]
    ride = cell_test(Plant(reaction=PLANTED, seed=7, soc=0.8).run(pieces, -5.0, "ride.csv"))
    cell = pulse.circuit(found(PLANTED))
    assert cell.reaction.resistance > 0

    def left(circuit):
        model, measured = follow_profile(circuit, ride)
        return float(np.sqrt(np.mean((model - measured) ** 2)))

    monkeypatch.setattr(pulse, "_charge_transfer", lambda *_: NO_REACTION)
    tests = [pulse_test(t, 6, seed=k, reaction=PLANTED)[0] for k, t in enumerate((-10.0, 10.0, 25.0))]
    without = pulse.circuit(pulse.calibrate_cell(tests, *slow()))
    assert left(cell) < 0.5 * left(without)


def test_a_cell_without_it_has_none():
    result = found(0.0)
    assert not result.effects["charge_transfer"]
    assert not any(name.startswith("charge_transfer") for name in result.parameters)
    assert any("no resistance that falls with current" in note for note in result.notes)


def test_it_may_take_all_of_r0():
    levels = [(4.0, 10, 2.5), (0.0, 40, 5), (-1.0, 10, 2.5), (0.0, 40, 5), (1.0, 700, 25), (0.0, 1400, 50)]
    cell = partial(Plant, r0=0.005, pairs=((0.005, 30.0),), cold=0.0, reaction=0.06, layer=0.0, activation=3200.0)
    runs = enumerate((25.0, 40.0))
    tests = [cell(seed=k).run([(0.0, 600, 100), *8 * levels], t, f"{t:g}.csv") for k, t in runs]
    ocv, capacity = slow()
    other = replace(ocv, value=ocv.value + 0.01 * np.sin(6 * ocv.axes["soc"]))  # of a cell that is much alike
    result = pulse.calibrate_cell(tests, other, capacity)
    resistance = result.parameters["charge_transfer_resistance"]
    assert abs(resistance.value - 0.06) < resistance.sd < 0.01
    r0 = result.curves["battery.r0"].value
    assert np.all((r0 > 0.004) & (r0 < 0.011))  # the cell's pair of 5 mΩ may be part of it
