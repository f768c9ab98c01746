"""Open-circuit voltage and capacity from a low-current test: full, discharge, rest, charge (Lord 2016, sec. 2.2).

The mean of both branches at one state of charge is free of what has the current's sign: resistance and hysteresis. Half
their gap, less the part that resistance makes, is what the open-circuit voltage depends on history (Plett 2015, vol. 1,
sec. 2.8 and 2.10): the standard deviation given.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration.cell_data import cell_test
from gz_onboard.calibration.fit import score
from gz_onboard.calibration.ocv_sweep import REST, REST_AT_BEGIN, UNEXPLAINED, OcvSweep, find_sweep
from gz_onboard.calibration.result import Curve, Found, Panel, PlotLine, Result
from gz_onboard.calibration.table import Measurements

_SOC = (
    "0 0.005 0.01 0.02 0.03 0.05 0.075 0.1 0.125 0.15 0.2 0.25 0.3 0.35 0.4 0.45 0.5 0.55 0.6 0.65 0.7 0.75 0.8 0.85 "
    "0.9 0.95 0.98 0.99 1"
)
SOC = np.array(_SOC.split(), dtype=float)
TESTER = 0.005  # relative: what a tester's current may be off
UNSURE = 0.2  # relative: the resistance of steady current, out of that of its steps
LEAST_SLOPE = 1e-3  # V over all of SOC: what a flat or falling part is given
LEAST_STEP = 2e-5  # V from node to node: twice the last digit that a vehicle file holds
VOLTMETER = 5e-4  # V: no tester's voltage is surer than that
NO_SURER = 0.02  # V: sd of a full cell's voltage that is not one at rest
FLAT = 0.1  # of SOC: where the sd of the voltage is worth more, the report says so


def calibrate(table: Measurements) -> Result:
    """``battery.ocv`` over the nodes `SOC` and ``cell_capacity``.

    SOC 1 is the state before the discharge, 0 its end. Where a branch is missing, the other is moved by half the gap
    seen where both are, or by the resistance of its steps, and is said to be less sure. Raises InputError for a table
    that is no such test (see `cell_data.cell_test`), for a discharge that is too fast or not there, or for a charge
    that brings back more than any cell takes.
    """
    test = cell_test(table)
    result = Result("ocv")
    sweep = find_sweep(test, result)
    sweep, half = _half_gap(sweep, result)
    value, sd = _between(sweep, half, result)
    value, sd = _ends(sweep, value, sd, result)
    value = _monotonic(value, result, test.name)
    sd_tester = TESTER * sweep.capacity
    if sweep.own or sweep.charged > (1 - UNEXPLAINED) * sweep.capacity:
        sd_tester = float(np.hypot(sd_tester, sweep.capacity - sweep.charged))
    source = (
        f"{table.file.name}: discharge at {sweep.current:.3f} A in {sweep.hours:.1f} h at "
        f"{np.mean(test.temperature[sweep.down]):.1f} degC, {np.count_nonzero(sweep.down)} points"
    )
    how = "mean of discharge and charge" if np.any(sweep.up) else "discharge moved by its resistance"
    ends = f"from {test.voltage[sweep.before]:.3f} V to {test.voltage[sweep.last]:.3f} V"
    result.parameters["cell_capacity"] = Found(sweep.capacity, sd_tester, "A·h", f"{source}, {ends}")
    result.curves["battery.ocv"] = Curve({"soc": SOC}, value, sd, "V", f"{source}; {how}")
    _flatness(value, sd, result)
    middle = sweep.down & (sweep.level > SOC[0]) & (sweep.level < 1)
    back = np.interp(sweep.level[middle], SOC, value - np.where(np.isfinite(half), half, 0.0))
    what = "discharge voltage less half the gap"
    result.fits.append(score(what, "V", test.voltage[middle], back, held_out=False, source=table.file.name))
    result.panels += _panels(sweep, value, sd, half)
    return result


def _half_gap(sweep: OcvSweep, result: Result) -> tuple[OcvSweep, Array]:
    """(`sweep`, its resistance none if it is more than the gap holds; half the gap [V] at the nodes, or nan)."""
    test = sweep.test
    if not np.any(sweep.up):
        result.notes.append("hysteresis is not identifiable without a charge branch")
        return sweep, np.full(len(SOC), np.nan)
    discharge, charge = (_smooth(sweep.level[part], test.voltage[part], SOC) for part in (sweep.down, sweep.up))
    half: Array = (charge - discharge) / 2
    if np.all(np.isnan(half)):
        return sweep, half
    gap, made = float(np.nanmedian(half)), f"({1e3 * sweep.resistance:.0f} mΩ within minutes)"
    note = f"between discharge and charge lie {2e3 * gap:.1f} mV in the median; "
    if sweep.resistive <= (1 + UNSURE) * gap:
        result.notes.append(f"{note}resistance {made} makes {2e3 * sweep.resistive:.1f} mV of it")
        return sweep, half
    result.notes.append(
        f"{note}the fall of the full cell's voltage {made} would make {2e3 * sweep.resistive:.1f} mV, so it is not "
        "resistance alone, and all of the gap counts as hysteresis"
    )
    return replace(sweep, resistance=0.0), half


def _flatness(value: Array, sd: Array, result: Result) -> None:
    """Where a voltage says little of the state of charge."""
    blur = sd / np.gradient(value, SOC)
    inside = (SOC >= 0.1) & (SOC <= 0.9)
    if (flat := inside & (blur > FLAT)).any():
        result.notes.append(
            f"the curve is flat against its sd at SOC {', '.join(f'{s:g}' for s in SOC[flat])}: there a rest voltage "
            f"tells the state of charge to ± {100 * float(np.median(blur[flat])):.0f} % at best. rest_voltage_error, "
            f"which this does not set, should be {1e3 * float(np.median(sd[flat])):.0f} mV or more"
        )


def _between(sweep: OcvSweep, half: Array, result: Result) -> tuple[Array, Array]:
    """(voltage, its sd) [V] at the nodes: the discharge moved up by half the gap, where that is known or near."""
    discharge = _smooth(sweep.level[sweep.down], sweep.test.voltage[sweep.down], SOC)
    resistive, both = sweep.resistive, np.isfinite(half)
    value = discharge + half
    sd = np.maximum(np.hypot(np.maximum(half - resistive, 0.0), UNSURE * resistive), VOLTMETER)
    missing = ~both & np.isfinite(discharge) & (SOC > 0) & (SOC < 1)
    if np.any(missing):
        # The gap of the covered nodes nearest to those that are not, else the resistive part alone.
        near = np.array([half[both][np.argmin(np.abs(SOC[both] - s))] if np.any(both) else resistive for s in SOC])
        value = np.where(missing, discharge + near, value)
        sd = np.where(missing, np.maximum(near, 3e-3), sd)
        charge = (
            f"it brings back {sweep.charged:.3f} of {sweep.capacity:.3f} A·h" if np.any(sweep.up) else "there is none"
        )
        where = " to ".join(dict.fromkeys(f"{s:g}" for s in SOC[missing][[0, -1]]))
        by = "the half gap at the nearest SOC that has both" if np.any(both) else "resistance times current"
        result.refusals.append(
            f"{sweep.test.name}: no charge branch at SOC {where} ({charge}); "
            f"there the discharge is moved by {by}, {1e3 * float(np.mean(near[missing])):.1f} mV"
        )
    ends = (SOC == 0) | (SOC == 1)
    value = np.where(ends & ~np.isfinite(value), discharge + resistive, value)
    return value, np.where(ends & ~np.isfinite(sd), np.nanmax(sd), sd)


def _panels(sweep: OcvSweep, value: Array, sd: Array, half: Array) -> list[Panel]:
    branches = [
        PlotLine(name, sweep.level[part], sweep.test.voltage[part], ".")
        for name, part in (("discharge", sweep.down), ("charge", sweep.up))
        if np.any(part)
    ]
    gap = PlotLine("half gap", SOC, 1e3 * half, "."), PlotLine("standard deviation", SOC, 1e3 * sd)
    return [
        Panel("Open-circuit voltage", "state of charge", "voltage [V]", (*branches, PlotLine("OCV", SOC, value))),
        Panel("Half the gap of the branches", "state of charge", "mV", gap),
    ]


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


def _ends(sweep: OcvSweep, value: Array, sd: Array, result: Result) -> tuple[Array, Array]:
    """Full and empty are where the cell rested, if it did: there the branches differ by their transients most."""
    value, sd = value.copy(), sd.copy()
    test, last = sweep.test, sweep.last
    value[-1] = sweep.full
    sd[-1] = max(sd[-2] if np.isfinite(sd[-2]) else 0.005, 2e-3)
    if not sweep.rested:
        sd[-1] = NO_SURER
        result.refusals.append(
            f"{test.name}: no rest before the discharge ({REST:.0f} s without current, {REST_AT_BEGIN:.0f} s where the "
            f"file begins), so full is where the discharge began, its voltage moved by {1e3 * sweep.resistive:.1f} mV "
            f"for resistance and known to {1e3 * NO_SURER:.0f} mV only"
        )
    rested = np.flatnonzero(~test.rest[last + 1 :])
    end = last + (int(rested[0]) if len(rested) else len(test) - last - 1)
    if end > last and test.time[end] - test.time[last] >= REST:
        value[0] = test.voltage[end]
        sd[0] = max(sd[0], (value[0] - test.voltage[last]) / 3)
    return value, sd


def _monotonic(value: Array, result: Result, name: str) -> Array:
    """A falling or flat part is raised to a slight slope, and said."""
    good = np.isfinite(value)
    if not np.all(good):
        result.refusals.append(f"{name}: no voltage at SOC {', '.join(f'{s:g}' for s in SOC[~good])}")
        value = np.interp(SOC, SOC[good], value[good])
    rising = increasing(SOC, value)
    moved = rising - value
    if float(moved.max()) > 5e-4:
        result.notes.append(
            f"{name}: raised by up to {1e3 * moved.max():.1f} mV at SOC {SOC[int(np.argmax(moved))]:g} to be monotonic"
        )
    return rising


def increasing(soc: Array, volts: Array) -> Array:
    """`volts` (n,) at `soc` (n,), raised where they fall or are flat, so that they increase when rounded too."""
    line = np.concatenate([[0.0], np.cumsum(np.maximum(LEAST_SLOPE * np.diff(soc), LEAST_STEP))])
    return np.asarray(np.maximum.accumulate(volts - line) + line)
