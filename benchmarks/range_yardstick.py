"""The usual estimators of range that ours is held against, and how an estimate is judged."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import norm

from gz_onboard.arrays import Array

FALLBACK = 45 * 3.6  # J/m: of an estimator that has nothing to go by yet
ROLLING = 25_000.0  # m, over which consumption is averaged
RESERVE = 0.15  # of the charge that a telematics module keeps back
SOME_WAY = 1000.0  # m, before which no mean is taken
OURS = {"ours": "gz_onboard", "route": "gz_onboard, with the route"}
BUT_FOR_HEIGHT = "height"  # no estimator: what none without a route can know, see `Truth.but_for_height`
NAMES = {
    **OURS,
    "rolling": "mean of 25 km, to 0 %",
    "rolling_reserve": "mean of 25 km, 15 % kept",
    "trip": "mean of the trip (VESC)",
    "rated": "SOC × rated range",
    "fixed": "45 Wh/km",
    BUT_FOR_HEIGHT: "all known but the height to come",
}


@dataclass
class Usual:
    """What estimators make of the BMS' percentage and of the power at the pack's terminals.

    capacity: rated [J]; rated_range: [m].
    """

    capacity: float
    rated_range: float
    energy: float = 0.0
    distance: float = 0.0
    _rows: deque[tuple[float, float]] = field(default_factory=deque)  # distance [m], energy [J]

    def ride(self, power: float, speed: float, dt: float) -> None:
        """Continue for `dt` [s] at `power` [W] and `speed` [m/s]."""
        self.energy += power * dt
        self.distance += speed * dt
        if not self._rows or self.distance - self._rows[-1][0] > 100:
            self._rows.append((self.distance, self.energy))
        while self.distance - self._rows[0][0] > ROLLING:
            self._rows.popleft()

    def ranges(self, soc: float) -> dict[str, float]:
        """By name [m], at the charge that the BMS shows."""
        way, energy = (self.distance - self._rows[0][0], self.energy - self._rows[0][1]) if self._rows else (0.0, 0.0)
        rolling = energy / way if way > SOME_WAY and energy > 0 else FALLBACK
        trip = self.energy / self.distance if self.distance > SOME_WAY and self.energy > 0 else FALLBACK
        left = soc * self.capacity
        return {
            "rolling": left / rolling,
            "rolling_reserve": max(soc - RESERVE, 0.0) * self.capacity / rolling,
            "trip": left / trip,
            "rated": soc * self.rated_range,
            "fixed": left / FALLBACK,
        }


def crps(value: float, low: float, high: float, true: float) -> float:
    """Continuous ranked probability score of a median and its P10 and P90, as two halves of normal distributions.

    By quantiles: twice the mean of the pinball losses (Gneiting & Raftery 2007, sec. 4.2).
    """
    share = (np.arange(200) + 0.5) / 200
    at = norm.ppf(share)
    ten = float(norm.ppf(0.9))
    quantiles = value + at * np.where(at < 0, value - low, high - value) / ten
    return float(2 * np.mean((share - (true < quantiles)) * (true - quantiles)))


def jumps(distance: Array, reach: Array) -> Array:
    """By how much ridden plus remaining moves over each kilometre [m]; (n,) both, distance rising."""
    at = np.arange(distance[0], distance[-1], 1000.0)
    whole: Array = np.interp(at, distance, np.add(distance, reach))
    return np.abs(np.diff(whole))
