from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gz_onboard.calibration.cell import OCV_SOC, open_circuit
from gz_onboard.errors import InputError
from tests.calibration.cells import Plant, slow_test


@given(capacity=st.floats(1, 5), r0=st.floats(0.01, 0.08), hysteresis=st.floats(0, 0.01), seed=st.integers(0, 1000))
@example(capacity=1.0, r0=0.012, hysteresis=0.0, seed=352)  # the voltage's steps are lost in its noise
@settings(max_examples=15, deadline=None)
def test_both_branches_give_curve_and_capacity_whatever_resistance_and_hysteresis(capacity, r0, hysteresis, seed):
    table, cell = slow_test(capacity=capacity, r0=r0, hysteresis=hysteresis, seed=seed)
    result = open_circuit(table)
    curve, found = result.curves["battery.ocv"], result.parameters["cell_capacity"]
    assert abs(found.value - capacity) < 2 * found.sd
    soc, inside = curve.axes["soc"], (curve.axes["soc"] > 0.05) & (curve.axes["soc"] < 1)
    assert np.all(np.diff(curve.value) > 0)
    assert np.abs(curve.value - cell.ocv(soc))[inside].max() < 0.003
    assert not result.refusals
    assert np.all(curve.sd > 0)


@pytest.mark.parametrize("r0", [0.002, 0.08])
def test_a_reversed_sign_is_refused_whether_the_steps_show_it_or_not(r0):
    table, _ = slow_test(capacity=1.0, r0=r0)
    table.columns["current"] *= -1
    how = "goes from .* discharging" if r0 > 0.01 else "as charge is drawn, .* discharging"
    with pytest.raises(InputError, match=f"ocv.csv.*{how} must be positive"):
        open_circuit(table)


def test_hysteresis_is_in_the_sd():
    little, much = (open_circuit(slow_test(hysteresis=h)[0]).curves["battery.ocv"].sd for h in (0.0, 0.02))
    middle = (OCV_SOC > 0.2) & (OCV_SOC < 0.8)
    assert np.median(much[middle]) > np.median(little[middle]) + 0.006


def test_without_a_charge_branch_the_discharge_is_moved_and_it_is_said():
    table, cell = slow_test(charge=0)
    result = open_circuit(table)
    assert "no charge branch" in result.refusals[0]
    curve = result.curves["battery.ocv"]
    middle = (curve.axes["soc"] > 0.1) & (curve.axes["soc"] < 0.9)
    error = np.abs(curve.value - cell.ocv(curve.axes["soc"]))[middle]
    assert np.all(error < 3 * curve.sd[middle])
    assert error.max() < 0.006


def test_a_charge_that_stops_early_is_used_as_far_as_it_goes():
    result = open_circuit(slow_test(charge=0.5)[0])
    assert "SOC 0.5 to 0.99" in result.refusals[0].replace("0.55", "0.5")
    sd = result.curves["battery.ocv"].sd
    assert np.median(sd[OCV_SOC > 0.6]) > np.median(sd[(OCV_SOC > 0.1) & (OCV_SOC < 0.4)])


def test_branches_that_do_not_close_are_not_averaged():
    table, cell = slow_test(charge=0.87)
    up = table.columns["current"] < 0
    volts = table.columns["voltage"].copy()
    volts[up] += np.linspace(0.0, table.columns["voltage"][0] - volts[up][-1], np.count_nonzero(up))
    result = open_circuit(replace(table, columns={**table.columns, "voltage": volts}))
    assert "do not close" in result.refusals[0]
    middle = (OCV_SOC > 0.1) & (OCV_SOC < 0.9)
    assert np.abs(result.curves["battery.ocv"].value - cell.ocv(OCV_SOC))[middle].max() < 0.006


def changed(**columns):
    table = slow_test()[0]
    return replace(table, columns={**table.columns, **{k: f(table.columns[k].copy()) for k, f in columns.items()}})


PIECES = [(0, 600, 60), (0.125, 43200, 60), (0, 3600, 60), (0.125, 28800, 60), (0, 3600, 60)]


def put(index, value):
    def change(column):
        column[index] = value
        return column

    return change


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (changed(current=lambda c: -c), "ocv.csv:13: the voltage falls"),
        (changed(current=lambda c: 0 * c), "no current flows"),
        (changed(time=lambda t: np.where(t > 30000, t + 9000, t)), "a gap of 9060 s while a current"),
        (changed(voltage=lambda v: np.maximum(v, 3.6)), "it is clipped"),
        (slow_test(hours=3)[0], "the discharge takes 3.0 h"),
        (changed(voltage=put(500, 0.0)), "ocv.csv:501: voltage is 0 V"),
        (changed(current=lambda c: np.where(c < 0, 1.25 * c, c)), r"brings back 3.\d+ of 2.500 A·h.*10 %"),
        (Plant().run(PIECES, name="ocv.csv"), r"ocv.csv: 2.5\d* A·h are drawn in pieces.* 1.5\d* of it without a"),
    ],
)
def test_what_is_no_slow_test_is_refused(table, words):
    with pytest.raises(InputError, match=words):
        open_circuit(table)


def test_a_missing_column_and_too_few_samples_are_named():
    table = slow_test()[0]
    without = {k: v for k, v in table.columns.items() if k != "voltage"}
    with pytest.raises(InputError, match=r"ocv\.csv: no column for 'voltage'"):
        open_circuit(replace(table, columns=without))
    with pytest.raises(InputError, match="20 samples are too few"):
        open_circuit(replace(table, columns={k: v[:20] for k, v in table.columns.items()}))
