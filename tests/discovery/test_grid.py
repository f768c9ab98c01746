"""What the discovery looks at residuals over: rough roads, brakes let go of."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.discovery.curve_forms import IN_PROPORTION, KNOTS, curve_forms
from gz_onboard.discovery.grid import LONGEST, since, suspension_speed, vibration
from gz_onboard.model.sensors import VIBRATION_MEMORY_S, VIBRATION_PERIOD_S
from gz_onboard.offline.sensors import Vibration

RATE = 100.0


def settled(values: np.ndarray, rate: float = RATE) -> float:
    shaken = Vibration()
    for value in values.tolist():
        shaken.update(1 / rate, value)
    return shaken.value


@given(level=st.floats(-20, 20), slope=st.floats(-2, 2))
def test_what_is_slow_is_no_vibration(level: float, slope: float):
    """A hill, a bend, a mounting angle: a ramp of `slope` lags by slope times the time constant."""
    time = np.arange(0, 20, 1 / RATE)
    assert settled(level + slope * time) <= 1.05 * abs(slope) * VIBRATION_PERIOD_S + 1e-9


@pytest.mark.parametrize("rate", [50.0, 100.0, 200.0])
def test_the_rms_of_a_vibration_hardly_depends_on_the_rate(rate: float):
    """A high pass of time constant τ keeps 1/√(1 + 1/(2π·8·τ)²) of a sine at 8 Hz."""
    time = np.arange(0, 6 * VIBRATION_MEMORY_S, 1 / rate)
    kept = 1 / np.sqrt(1 + 1 / (2 * np.pi * 8 * VIBRATION_PERIOD_S) ** 2)
    assert settled(9.81 + 2 * np.sin(2 * np.pi * 8 * time), rate) == pytest.approx(2 / np.sqrt(2) * kept, rel=0.12)


@given(size=st.floats(0.01, 10), seed=st.integers(0, 99))
def test_twice_the_shaking_is_twice_the_vibration(size: float, seed: int):
    noise = np.random.default_rng(seed).normal(size=1000)
    assert settled(size * noise) == pytest.approx(size * settled(noise), rel=1e-6)


def test_vibration_on_the_grid_is_that_of_the_road_there():
    time = np.arange(0, 60, 1 / RATE)
    rng = np.random.default_rng(1)
    shaking = np.where((time > 20) & (time < 40), 3.0, 0.5)
    found = vibration(time, 9.81 + shaking * rng.normal(size=len(time)), np.arange(0, 60, 0.1))
    assert np.median(found[:190]) == pytest.approx(0.5 * settled(rng.normal(size=2000)), rel=0.15)
    assert np.median(found[260:390]) > 5 * np.median(found[:190])


def test_since():
    happens = np.zeros(1000, dtype=bool)
    happens[[100, 101, 400]] = True
    assert since(happens)[0] == LONGEST
    assert since(happens)[[100, 101, 111, 399]] == pytest.approx([0, 0, 1.0, 29.8])
    assert since(happens)[-1] == pytest.approx(59.9)
    assert np.all(since(np.zeros(10, dtype=bool)) == LONGEST)


def test_suspension_speed_is_the_rms_of_both():
    time = np.arange(0, 30, 0.02)
    wheels = [(time, 0.03 + a * np.sin(2 * np.pi * 1.5 * time)) for a in (0.010, 0.004)]
    each = [a * 2 * np.pi * 1.5 / np.sqrt(2) for a in (0.010, 0.004)]
    found = suspension_speed(wheels, np.arange(5, 25, 0.1))
    assert found == pytest.approx(np.hypot(*each), rel=0.05)


def test_forms_are_curves_and_what_is_in_proportion():
    straight = [form for form in curve_forms() if form.straight]
    assert {form.quantity for form in straight} == set(IN_PROPORTION)
    assert len({form.name for form in curve_forms()}) == len(curve_forms())
    for form in straight:
        knots = np.array(KNOTS[form.quantity][0])
        assert form.basis.shape == (len(knots), 1)
        assert form.basis[:, 0] == pytest.approx(knots / np.abs(knots).max())
