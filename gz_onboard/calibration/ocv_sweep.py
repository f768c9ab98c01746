"""A slow discharge with the charge that belongs to it: which samples they are, and whether they can be compared."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.calibration.cell_data import CellTest
from gz_onboard.calibration.result import Result
from gz_onboard.constants import HOUR

SLOWEST_HOURS = 8.0  # a discharge faster than that is not slow
REST = 600.0  # s without current, after which a voltage is that of rest
REST_AT_BEGIN = 60.0  # s: the same where the file begins with it, as what was before is not in it
FULL_WITHIN = 0.01  # V: a charge that comes so near to the full cell's voltage is complete
UNEXPLAINED = 0.03  # of the capacity: what coulombic efficiency and a tester leave between the branches at most
MOST_APART = 0.1  # of the capacity: branches of charges that differ more are not of one cell between the same ends
ALIKE = 1.5  # currents of both branches whose ratio is smaller move them by the same voltage
SWITCHED, LONGEST_SWITCH = 120.0, 1000.0  # s after switching the current: where its step is read; no gap may be longer


@dataclass(frozen=True)
class OcvSweep:
    """A slow discharge, and the charge that belongs to it; `down` and `up` are their samples, `up` may be empty.

    own: whether the charge's state of charge is by its own charge, since that of the discharge does not agree.
    resistance [ohm]: within minutes of switching the current.
    """

    test: CellTest
    down: Mask
    up: Mask
    own: bool = False
    resistance: float = 0.0

    @cached_property
    def first(self) -> int:
        """The first row of the discharge."""
        return int(np.flatnonzero(self.down)[0])

    @cached_property
    def before(self) -> int:
        """The row before the discharge."""
        return max(self.first - 1, 0)

    @cached_property
    def rested(self) -> bool:
        """Whether the cell rested before the discharge."""
        rest = self.test.rested(self.before)
        return rest >= (REST_AT_BEGIN if rest == self.test.time[self.before] - self.test.time[0] else REST)

    @property
    def full(self) -> float:
        """The voltage of the full cell [V], at rest or as near to that as can be had."""
        volts = self.test.voltage
        return float(volts[self.before]) if self.rested else float(volts[self.first]) + self.resistive

    @cached_property
    def last(self) -> int:
        """The last row of the discharge."""
        return int(np.flatnonzero(self.down)[-1])

    @cached_property
    def capacity(self) -> float:
        """What is discharged [A·h]."""
        return float(self.test.drawn[self.last] - self.test.drawn[self.before])

    @property
    def uncharged(self) -> float:
        """What is drawn from the charge before the discharge to that after it [A·h]."""
        charging = np.flatnonzero((self.test.current < 0) & ~self.test.rest)
        begin, end = np.searchsorted(charging, [self.first, self.last])
        first = int(charging[begin - 1]) if begin else 0
        last = int(charging[end]) - 1 if end < len(charging) else -1
        return float(self.test.drawn[last] - self.test.drawn[first])

    @cached_property
    def charged(self) -> float:
        """What is brought back [A·h]."""
        rows = np.flatnonzero(self.up)
        return float(self.test.drawn[max(rows[0] - 1, 0)] - self.test.drawn[rows[-1]]) if len(rows) else 0.0

    @cached_property
    def level(self) -> Array:
        """The state of charge of each sample, 1 before the discharge."""
        level: Array = 1 - (self.test.drawn - self.test.drawn[self.before]) / self.capacity
        if self.own:
            drawn = self.test.drawn[self.up]
            level[self.up] = 1 - (drawn - drawn[-1]) / self.charged
        return level

    @cached_property
    def hours(self) -> float:
        """What the discharge takes."""
        return float(np.sum(self.test.dt[self.down])) / HOUR

    @cached_property
    def current(self) -> float:
        """The mean of the discharge [A]."""
        return float(np.mean(self.test.current[self.down]))

    @property
    def resistive(self) -> float:
        """How far resistance moves the discharge [V]."""
        return self.resistance * self.current


def find_sweep(test: CellTest, result: Result) -> OcvSweep:
    """The longest discharge of `test` and its charge, without that if it is no counterpart, which `result` then says.

    Raises InputError for no discharge, one that is too fast or in pieces, or a charge that no cell takes.
    """
    sweep = OcvSweep(test, *_branches(test))
    if not np.any(sweep.down):
        raise test.table.error("there is no discharge: its current must be positive")
    if sweep.hours < SLOWEST_HOURS:
        raise test.table.error(
            f"the discharge takes {sweep.hours:.1f} h: at such a current the voltage is not the open-circuit voltage; "
            f"at least {SLOWEST_HOURS:.0f} h (C/{SLOWEST_HOURS:.0f}) without a pause are needed"
        )
    if (whole := sweep.uncharged) > (1 + UNEXPLAINED) * sweep.capacity:
        raise test.table.error(
            f"{whole:.3f} A·h are drawn in pieces, {sweep.capacity:.3f} of it without a pause of {REST:.0f} s or more: "
            "the rests between are no part of a slow discharge, and its capacity would be that of the longest piece"
        )
    return _paired(replace(sweep, resistance=_resistance(sweep)), result)


def _paired(sweep: OcvSweep, result: Result) -> OcvSweep:
    """`sweep` without a charge that is no counterpart of its discharge, or with that by its own charge."""
    test, up = sweep.test, sweep.up
    if not np.any(up):
        return sweep
    share, current = sweep.charged / sweep.capacity, -float(np.mean(test.current[up]))
    reached = float(test.voltage[up].max())
    counts = f"the charge brings back {sweep.charged:.3f} of {sweep.capacity:.3f} A·h"
    if not sweep.current / ALIKE < current < sweep.current * ALIKE:
        why = f"the charge at {current:.3g} A is no counterpart of the discharge at {sweep.current:.3g} A"
    elif abs(share - 1) <= UNEXPLAINED or (share < 1 and reached <= sweep.full - FULL_WITHIN):
        return sweep
    elif abs(share - 1) <= MOST_APART:
        result.refusals.append(
            f"{test.name}: {counts}: they differ by {100 * abs(share - 1):.1f} %, of which coulombic efficiency and "
            f"tester explain {100 * UNEXPLAINED:.0f} % at most. The capacity is what was discharged, its sd holds the "
            "difference; each branch's state of charge is by its own charge"
        )
        return replace(sweep, own=True)
    elif share > 1:
        raise test.table.error(
            f"{counts}, over {100 * MOST_APART:.0f} % more: the discharge did not begin full or end empty, or a "
            "current is wrong"
        )
    else:
        why = (
            f"the charge reaches {reached:.3f} V, as full as the discharge began ({sweep.full:.3f} V), after "
            f"{sweep.charged:.3f} of {sweep.capacity:.3f} A·h: the branches do not close, their mean would be wrong"
        )
    result.refusals.append(f"{test.name}: {why}. The discharge alone is used, moved by its resistance")
    return replace(sweep, up=np.zeros(len(test), dtype=bool))


def _branches(test: CellTest) -> tuple[Mask, Mask]:
    """The longest discharge (by charge) and the longest charge after it, or before it if there is none after.

    A pause shorter than `REST` does not end them.
    """
    flows = np.sign(np.where(test.rest, 0.0, test.current))
    through, moving = flows.copy(), np.flatnonzero(flows)
    for a, b in pairwise(moving.tolist()):
        if b - a > 1 and flows[a] == flows[b] and test.time[b] - test.time[a] < REST:
            through[a:b] = flows[a]
    run = np.cumsum(np.concatenate([[True], through[1:] != through[:-1]]))

    def longest(sign: int, after: int = -1) -> Mask:
        mine = (flows == sign) & (np.arange(len(test)) > after)
        if not np.any(mine):
            return np.zeros(len(test), dtype=bool)
        amount = np.bincount(run[mine], np.abs(test.flowed * test.dt)[mine])
        return np.asarray(mine & (run == int(np.argmax(amount))))

    down = longest(1)
    after = longest(-1, int(np.flatnonzero(down)[-1]) if np.any(down) else 0)
    return down, after if np.any(after) else longest(-1)


def _resistance(sweep: OcvSweep) -> float:
    """Resistance [ohm] within some two minutes of switching the current on, else at switching it off."""
    test, first, last = sweep.test, sweep.first, sweep.last
    if sweep.rested and test.dt[first] < LONGEST_SWITCH:
        later = min(int(np.searchsorted(test.time, test.time[first] + SWITCHED)), last)
        fall = (test.voltage[first - 1] - test.voltage[later]) / np.mean(test.current[first : later + 1])
    elif last + 1 < len(test):
        fall = (test.voltage[last + 1] - test.voltage[last]) / test.current[last]
    else:
        return 0.0
    return max(float(fall), 0.0)
