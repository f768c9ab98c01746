"""Two sensors that do not sample at one time: what they differ by beyond what either moved meanwhile.

A value is held until the next message, so that of two messages is up to a period older than the other. Where what is
measured leaps, as a voltage does at full throttle, that is a difference of two times and not of two sensors. So each
moment is judged when what came before and after it is known.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

JITTER = 0.05  # s: messages come so much sooner or later than they were sampled
FORGOTTEN = 10.0  # s: after this a message that came late no longer says that messages do


class SkewedPair:
    """Compares a value of each with all of the other's within the time by which they are apart; so much later, too."""

    __slots__ = ("_apart", "_coming", "_judged", "_now")

    def __init__(self) -> None:
        self._now = 0.0  # s
        self._apart = 0.0  # s: by how much the two messages are, at most of late
        self._coming: deque[tuple[float, float | None, float | None]] = deque()  # s, both values; not judged yet
        self._judged: deque[tuple[float, float | None, float | None]] = deque()

    def update(
        self, dt: float, first: float | None, second: float | None, apart: float, least: float = 0.0
    ) -> float | None:
        """By how much they differed a moment ago, at least, after `dt` [s]; None if nothing is known of that time.

        apart: the time of the one's message less that of the other's [s]. Up to `least` it is the plain difference,
        which is no less.
        """
        self._now += dt
        if first is not None and second is not None:
            self._apart = max(abs(apart), self._apart * (1 - min(dt / FORGOTTEN, 1.0)))
        skew, coming, judged = self._apart + JITTER, self._coming, self._judged
        coming.append((self._now, first, second))
        while coming[0][0] <= self._now - skew:
            judged.append(coming.popleft())
        if not judged:
            return None
        time, first, second = judged[-1]
        while judged[0][0] < time - skew:
            judged.popleft()
        if first is None or second is None:
            return None
        if abs(first - second) <= least:
            return abs(first - second)
        near = [*judged, *(moment for moment in coming if moment[0] <= time + skew)]
        return max(_outside(first, (of[2] for of in near)), _outside(second, (of[1] for of in near)))


def _outside(value: float, others: Iterable[float | None]) -> float:
    """By how much `value` is beyond the least and the greatest of the others."""
    known = [other for other in others if other is not None]
    return max(value - max(known), min(known) - value, 0.0)
