"""The wheel's rolling radius from GPS."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.calibration.sensors import RIDE, wheel_radius
from gz_onboard.errors import InputError
from gz_onboard.recording.recording import Recording
from gz_onboard.vehicle import read_vehicle

VEHICLE = read_vehicle("reference")


def ride(
    radius: float, seed: int, lag: float = 0.4, minutes: float = 10, top: float = 12.0, bias: float = 0.0
) -> Recording:
    """Stop and go with cruising between; the receiver reports `lag` [s] late, with noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 60 * minutes, 0.05)
    target = np.repeat(rng.choice([0.0, 0.6, 0.8, 1.0], size=int(minutes * 2) + 1) * top, 600)[: len(time)]
    speed = np.empty_like(time)
    v = 0.0
    for k, wanted in enumerate(target):
        v += float(np.clip((wanted - v) / 1.0, -1.5, 1.2)) * 0.05
        speed[k] = v
    fixes = np.arange(2.0, time[-1], 0.2)
    gps = np.interp(fixes - lag, time, speed) * (1 + bias) + rng.normal(0, 0.05, len(fixes))
    return Recording(f"ride_{seed}", {"motor_speed": (time, speed / radius), "gps_speed": (fixes, gps)})


@settings(max_examples=10, deadline=None)
@given(st.floats(0.2, 0.35), st.integers(0, 1000), st.floats(0, 0.6))
def test_a_planted_radius_comes_back(radius, seed, lag):
    found = wheel_radius([ride(radius, seed, lag, top=14.0), ride(radius, seed + 1, lag, top=14.0)], VEHICLE)
    assert found.parameters["wheel_radius"].value == pytest.approx(radius, rel=0.002)


def test_its_sd_holds_receivers_that_err():
    inside = 0
    for seed in range(60):
        bias = float(np.random.default_rng(seed).normal(0, RIDE.receiver_sd))  # one receiver on all rides
        rides = [ride(0.24, 10 * seed + k, minutes=3, bias=bias) for k in range(3)]
        found = wheel_radius(rides, VEHICLE).parameters["wheel_radius"]
        inside += abs(found.value - 0.24) < 1.96 * found.sd
    assert 0.9 <= inside / 60 <= 0.99


def test_what_does_not_tell_is_refused():
    good = ride(0.24, 1)
    blind = Recording("blind", {"motor_speed": good.columns["motor_speed"]})
    slow = ride(0.24, 2, top=4.0)
    result = wheel_radius([good, blind, slow], VEHICLE)
    assert result.refusals[0] == "blind: has no gps_speed or no motor_speed, nor a wheel_speed_rear instead"
    assert "ride_2: 0 fixes at steady speed" in result.refusals[1]
    assert "ride_1" in result.parameters["wheel_radius"].source
    with pytest.raises(InputError, match="no ride tells the wheel's radius: blind"):
        wheel_radius([blind], VEHICLE)


def test_without_a_motor_speed_it_is_that_of_the_rear_wheel_and_says_so():
    with_motor = ride(0.24, 1)
    time, turned = with_motor.columns["motor_speed"]
    columns = {"gps_speed": with_motor.columns["gps_speed"], "wheel_speed_rear": (time, turned)}
    geared = VEHICLE.changed(VEHICLE.parameters.replaced(gear_ratio=0.2))
    result = wheel_radius([Recording("car", columns)], geared)
    assert result.parameters["wheel_radius"].value == pytest.approx(0.24, rel=0.003)
    assert "car: no motor_speed, taken by wheel_speed_rear instead" in result.notes
    assert "gps_speed over wheel_speed_rear" in result.parameters["wheel_radius"].source
