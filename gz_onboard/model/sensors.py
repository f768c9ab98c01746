"""Readings of the vehicle's sensors, corrected for the offset, gain and scale that its file gives.

The functions take floats and arrays alike; `parameters` are those of the vehicle.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gz_onboard.constants import GRAVITY
from gz_onboard.events import SPEEDS

VIBRATION_PERIOD_S = 0.1  # slower acceleration is the vehicle's own motion
VIBRATION_MEMORY_S = 2.0  # over which the mean of the square goes


def true_current(reading: Any, parameters: Mapping[str, float]) -> Any:
    """The pack's current [A] at a `reading` [A] of its sensor."""
    return (reading - parameters["pack_current_offset"]) / parameters["pack_current_gain"]


def true_voltage(reading: Any, parameters: Mapping[str, float]) -> Any:
    """The pack's voltage [V] at a `reading` [V] of its sensor."""
    return reading - parameters["pack_voltage_offset"]


def grade_shown(forward: Any, acceleration: Any) -> Any:
    """Sine of the road's angle by a forward accelerometer, which shows gravity too; both [m/s²]."""
    return (forward - acceleration) / GRAVITY


def speed_factors(radius: float, gear: float) -> dict[str, float]:
    """Factors from a true speed to m/s, by role, the best first. radius: of the wheel [m]. gear: wheel over motor."""
    return dict(zip(SPEEDS, (radius * gear, radius, radius, 1.0, 1.0), strict=True))
