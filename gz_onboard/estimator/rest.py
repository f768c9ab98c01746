"""Whether the cells have rested: only then does their voltage show the state of charge.

After a load the voltage of a cell goes on rising for minutes to an hour: first fast (the RC pair of the cell model),
then slowly (diffusion, which the cell model does not have). What is still to come is bounded by how fast the voltage
moves: over a tail with the time constant T, slope times T. Before any load was seen, a slope that shows no fast tail
leaves at most what the cell model does not have; after a load only one that shows no slow tail either is a proof.
A voltage that was never seen to change proves nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import hypot, sqrt

REST_RATE = 0.05  # 1/h: current over capacity below which a cell counts as unloaded; standing with the key on is less
BLOCK = 2.0  # s over which the voltage is averaged
LONGEST = 900  # blocks: half an hour
SLOW_TIME = 1000.0  # s: time constant of slow diffusion in lithium-ion cells, a quarter of an hour or so
SLOW_SHARE = 0.7  # relative sd of that: it is from ten minutes to an hour
PROVEN = 1.5  # times what the cell model does not have: beyond, a slope proves no rest
ROUNDING = 12.0  # the square of a step over the variance of a value rounded to it
FIT_ALL = 6  # blocks: of fewer all are fitted, of more the later half
FAST_TIMES = 3.0  # time constants of the RC pair: the fast part is a mixture of some, too


class RestMonitor:
    """Follows the voltage of a cell, less what its resistance takes, while there is no load."""

    def __init__(self) -> None:
        self.coming = 0.0  # V of a cell that relaxation will still add
        self.sd: float | None = None  # V of a cell, of what it adds; None while nothing is proven
        self.fresh = False  # whether `sd` is of this step
        self.loaded = False  # ever
        self._resolution: float | None = None  # V: the smallest change ever seen
        self._last: float | None = None
        self._blocks: deque[tuple[float, float]] = deque(maxlen=LONGEST)  # mean [V], its variance [V²]
        self._begin()

    def _begin(self) -> None:
        self._time = self._sum = self._squares = 0.0
        self._count = 0

    def step(self, dt: float, voltage: float, emf: float, c_rate: float, fast_time: float, unmodelled: float) -> None:
        """Go `dt` [s] on.

        voltage: of a cell as measured [V]; emf: the same without the drop over R0 [V]; c_rate: current over capacity
        [1/h]; fast_time: time constant of the RC pair [s]; unmodelled: sd of what the cell model does not have [V].
        """
        self.fresh = False
        if self._last is not None and voltage != self._last:
            change = abs(voltage - self._last)
            self._resolution = min(change, self._resolution or change)
        self._last = voltage
        if abs(c_rate) > REST_RATE:
            self.loaded = True
            self.interrupt()
            return
        self._time += dt
        self._count += 1
        self._sum += emf
        self._squares += emf * emf
        if self._time < BLOCK or self._resolution is None or self._count < 2:
            return
        mean = self._sum / self._count
        variance = max(self._squares / self._count - mean * mean, 0.0) / (self._count - 1)
        self._blocks.append((mean, variance + self._resolution**2 / ROUNDING))
        self._begin()
        if len(self._blocks) >= 2:
            rate, noise = slope(self._blocks)
            self.coming, self.sd = SLOW_TIME * rate, SLOW_TIME * hypot(SLOW_SHARE * rate, noise)
            at_first = hypot(FAST_TIMES * fast_time * hypot(rate, noise), unmodelled)
            if not self.loaded and at_first < self.sd:
                self.coming, self.sd = 0.0, at_first
            elif self.sd > PROVEN * unmodelled:  # a fast tail, of which the slow one's time constant says nothing
                self.sd = None
            self.fresh = self.sd is not None

    def interrupt(self) -> None:
        """A load, or a pause in the data: begin anew."""
        if self.sd is not None or self._count:
            self._blocks.clear()
            self._begin()
            self.sd = None


def slope(blocks: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """How fast the voltage moves, and its sd [V/s]: from (mean [V], variance [V²]) of the later half of the blocks."""
    later = list(blocks)[len(blocks) // 2 if len(blocks) >= FIT_ALL else 0 :]
    n = len(later)
    middle = (n - 1) / 2
    spread = n * (n * n - 1) / 12  # Σ (i - middle)²
    line = sum((i - middle) * mean for i, (mean, _) in enumerate(later)) / spread
    noise = sqrt(sum(variance for _, variance in later) / n / spread)
    return line / BLOCK, noise / BLOCK
