"""The road under the scooter, or the roller of a chassis dynamometer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gz_onboard.model.functions import direction

Place = tuple[float, float, float]
"""(grade as the sine of the road's angle, curvature [1/m] positive to the left, headwind [m/s])."""
RoadProfile = Callable[[float], Place]
"""The road at a distance [m]."""


def straight(grade: float = 0.0, headwind: float = 0.0) -> RoadProfile:
    """A road without end or bend."""
    place = (grade, 0.0, headwind)
    return lambda distance: place


@dataclass(frozen=True)
class Dynamometer:
    """A chassis dynamometer: a roller of `inertia` [kg at its surface] that brakes with A + B·V + C·V² [N].

    On it there is no air, no grade and no front wheel; tyre and rear axle load are as on the road.
    """

    inertia: float
    a: float = 0.0  # N
    b: float = 0.0  # N·s/m
    c: float = 0.0  # N·s²/m²

    def absorbed(self, speed: Any) -> Any:
        """The force [N] at a surface speed [m/s]."""
        return self.a * direction(speed) + self.b * speed + self.c * speed * abs(speed)
