"""What sensors show and what is."""

from __future__ import annotations

import numpy as np
import pytest

from gz_onboard.constants import GRAVITY
from gz_onboard.errors import InputError
from gz_onboard.model.sensors import grade_shown, speed_factors
from gz_onboard.recording.sensors import road_speed, speed_role, true_columns

P = {
    "pack_current_offset": 0.5,
    "pack_current_gain": 1.1,
    "pack_voltage_offset": -0.3,
    "speed_sensor_scale": 1.05,
    "wheel_radius": 0.25,
    "gear_ratio": 0.2,
}


def test_an_accelerometer_shows_the_hill_beside_the_wheels():
    assert grade_shown(GRAVITY * 0.03 + 0.7, 0.7) == pytest.approx(0.03)


def test_all_speeds_of_a_vehicle_are_one():
    speed, (radius, gear) = 7.0, (P["wheel_radius"], P["gear_ratio"])
    factors = speed_factors(radius, gear)
    assert factors["motor_speed"] == road_speed(1.0, P) and factors["gps_speed"] == 1.0
    assert factors["wheel_speed_front"] * speed / radius == pytest.approx(speed)


def test_the_errors_of_the_sensors_are_taken_off():
    time, true = np.arange(3.0), np.array([0.0, 10.0, 40.0])
    shown = {
        "pack_current": (time, 1.1 * true + 0.5),
        "pack_voltage": (time, true - 0.3),
        "motor_speed": (time, 1.05 * true),
        "gps_speed": (time, true),
    }
    for at, values in true_columns(shown, P).values():
        assert at is time
        assert values == pytest.approx(true)


def test_speed_is_the_motors_if_there_is_one():
    columns = {role: (np.zeros(1), np.ones(1)) for role in ("gps_speed", "wheel_speed_rear", "motor_speed")}
    assert road_speed(200.0, P) == pytest.approx(10.0)
    assert speed_role("ride", columns, P) == ("motor_speed", 0.25 * 0.2)
    del columns["motor_speed"]
    assert speed_role("ride", columns, P) == ("wheel_speed_rear", 0.25)
    with pytest.raises(InputError, match="ride: has no speed; it needs one of motor_speed, wheel"):
        speed_role("ride", {}, P)
