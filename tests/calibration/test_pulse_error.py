"""By how much, and for how long in the same way, a circuit errs: given back from errors of known size and time."""

from __future__ import annotations

import numpy as np
import pytest

from gz_onboard.calibration.pulse import Residual, voltage_errors
from gz_onboard.calibration.result import Result


def wandering(seed, sd, tau, hours=60.0):
    """A Gauss-Markov process, at uneven times as a tester writes them."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.choice([0.1, 1.0, 10.0], size=int(hours * 3600 / 3.7)))
    values = np.empty(len(time))
    values[0] = sd * rng.standard_normal()
    for k, left in enumerate(np.exp(-np.diff(time) / tau)):
        values[k + 1] = left * values[k] + sd * np.sqrt(1 - left**2) * rng.standard_normal()
    return time, values


def resting(time):
    """True but for the last tenth of each hour."""
    return time % 3600 < 3240


def test_size_and_time_come_back():
    residuals = []
    for seed, (temperature, sd) in enumerate(((-10.0, 0.02), (25.0, 0.005))):
        time, values = wandering(seed, sd, 400.0)
        residuals.append(Residual(temperature, time, values, np.full(len(time), 0.5), resting(time)))
    result = Result("pulse")
    voltage_errors(residuals, "t", result)
    curve, time = result.curves["battery.voltage_error"], result.parameters["cell_voltage_error_time"]
    assert list(curve.axes["temperature"]) == [-10, 25]
    assert curve.value == pytest.approx([0.02, 0.005], rel=0.15)
    assert time.value == pytest.approx(400, rel=0.35)


def test_the_time_comes_back_at_each_temperature():
    true = {-10.0: 1500.0, 25.0: 150.0}
    residuals = []
    for seed, (temperature, tau) in enumerate(true.items()):
        time, values = wandering(seed, 0.01, tau)
        residuals.append(Residual(temperature, time, values, np.full(len(time), 0.5), resting(time)))
    result = Result("pulse")
    voltage_errors(residuals, "t", result)
    curve = result.curves["voltage_error_time"]
    assert dict(zip(curve.axes["temperature"], curve.value, strict=True)) == pytest.approx(true, rel=0.5)
    assert result.parameters["cell_voltage_error_time"].value == pytest.approx(np.sqrt(np.prod(curve.value)))


def test_what_is_near_empty_is_left_out():
    time, values = wandering(3, 0.005, 300.0)
    level = np.linspace(1.0, 0.0, len(time))
    spoilt = np.where(level < 0.1, 0.3, values)
    result = Result("pulse")
    voltage_errors([Residual(25.0, time, spoilt, level, resting(time))], "t", result)
    assert result.curves["battery.voltage_error"].value == pytest.approx([0.005], rel=0.15)


def test_load_counts_as_much_as_rest_though_a_test_has_little_of_it():
    time = np.arange(0.0, 36000.0, 5.0)
    rest = resting(time)
    values = np.where(rest, 0.005, 0.04)
    result = Result("pulse")
    voltage_errors([Residual(-10.0, time, values, np.full(len(time), 0.5), rest)], "t", result)
    assert result.curves["battery.voltage_error"].value == pytest.approx([np.hypot(0.005, 0.04) / np.sqrt(2)])
