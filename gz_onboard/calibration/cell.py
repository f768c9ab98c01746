"""Bench tests of one cell, and open-circuit voltage and capacity from a slow one (Lord 2016, sec. 2.2).

A slow test is full, rest, discharge, rest, charge. At one state of charge the mean of both branches is free of
resistance and hysteresis, which have the current's sign. Half their gap, less the part that resistance makes, is how
far the open-circuit voltage depends on history (Plett 2015, vol. 1, sec. 2.8 and 2.10): the standard deviation given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gz_onboard.arrays import Array, Mask
from gz_onboard.calibration.fit import score
from gz_onboard.calibration.result import Curve, Found, Panel, PlotLine, Result
from gz_onboard.calibration.table import Measurements
from gz_onboard.constants import HOUR
from gz_onboard.model.tables import LIMITS

# --- any test of a cell --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CellTestConfig:
    """Requirements of a test of a cell; currents are relative to the largest of the test."""

    fewest_samples: int = 50
    voltage: tuple[float, float] = (0.2, 6.0)  # V: one cell of any chemistry, under any load
    shortest: float = 600.0  # s
    longest_gap: float = 150.0  # s between samples while a current flows
    switch: float = 0.1  # change of current that counts as switching
    rest: float = 0.02  # current up to which the cell rests
    edge: float = 0.2  # change of current whose voltage step shows the sign
    regular_times: float = 0.02  # relative: sample times that are alike
    regular_share: float = 0.99  # share of them in a record at equal times
    quick: float = 0.3  # s: quicker samples show a switch by themselves
    counted: float = 5.0  # s: over longer ones the tester's own counter counts
    fewest_clipped: int = 10  # samples at one voltage under a steady current


CELL_TEST = CellTestConfig()


@dataclass(frozen=True)
class CellTest:
    """One test of one cell.

    All (m,): time [s], dt [s] before each sample, flowed [A]: the mean current over that dt, current [A] at the sample,
    voltage [V], temperature [degC], drawn [A·h] since the first sample. block: number of the pulse with the rest after
    it, 0 before the first; rest: True where no current flows.
    """

    table: Measurements
    time: Array
    dt: Array
    flowed: Array
    current: Array
    voltage: Array
    temperature: Array
    drawn: Array
    block: NDArray[np.int_]
    rest: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.time)

    @property
    def name(self) -> str:
        """The file's name."""
        return self.table.file.name

    def rested(self, row: int) -> float:
        """How long [s] no current has flowed at `row`; below zero while one flows."""
        moving = np.flatnonzero(~self.rest[: row + 1])
        return float(self.time[row] - self.time[min(moving[-1] + 1, len(self) - 1) if len(moving) else 0])


def cell_test(table: Measurements) -> CellTest:
    """The test in `table`: columns time, current, voltage, cell_temperature and, where it has one, charge.

    ``charge`` [A·h] is the tester's own counter, of either sign; with it a gap in the samples does no harm. Raises
    InputError, with the line: missing columns, too few samples, values that no cell has, a gap while a current flows, a
    current of the wrong sign, a clipped voltage.
    """
    c = CELL_TEST
    time, current, volts, temperature = (table[k] for k in ("time", "current", "voltage", "cell_temperature"))
    _check_units(table)
    largest = float(np.max(np.abs(current)))
    if largest < 1e-3:
        raise table.error(f"no current flows: the largest is {largest:g} A")
    dt = np.diff(time, prepend=time[0])
    before = np.concatenate([current[:1], current[:-1]])
    # A tester writes a sample when it switches: until then the current before it flowed. A record at equal times knows
    # of no switch: taking its large steps so and its small ones not would count a road profile 2 % wrong.
    regular = float(np.mean(np.abs(dt[1:] / np.median(dt[1:]) - 1) < c.regular_times)) > c.regular_share
    switched = np.zeros(len(dt), dtype=bool) if regular else np.abs(current - before) > c.switch * largest
    flowed = np.where(switched & (dt > c.quick), before, (before + current) / 2)
    on = np.abs(current) > c.rest * largest
    was_on = np.concatenate([[False], on[:-1]])
    if "charge" in table:
        counter = table["charge"] - table["charge"][0]
        drawn = counter if float(np.dot(np.diff(counter), flowed[1:])) >= 0 else -counter
        by_counter = np.diff(drawn, prepend=0.0) * HOUR / np.where(dt > 0, dt, 1.0)
        flowed = np.where(dt > c.counted, by_counter, flowed)
    else:
        gaps = np.flatnonzero((dt > c.longest_gap) & (on | was_on))
        if len(gaps):
            row = int(gaps[0])
            raise table.error(
                f"a gap of {dt[row]:.0f} s while a current of {before[row]:.3g} A flows: what was drawn "
                "meanwhile is not known; a column 'charge' (the tester's counter, Ah) would tell",
                row,
            )
        drawn = np.cumsum(flowed * dt) / HOUR
    _check_sign(table, dt, drawn, largest)
    _check_clipped(table, on, largest)
    block = np.cumsum(on & ~was_on)
    return CellTest(table, time, dt, flowed, current, volts, temperature, drawn, block, ~on)


