"""What was ridden: segments, the second that is being gathered, and sums over the segments so far."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import exp, isfinite
from typing import Any

from gz_onboard.estimator.load_model import EffectInputs
from gz_onboard.physics.effect import MOVING

MEMORY = 12000.0  # m: what is further back counts for less than 1/e
MOST_SEGMENTS = 200  # 50 km: of what is further back nothing counts
RECENT = 1000.0  # m: what a rider calls his consumption
FACTOR = 0.1, 10.0  # measured over modelled energy: a heated van in a jam has 5; beyond, parameters are wrong
# What a saved segment can have at most: m, s, J, W²·s and J; time moving in s.
MOST_DISTANCE, MOST_DURATION, MOST_ENERGY, MOST_TIME_MOVING = 1e5, 1e6, 1e12, 1e7


@dataclass(slots=True)
class Segment:
    """Some distance of the ride. Energies in J at the pack's terminals."""

    distance: float = 0.0  # m
    duration: float = 0.0  # s
    measured: float = 0.0
    squares: float = 0.0  # W²·s, of the measured power
    modelled: float = 0.0
    level: float = 0.0  # modelled, less what height and speed have stored: its hills and stops, but back where it began
    unseen: float = 0.0  # m of which no sensor showed the grade
    learned: tuple[float, float] | None = None  # the factor and its variance before it; None after a restart


@dataclass(slots=True)
class Second:
    """What is gathered until the model is asked."""

    seconds: float = 0.0
    distance: float = 0.0  # m, negative backwards
    energy: float = 0.0  # J
    squares: float = 0.0  # W²·s
    climb: float = 0.0  # m
    lateral: float = 0.0  # m²/s³: the square of the lateral acceleration
    lateral_seconds: float = 0.0  # for which that is known
    vibration: float = 0.0  # m²/s³: the square of the vibration
    vibration_seconds: float = 0.0  # for which that is known

    def add_inputs(self, dt: float, inputs: EffectInputs) -> None:
        """`dt` [s] of what an extended model reads."""
        if inputs.lateral_acceleration is not None:
            self.lateral += inputs.lateral_acceleration**2 * dt
            self.lateral_seconds += dt
        if inputs.vibration is not None:
            self.vibration += inputs.vibration**2 * dt
            self.vibration_seconds += dt


@dataclass
class Riding:
    """What is known of the riding: state of the forecast."""

    factor: float  # measured over modelled energy
    factor_variance: float
    segments: deque[Segment] = field(default_factory=lambda: deque(maxlen=MOST_SEGMENTS))
    current: Segment = field(default_factory=Segment)
    second: Second = field(default_factory=Second)
    time_moving: float = 0.0  # s since the start
    speed_before: float | None = None  # m/s, at the start of the second

    def add(self, dt: float, speed: float, grade: float | None, power: float, inputs: EffectInputs | None) -> None:
        """`dt` [s] at `speed` [m/s], `grade` (sine) and `power` [W]."""
        if self.speed_before is None:
            self.speed_before = speed
        second = self.second
        second.seconds += dt
        second.distance += speed * dt
        second.energy += power * dt
        second.squares += power * power * dt
        second.climb += (grade or 0.0) * speed * dt
        self.current.unseen += abs(speed) * dt if grade is None else 0.0
        if inputs:
            second.add_inputs(dt, inputs)
            if speed > MOVING:
                self.time_moving += dt

    def snapshot(self) -> dict[str, object]:
        """What is to be kept over a restart."""
        rows = [[s.distance, s.duration, s.measured, s.squares, s.modelled, s.level] for s in self.segments]
        return {
            "segments": rows,
            "factor": self.factor,
            "factor_variance": self.factor_variance,
            "time_moving": self.time_moving,
        }


def restored(saved: Mapping[str, Any]) -> Riding:
    """What `Riding.snapshot` gave; KeyError, TypeError or ValueError if it is not that."""
    segments = [Segment(a, b, c, d, e, f) for a, b, c, d, e, f in (map(float, row) for row in saved["segments"])]
    riding = Riding(factor=float(saved["factor"]), factor_variance=float(saved["factor_variance"]))
    riding.segments.extend(segments)
    riding.time_moving = float(saved["time_moving"])
    numbers = [x for s in segments for x in (s.measured, s.squares, s.modelled, s.level)]
    good = all(0 < s.distance < MOST_DISTANCE and 0 < s.duration < MOST_DURATION for s in segments) and all(
        abs(x) < MOST_ENERGY for x in numbers
    )
    if not good or not (FACTOR[0] <= riding.factor <= FACTOR[1] and 0 < riding.factor_variance < 1):
        raise ValueError("implausible riding")
    if not (0 <= riding.time_moving < MOST_TIME_MOVING):
        raise ValueError("implausible time moving")
    return riding


def restored_states(saved: Mapping[str, Any]) -> dict[str, float]:
    """The states of effects by name; KeyError, TypeError or ValueError if they are not numbers."""
    states = {str(name): float(x) for name, x in saved.items()}
    if not all(map(isfinite, states.values())):
        raise ValueError("implausible states of effects")
    return states


@dataclass(slots=True)
class Past:
    """Sums over the closed segments, each weighted by how far back it is."""

    level: float = 0.0  # J
    duration: float = 0.0  # s
    distance: float = 0.0  # m
    squares: float = 0.0  # J²/m: of the consumptions, by distance
    measured: float = 0.0  # J
    power_squares: float = 0.0  # W²·s
    recent: float = 0.0  # J, measured over the last kilometre
    recent_modelled: float = 0.0  # J
    recent_distance: float = 0.0  # m
    whole: float = 0.0  # m, unweighted

    @classmethod
    def of(cls, segments: Iterable[Segment]) -> Past:
        """The sums over `segments`, the latest first."""
        past = cls()
        for segment in segments:
            share = exp(-past.whole / MEMORY)
            past.whole += segment.distance
            past.level += share * segment.level
            past.duration += share * segment.duration
            past.measured += share * segment.measured
            past.power_squares += share * segment.squares
            past.distance += share * segment.distance
            past.squares += share * segment.level**2 / segment.distance
            if past.recent_distance < RECENT:
                past.recent += segment.measured
                past.recent_modelled += segment.modelled
                past.recent_distance += segment.distance
        return past

    @property
    def recent_factor(self) -> float:
        """Measured over modelled energy of the last kilometre or so; 1 while that is not known."""
        known = self.recent_distance >= RECENT and self.recent_modelled > 0
        return self.recent / self.recent_modelled if known else 1.0
