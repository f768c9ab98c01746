"""The riding of the last kilometres as few operating points: what the split of the range asks the model at.

Each second ridden falls into a bin of speed and acceleration. What is further back than `MEMORY` counts little, as it
does in the forecast. Hills count as if ridden there and back: by the mean square of their grade.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, field
from math import exp, inf, isfinite, sqrt

from gz_onboard.estimator.ridden import MEMORY, Second
from gz_onboard.physics.effect import MOVING

FADED_EVERY = 250.0  # m: the older riding is weighted down in such steps, as the segments of the forecast are
ROOT_STEP = 0.5  # sqrt(m/s): bins of speed are as wide as ever the square of this times what their number says
ACCELERATIONS = -0.8, -0.2, 0.2, 0.8  # m/s²: between the bins; braking, coasting, steady, and pulling away
STEEPEST = 0.3  # sine: no road is steeper
MOST_BINS = 200  # in a saved state: more than any speed has
MOST_SUM = 1e12  # of a saved sum


@dataclass(frozen=True, slots=True)
class Point:
    """Riding of one kind."""

    time: float  # s
    distance: float  # m
    speed: float  # m/s; moving, that of the mean square over the distance, as drag goes with it
    acceleration: float  # m/s²
    grade: float = 0.0  # sine, root of the mean square over the distance
    slope: float = 0.0  # sine, mean over the distance: who pulls away has his nose up
    lateral: float | None = None  # m/s², root of the mean square; None: not known
    cruise: int = 0  # the bin of its speed; negative standing
    returns: bool = True  # height and speed are given back; False: the points are a whole ride in themselves


@dataclass(slots=True)
class Bin:
    """Sums over the seconds in it."""

    time: float = 0.0  # s
    distance: float = 0.0  # m
    cubes: float = 0.0  # m³/s²: speed cubed, over time
    gained: float = 0.0  # m/s, of speed
    climb: float = 0.0  # m
    hills: float = 0.0  # m: grade squared, over distance
    lateral: float = 0.0  # m²/s³: lateral acceleration squared, over time
    lateral_time: float = 0.0  # s for which that is known

    def sums(self) -> list[float]:
        """All of them, in the order of the fields."""
        return list(astuple(self))


@dataclass
class Pattern:
    """The bins, and the way since they were last weighted down."""

    bins: dict[tuple[int, int], Bin] = field(default_factory=dict)
    since: float = 0.0  # m

    def add(self, second: Second, speed: float, acceleration: float) -> None:
        """A second at a mean `speed` [m/s] and `acceleration` [m/s²]."""
        key = _STANDING
        if speed > MOVING:
            key = cruise_of(speed), sum(acceleration > edge for edge in ACCELERATIONS)
        b = self.bins.get(key)
        if b is None:
            b = self.bins[key] = Bin()
        distance = max(second.distance, 0.0)
        b.time += second.seconds
        b.distance += distance
        b.cubes += speed * speed * distance
        b.gained += acceleration * second.seconds
        if distance:
            grade = min(max(second.climb / distance, -STEEPEST), STEEPEST)
            b.climb += grade * distance
            b.hills += grade * grade * distance
        b.lateral += second.lateral
        b.lateral_time += second.lateral_seconds
        self.since += distance
        if self.since >= FADED_EVERY:
            self._fade()

    def _fade(self) -> None:
        share = exp(-self.since / MEMORY)
        self.since = 0.0
        for key, b in self.bins.items():
            self.bins[key] = Bin(*(share * x for x in b.sums()))

    def points(self) -> tuple[Point, ...]:
        """What was ridden; none if nothing was."""
        return tuple(_point(key, b) for key, b in sorted(self.bins.items()) if b.time > 0)

    def snapshot(self) -> list[list[float]]:
        """What is to be kept over a restart."""
        return [[*key, *b.sums()] for key, b in self.bins.items()]


_STANDING = -1, 0


def cruise_of(speed: float) -> int:
    """The bin of a `speed` [m/s]."""
    return int(sqrt(speed) / ROOT_STEP)


def _point(key: tuple[int, int], b: Bin) -> Point:
    lateral = sqrt(b.lateral / b.lateral_time) if b.lateral_time else None
    if key == _STANDING:
        return Point(b.time, b.distance, 0.0, 0.0, lateral=lateral, cruise=-1)
    speed, grade = sqrt(b.cubes / b.distance), sqrt(b.hills / b.distance)
    slope = min(max(b.climb / b.distance, -grade), grade)
    return Point(b.distance / speed, b.distance, speed, b.gained / b.time, grade, slope, lateral, cruise=key[0])


def restored_pattern(saved: Iterable[Sequence[float]]) -> Pattern:
    """What `Pattern.snapshot` gave; TypeError or ValueError if it is not that."""
    pattern = Pattern()
    for speed, acceleration, *sums in saved:
        b = Bin(*(float(x) for x in sums))
        key = int(speed), int(acceleration)
        moving = key != _STANDING
        plausible = all(isfinite(x) and abs(x) < MOST_SUM for x in b.sums()) and 0 < b.time < inf
        plausible &= 0 <= b.hills <= STEEPEST**2 * b.distance * (1 + 1e-9) and b.lateral >= 0
        if not plausible or (moving and not (b.distance > 0 and b.cubes > 0)):
            raise ValueError("implausible pattern of the riding")
        pattern.bins[key] = b
    if len(pattern.bins) > MOST_BINS:
        raise ValueError("implausible pattern of the riding")
    return pattern
