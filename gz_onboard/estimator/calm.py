"""The range that is shown: it moves as the vehicle does, and draws near to the newest forecast over some distance.

The errors of successive forecasts are nearly the same error: within `CALM` the riding to come is not known any better.
So what is ridden is taken off what was shown, and of the gap that is left to the forecast a share is closed with each
metre: the Kalman filter of a constant (ridden plus remaining) seen through an error that fades over `CALM`. It closes
faster
- at first, while the forecast itself follows each kilometre: over as much riding as the forecast is known from;
- near empty, where the forecast's error goes as its range does: over a third of that.

At standstill, and over a restart, the shown range keeps its ratio to the forecast. So energy that is drawn or charged,
and a state of charge that was corrected, show at once. While riding only a step of the energy by more than `STEP` from
one forecast to the next does, which no riding makes: a state of charge that was begun anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import exp
from typing import Any

CALM = 6000.0  # m
NEAR_EMPTY = 3.0  # the gap closes over the range over this
FIRST = 250.0  # m, over which it closes at first
STEP = 0.05  # of the energy that is left
RATIO = 0.2, 5.0  # shown over forecast: beyond, it is not kept


class Calm:
    """Follows the forecast's range."""

    def __init__(self, ratio: float = 1.0) -> None:
        self.ratio = ratio  # shown over forecast
        self._before: tuple[float, float] | None = None  # the last forecast's range [m] and energy [J]
        self._ridden = 0.0  # m since

    def ride(self, distance: float) -> None:
        """`distance` [m] was ridden."""
        self._ridden += distance

    def follow(self, raw: float, energy: float, known: float) -> float:
        """The range to show [m] for a forecast of `raw` [m] with `energy` [J], from so much riding `known` [m]."""
        before, ridden = self._before, self._ridden
        self._before, self._ridden = (raw, energy), 0.0
        if before is None or ridden == 0 or min(raw, *before) <= 0 or abs(energy - before[1]) > STEP * before[1]:
            return raw * self.ratio
        length = max(min(known, CALM, raw / NEAR_EMPTY), FIRST)
        gap = (before[0] * self.ratio - ridden - raw) * exp(-ridden / length)
        self.ratio = min(max(1 + gap / raw, RATIO[0]), RATIO[1])
        return raw * self.ratio


def restored_ratio(saved: Mapping[str, Any]) -> float:
    """The ratio that was saved as `shown`, 1 where none was; TypeError or ValueError if it is implausible."""
    ratio = float(saved.get("shown", 1.0))
    if not RATIO[0] <= ratio <= RATIO[1]:
        raise ValueError("implausible range shown")
    return ratio
