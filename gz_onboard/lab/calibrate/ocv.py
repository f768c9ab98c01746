"""Open-circuit voltage and capacity from a low-current test: full, discharge, rest, charge (Lord 2016, sec. 2.2).

The mean of both branches at one state of charge is free of what has the current's sign: resistance and hysteresis. Half
their gap, less the part that resistance makes, is what the open-circuit voltage depends on history (Plett 2015, vol. 1,
sec. 2.8 and 2.10): the standard deviation given.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gz_onboard.arrays import Array
from gz_onboard.lab.calibrate.cell_data import CellTest, cell_test
from gz_onboard.lab.calibrate.result import Curve, Fit, Found, Panel, PlotLine, Result
from gz_onboard.lab.calibrate.table import Measurements

SOC = np.array(
    [
        0,
        0.005,
        0.01,
        0.02,
        0.03,
        0.05,
        0.075,
        0.1,
        0.125,
        0.15,
        0.2,
        0.25,
        0.3,
        0.35,
        0.4,
        0.45,
        0.5,
        0.55,
        0.6,
        0.65,
        0.7,
        0.75,
        0.8,
        0.85,
        0.9,
        0.95,
        0.98,
        0.99,
        1,
    ]
)
SLOWEST_HOURS = 8.0  # a discharge faster than that is not slow
TESTER = 0.005  # relative: what a tester's current may be off
UNSURE = 0.2  # relative: the resistance of steady current, out of that of its steps
LEAST_SLOPE = 1e-3  # V over all of SOC: what a flat or falling part is given


def calibrate(table: Measurements, soc: Array = SOC) -> Result:
    """``battery.ocv`` over the nodes `soc` and ``cell_capacity``.

    SOC 1 is the state before the discharge, 0 its end. Where a branch is missing, the other is moved by half the gap
    seen where both are, or by the resistance of its steps, and is said to be less sure. Raises InputError for a table
    that is no such test (see `cell_data.cell_test`), for a discharge that is too fast or not there.
    """
    test = cell_test(table)
    result = Result("ocv")
    down, up = _branches(test)
    if not np.any(down):
        raise table.error("there is no discharge: its current must be positive")
    hours = float(np.sum(test.dt[down])) / 3600
    if hours < SLOWEST_HOURS:
        raise table.error(
            f"the discharge takes {hours:.1f} h: at such a current the voltage is not the open-circuit voltage; "
            f"at least {SLOWEST_HOURS:.0f} h (C/{SLOWEST_HOURS:.0f}) are needed"
        )
    first, last = np.flatnonzero(down)[[0, -1]]
    start = test.drawn[max(first - 1, 0)]
    capacity = float(test.drawn[last] - start)
    level = 1 - (test.drawn - start) / capacity
    resistance = _resistance(test, int(first), int(last))
    mean_current = float(np.mean(test.current[down]))
    discharge = _smooth(level[down], test.voltage[down], soc)
    charge = _smooth(level[up], test.voltage[up], soc) if np.any(up) else np.full(len(soc), np.nan)
    both = np.isfinite(discharge) & np.isfinite(charge)
    half = np.where(both, (charge - discharge) / 2, np.nan)
    resistive = resistance * mean_current
    full = float(test.voltage[max(first - 1, 0)])
    if np.any(both) and _charged(test, up) < 0.97 * capacity and float(test.voltage[up].max()) > full - 0.01:
        result.refusals.append(
            f"{test.name}: the charge reaches {test.voltage[up].max():.3f} V, as full as the discharge began "
            f"({full:.3f} V), after {_charged(test, up):.3f} of {capacity:.3f} A·h: the branches do not close, "
            f"their mean would be wrong (half their gap is {1e3 * float(np.nanmedian(half)):.0f} mV, resistance makes "
            f"{1e3 * resistive:.0f} mV of it). The discharge alone is used, moved by its resistance"
        )
        charge, both, half = np.full(len(soc), np.nan), np.zeros(len(soc), dtype=bool), np.full(len(soc), np.nan)
        up = np.zeros(len(test), dtype=bool)
    value, sd = discharge + half, np.hypot(np.maximum(half - resistive, 0.0), UNSURE * resistive)
    missing = ~both & np.isfinite(discharge) & (soc > 0) & (soc < 1)
    if np.any(missing):
        # The gap of the covered nodes nearest to those that are not, else the resistive part alone.
        near = np.array([half[both][np.argmin(np.abs(soc[both] - s))] if np.any(both) else resistive for s in soc])
        value = np.where(missing, discharge + near, value)
        sd = np.where(missing, np.maximum(near, 3e-3), sd)
        top = f"{soc[missing].min():g} to {soc[missing].max():g}"
    ends = (soc == 0) | (soc == 1)
    value = np.where(ends & ~np.isfinite(value), discharge + resistive, value)
    sd = np.where(ends & ~np.isfinite(sd), np.nanmax(sd), sd)
    if np.any(missing):
        result.refusals.append(
            f"{test.name}: no charge branch at SOC {top} ("
            + (f"it brings back {_charged(test, up):.3f} of {capacity:.3f} A·h" if np.any(up) else "there is none")
            + "); there the discharge is moved by "
            + ("the half gap at the nearest SOC that has both" if np.any(both) else "resistance times current")
            + f", {1e3 * float(np.mean(near[missing])):.1f} mV"
        )
    value, sd = _ends(test, int(first), int(last), soc, value, sd, result)
    value = _monotonic(soc, value, result, test.name)
    sd_tester = TESTER * capacity
    if np.any(up) and _charged(test, up) > 0.97 * capacity:
        sd_tester = float(np.hypot(sd_tester, capacity - _charged(test, up)))
    source = (
        f"{table.file.name}: discharge at {mean_current:.3f} A in {hours:.1f} h at "
        f"{np.mean(test.temperature[down]):.1f} degC, {np.count_nonzero(down)} points"
    )
    ends = f"from {test.voltage[max(first - 1, 0)]:.3f} V to {test.voltage[last]:.3f} V"
    result.parameters["cell_capacity"] = Found(capacity, sd_tester, "A·h", f"{source}, {ends}")
    result.curves["battery.ocv"] = Curve({"soc": soc}, value, sd, "V", f"{source}; mean of discharge and charge")
    result.notes.append(
        f"between discharge and charge lie {2e3 * float(np.nanmedian(half)):.1f} mV in the median; resistance "
        f"({1e3 * resistance:.0f} mΩ within minutes) makes {2e3 * resistive:.1f} mV of it"
        if np.any(both)
        else "hysteresis cannot be told without a charge branch"
    )
    middle = down & (level > soc[0]) & (level < 1)
    back = np.interp(level[middle], soc, value - np.where(np.isfinite(half), half, 0.0)) - test.voltage[middle]
    result.fits.append(
        Fit(
            "discharge voltage less half the gap",
            "V",
            float(np.sqrt(np.mean(back**2))),
            float(np.abs(back).max()),
            1 - float(np.sum(back**2) / np.sum((test.voltage[middle] - test.voltage[middle].mean()) ** 2)),
            int(np.count_nonzero(middle)),
            False,
            table.file.name,
        )
    )
    traces = [PlotLine("discharge", level[down], test.voltage[down], ".")]
    if np.any(up):
        traces.append(PlotLine("charge", level[up], test.voltage[up], "."))
    result.panels.append(
        Panel("Open-circuit voltage", "state of charge", "voltage [V]", (*traces, PlotLine("OCV", soc, value)))
    )
    result.panels.append(
        Panel(
            "Half the gap of the branches",
            "state of charge",
            "mV",
            (PlotLine("half gap", soc, 1e3 * half, "."), PlotLine("standard deviation", soc, 1e3 * sd)),
        )
    )
    return result


def _branches(test: CellTest) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """The longest discharge (by charge) and the longest charge after it."""
    flows = np.sign(np.where(test.rest, 0.0, test.current))
    run = np.cumsum(np.concatenate([[True], flows[1:] != flows[:-1]]))

    def longest(sign: int, after: int) -> NDArray[np.bool_]:
        mine = (flows == sign) & (np.arange(len(test)) > after)
        if not np.any(mine):
            return np.zeros(len(test), dtype=bool)
        amount = np.bincount(run[mine], np.abs(test.flowed * test.dt)[mine])
        return np.asarray(mine & (run == int(np.argmax(amount))))

    down = longest(1, -1)
    last = int(np.flatnonzero(down)[-1]) if np.any(down) else 0
    return down, longest(-1, last)


def _charged(test: CellTest, up: NDArray[np.bool_]) -> float:
    rows = np.flatnonzero(up)
    return float(test.drawn[max(rows[0] - 1, 0)] - test.drawn[rows[-1]])


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


def _ends(
    test: CellTest, first: int, last: int, soc: Array, value: Array, sd: Array, result: Result
) -> tuple[Array, Array]:
    """Full and empty are where the cell rested, if it did: there the branches differ by their transients most."""
    value, sd = value.copy(), sd.copy()
    if first > 0 and test.time[first - 1] - test.time[0] >= 60 and soc[-1] == 1:
        value[-1] = test.voltage[first - 1]
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
    line = LEAST_SLOPE * soc
    rising = np.maximum.accumulate(value - line) + line
    moved = rising - value
    if float(moved.max()) > 5e-4:
        result.notes.append(
            f"{name}: raised by up to {1e3 * moved.max():.1f} mV at SOC {soc[int(np.argmax(moved))]:g} to be monotonic"
        )
    return np.asarray(rising)
