"""Voltage and current of one time, where the one comes later than the other."""

from __future__ import annotations

from collections import deque


class Synchroniser:
    """Keeps the one that comes first, and interpolates it. `latency` [s]: of the voltage; negative: of the current."""

    def __init__(self, latency: float) -> None:
        self.latency = latency
        self._recent: deque[tuple[float, float, float]] = deque()  # s, V, A of the pack

    def pair(self, now: float, voltage: float, current: float, pause: float) -> tuple[float, float] | None:
        """(voltage [V], current [A]) of one time; None if not yet, or over a gap longer than `pause` [s]."""
        recent, then = self._recent, now - abs(self.latency)
        recent.append((now, voltage, current))
        if recent[0][0] > then:
            return None
        while recent[1][0] <= then:
            recent.popleft()
        (t0, v0, i0), (t1, v1, i1) = recent[0], recent[1]
        if t1 - t0 > pause:
            return None
        share = (then - t0) / (t1 - t0)
        if self.latency > 0:
            return voltage, i0 + share * (i1 - i0)
        return v0 + share * (v1 - v0), current
