"""The speed that a rider would ride a route with."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from itertools import accumulate, pairwise

from gz_onboard.routes.route import Route

STEP_M = 5.0  # at most, between points of a profile


@dataclass(frozen=True)
class SpeedProfile:
    """Target `speed` [m/s] over `distance` [m] and the `time` [s] at which it is reached; tuples of one length.

    Acceleration is constant between points. The ride begins and ends at standstill: a rider who follows speed over
    distance must look a little ahead, or follow speed over time.
    """

    distance: tuple[float, ...]
    speed: tuple[float, ...]
    time: tuple[float, ...]

    def speed_at(self, distance: float) -> float:
        """Target speed [m/s] at `distance` [m]; 0 before the start and past the end."""
        if not 0.0 <= distance <= self.distance[-1]:
            return 0.0
        i = min(bisect_right(self.distance, distance), len(self.distance) - 1) - 1
        part = (distance - self.distance[i]) / (self.distance[i + 1] - self.distance[i])
        v0, v1 = self.speed[i], self.speed[i + 1]
        return math.sqrt(v0 * v0 + part * (v1 * v1 - v0 * v0))


def speed_profile(
    route: Route,
    *,
    lateral_acceleration: float = 2.5,
    acceleration: float = 1.2,
    deceleration: float = 1.5,
    top_speed: float = math.inf,
) -> SpeedProfile:
    """The fastest ride of `route`, from standstill to standstill, within its limits and the rider's.

    At the route's stops it comes to a halt, for no time. Speed stays within the speed limit, `top_speed` [m/s] and
    √(lateral_acceleration/|curvature|), everywhere and not only at points; it rises and falls with at most
    `acceleration` and `deceleration` (all in m/s²). Points are the route's and others between them.
    """
    distance = [0.0]
    curve: list[float] = [abs(route.curvature[0])]
    limit: list[float] = []  # square of the speed allowed in each interval
    for i, (d0, d1) in enumerate(pairwise(route.distance)):
        pieces = max(2, math.ceil((d1 - d0) / STEP_M))  # two at least: one interval would be standstill throughout
        fixed = min(route.speed_limit[i], top_speed) ** 2
        for k in range(1, pieces + 1):
            part = k / pieces
            distance.append(d0 + part * (d1 - d0) if k < pieces else d1)
            curve.append(abs(route.curvature[i] + part * (route.curvature[i + 1] - route.curvature[i])))
            sharpest = max(curve[-2:])
            limit.append(min(fixed, lateral_acceleration / sharpest if sharpest > 0 else math.inf))
    square = [0.0, *(min(pair) for pair in pairwise(limit)), 0.0]
    stops = {d for d, stop in zip(route.distance, route.stop, strict=False) if stop > 0}
    square = [0.0 if d in stops else v2 for d, v2 in zip(distance, square, strict=True)]
    lengths = [d1 - d0 for d0, d1 in pairwise(distance)]
    for i, length in enumerate(lengths):
        square[i + 1] = min(square[i + 1], square[i] + 2 * acceleration * length)
    for i, length in reversed(list(enumerate(lengths))):
        square[i] = min(square[i], square[i + 1] + 2 * deceleration * length)
    speed = [math.sqrt(v2) for v2 in square]
    durations = (2 * length / (v0 + v1) for length, (v0, v1) in zip(lengths, pairwise(speed), strict=True))
    return SpeedProfile(tuple(distance), tuple(speed), tuple(accumulate(durations, initial=0.0)))