def _check_units(table: Measurements) -> None:
    """Refuse values of a wrong unit, of a pack, or of a lost sample."""
    c, time = CELL_TEST, table["time"]
    if len(time) < c.fewest_samples:
        raise table.error(
            f"{len(time)} samples are too few for a test of a cell, at least {c.fewest_samples} are needed"
        )
    for name, unit, (low, high) in (("voltage", "V", c.voltage), ("cell_temperature", "degC", LIMITS.temperature)):
        outside = np.flatnonzero((table[name] < low) | (table[name] > high))
        if len(outside):
            row, more = int(outside[0]), f" (and at {len(outside) - 1} more samples)" if len(outside) > 1 else ""
            raise table.error(
                f"{name} is {table[name][row]:g} {unit}, not {low:g} to {high:g} {unit} as of one cell{more}", row
            )
    if (duration := float(np.ptp(time))) < c.shortest:
        raise table.error(f"is {duration:.3g} s long; a test of a cell takes {c.shortest:g} s or more. Is time in s?")


def _check_sign(table: Measurements, dt: Array, drawn: Array, largest: float) -> None:
    """Refuse a voltage that rises on discharge: at the steps of the current, or over the test if noise hides those."""
    current, volts = table["current"], table["voltage"]
    step, change = np.diff(current), np.diff(volts)
    steps = (np.abs(step) > CELL_TEST.edge * largest) & (dt[1:] < CELL_TEST.longest_gap)
    jumps = change[steps] * np.sign(step[steps])
    noise = 1.4826 * float(np.median(np.abs(change - np.median(change))))  # as an sd (Hampel 1974)
    if jumps.size and abs(float(np.median(jumps))) > 4 * noise / np.sqrt(jumps.size):
        if float(np.median(jumps)) > 0:
            row = int(np.flatnonzero(steps)[jumps > 0][0]) + 1
            way = "rises" if change[row - 1] > 0 else "falls"
            raise table.error(
                f"the voltage {way} by {abs(change[row - 1]):.3g} V as the current goes from {current[row - 1]:.3g} to "
                f"{current[row]:.3g} A, and so at most steps: discharging must be positive (scale = -1 turns it)",
                row,
            )
    elif float(np.dot(drawn - drawn.mean(), volts - volts.mean())) > 0:
        raise table.error(
            "the voltage rises as charge is drawn, and falls as it is charged: discharging must be positive "
            "(scale = -1 turns it)"
        )


def _check_clipped(table: Measurements, on: Mask, largest: float) -> None:
    """Refuse a voltage that stays at its extreme under a steady current, the instrument's limit.

    A charger that holds a voltage is none: its current changes from sample to sample.
    """
    current, volts = table["current"], table["voltage"]
    for edge, word in ((float(volts.max()), "largest"), (float(volts.min()), "least")):
        stuck = (volts == edge) & on
        steady = stuck[1:] & stuck[:-1] & (np.abs(np.diff(current)) < 1e-3 * largest)
        if np.count_nonzero(steady) > CELL_TEST.fewest_clipped:
            row = int(np.flatnonzero(steady)[0]) + 1
            raise table.error(
                f"the voltage stays at {edge:g} V, its {word}, for {np.count_nonzero(steady)} samples of constant "
                f"current ({current[row]:.3g} A): it is clipped",
                row,
            )


# --- open-circuit voltage and capacity -----------------------------------------------------------------------------


