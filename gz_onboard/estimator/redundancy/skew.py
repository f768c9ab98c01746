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

    __slots__ = ("_apart", "_moments", "_now")

    def __init__(self) -> None:
        self._now = 0.0  # s
        self._apart = 0.0  # s: by how much the two messages are, at most of late
        self._moments: deque[tuple[float, float | None, float | None]] = deque()  # s, both values

    def update(self, dt: float, first: float | None, second: float | None, apart: float) -> float | None:
        """By how much they differed a moment ago, at least, after `dt` [s]; None if nothing is known of that time.

        apart: the time of the one's message less that of the other's [s].
        """
        self._now += dt
        if first is not None and second is not None:
            self._apart = max(abs(apart), self._apart * (1 - min(dt / FORGOTTEN, 1.0)))
        skew, moments = self._apart + JITTER, self._moments
        moments.append((self._now, first, second))
        middle = next((i for i in range(len(moments) - 1, -1, -1) if moments[i][0] <= self._now - skew), None)
        if middle is None:
            return None
        time, first, second = moments[middle]
        while moments[0][0] < time - skew:
            moments.popleft()
        if first is None or second is None:
            return None
        near = [moment for moment in moments if moment[0] <= time + skew]
        return max(_outside(first, (of[2] for of in near)), _outside(second, (of[1] for of in near)))


def _outside(value: float, others: Iterable[float | None]) -> float:
    """By how much `value` is beyond the least and the greatest of the others."""
    known = [other for other in others if other is not None]
    return max(value - max(known), min(known) - value, 0.0)
