"""Open-circuit voltage and capacity from a low-current test: full, discharge, rest, charge (Lord 2016, sec. 2.2).

The mean of both branches at one state of charge is free of what has the current's sign: resistance and hysteresis. Half
their gap, less the part that resistance makes, is what the open-circuit voltage depends on history (Plett 2015, vol. 1,
sec. 2.8 and 2.10): the standard deviation given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.constants import HOUR
from gz_onboard.lab.calibrate.cell_data import CellTest, cell_test
from gz_onboard.lab.calibrate.fit import score
from gz_onboard.lab.calibrate.result import Curve, Found, Panel, PlotLine, Result
from gz_onboard.lab.calibrate.table import Measurements

_SOC = (
    "0 0.005 0.01 0.02 0.03 0.05 0.075 0.1 0.125 0.15 0.2 0.25 0.3 0.35 0.4 0.45 0.5 0.55 0.6 0.65 0.7 0.75 0.8 0.85 "
    "0.9 0.95 0.98 0.99 1"
)
SOC = np.array(_SOC.split(), dtype=float)
SLOWEST_HOURS = 8.0  # a discharge faster than that is not slow
TESTER = 0.005  # relative: what a tester's current may be off
UNSURE = 0.2  # relative: the resistance of steady current, out of that of its steps
LEAST_SLOPE = 1e-3  # V over all of SOC: what a flat or falling part is given
LEAST_STEP = 2e-5  # V from node to node: twice the last digit that a vehicle file holds
VOLTMETER = 5e-4  # V: no tester's voltage is surer than that
CLOSED = 0.97  # of the capacity: what a charge that closes the loop brings back at least


@dataclass(frozen=True)
class _Sweep:
    """A slow discharge, and the charge after it; `down` and `up` are their samples, `up` may be empty."""

    test: CellTest
    down: Mask
    up: Mask

    @cached_property
    def before(self) -> int:
        """The row before the discharge."""
        return max(int(np.flatnonzero(self.down)[0]) - 1, 0)

    @cached_property
    def last(self) -> int:
        """The last row of the discharge."""
        return int(np.flatnonzero(self.down)[-1])

    @cached_property
    def capacity(self) -> float:
        """What is discharged [A·h]."""
        return float(self.test.drawn[self.last] - self.test.drawn[self.before])

    @cached_property
    def charged(self) -> float:
        """What is brought back [A·h]."""
        rows = np.flatnonzero(self.up)
        return float(self.test.drawn[max(rows[0] - 1, 0)] - self.test.drawn[rows[-1]]) if len(rows) else 0.0

    @cached_property
    def level(self) -> Array:
        """The state of charge of each sample, 1 before the discharge."""
        level: Array = 1 - (self.test.drawn - self.test.drawn[self.before]) / self.capacity
        return level

    @cached_property
    def hours(self) -> float:
        """What the discharge takes."""
        return float(np.sum(self.test.dt[self.down])) / HOUR

    @cached_property
    def current(self) -> float:
        """The mean of the discharge [A]."""
        return float(np.mean(self.test.current[self.down]))

    @cached_property
    def resistance(self) -> float:
        """[ohm], within minutes of switching the current."""
        return _resistance(self.test, int(np.flatnonzero(self.down)[0]), self.last)

    @property
    def resistive(self) -> float:
        """How far resistance moves the discharge [V]."""
        return self.resistance * self.current


def calibrate(table: Measurements, soc: Array = SOC) -> Result:
    """``battery.ocv`` over the nodes `soc` and ``cell_capacity``.

    SOC 1 is the state before the discharge, 0 its end. Where a branch is missing, the other is moved by half the gap
    seen where both are, or by the resistance of its steps, and is said to be less sure. Raises InputError for a table
    that is no such test (see `cell_data.cell_test`), for a discharge that is too fast or not there.
    """
    test = cell_test(table)
    result = Result("ocv")
    sweep = _Sweep(test, *_branches(test))
    if not np.any(sweep.down):
        raise table.error("there is no discharge: its current must be positive")
    if sweep.hours < SLOWEST_HOURS:
        raise table.error(
            f"the discharge takes {sweep.hours:.1f} h: at such a current the voltage is not the open-circuit voltage; "
            f"at least {SLOWEST_HOURS:.0f} h (C/{SLOWEST_HOURS:.0f}) are needed"
        )
    sweep, half = _half_gap(sweep, soc, result)
    value, sd = _between(sweep, soc, half, result)
    value, sd = _ends(sweep, soc, value, sd, result)
    value = _monotonic(soc, value, result, test.name)
    sd_tester = TESTER * sweep.capacity
    if np.any(sweep.up) and sweep.charged > CLOSED * sweep.capacity:
        sd_tester = float(np.hypot(sd_tester, sweep.capacity - sweep.charged))
    source = (
        f"{table.file.name}: discharge at {sweep.current:.3f} A in {sweep.hours:.1f} h at "
        f"{np.mean(test.temperature[sweep.down]):.1f} degC, {np.count_nonzero(sweep.down)} points"
    )
    ends = f"from {test.voltage[sweep.before]:.3f} V to {test.voltage[sweep.last]:.3f} V"
    result.parameters["cell_capacity"] = Found(sweep.capacity, sd_tester, "A·h", f"{source}, {ends}")
    result.curves["battery.ocv"] = Curve({"soc": soc}, value, sd, "V", f"{source}; mean of discharge and charge")
    result.notes.append(
        f"between discharge and charge lie {2e3 * float(np.nanmedian(half)):.1f} mV in the median; resistance "
        f"({1e3 * sweep.resistance:.0f} mΩ within minutes) makes {2e3 * sweep.resistive:.1f} mV of it"
        if np.any(np.isfinite(half))
        else "hysteresis cannot be told without a charge branch"
    )
    middle = sweep.down & (sweep.level > soc[0]) & (sweep.level < 1)
    back = np.interp(sweep.level[middle], soc, value - np.where(np.isfinite(half), half, 0.0))
    what = "discharge voltage less half the gap"
    result.fits.append(score(what, "V", test.voltage[middle], back, held_out=False, source=table.file.name))
    result.panels += _panels(sweep, soc, value, sd, half)
    return result


def _half_gap(sweep: _Sweep, soc: Array, result: Result) -> tuple[_Sweep, Array]:
    """(the test, without its charge if that does not close; half the gap of the branches [V] at the nodes, or nan)."""
    test, up = sweep.test, sweep.up
    if not np.any(up):
        return sweep, np.full(len(soc), np.nan)
    discharge, charge = (_smooth(sweep.level[part], test.voltage[part], soc) for part in (sweep.down, up))
    half = (charge - discharge) / 2
    full, reached = float(test.voltage[sweep.before]), float(test.voltage[up].max())
    if np.all(np.isnan(half)) or sweep.charged >= CLOSED * sweep.capacity or reached <= full - 0.01:
        return sweep, half
    result.refusals.append(
        f"{test.name}: the charge reaches {reached:.3f} V, as full as the discharge began "
        f"({full:.3f} V), after {sweep.charged:.3f} of {sweep.capacity:.3f} A·h: the branches do not close, "
        f"their mean would be wrong (half their gap is {1e3 * float(np.nanmedian(half)):.0f} mV, resistance makes "
        f"{1e3 * sweep.resistive:.0f} mV of it). The discharge alone is used, moved by its resistance"
    )
    return replace(sweep, up=np.zeros(len(test), dtype=bool)), np.full(len(soc), np.nan)


def _between(sweep: _Sweep, soc: Array, half: Array, result: Result) -> tuple[Array, Array]:
    """(voltage, its sd) [V] at the nodes: the discharge moved up by half the gap, where that is known or near."""
    discharge = _smooth(sweep.level[sweep.down], sweep.test.voltage[sweep.down], soc)
    resistive, both = sweep.resistive, np.isfinite(half)
    value = discharge + half
    sd = np.maximum(np.hypot(np.maximum(half - resistive, 0.0), UNSURE * resistive), VOLTMETER)
    missing = ~both & np.isfinite(discharge) & (soc > 0) & (soc < 1)
    if np.any(missing):
        # The gap of the covered nodes nearest to those that are not, else the resistive part alone.
        near = np.array([half[both][np.argmin(np.abs(soc[both] - s))] if np.any(both) else resistive for s in soc])
        value = np.where(missing, discharge + near, value)
        sd = np.where(missing, np.maximum(near, 3e-3), sd)
        charge = (
            f"it brings back {sweep.charged:.3f} of {sweep.capacity:.3f} A·h" if np.any(sweep.up) else "there is none"
        )
        by = "the half gap at the nearest SOC that has both" if np.any(both) else "resistance times current"
        result.refusals.append(
            f"{sweep.test.name}: no charge branch at SOC {soc[missing].min():g} to {soc[missing].max():g} ({charge}); "
            f"there the discharge is moved by {by}, {1e3 * float(np.mean(near[missing])):.1f} mV"
        )
    ends = (soc == 0) | (soc == 1)
    value = np.where(ends & ~np.isfinite(value), discharge + resistive, value)
    return value, np.where(ends & ~np.isfinite(sd), np.nanmax(sd), sd)


def _panels(sweep: _Sweep, soc: Array, value: Array, sd: Array, half: Array) -> list[Panel]:
    branches = [
        PlotLine(name, sweep.level[part], sweep.test.voltage[part], ".")
        for name, part in (("discharge", sweep.down), ("charge", sweep.up))
        if np.any(part)
    ]
    gap = PlotLine("half gap", soc, 1e3 * half, "."), PlotLine("standard deviation", soc, 1e3 * sd)
    return [
        Panel("Open-circuit voltage", "state of charge", "voltage [V]", (*branches, PlotLine("OCV", soc, value))),
        Panel("Half the gap of the branches", "state of charge", "mV", gap),
    ]


def _branches(test: CellTest) -> tuple[Mask, Mask]:
    """The longest discharge (by charge) and the longest charge after it."""
    flows = np.sign(np.where(test.rest, 0.0, test.current))
    run = np.cumsum(np.concatenate([[True], flows[1:] != flows[:-1]]))

    def longest(sign: int, after: int) -> Mask:
        mine = (flows == sign) & (np.arange(len(test)) > after)
        if not np.any(mine):
            return np.zeros(len(test), dtype=bool)
        amount = np.bincount(run[mine], np.abs(test.flowed * test.dt)[mine])
        return np.asarray(mine & (run == int(np.argmax(amount))))

    down = longest(1, -1)
    last = int(np.flatnonzero(down)[-1]) if np.any(down) else 0
    return down, longest(-1, last)


def _resistance(test: CellTest, first: int, last: int) -> float:
    """Resistance [ohm] within some two minutes of switching the current on or off."""
    found = []
    if first > 0 and test.dt[first] < 1000:
        later = min(int(np.searchsorted(test.time, test.time[first] + 120)), last)
        found.append((test.voltage[first - 1] - test.voltage[later]) / np.mean(test.current[first : later + 1]))
    if not found and last + 1 < len(test):
        found.append((test.voltage[last + 1] - test.voltage[last]) / test.current[last])
    return max(float(np.mean(found)), 0.0) if found else 0.0


def _smooth(level: Array, volts: Array, soc: Array) -> Array:
    """Voltage at the nodes: a straight line through the samples nearest to each; nan where there are none."""
    result = np.full(len(soc), np.nan)
    for k, s in enumerate(soc):
        width = 0.5 * min(abs(s - t) for t in soc if t != s)
        near = np.abs(level - s) <= width
        if np.count_nonzero(near) >= 4 and np.ptp(level[near]) > 0.5 * width:
            result[k] = np.polyval(np.polyfit(level[near] - s, volts[near], 1), 0.0)
        elif level.min() <= s <= level.max():
            order = np.argsort(level)
            result[k] = np.interp(s, level[order], volts[order])
    return result


def _ends(sweep: _Sweep, soc: Array, value: Array, sd: Array, result: Result) -> tuple[Array, Array]:
    """Full and empty are where the cell rested, if it did: there the branches differ by their transients most."""
    value, sd = value.copy(), sd.copy()
    test, before, last = sweep.test, sweep.before, sweep.last
    if test.time[before] - test.time[0] >= 60 and soc[-1] == 1:
        value[-1] = test.voltage[before]
        sd[-1] = max(sd[-2] if np.isfinite(sd[-2]) else 0.005, 2e-3)
    elif not np.isfinite(value[-1]) or soc[-1] == 1:
        result.refusals.append(f"{test.name}: no rest before the discharge, so full is where the discharge began")
        sd[-1] = 0.02
    rested = np.flatnonzero(~test.rest[last + 1 :])
    end = last + (int(rested[0]) if len(rested) else len(test) - last - 1)
    if end > last and test.time[end] - test.time[last] >= 600 and soc[0] == 0:
        value[0] = test.voltage[end]
        sd[0] = max(sd[0], (value[0] - test.voltage[last]) / 3)
    return value, sd


def _monotonic(soc: Array, value: Array, result: Result, name: str) -> Array:
    """A falling or flat part is raised to a slight slope, and said."""
    good = np.isfinite(value)
    if not np.all(good):
        result.refusals.append(f"{name}: no voltage at SOC {', '.join(f'{s:g}' for s in soc[~good])}")
        value = np.interp(soc, soc[good], value[good])
    rising = increasing(soc, value)
    moved = rising - value
    if float(moved.max()) > 5e-4:
        result.notes.append(
            f"{name}: raised by up to {1e3 * moved.max():.1f} mV at SOC {soc[int(np.argmax(moved))]:g} to be monotonic"
        )
    return rising


def increasing(soc: Array, volts: Array) -> Array:
    """`volts` (n,) at `soc` (n,), raised where they fall or are flat, so that they increase when rounded too."""
    line = np.concatenate([[0.0], np.cumsum(np.maximum(LEAST_SLOPE * np.diff(soc), LEAST_STEP))])
    return np.asarray(np.maximum.accumulate(volts - line) + line)