@dataclass(frozen=True)
class SlowTestConfig:
    """A slow test: which samples count, and how far its branches are believed."""

    slowest_hours: float = 8.0  # a faster discharge is not slow
    rest: float = 600.0  # s without current, after which a voltage is that of rest
    rest_at_begin: float = 60.0  # s: the same where the file begins with it, as what was before is not in it
    full_within: float = 0.01  # V: a charge that comes so near to the full cell's voltage is complete
    unexplained: float = 0.03  # of capacity: what efficiency and tester leave between the branches at most
    max_difference: float = 0.1  # of capacity: branches further apart are not of one cell between the same ends
    alike: float = 1.5  # ratio of the branches' currents below which both move the voltage alike
    switched: float = 120.0  # s after switching the current: where its step is read
    longest_switch: float = 1000.0  # s: a longer gap shows no step
    resistance_sd: float = 0.2  # relative: of steady current, out of that of its steps
    min_slope: float = 1e-3  # V over all of SOC: what a flat or falling part is given
    min_step: float = 2e-5  # V from node to node: twice the last digit that a vehicle file holds
    voltmeter_sd: float = 5e-4  # V: no tester's voltage is surer
    unrested_sd: float = 0.02  # V: of a full cell's voltage that is not one at rest
    above_cutoff: float = 0.2  # V: at C/8 or slower a nearly empty cell is that near its open-circuit voltage


SLOW_TEST = SlowTestConfig()
TESTER = 0.005  # relative: what a tester's current may be off
FLAT = 0.1  # of SOC: sd of the voltage over its slope, above which it does not tell the state of charge
_SOC = (
    "0 0.005 0.01 0.02 0.03 0.05 0.075 0.1 0.125 0.15 0.2 0.25 0.3 0.35 0.4 0.45 0.5 0.55 0.6 0.65 0.7 0.75 0.8 0.85 "
    "0.9 0.95 0.98 0.99 1"
)
OCV_SOC = np.array(_SOC.split(), dtype=float)


def open_circuit(table: Measurements, cutoff: float = 0.0) -> Result:
    """``battery.ocv`` over the nodes `OCV_SOC` and ``cell_capacity`` of a slow test.

    SOC 1 is the state before the discharge, 0 its end. Where a branch is missing, the other is moved by half the gap
    seen where both are, or by the resistance of its steps, and is said to be less sure. cutoff [V]: of the cell; a
    discharge that ends far above is said. Raises InputError for a table that is no such test (see `cell_test`), for a
    discharge that is too fast or not there, or for a charge that brings back more than any cell takes.
    """
    test, result, c = cell_test(table), Result("ocv"), SLOW_TEST
    sweep, half = _half_gap(_find_sweep(test, result), result)
    value, sd = _ends(sweep, *_between(sweep, half, result), result)
    value = _monotonic(value, result, test.name)
    sd_tester = TESTER * sweep.capacity
    if sweep.charged > (1 - c.unexplained) * sweep.capacity:
        sd_tester = float(np.hypot(sd_tester, sweep.capacity - sweep.charged))
    source = (
        f"{test.name}: discharge at {sweep.current:.3f} A in {sweep.hours:.1f} h at "
        f"{np.mean(test.temperature[sweep.down]):.1f} degC, {np.count_nonzero(sweep.down)} points"
    )
    how = "mean of discharge and charge" if np.any(sweep.up) else "discharge moved by its resistance"
    ends = f"from {test.voltage[sweep.before]:.3f} V to {test.voltage[sweep.last]:.3f} V"
    result.parameters["cell_capacity"] = Found(sweep.capacity, sd_tester, "A·h", f"{source}, {ends}")
    result.curves["battery.ocv"] = Curve({"soc": OCV_SOC}, value, sd, "V", f"{source}; {how}")
    _notes(value, sd, cutoff, result)
    middle = sweep.down & (sweep.level > 0) & (sweep.level < 1)
    back = np.interp(sweep.level[middle], OCV_SOC, value - np.where(np.isfinite(half), half, 0.0))
    what = "discharge voltage less half the gap"
    result.fits.append(score(what, "V", test.voltage[middle], back, held_out=False, source=test.name))
    branches = [
        PlotLine(name, sweep.level[part], test.voltage[part], ".")
        for name, part in (("discharge", sweep.down), ("charge", sweep.up))
        if np.any(part)
    ]
    gap = PlotLine("half gap", OCV_SOC, 1e3 * half, "."), PlotLine("standard deviation", OCV_SOC, 1e3 * sd)
    lines = (*branches, PlotLine("OCV", OCV_SOC, value))
    result.panels.append(Panel("Open-circuit voltage", "state of charge", "voltage [V]", lines))
    result.panels.append(Panel("Half the gap of the branches", "state of charge", "mV", gap))
    return result


