"""Whether the cells have rested: only then does their voltage show the state of charge.

After a load the voltage of a cell rises for minutes to an hour: first fast (the RC pair of the cell model), then slowly
(diffusion, which the cell model has as slow relaxation, if at all). The rise still to come is bounded by the slope of
the voltage: over a tail with the time constant T, slope times T. Before any load was seen, a slope that shows no fast
tail leaves at most the error of the cell model; after a load only one that shows no slow tail either proves it. A
voltage that was never seen to change proves nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, inf, sqrt

from gz_onboard.estimator.battery_priors import PRIOR


@dataclass(frozen=True)
class RestConfig:
    """Constants of the rest detector."""

    block_s: float = 2.0  # over which the voltage is averaged
    most_blocks: int = 900  # half an hour
    fit_all: int = 6  # blocks: of fewer all are fitted, of more the later half
    relaxation_sd: float = 0.7  # relative, of `relaxation_s`: it is from ten minutes to an hour
    proven: float = 1.5  # times the error of the cell model: beyond, a slope proves no rest
    fast_times: float = 3.0  # time constants of the RC pair: the fast part is a mixture of some
    better_sd: float = 0.15  # of the known sd: a rest after a load is used only if its own is no more than this
    news: float = 0.8  # a rest is used again when its variance fell below this share


REST = RestConfig()


class RestDetector:
    """Follows the voltage of a cell, without the drop over its R0, while there is no load."""

    def __init__(self) -> None:
        self.has_shown = False  # whether a rest has shown the state of charge yet
        self._is_loaded = False  # ever
        self._resolution = inf  # V: the smallest change ever seen
        self._last: float | None = None
        self._blocks: deque[tuple[float, float]] = deque(maxlen=REST.most_blocks)  # mean [V], its variance [V²]
        self.interrupt()

    def interrupt(self) -> None:
        """Start again: a load, or a gap in the data."""
        self._blocks.clear()
        self._time = self._sum = self._squares = 0.0
        self._count = 0
        self.used = inf  # V²: variance of the rest voltage as it was used last

    def step(
        self, dt: float, voltage: float, c_rate: float, emf: float, fast_s: float, model_sd: float
    ) -> tuple[float, float] | None:
        """Add the `voltage` of a cell over `dt` [s]; returns a new estimate of (its rise to come, sd) [V], if any.

        c_rate: current over capacity [1/h]; emf: voltage without the drop over R0 [V]; fast_s: time constant of the RC
        pair; model_sd: error of the cell model [V].
        """
        if self._last is not None and voltage != self._last:
            self._resolution = min(abs(voltage - self._last), self._resolution)
        self._last = voltage
        if abs(c_rate) > PRIOR.loaded_rate:
            self._is_loaded = True
            if self._count or self._blocks:
                self.interrupt()
            return None
        self._time, self._count = self._time + dt, self._count + 1
        self._sum, self._squares = self._sum + emf, self._squares + emf * emf
        if self._time < REST.block_s or self._resolution == inf or self._count < 2:
            return None
        mean = self._sum / self._count
        scatter = max(self._squares / self._count - mean * mean, 0.0) / (self._count - 1)
        self._blocks.append((mean, scatter + self._resolution**2 / 12))
        self._time = self._sum = self._squares = 0.0
        self._count = 0
        if len(self._blocks) < 2:
            return None
        rate, noise = slope(self._blocks)
        coming, sd = PRIOR.relaxation_s * rate, PRIOR.relaxation_s * hypot(REST.relaxation_sd * rate, noise)
        at_first = hypot(REST.fast_times * fast_s * hypot(rate, noise), model_sd)
        if not self._is_loaded and at_first < sd:
            coming, sd = 0.0, at_first
        elif sd > REST.proven * model_sd:  # a fast tail: the slow time constant does not apply
            self.used = inf
            return None
        self.has_shown = True
        return coming, sd

    def news(self, variance: float, soc_variance: float, width: float) -> float | None:
        """Variance [V²] of the part that is new in a rest voltage of this `variance` [V²]; None if it is not used.

        width: sd of SOC by the voltage. Curve and relaxation err the same way at every rest: that does not average out.
        """
        first = self.used == inf
        better = REST.better_sd if self._is_loaded and first else 1.0
        if variance > REST.news * self.used or better**2 * soc_variance < width * width:
            return None
        # The same rest again, only better known: the difference in information is new.
        new = 1 / (1 / variance - (0.0 if first else 1 / self.used))
        self.used = variance
        return new


def slope(blocks: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """(slope of the voltage, its sd) [V/s] from (mean [V], variance [V²]) of the later half of the blocks."""
    later = list(blocks)[len(blocks) // 2 if len(blocks) >= REST.fit_all else 0 :]
    n = len(later)
    middle, spread = (n - 1) / 2, n * (n * n - 1) / 12  # Σ (i - middle)²
    line = sum((i - middle) * mean for i, (mean, _) in enumerate(later)) / spread
    noise = sqrt(sum(variance for _, variance in later) / n / spread)
    return line / REST.block_s, noise / REST.block_s
