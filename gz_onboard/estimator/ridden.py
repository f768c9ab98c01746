"""What was ridden: segments, the second that is being gathered, and sums over the segments so far."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from math import exp
from typing import Any

from gz_onboard.estimator.load_model import EffectInputs
from gz_onboard.estimator.usual import MOST_VARIANCE, Habit, Unit, Usual, restored_usual
from gz_onboard.physics.effect import MOVING

IN_DOUBT = 1.25  # of the difference that a sensor in doubt made: sd; price and stops may differ the same way
MEMORY = 12000.0  # m: what is further back counts for less than 1/e
MOST_SEGMENTS = 200  # 50 km: of what is further back nothing counts
RECENT = 1000.0  # m: what a rider calls his consumption
SHOWN_FROM = 500.0  # m: over less the recent consumption is that of one traffic light
LEAST_PRICE = 0.2  # of the prior riding: the price that a factor is weighted by
RIDE_ENDS = 600.0  # s without motion: what comes then is another ride
COLD_AGAIN = 3600.0  # s without motion: tyres have cooled, and what rolls begins anew
FACTOR = 0.1, 10.0  # measured over modelled energy: a heated van in a jam has 5; beyond, parameters are wrong
# What a saved segment can have at most: m, s, J, W²·s and J.
MOST_DISTANCE, MOST_DURATION, MOST_ENERGY = 1e5, 1e6, 1e12


@dataclass(slots=True)
class Segment:
    """Some distance of the ride. Energies in J at the pack's terminals."""

    distance: float = 0.0  # m
    duration: float = 0.0  # s
    measured: float = 0.0  # in motion
    squares: float = 0.0  # W²·s, of the measured power
    modelled: float = 0.0  # in motion
    level: float = 0.0  # modelled, less what height and speed have stored: its hills, but back where it began
    standing: float = 0.0  # measured, at stops
    unseen: float = 0.0  # m of which no sensor showed the grade
    climb: float = 0.0  # m, of the rest
    beside: float = 0.0  # J in motion of auxiliaries beyond the file's, and at stops: they are watts, of any way
    beside_standing: float = 0.0
    learned: Usual | None = None  # what was usual before it; None after a restart


KEPT = "distance", "duration", "measured", "squares", "modelled", "level", "standing", "unseen"
KEPT_ONCE = 6
"""What of a segment is saved; older versions have so many of them, the first."""


@dataclass(slots=True)
class Second:
    """What is gathered until the model is asked."""

    seconds: float = 0.0
    distance: float = 0.0  # m, negative backwards
    energy: float = 0.0  # J
    driven: float = 0.0  # J of it into the motor
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

    usual: Usual
    segments: deque[Segment] = field(default_factory=lambda: deque(maxlen=MOST_SEGMENTS))
    current: Segment = field(default_factory=Segment)
    second: Second = field(default_factory=Second)
    time_moving: float = 0.0  # s, since the start or the last long standstill
    speed_before: float | None = None  # m/s, at the start of the second
    still: float = 0.0  # s since the last motion
    coasted: float = 0.0  # m without the motor, of which road and bus leave something
    unexplained: float = 0.0  # J
    towed: bool = False  # so much that something else moves the vehicle

    @property
    def factor(self) -> float:
        """Measured over modelled energy of the present riding, without auxiliaries beyond the file's."""
        return min(max(self.usual.factor.now, FACTOR[0]), FACTOR[1])

    @property
    def factor_variance(self) -> float:
        """Of `factor`."""
        return self.usual.factor.variance

    def stand(self, dt: float) -> bool:
        """`dt` [s] without motion; gives whether the ride has ended with it: what follows is another."""
        riding, self.still = self.still < RIDE_ENDS, self.still + dt
        ended = riding and self.still >= RIDE_ENDS
        if ended:
            self.usual = self.usual.rested()
        if self.still >= COLD_AGAIN:
            self.time_moving = 0.0
        return ended

    def coast(self, unexplained: float | None, most: float) -> None:
        """Take in a second in which road and bus leave `unexplained` [J]; None: the motor drove. most: heights err."""
        left = 0.0 if unexplained is None else self.unexplained + unexplained
        self.unexplained = min(max(left, 0.0), 2 * most)
        self.coasted = self.coasted + abs(self.second.distance) if self.unexplained else 0.0
        self.towed = self.unexplained > most

    def take_back(self, distance: float) -> None:
        """Unlearn the last `distance` [m] or a little more."""
        distance -= self.current.distance
        self.current = Segment()
        while distance > 0 and self.segments and (before := self.segments[-1].learned):
            distance -= self.segments.pop().distance
            self.usual = before

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
        rows = [[getattr(segment, name) for name in KEPT] for segment in self.segments]
        return {"segments": rows, "usual": self.usual.snapshot(), "still": self.still, "time_moving": self.time_moving}