@dataclass(frozen=True)
class OcvSweep:
    """A slow discharge and the charge that belongs to it; `down` and `up` are their samples, `up` may be empty.

    before, last: rows before the discharge and at its end. rested: before the discharge. charged [A·h]: brought back.
    resistance [ohm]: within minutes of switching the current.
    """

    test: CellTest
    down: Mask
    up: Mask
    before: int
    last: int
    rested: bool
    hours: float
    current: float  # A
    capacity: float  # A·h
    charged: float
    resistance: float

    @property
    def resistive(self) -> float:
        """How far resistance moves the discharge [V]."""
        return self.resistance * self.current

    @property
    def full(self) -> float:
        """Voltage of the full cell [V], at rest or as near to that as can be had."""
        first = self.test.voltage[int(np.flatnonzero(self.down)[0])]
        return float(self.test.voltage[self.before] if self.rested else first + self.resistive)

    @property
    def level(self) -> Array:
        """State of charge of each sample, 1 before the discharge."""
        drawn = self.test.drawn
        return np.asarray(1 - (drawn - drawn[self.before]) / self.capacity)


def _find_sweep(test: CellTest, result: Result) -> OcvSweep:
    """The longest discharge of `test` and its charge, without that if it is no counterpart, which `result` then says.

    Raises InputError for no discharge, one that is too fast or in pieces, or a charge that no cell takes.
    """
    c, table, drawn = SLOW_TEST, test.table, test.drawn
    down, up = _branches(test)
    if not down.any():
        raise table.error("there is no discharge: its current must be positive")
    first, last = (int(row) for row in np.flatnonzero(down)[[0, -1]])
    before = max(first - 1, 0)
    hours, capacity = float(np.sum(test.dt[down])) / HOUR, float(drawn[last] - drawn[before])
    if hours < c.slowest_hours:
        raise table.error(
            f"the discharge takes {hours:.1f} h: at such a current the voltage is not the open-circuit voltage; "
            f"at least {c.slowest_hours:.0f} h (C/{c.slowest_hours:.0f}) without a pause are needed"
        )
    charging = np.flatnonzero((test.current < 0) & ~test.rest)
    begin, end = np.searchsorted(charging, [first, last])
    whole = float(drawn[charging[end] - 1 if end < len(charging) else -1] - drawn[charging[begin - 1] if begin else 0])
    if whole > (1 + c.unexplained) * capacity:
        raise table.error(
            f"{whole:.3f} A·h are drawn in pieces, {capacity:.3f} of it without a pause of {c.rest:.0f} s or more: "
            "the rests between are no part of a slow discharge, and its capacity would be that of the longest piece"
        )
    rest, rows = test.rested(before), np.flatnonzero(up)
    rested = rest >= (c.rest_at_begin if rest == test.time[before] - test.time[0] else c.rest)
    if rested and test.dt[first] < c.longest_switch:  # resistance by switching the current on, else off
        later = min(int(np.searchsorted(test.time, test.time[first] + c.switched)), last)
        ohm = (test.voltage[before] - test.voltage[later]) / np.mean(test.current[first : later + 1])
    else:
        ohm = (test.voltage[last + 1] - test.voltage[last]) / test.current[last] if last + 1 < len(test) else 0.0
    charged = float(drawn[max(rows[0] - 1, 0)] - drawn[rows[-1]]) if len(rows) else 0.0
    current = float(np.mean(test.current[down]))
    return _paired(
        OcvSweep(test, down, up, before, last, rested, hours, current, capacity, charged, max(float(ohm), 0.0)), result
    )


def _paired(sweep: OcvSweep, result: Result) -> OcvSweep:
    """`sweep`, without a charge that is no counterpart of its discharge."""
    test, c = sweep.test, SLOW_TEST
    if not np.any(sweep.up):
        return sweep
    share, current = sweep.charged / sweep.capacity, -float(np.mean(test.current[sweep.up]))
    reached = float(test.voltage[sweep.up].max())
    counts = f"the charge brings back {sweep.charged:.3f} of {sweep.capacity:.3f} A·h"
    if not sweep.current / c.alike < current < sweep.current * c.alike:
        why = f"the charge at {current:.3g} A is no counterpart of the discharge at {sweep.current:.3g} A"
    elif abs(share - 1) <= c.unexplained or (share < 1 and reached <= sweep.full - c.full_within):
        return sweep
    elif share > 1 + c.max_difference:
        raise test.table.error(
            f"{counts}, over {100 * c.max_difference:.0f} % more: the discharge did not begin full or end empty, or a "
            "current is wrong"
        )
    else:
        why = f"{counts}, and reaches {reached:.3f} V of {sweep.full:.3f} V: the branches do not close"
    result.refusals.append(f"{test.name}: {why}. The discharge alone is used, moved by its resistance")
    return replace(sweep, up=np.zeros(len(test), dtype=bool), charged=0.0)


