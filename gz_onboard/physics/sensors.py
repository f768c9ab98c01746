"""Readings of the vehicle's sensors, corrected for the offset, gain and scale that its file gives.

The functions take floats and arrays alike; `parameters` are those of the vehicle.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import exp
from typing import TYPE_CHECKING, Any

from gz_onboard.constants import GRAVITY
from gz_onboard.errors import InputError
from gz_onboard.events import SPEEDS

if TYPE_CHECKING:
    from gz_onboard.arrays import Array

    Columns = Mapping[str, tuple[Array, Array]]

VIBRATION_PERIOD_S = 0.1  # slower acceleration is the vehicle's own motion
VIBRATION_MEMORY_S = 2.0  # over which the mean of the square goes


def true_current(reading: Any, parameters: Mapping[str, float]) -> Any:
    """The pack's current [A] at a `reading` [A] of its sensor."""
    return (reading - parameters["pack_current_offset"]) / parameters["pack_current_gain"]


def true_voltage(reading: Any, parameters: Mapping[str, float]) -> Any:
    """The pack's voltage [V] at a `reading` [V] of its sensor."""
    return reading - parameters["pack_voltage_offset"]


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


def grade_shown(forward: Any, acceleration: Any) -> Any:
    """Sine of the road's angle by a forward accelerometer, which shows gravity too; both [m/s²]."""
    return (forward - acceleration) / GRAVITY


def speed_factors(radius: float, gear: float) -> dict[str, float]:
    """Factors from a true speed to m/s, by role, the best first. radius: of the wheel [m]. gear: wheel over motor."""
    return dict(zip(SPEEDS, (radius * gear, radius, radius, 1.0, 1.0), strict=True))


def speed_role(name: str, columns: Columns, parameters: Mapping[str, float]) -> tuple[str, float]:
    """(role of the best speed among the true `columns` of ride `name`, factor from it to m/s).

    Motor and wheel come before reported speeds. InputError if there is no speed.
    """
    factors = speed_factors(parameters["wheel_radius"], parameters["gear_ratio"])
    del factors["wheel_speed_front"]  # the discovery compares it with that of the driven wheel
    for role, factor in factors.items():
        if role in columns:
            return role, factor
    raise InputError(f"{name}: has no speed: none of {', '.join(factors)}")


class Vibration:
    """RMS [m/s²] of the vertical acceleration faster than `VIBRATION_PERIOD_S`, over about `VIBRATION_MEMORY_S`.

    For samples at 30 Hz or more. Two first-order filters, each exact for any time between samples. The estimator, the
    discovery and the simulated sensors share this definition of how rough a road is.
    """

    __slots__ = ("_mean", "_square", "_step", "_weights")

    def __init__(self) -> None:
        self._mean: float | None = None
        self._square = 0.0
        self._step = 0.0
        self._weights = (0.0, 0.0)

    def update(self, dt: float, accel_z: float) -> None:
        """Add a sample [m/s²], `dt` [s] after the last."""
        if self._mean is None:
            self._mean = accel_z
            return
        if abs(dt - self._step) > 1e-4:  # samples come evenly: the weights hold for most of them
            self._step, self._weights = dt, (1 - exp(-dt / VIBRATION_PERIOD_S), 1 - exp(-dt / VIBRATION_MEMORY_S))
        fast, slow = self._weights
        self._mean += fast * (accel_z - self._mean)
        self._square += slow * ((accel_z - self._mean) ** 2 - self._square)

    @property
    def value(self) -> float:
        """The RMS [m/s²]."""
        return float(self._square**0.5)
