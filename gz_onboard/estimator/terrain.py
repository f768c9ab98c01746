"""How far roads climb or fall for good, where no route tells the hills ahead.

What a hill takes it gives back, but for what is lost, and that is part of the price of a metre. The height that a way
ends above its begin is not: on unknown roads it is as likely as that below, and grows as a random walk does. How fast
is learned from the net climb over stretches of `STRETCH`, a mean of their squares that begins with a guess.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from math import isfinite, sqrt
from typing import Any

from gz_onboard.estimator.pattern import STEEPEST

STRETCH = 4000.0  # m
RATE = 0.05  # m² per m, of the altitudes of 32 trips of a car, 0 to 0.24 each; recorded rides of the scooter 0 to 0.05
WEIGHT = 2.0  # stretches that this guess counts for
REMEMBERED = 50.0  # stretches: of what is further back than 200 km less and less counts
MOST_UNSEEN = 0.2  # of a stretch: with more way whose grade was not seen it tells nothing
MOST_CLIMB = STEEPEST * STRETCH  # m


@dataclass(frozen=True, slots=True)
class Terrain:
    """What was learned, and the present stretch."""

    squares: float = 0.0  # m²: net climbs squared, over the stretches that count
    stretches: float = 0.0
    way: float = 0.0  # m, of the present one
    climb: float = 0.0  # m
    unseen: float = 0.0  # m

    @property
    def rate(self) -> float:
        """Variance of the height [m²] over each metre of the way."""
        return (WEIGHT * RATE * STRETCH + self.squares) / ((WEIGHT + self.stretches) * STRETCH)

    @property
    def share(self) -> float:
        """How much of `rate` was ridden: 0 to 1; the rest is the guess."""
        return self.stretches / (WEIGHT + self.stretches)

    @property
    def relative_sd(self) -> float:
        """Of the height's sd, as that of so many normal numbers is known."""
        return 1 / sqrt(2 * (WEIGHT + self.stretches))

    def ridden(self, way: float, climb: float, unseen: float) -> Terrain:
        """After `way` [m] that climbed by `climb` [m], but for `unseen` [m] of it whose grade was not seen."""
        way, climb, unseen = self.way + way, self.climb + climb, self.unseen + unseen
        if way < STRETCH:
            return Terrain(self.squares, self.stretches, way, climb, unseen)
        if unseen > MOST_UNSEEN * way or abs(climb) > STEEPEST * way:
            return Terrain(self.squares, self.stretches)
        keep = 1 - 1 / REMEMBERED
        return Terrain(keep * self.squares + climb * climb * STRETCH / way, keep * self.stretches + 1)

    def variance(self, way: float) -> float:
        """Of the height [m²] that the next `way` [m] ends above or below; on a short one the slope stays the same."""
        return self.rate * way * min(way / STRETCH, 1.0)

    def snapshot(self) -> dict[str, float]:
        """What is to be kept over a restart."""
        return asdict(self)


def restored_terrain(saved: Mapping[str, Any] | None) -> Terrain:
    """What `Terrain.snapshot` gave, None for an older version; KeyError, TypeError or ValueError if it is not that."""
    if saved is None:
        return Terrain()
    terrain = Terrain(**{name: float(saved[name]) for name in asdict(Terrain())})
    numbers = asdict(terrain).values()
    possible = min(terrain.squares, terrain.stretches, terrain.way, terrain.unseen) >= 0
    possible &= terrain.stretches <= REMEMBERED and terrain.way < STRETCH
    possible &= terrain.squares <= 2 * MOST_CLIMB**2 * terrain.stretches  # a stretch may end late, but not so late
    if not (possible and all(map(isfinite, numbers))):
        raise ValueError("implausible terrain")
    return terrain