def restored(saved: Mapping[str, Any], prior: Usual, unit: Unit) -> Riding:
    """What `Riding.snapshot` gave; KeyError, TypeError or ValueError if it is not that. unit: see `restored_usual`.

    What older versions saved has stops within the rest of a segment, and of what is usual only the factor: the rest is
    taken from `prior`.
    """
    rows = [[float(x) for x in row] for row in saved["segments"]]
    if not all(KEPT_ONCE <= len(row) <= len(KEPT) for row in rows):
        raise ValueError("segments of another form")
    segments = []
    for row in rows:
        segments.append(Segment())
        for name, value in zip(KEPT, row, strict=False):
            setattr(segments[-1], name, value)
    if "usual" in saved:
        usual = restored_usual(saved["usual"], unit)
    else:
        factor = replace(prior.factor, usual=float(saved["factor"]), usual_variance=float(saved["factor_variance"]))
        usual = restored_usual(replace(prior, factor=factor).snapshot())
    riding = Riding(usual, still=float(saved.get("still", 0.0)))
    riding.segments.extend(segments)
    riding.time_moving = float(saved["time_moving"])
    numbers = [getattr(segment, name) for segment in segments for name in KEPT[2:]]
    good = all(0 < s.distance < MOST_DISTANCE and 0 < s.duration < MOST_DURATION for s in segments) and all(
        abs(x) < MOST_ENERGY for x in numbers
    )
    if not good or any(not 0 <= s.unseen <= s.distance * (1 + 1e-9) for s in segments):
        raise ValueError("implausible riding")
    return riding


def restored_states(saved: Mapping[str, Any]) -> dict[str, float]:
    """The states of effects by name; TypeError or ValueError if they are not numbers."""
    return {str(name): float(x) for name, x in saved.items()}


def learned(usual: Usual, segment: Segment, price: float, speed: float, height: float) -> Usual:
    """What is usual after `segment`. The prior riding costs `price` [J/m] in motion, at `speed` [m/s] with its stops.

    `height`: sd [J] of what hills that no sensor showed have stored; there the price is the model's, times the factor.
    The factor's residual is weighted by the energy that is to be expected, not by the segment's modelled: whose errors
    (of the grade) would draw the factor to 0.
    """
    way, unit, unseen = segment.distance, price * segment.distance, segment.unseen / segment.distance
    factor, likely = usual.factor.now, max(usual.price.now, LEAST_PRICE)
    measured, stood = segment.measured - segment.beside, segment.standing - segment.beside_standing
    paid = (1 - unseen) * (measured - segment.modelled) + ((1 - unseen) + unseen * factor) * segment.level
    excess = factor * (measured - factor * segment.modelled) / (likely * unit)
    return Usual(
        usual.price.learned(paid / unit - usual.price.now, way, unseen * unseen * usual.factor.variance),
        usual.standing.learned(stood / unit - usual.standing.now, way),
        usual.pace.learned(segment.duration * speed / way - usual.pace.now, way),
        usual.factor.learned(excess, way, (height * factor / (likely * unit)) ** 2),
    )


def unlearned(usual: Usual, seen: Usual) -> Usual:
    """What is `usual` without what a sensor taught that errs. `seen`: with it; that may be true all the same."""
    return Usual(*(_in_doubt(getattr(usual, f.name), getattr(seen, f.name).now) for f in fields(Usual)))


def _in_doubt(habit: Habit, seen: float) -> Habit:
    more = (IN_DOUBT * (seen - habit.now)) ** 2
    variance = min(habit.present_variance + more, max(habit.present_variance, MOST_VARIANCE))
    return replace(habit, present_variance=variance)


@dataclass(slots=True)
class Past:
    """Sums over the closed segments, each weighted by how far back it is."""

    level: float = 0.0  # J
    duration: float = 0.0  # s
    distance: float = 0.0  # m
    unseen: float = 0.0  # m of which no sensor showed the grade
    measured: float = 0.0  # J, stops included
    power_squares: float = 0.0  # W²·s
    recent: float = 0.0  # J, measured over the last kilometre, in motion
    recent_standing: float = 0.0  # J, the same, at stops
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
            past.distance += share * segment.distance
            past.unseen += share * segment.unseen
            past.measured += share * (segment.measured + segment.standing)
            past.power_squares += share * segment.squares
            if past.recent_distance < RECENT:
                past.recent += segment.measured
                past.recent_standing += segment.standing
                past.recent_modelled += segment.modelled
                past.recent_distance += segment.distance
        return past

    def recent_price(self, now: Segment) -> float | None:
        """Measured over the last kilometre or so, stops included [J/m], with the segment `now`; None: too short."""
        distance = self.recent_distance + now.distance
        if distance < SHOWN_FROM:
            return None
        return (self.recent + self.recent_standing + now.measured + now.standing) / distance

    @property
    def blind(self) -> float:
        """The share of the way whose hills no sensor showed."""
        return self.unseen / self.distance if self.distance else 0.0

    @property
    def recent_factor(self) -> float:
        """Measured over modelled energy of the last kilometre or so; 1 while that is not known."""
        known = self.recent_distance >= RECENT and self.recent_modelled > 0
        return self.recent / self.recent_modelled if known else 1.0