def _branches(test: CellTest) -> tuple[Mask, Mask]:
    """The longest discharge (by charge) and the longest charge after it, or before it if there is none after.

    A pause shorter than a rest does not end them.
    """
    flows = np.sign(np.where(test.rest, 0.0, test.current))
    through, moving = flows.copy(), np.flatnonzero(flows)
    for a, b in pairwise(moving.tolist()):
        if b - a > 1 and flows[a] == flows[b] and test.time[b] - test.time[a] < SLOW_TEST.rest:
            through[a:b] = flows[a]
    run = np.cumsum(np.concatenate([[True], through[1:] != through[:-1]]))

    def longest(sign: int, after: int = -1) -> Mask:
        mine = (flows == sign) & (np.arange(len(test)) > after)
        if not np.any(mine):
            return np.asarray(mine)
        amount = np.bincount(run[mine], np.abs(test.flowed * test.dt)[mine])
        return np.asarray(mine & (run == int(np.argmax(amount))))

    down = longest(1)
    after = longest(-1, int(np.flatnonzero(down)[-1]) if np.any(down) else 0)
    return down, after if np.any(after) else longest(-1)


def _half_gap(sweep: OcvSweep, result: Result) -> tuple[OcvSweep, Array]:
    """(`sweep`, its resistance none if it is more than the gap holds; half the gap [V] at the nodes, or nan)."""
    if not np.any(sweep.up):
        result.notes.append("hysteresis is not identifiable without a charge branch")
        return sweep, np.full(len(OCV_SOC), np.nan)
    half: Array = (_at_nodes(sweep, sweep.up) - _at_nodes(sweep, sweep.down)) / 2
    if np.all(np.isnan(half)):
        return sweep, half
    gap, made = float(np.nanmedian(half)), f"({1e3 * sweep.resistance:.0f} mΩ within minutes)"
    note = f"between discharge and charge lie {2e3 * gap:.1f} mV in the median; "
    if sweep.resistive <= (1 + SLOW_TEST.resistance_sd) * gap:
        result.notes.append(f"{note}resistance {made} makes {2e3 * sweep.resistive:.1f} mV of it")
        return sweep, half
    result.notes.append(
        f"{note}the fall of the full cell's voltage {made} would make {2e3 * sweep.resistive:.1f} mV, so it is not "
        "resistance alone, and all of the gap counts as hysteresis"
    )
    return replace(sweep, resistance=0.0), half


def _between(sweep: OcvSweep, half: Array, result: Result) -> tuple[Array, Array]:
    """(voltage, its sd) [V] at the nodes: the discharge moved up by half the gap, where that is known or near."""
    c, discharge, soc = SLOW_TEST, _at_nodes(sweep, sweep.down), OCV_SOC
    resistive, both = sweep.resistive, np.isfinite(half)
    value = discharge + half
    sd = np.maximum(np.hypot(np.maximum(half - resistive, 0.0), c.resistance_sd * resistive), c.voltmeter_sd)
    missing = ~both & np.isfinite(discharge) & (soc > 0) & (soc < 1)
    if np.any(missing):
        # The gap of the covered nodes nearest to those that are not, else the resistive part alone.
        near = np.array([half[both][np.argmin(np.abs(soc[both] - s))] if np.any(both) else resistive for s in soc])
        value = np.where(missing, discharge + near, value)
        sd = np.where(missing, np.maximum(near, 3e-3), sd)
        charge = (
            f"it brings back {sweep.charged:.3f} of {sweep.capacity:.3f} A·h" if np.any(sweep.up) else "there is none"
        )
        where = " to ".join(dict.fromkeys(f"{s:g}" for s in soc[missing][[0, -1]]))
        by = "the half gap at the nearest SOC that has both" if np.any(both) else "resistance times current"
        result.refusals.append(
            f"{sweep.test.name}: no charge branch at SOC {where} ({charge}); "
            f"there the discharge is moved by {by}, {1e3 * float(np.mean(near[missing])):.1f} mV"
        )
    ends = (soc == 0) | (soc == 1)
    value = np.where(ends & ~np.isfinite(value), discharge + resistive, value)
    return value, np.where(ends & ~np.isfinite(sd), np.nanmax(sd), sd)


