from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gz_onboard.calibration.cell import OCV_SOC, open_circuit
from gz_onboard.calibration.table import Measurements
from gz_onboard.errors import InputError
from tests.calibration.cells import Plant, changed, slow_test


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


def test_hysteresis_is_in_the_sd():
    little, much = (open_circuit(slow_test(hysteresis=h)[0]).curves["battery.ocv"].sd for h in (0.0, 0.02))
    middle = (OCV_SOC > 0.2) & (OCV_SOC < 0.8)
    assert np.median(much[middle]) > np.median(little[middle]) + 0.006


SLOW = slow_test()[0]
FULL, DOWN, REST, UP = (0, 600, 60), (0.125, 72000, 60), (0, 3600, 60), (-0.125, 72000, 60)


def full_early():
    """A slow test whose charge is full after 87 % of what was discharged."""
    table = slow_test(charge=0.87)[0]
    up = table["current"] < 0
    table["voltage"][up] += np.linspace(0.0, table["voltage"][0] - table["voltage"][up][-1], np.count_nonzero(up))
    return table


@pytest.mark.parametrize(
    ("table", "said", "error_v"),
    [
        (slow_test(charge=0)[0], "no charge branch", 0.006),
        (slow_test(charge=0.5)[0], r"no charge branch at SOC 0\.55? to 0\.99", 0.006),
        (full_early(), "the branches do not close", 0.006),
        (changed(SLOW, current=lambda c: np.where(c < 0, 0.94 * c, c)), "brings back 2.350 of 2.500", 0.006),
        (Plant().run([FULL, DOWN, REST, (-1.25, 7200, 60), FULL], name="ocv.csv"), "1.25 A is no counterpart", 0.006),
        (Plant(soc=0.0).run([FULL, UP, REST, DOWN, REST], name="ocv.csv"), "", 0.003),
    ],
)
def test_an_incomplete_test_gives_a_curve_and_is_said_to_be(table, said, error_v):
    result = open_circuit(table)
    assert re.search(said, result.refusals[0]) if said else not result.refusals
    curve, middle = result.curves["battery.ocv"], (OCV_SOC > 0.1) & (OCV_SOC < 0.9)
    error = np.abs(curve.value - Plant().ocv(OCV_SOC))[middle]
    assert error.max() < error_v
    assert np.all(error < 3 * curve.sd[middle])


@pytest.mark.parametrize("before", [[], [(-0.125, 3600, 60)], [(-1.25, 360, 60), (0, 120, 60)]])
def test_without_a_rest_before_the_discharge_full_is_not_its_first_voltage(before):
    cell = Plant(soc=1.0 - sum(-current * seconds for current, seconds, _ in before) / 3600 / 2.5)
    table = cell.run([*before, DOWN, REST, UP, FULL], name="ocv.csv")
    if not before:
        table = replace(table, columns={name: column[2:] for name, column in table.columns.items()})
    result = open_circuit(table)
    curve = result.curves["battery.ocv"]
    assert re.search(r"ocv.csv: no rest before the discharge .* moved by", result.refusals[-1])
    assert abs(curve.value[-1] - cell.ocv(1.0)) < min(curve.sd[-1], 0.012)


PIECES = [FULL, (0.125, 43200, 60), REST, (0.125, 28800, 60), REST]


def backwards():
    """A test of the wrong sign whose voltage's steps are lost in its noise."""
    table = slow_test(capacity=1.0, r0=0.002)[0]
    table.columns["current"] *= -1
    return table


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (changed(SLOW, current=lambda c: -c), "ocv.csv:13: the voltage falls .* discharging must be positive"),
        (backwards(), "as charge is drawn, .* discharging must be positive"),
        (changed(SLOW, current=lambda c: 0 * c), "no current flows"),
        (changed(SLOW, time=lambda t: np.where(t > 30000, t + 9000, t)), "a gap of 9060 s while a current"),
        (changed(SLOW, voltage=lambda v: np.maximum(v, 3.6)), "it is clipped"),
        (slow_test(hours=3)[0], "the discharge takes 3.0 h"),
        (changed(SLOW, voltage=lambda v: np.where(np.arange(len(v)) == 500, 0.0, v)), "ocv.csv:501: voltage is 0 V"),
        (changed(SLOW, current=lambda c: np.where(c < 0, 1.25 * c, c)), r"brings back 3.\d+ of 2.500 A·h.*10 %"),
        (Plant().run(PIECES, name="ocv.csv"), r"ocv.csv: 2.5\d* A·h are drawn in pieces.* 1.5\d* of it without a"),
        (Measurements(Path("ocv.csv"), {"time": np.arange(9.0), "current": np.ones(9)}), "no column for 'voltage'"),
        (replace(SLOW, columns={k: v[:20] for k, v in SLOW.columns.items()}), "20 samples are too"),
    ],
)
def test_what_is_no_slow_test_is_refused(table, words):
    with pytest.raises(InputError, match=words):
        open_circuit(table)
