"""The riding of the last kilometres as few operating points, at which the explanation of the range asks the model.

Each second ridden falls into a bin of speed and acceleration. Older riding fades as in the learner. Hills count as if
ridden there and back: by the mean square of their grade.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, field
from math import sqrt

from gz_onboard.physics.effect import MOVING

ROOT_STEP = 0.5  # sqrt(m/s): bins of speed are about as wide as the root of the speed
ACCELERATIONS = -0.8, -0.2, 0.2, 0.8  # m/s²: between the bins; braking, coasting, steady, and pulling away
STEEPEST = 0.3  # sine: no road is steeper
MOST_BINS = 200  # in a saved state: more than any speed has
_STANDING = -1, 0


@dataclass(frozen=True, slots=True)
class Point:
    """Riding of one kind."""

    time: float  # s
    distance: float  # m
    speed: float  # m/s; moving, that of the mean square over the distance, as drag goes with it
    acceleration: float  # m/s²
    grade: float = 0.0  # sine, root of the mean square over the distance
    slope: float = 0.0  # sine, mean over the distance: a vehicle that pulls away has its nose up
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

    def point(self, key: tuple[int, int]) -> Point:
        """The mean of the riding in this bin, `key`."""
        lateral = sqrt(self.lateral / self.lateral_time) if self.lateral_time else None
        if key == _STANDING:
            return Point(self.time, self.distance, 0.0, 0.0, lateral=lateral, cruise=-1)
        speed, grade = sqrt(self.cubes / self.distance), sqrt(self.hills / self.distance)
        slope = min(max(self.climb / self.distance, -grade), grade)
        return Point(
            self.distance / speed, self.distance, speed, self.gained / self.time, grade, slope, lateral, cruise=key[0]
        )


@dataclass
class Pattern:
    """Bins by numbers of speed and acceleration."""

    bins: dict[tuple[int, int], Bin] = field(default_factory=dict)

    def add(self, dt: float, motion: tuple[float, float, float | None], distance: float, climb: float) -> None:
        """Take in `dt` [s] of riding, `distance` and `climb` [m].

        motion: mean speed [m/s], acceleration and lateral acceleration [m/s²], the last None if unknown.
        """
        speed, acceleration, lateral = motion
        key = _STANDING
        if speed > MOVING:
            key = cruise_of(speed), sum(acceleration > edge for edge in ACCELERATIONS)
        b = self.bins.setdefault(key, Bin())
        distance = max(distance, 0.0)
        b.time += dt
        b.distance += distance
        b.cubes += speed * speed * distance
        b.gained += acceleration * dt
        if distance:
            grade = min(max(climb / distance, -STEEPEST), STEEPEST)
            b.climb += grade * distance
            b.hills += grade * grade * distance
        if lateral is not None:
            b.lateral += lateral * lateral * dt
            b.lateral_time += dt

    def fade(self, share: float) -> None:
        """Weight all down to `share`."""
        for key, b in self.bins.items():
            self.bins[key] = Bin(*(share * x for x in astuple(b)))

    def points(self) -> tuple[Point, ...]:
        """What was ridden; none if nothing was."""
        return tuple(b.point(key) for key, b in sorted(self.bins.items()) if b.time > 0)

    def snapshot(self) -> list[list[float]]:
        """State to be kept over a restart."""
        return [[*key, *astuple(b)] for key, b in self.bins.items()]


def cruise_of(speed: float) -> int:
    """Number of the bin of a `speed` [m/s]."""
    return int(sqrt(speed) / ROOT_STEP)


def restored_pattern(saved: Iterable[Sequence[float]]) -> Pattern:
    """A pattern out of its `snapshot`; TypeError or ValueError for anything else."""
    pattern = Pattern()
    for speed, acceleration, *sums in saved:
        b = Bin(*(float(x) for x in sums))
        key = int(speed), int(acceleration)
        plausible = all(abs(x) < 1e12 for x in astuple(b)) and b.time > 0 and b.lateral >= 0
        plausible &= 0 <= b.hills <= STEEPEST**2 * b.distance * (1 + 1e-9)
        if not plausible or (key != _STANDING and not (b.distance > 0 and b.cubes > 0)):
            raise ValueError("implausible pattern of the riding")
        pattern.bins[key] = b
    if len(pattern.bins) > MOST_BINS:
        raise ValueError("implausible pattern of the riding")
    return pattern
