"""The ride in spans of three seconds, with the grade of the same road: what the road load is learned from.

In one second the edges of each acceleration count: pack power and speed are not of quite the same time, and what starts
within it looks like less mass (by 10 kg of 190 on rides of the tests' plant; three seconds by none that was seen). The
grade is that of `GRADE_TIME` later, by which the accelerometer's low pass lags: taken at once, hills of some hundred
metres are half of what they are.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import exp, sqrt

from gz_onboard.estimator.road import GRADE_TIME

SECONDS = 3  # of a span
LEAST_DISTANCE = 1.0  # m: over less the speeds at both ends tell no acceleration


@dataclass(slots=True)
class Second:
    """A second or so of riding, as long as the speed's period if that is longer; SI units."""

    seconds: float
    distance: float
    energy: float  # J, behind the pack's cable
    before: float  # m/s, at its begin
    after: float  # m/s, at its end
    grade: float | None  # sine, low-passed, at its end; None: not known
    lateral: float  # m/s²; 0 if it is not known
    braked: bool  # at its end: a brake may take what no sensor shows
    slow: float = 0.0  # m/s²: the acceleration as the grade's low pass has it


@dataclass(frozen=True, slots=True)
class Span:
    """Means over a span; SI units."""

    seconds: float
    distance: float
    speed: float
    acceleration: float  # that makes the kinetic energy what it became
    grade: float | None
    slow_acceleration: float  # see `Second`
    power: float
    braked: bool
    lateral: float  # root mean square


class Spans:
    """Gathers seconds."""

    def __init__(self) -> None:
        self._waiting: deque[Second] = deque()
        self._span: list[Second] = []
        self._after: float | None = None  # m/s, at the end of the last second
        self._slow, self._braked = 0.0, False  # m/s²; at its end

    def pause(self) -> None:
        """What was being gathered is left."""
        self._waiting.clear()
        self._span.clear()
        self._slow, self._braked = 0.0, False

    def add(self, second: Second) -> Span | None:
        """A second; gives a span each three of them."""
        if second.before != self._after:
            self.pause()
        rate = (second.after - second.before) / second.seconds
        self._slow += (rate - self._slow) * (1 - exp(-second.seconds / GRADE_TIME))
        second.slow, self._after = self._slow, second.after
        second.braked, self._braked = second.braked or self._braked, second.braked
        self._waiting.append(second)
        if len(self._waiting) <= max(round(GRADE_TIME / second.seconds), 1):
            return None
        then = self._waiting.popleft()
        then.grade, then.slow = second.grade, second.slow  # which lag
        self._span.append(then)
        if len(self._span) < SECONDS:
            return None
        span, self._span = _span(self._span), []
        return span


def _span(parts: list[Second]) -> Span:
    seconds, distance = sum(s.seconds for s in parts), sum(s.distance for s in parts)
    before, after = parts[0].before, parts[-1].after
    far = distance > LEAST_DISTANCE
    ways = [s.distance if far else s.seconds for s in parts]
    way = sum(ways)
    grades = [s.grade for s in parts if s.grade is not None]
    return Span(
        seconds,
        distance,
        distance / seconds,
        (after * after - before * before) / 2 / distance if far else (after - before) / seconds,
        sum(g * w for g, w in zip(grades, ways, strict=True)) / way if len(grades) == SECONDS else None,
        sum(s.slow * w for s, w in zip(parts, ways, strict=True)) / way,
        sum(s.energy for s in parts) / seconds,
        any(s.braked for s in parts),
        sqrt(sum(s.lateral * s.lateral * s.seconds for s in parts) / seconds),
    )