def _at_nodes(sweep: OcvSweep, branch: Mask) -> Array:
    """Voltage at the nodes: a straight line through the samples nearest to each; nan where there are none."""
    level, volts, soc = sweep.level[branch], sweep.test.voltage[branch], OCV_SOC
    order, result = np.argsort(level), np.full(len(soc), np.nan)
    for k, s in enumerate(soc):
        width = 0.5 * min(abs(s - t) for t in soc if t != s)
        near = np.abs(level - s) <= width
        if np.count_nonzero(near) >= 4 and np.ptp(level[near]) > 0.5 * width:
            result[k] = np.polyval(np.polyfit(level[near] - s, volts[near], 1), 0.0)
        elif level.min() <= s <= level.max():
            result[k] = np.interp(s, level[order], volts[order])
    return result


def _ends(sweep: OcvSweep, value: Array, sd: Array, result: Result) -> tuple[Array, Array]:
    """Full and empty are where the cell rested, if it did: there the branches differ by their transients most."""
    c, test, last = SLOW_TEST, sweep.test, sweep.last
    value[-1] = sweep.full
    sd[-1] = max(sd[-2] if np.isfinite(sd[-2]) else 0.005, 2e-3)
    if not sweep.rested:
        sd[-1] = c.unrested_sd
        result.refusals.append(
            f"{test.name}: no rest before the discharge ({c.rest:.0f} s without current, {c.rest_at_begin:.0f} s where "
            f"the file begins), so full is where the discharge began, its voltage moved by {1e3 * sweep.resistive:.1f} "
            f"mV for resistance and known to {1e3 * c.unrested_sd:.0f} mV only"
        )
    rested = np.flatnonzero(~test.rest[last + 1 :])
    end = last + (int(rested[0]) if len(rested) else len(test) - last - 1)
    if end > last and test.time[end] - test.time[last] >= c.rest:
        value[0] = test.voltage[end]
        sd[0] = max(sd[0], (value[0] - test.voltage[last]) / 3)
    return value, sd


def _monotonic(value: Array, result: Result, name: str) -> Array:
    """A falling or flat part is raised to a slight slope, and said."""
    good = np.isfinite(value)
    if not np.all(good):
        result.refusals.append(f"{name}: no voltage at SOC {', '.join(f'{s:g}' for s in OCV_SOC[~good])}")
        value = np.interp(OCV_SOC, OCV_SOC[good], value[good])
    rising = increasing(OCV_SOC, value)
    moved = rising - value
    if float(moved.max()) > 5e-4:
        where = OCV_SOC[int(np.argmax(moved))]
        result.notes.append(f"{name}: raised by up to {1e3 * moved.max():.1f} mV at SOC {where:g} to be monotonic")
    return rising


def increasing(soc: Array, volts: Array) -> Array:
    """`volts` (n,) at `soc` (n,), raised where they fall or are flat, so that they increase when rounded too."""
    rise = np.maximum(SLOW_TEST.min_slope * np.diff(soc), SLOW_TEST.min_step)
    line = np.concatenate([[0.0], np.cumsum(rise)])
    return np.asarray(np.maximum.accumulate(volts - line) + line)


def _notes(value: Array, sd: Array, cutoff: float, result: Result) -> None:
    """Say where the voltage tells little of the state of charge, and whether the discharge ends too early."""
    blur, inside = sd / np.gradient(value, OCV_SOC), (OCV_SOC >= 0.1) & (OCV_SOC <= 0.9)
    if (flat := inside & (blur > FLAT)).any():
        result.notes.append(
            f"the curve is flat against its sd at SOC {', '.join(f'{s:g}' for s in OCV_SOC[flat])}: there a rest "
            f"voltage tells the state of charge to ± {100 * float(np.median(blur[flat])):.0f} % at best. "
            f"rest_voltage_error, which this does not set, should be {1e3 * float(np.median(sd[flat])):.0f} mV or more"
        )
    empty = float(value[0])
    if cutoff and empty > cutoff + SLOW_TEST.above_cutoff:
        result.refusals.append(
            f"the discharge ends at an open-circuit voltage of {empty:.2f} V, {empty - cutoff:.2f} V above "
            f"cell_cutoff_voltage ({cutoff:g} V): what the cell holds in between is not in its capacity"
        )
