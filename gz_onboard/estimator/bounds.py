"""Between which the numbers of a saved state can be."""

from __future__ import annotations

import sys
from collections.abc import Mapping

from gz_onboard.estimator.motion import MOTION

BOUNDS = {
    "soc": (0.0, 1.0),
    "v1": (-1.0, 1.0),  # V of a cell
    "current": (-1e4, 1e4),  # A
    "odometer": (-1e3, 1e10),  # m
    "own_soc": (-0.1, 1.1),
    "consumption": (-1e5, 1e5),  # J/m
    "gyro_bias": (-MOTION.max_gyro_bias, MOTION.max_gyro_bias),
    "still": (0.0, 1e10),  # s
    "time_moving": (0.0, 1e7),  # s
    "gap": (-1e6, 1e6),  # m
    "forecast": (0.0, 1e12),  # m, J
}
"""Between which a saved number can be, by its name; one without has to be finite."""


def within(name: str, saved: object) -> None:
    """ValueError if a number in `saved`, which has this name, is out of its bounds."""
    if isinstance(saved, Mapping):
        for each, value in saved.items():
            within(each, value)
    elif isinstance(saved, list | tuple):
        for value in saved:
            within(name, value)
    elif isinstance(saved, int | float):
        low, high = BOUNDS.get(name, (-sys.float_info.max, sys.float_info.max))
        if not low <= saved <= high:
            raise ValueError(f"its {name} cannot be")
