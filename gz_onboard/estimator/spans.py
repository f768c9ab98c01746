"""The ride in spans of three seconds, with the grade of the same road: what the road load is learned from.

In one second the edges of each acceleration count: pack power and speed are not of quite the same time, and what starts
within it looks like less mass (by 10 kg of 190 on rides of the tests' plant; three seconds by none that was seen). The
grade is that of `GRADE_TIME` later, by which the accelerometer's low pass lags: taken at once, hills of some hundred
metres are half of what they are.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import sqrt
from typing import NamedTuple

from gz_onboard.estimator.road import GRADE_TIME

SECOND = 1.0  # s
SECONDS = 3  # of a span
LEAST_DISTANCE = 1.0  # m: over less the speeds at both ends tell no acceleration


class Motion(NamedTuple):
    """What is known of one step; SI units."""

    seconds: float
    speed: float
    acceleration: float
    grade: float | None  # sine, low-passed; None: not known
    power: float  # W, at the pack's terminals
    braked: bool  # a brake may take what no sensor shows
    lateral: float  # m/s²; 0 if it is not known


@dataclass(slots=True)
class Second:
    """Sums over a second or so. `slow`: the acceleration as the grade's low pass has it."""

    before: float  # m/s, at its begin
    seconds: float = 0.0
    distance: float = 0.0
    energy: float = 0.0  # J
    sideways: float = 0.0  # m²/s³
    grade: float = 0.0  # s
    slow: float = 0.0  # m/s
    braked: bool = False
    blind: bool = False  # no sensor showed the grade
    after: float = 0.0  # m/s, at its end


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
    """Gathers steps."""

    def __init__(self) -> None:
        self._second: Second | None = None
        self._waiting: deque[Second] = deque()
        self._span: list[Second] = []
        self._slow = 0.0  # m/s²

    def pause(self) -> None:
        """What was being gathered is left."""
        self._second = None
        self._waiting.clear()
        self._span.clear()

    def add(self, m: Motion, period: float) -> Span | None:
        """A step; gives a span each three seconds, or three of the `period` [s] of the speed if that is longer."""
        s = self._second
        if s is None:
            s = self._second = Second(m.speed)
        dt = m.seconds
        s.seconds += dt
        s.distance += m.speed * dt
        s.energy += m.power * dt
        s.sideways += m.lateral * m.lateral * dt
        self._slow += (m.acceleration - self._slow) * min(dt / GRADE_TIME, 1.0)
        s.slow += self._slow * dt
        s.braked = s.braked or m.braked
        if m.grade is None:
            s.blind = True
        else:
            s.grade += m.grade * dt
        if s.seconds < max(SECOND, period):
            return None
        s.after = m.speed
        self._second = Second(m.speed)
        self._waiting.append(s)
        if len(self._waiting) <= max(round(GRADE_TIME / s.seconds), 1):
            return None
        then = self._waiting.popleft()
        then.grade, then.slow, then.blind = s.grade / s.seconds, s.slow / s.seconds, s.blind
        self._span.append(then)
        if len(self._span) < SECONDS:
            return None
        span, self._span = _span(self._span), []
        return span


def _span(parts: list[Second]) -> Span:
    seconds, distance = sum(s.seconds for s in parts), sum(s.distance for s in parts)
    before, after = parts[0].before, parts[-1].after
    ways = [s.distance for s in parts] if distance > LEAST_DISTANCE else [s.seconds for s in parts]
    way = sum(ways)
    far = distance > LEAST_DISTANCE
    return Span(
        seconds,
        distance,
        distance / seconds,
        (after * after - before * before) / 2 / distance if far else (after - before) / seconds,
        None if any(s.blind for s in parts) else sum(s.grade * w for s, w in zip(parts, ways, strict=True)) / way,
        sum(s.slow * w for s, w in zip(parts, ways, strict=True)) / way,
        sum(s.energy for s in parts) / seconds,
        any(s.braked for s in parts),
        sqrt(sum(s.sideways for s in parts) / seconds),
    )
