"""What all checks share: the fault counter of a sensor, the limit on how fast a value changes, the interface."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from gz_onboard.estimator.signals import Signals

FAULTY_AFTER = 3.0  # s of contradiction: wheels spin and lock for a second or two
RECOVERED_AFTER = 60.0  # s of agreement
AGREEMENT_WEIGHT = 0.5  # s of contradiction that a second of agreement cancels
ROUNDING = 1e-9  # s, of a sum of steps
SETTLED = 30.0  # s: a signal that has held so long is not replaced by what contradicts it
AGREES = 0.5  # of a limit: what differs by no more agrees; between it and the limit nothing is proven
MOVING = 2.0  # m/s: below, wheel sensors lose their teeth, and a dead sensor is as right as any
STUCK_AFTER = 1.0  # s of one and the same value while others move
LONGEST_EVIDENCE = 1.0  # s: one value after a longer silence is no more evidence than this
NO_SENSOR: frozenset[str] = frozenset()


class StepInputs(NamedTuple):
    """One step of the estimator, before any of its signals is used."""

    now: float  # s, its end
    dt: float  # s since the last step
    observed: float  # s of `dt` in which something was received; what can have changed has all of it
    signals: Signals
    speed: float | None  # m/s, of the last step


class FaultCounter:
    """The evidence against one sensor."""

    __slots__ = ("agreed", "contradicted", "faulty")

    def __init__(self) -> None:
        self.contradicted = 0.0  # s, less `AGREEMENT_WEIGHT` of the time of agreement
        self.agreed = 0.0  # s of agreement since the last contradiction
        self.faulty = False

    def update(self, dt: float, contradicts: bool | None) -> None:
        """`dt` [s] in which the sensor contradicts, agrees, or (None) in which there is nothing to compare it with."""
        if contradicts:
            self.agreed = 0.0
            self.contradicted = min(self.contradicted + dt, FAULTY_AFTER)
            self.faulty |= self.contradicted >= FAULTY_AFTER - ROUNDING
        elif contradicts is not None:
            if self.contradicted:
                self.contradicted = max(self.contradicted - AGREEMENT_WEIGHT * dt, 0.0)
            self.agreed += dt
            if self.agreed >= RECOVERED_AFTER:
                self.faulty = False


class SensorCheck(Protocol):
    """A check of single sensors: sets `Signal.trusted` of its roles before they are used."""

    counters: dict[str, FaultCounter]

    def step(self, step: StepInputs) -> None:
        """Compare the values of this step."""


def counters(roles: tuple[str, ...]) -> dict[str, FaultCounter]:
    """A new counter for each role."""
    return {role: FaultCounter() for role in roles}


def faulty(counters: Mapping[str, FaultCounter]) -> frozenset[str]:
    """The roles whose sensors are faulty."""
    return frozenset(role for role, counter in counters.items() if counter.faulty)


def share_of_new(dt: float, time: float) -> float:
    """The share of a new value in a mean over `time` [s], of which `dt` [s] are new."""
    return min(dt / time, 1.0) if time > 0 else 1.0


class RateLimit:
    """What a slow signal can be by now: it follows the signal no faster than that can change.

    The first value is no better than any other: until the signal has held for `SETTLED` seconds, one that holds for
    longer takes its place.
    """

    __slots__ = ("_fall", "_other", "_rise", "_seconds", "_value")

    def __init__(self) -> None:
        self._value: float | None = None
        self._rise = self._fall = 0.0  # how far the signal can have gone since
        self._seconds = 0.0  # for how long it has held
        self._other: RateLimit | None = None  # of the values that could not follow it

    def update(self, dt: float, value: float | None, rise: float, jump: float, fall: float | None = None) -> bool:
        """Whether `value` is possible, `dt` [s] in which the signal rises by `rise` or falls by `fall`; None: silent.

        jump: by how much it may be off what it can be. fall: as `rise` if it is not given.
        """
        fall = rise if fall is None else fall
        self._rise, self._fall = self._rise + rise, self._fall + fall
        if value is None:
            return True
        if self._value is None:
            self._value = value
        near = min(max(value, self._value - self._fall), self._value + self._rise)
        if abs(value - near) <= jump:
            self._value, self._rise, self._fall, self._other = near, 0.0, 0.0, None
            self._seconds += dt
            return True
        if self._seconds >= SETTLED:
            return False
        if self._other is None or not self._other.update(dt, value, rise, jump, fall):
            self._other = RateLimit()
            self._other.update(0.0, value, rise, jump, fall)
        other = self._other
        if other._seconds <= self._seconds:
            return False
        self._value, self._rise, self._fall, self._other = other._value, 0.0, 0.0, None
        self._seconds = other._seconds
        return True
