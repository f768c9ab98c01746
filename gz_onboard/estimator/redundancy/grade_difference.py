"""How far two witnesses of the grade are apart over distance, and what of it is usual for this vehicle."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

NEAR, FAR, USUAL = 300.0, 1000.0, 3000.0  # m over which the difference is taken: at once, surely, and as usual
MOST_USUAL = 0.05  # sine: 3 degrees of mounting


class Limits(NamedTuple):
    """Differences of two grades (sines) that contradict each other."""

    near: float  # over `NEAR`
    far: float  # over `FAR`
    unknown: float  # over `NEAR` while it is not known what is usual


class DistanceMean:
    """A mean over distance that forgets over `length` [m]; with `whole`, the plain mean until so much was ridden."""

    __slots__ = ("distance", "length", "value", "whole")

    def __init__(self, length: float, whole: bool = False) -> None:
        self.length, self.whole = length, whole
        self.value = self.distance = 0.0

    def add(self, distance: float, total: float) -> None:
        """`total` over the next `distance` [m]."""
        self.distance += distance
        length = min(self.distance, self.length) if self.whole else self.length
        self.value += (total - self.value * distance) / length


class GradeDifference:
    """How far two witnesses of the grade are apart, over some hundred metres and over a kilometre."""

    def __init__(self) -> None:
        self.near, self.far = DistanceMean(NEAR), DistanceMean(FAR)
        self._usual = DistanceMean(USUAL, whole=True)
        self._waiting: deque[tuple[float, float]] = deque()  # (distance, climb) [m] not yet in `_usual`
        self._distance = 0.0  # m of it

    @property
    def usual(self) -> float:
        """What it usually is: how the accelerometer is mounted, what the model and the wind make."""
        return min(max(self._usual.value, -MOST_USUAL), MOST_USUAL) if self.known else 0.0

    @property
    def known(self) -> bool:
        """Whether it is known what is usual."""
        return self._usual.distance >= FAR

    def add(self, distance: float, climb: float) -> None:
        """`climb` [m]: of the one less that of the other over `distance` [m]."""
        self.near.add(distance, climb)
        self.far.add(distance, climb)

    def learn(self, distance: float, climb: float) -> None:
        """Take this for usual, once `FAR` more was ridden and nothing was wrong with it."""
        self._waiting.append((distance, climb))
        self._distance += distance
        while self._distance > FAR:
            old = self._waiting.popleft()
            self._distance -= old[0]
            self._usual.add(*old)

    def doubt(self) -> None:
        """What was to become usual is doubted."""
        self._waiting.clear()
        self._distance = 0.0

    def beyond(self, limits: Limits, share: float = 1.0) -> float:
        """The difference from what is usual if it is beyond a `share` of the limits, else 0."""
        near = share * (limits.near if self.known else limits.unknown)
        if abs(self.near.value - self.usual) > near:
            return self.near.value - self.usual
        far = share * limits.far if self.known else MOST_USUAL
        return self.far.value - self.usual if abs(self.far.value - self.usual) > far else 0.0
