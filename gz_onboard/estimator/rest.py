"""Whether the cells have rested: only then does their voltage show the state of charge.

After a load the voltage of a cell goes on rising for minutes to an hour: first fast (the RC pair of the cell model),
then slowly (diffusion, which the cell model has as slow relaxation, if at all). What is still to come is bounded by how
fast the voltage moves: over a tail with the time constant T, slope times T. Before any load was seen, a slope that
shows no fast tail leaves at most what the cell model does not have; after a load only one that shows no slow tail
either proves it. A voltage that was never seen to change proves nothing.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import hypot, inf, sqrt

from gz_onboard.estimator.cell_effects import CellEffects
from gz_onboard.estimator.ekf import SocFilter
from gz_onboard.estimator.start import SLOW_TIME, bounded, soc_width, update_soc
from gz_onboard.estimator.uncertainty import VoltageUncertainty
from gz_onboard.physics.battery import Battery

REST_RATE = 0.05  # 1/h: current over capacity below which a cell counts as unloaded; standing with the key on is less
BLOCK = 2.0  # s over which the voltage is averaged
LONGEST = 900  # blocks: half an hour
SLOW_SHARE = 0.7  # relative sd of SLOW_TIME: it is from ten minutes to an hour
PROVEN = 1.5  # times what the cell model does not have: beyond, a slope proves no rest
ROUNDING = 12.0  # the square of a step over the variance of a value rounded to it
FIT_ALL = 6  # blocks: of fewer all are fitted, of more the later half
REST_BETTER = 0.15  # of the sd that is known: a rest after a load is taken in only if its own is no more than this
REST_NEWS = 0.8  # a rest is taken in again when its variance fell below this share
FAST_TIMES = 3.0  # time constants of the RC pair: the fast part is a mixture of some, too


class RestMonitor:
    """Follows the voltage of a cell, without the drop over its R0, while there is no load."""

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

    def step(self, dt: float, emf: float, fast_time: float, unmodelled: float) -> None:
        """Go `dt` [s] on without a load.

        emf: voltage of a cell without the drop over R0 [V]; fast_time: time constant of the RC pair [s]; unmodelled:
        sd of what the cell model does not have [V].
        """
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
            elif self.sd > PROVEN * unmodelled:  # a fast tail: the slow time constant does not apply
                self.sd = None
            self.fresh = self.sd is not None

    def load(self, voltage: float, c_rate: float) -> bool:
        """Whether `c_rate` [1/h], current over capacity, is a load; voltage: of a cell, as measured with it [V]."""
        self.fresh = False
        if self._last is not None and voltage != self._last:
            change = abs(voltage - self._last)
            self._resolution = min(change, self._resolution or change)
        self._last = voltage
        if abs(c_rate) <= REST_RATE:
            return False
        self.loaded = True
        self.interrupt()
        return True

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


class RestUpdate:
    """Follows the rests of a pack, and what of the present one was taken in."""

    def __init__(self, battery: Battery, uncertainty: VoltageUncertainty, effects: CellEffects) -> None:
        self._battery, self._uncertainty, self._effects = battery, uncertainty, effects
        self._rest = RestMonitor()
        self._taken = inf  # V² of a cell: variance of what was taken in of this rest
        self.shown = False  # whether a rest has shown the state of charge yet

    def interrupt(self) -> None:
        """A pause in the data."""
        self._rest.interrupt()
        self._taken = inf

    def step(
        self, filter_: SocFilter, dt: float, voltage: float, current: float, temperature: float, voltage_sd: float
    ) -> bool:
        """Update with the `voltage` [V] of a rest that is better proven than before; gives whether it did.

        voltage, current [A] and voltage_sd [V]: of a cell, over `dt` [s] at `temperature` [degC].
        """
        battery, rest = self._battery, self._rest
        if rest.load(voltage, current / battery.cell_capacity(temperature)):  # as most of the time
            self._taken = inf
            return False
        emf = voltage + battery.r0.at(filter_.soc, temperature)[0] * current + self._effects.overpotential
        fast = battery.r1.at(filter_.soc, temperature)[0] * battery.c1.at(filter_.soc, temperature)[0]
        rest.step(dt, emf, fast, self._uncertainty.model)
        if rest.sd is None:
            self._taken = inf
            return False
        variance = rest.sd**2 + self._uncertainty.rest**2 + voltage_sd**2
        self.shown = True
        if not rest.fresh or variance > REST_NEWS * self._taken:
            return False
        emf += rest.coming
        # Curve and relaxation err the same way at every rest: that does not average out.
        better = REST_BETTER if rest.loaded and self._taken == inf else 1.0
        if better**2 * filter_.covariance[0] < (soc_width(battery, emf, sqrt(variance), temperature) / 2) ** 2:
            return False
        # The same rest again, only better known: what is new is the difference in information.
        new = 1 / (1 / variance - (0.0 if self._taken == inf else 1 / self._taken))
        self._taken = variance
        update_soc(
            filter_, battery.soc_at(emf, temperature), (soc_width(battery, emf, sqrt(new), temperature) / 2) ** 2
        )
        filter_.soc = bounded(filter_.soc)
        return True
