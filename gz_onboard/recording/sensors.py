"""A ride's sensor readings, corrected and put to use: columns and the best speed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gz_onboard.arrays import Array
from gz_onboard.errors import InputError
from gz_onboard.model.sensors import speed_factors, true_current, true_voltage

Columns = Mapping[str, tuple[Array, Array]]


def true_motor_speed(reading: Any, parameters: Mapping[str, float]) -> Any:
    """The motor's speed at a `reading` of its sensor, in the same unit."""
    return reading / parameters["speed_sensor_scale"]


TRUE = {"pack_current": true_current, "pack_voltage": true_voltage, "motor_speed": true_motor_speed}
"""Corrections by role; a file gives no errors of other sensors."""


def true_columns(columns: Columns, parameters: Mapping[str, float]) -> dict[str, tuple[Array, Array]]:
    """The columns of a ride (times and values by role), corrected for known errors of the sensors."""
    return {role: (t, TRUE[role](v, parameters) if role in TRUE else v) for role, (t, v) in columns.items()}


def road_speed(motor_speed: Any, parameters: Mapping[str, float]) -> Any:
    """Speed [m/s] of the driven wheel at the motor's true speed [rad/s], without slip."""
    return motor_speed * (parameters["wheel_radius"] * parameters["gear_ratio"])


def speed_role(name: str, columns: Columns, parameters: Mapping[str, float]) -> tuple[str, float]:
    """(role of the best speed among the true `columns` of ride `name`, factor from it to m/s).

    Motor and wheel come before reported speeds. InputError if there is no speed.
    """
    factors = speed_factors(parameters["wheel_radius"], parameters["gear_ratio"])
    del factors["wheel_speed_front"]  # the discovery compares it with that of the driven wheel
    for role, factor in factors.items():
        if role in columns:
            return role, factor
    raise InputError(f"{name}: has no speed; it needs one of {', '.join(factors)}")
