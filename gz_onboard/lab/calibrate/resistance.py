"""Resistances beside the cells, out of rides: from pack to inverter, and in the pack up to where the BMS measures.

- cable_resistance: voltage of pack less inverter over the inverter's current (a line, its offset left to the sensors).
- pack_series_resistance: voltage over current at fast steps, less what the cells' own R0 and RC pair give in that time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.errors import InputError
from gz_onboard.lab.calibrate.fit import linear, score, split
from gz_onboard.lab.calibrate.offsets import read_pair
from gz_onboard.lab.calibrate.result import Found, Panel, PlotLine, Result
from gz_onboard.lab.calibrate.table import Measurements
from gz_onboard.simulation.samples import Samples
from gz_onboard.vehicle import Vehicle

STEP_TIME = 0.2  # s
LEAST_STEP = 15.0  # A
LEAST_STEPS = 20
LEAST_SPAN = 10.0  # A: of current, for a line
WARM = 20.0  # degC: below the cells' resistance is many times that of bars and fuse
VOLTAGE_GAIN_SD = 1e-3  # of each voltage sensor: a volt of either's gain over the sag of the pack looks like resistance
CELL_SHARE_SD = 0.05  # of the cells' resistance, from cell to cell and from table to step


def cable_resistance(rides: Sequence[Samples], vehicle: Vehicle) -> Result:
    """cable_resistance [ohm] between the two voltage sensors. InputError for rides without current."""
    result = Result("cable_resistance")
    currents: list[Array] = []
    volts: list[Array] = []
    packs: list[Array] = []
    labels: list[Array] = []
    for k, ride in enumerate(rides):
        pair = read_pair(ride, vehicle)
        count = max(round(1.0 / float(np.median(np.diff(pair.time)))), 1)  # means of a second: timing counts less
        whole = len(pair.time) // count * count
        apart = pair.pack_voltage - pair.inverter_voltage
        for column, values in ((currents, pair.inverter), (volts, apart), (packs, pair.pack_voltage)):
            column.append(values[:whole].reshape(-1, count).mean(axis=1))
        labels.append(np.full(whole // count, k))
    if not currents:
        raise InputError("no ride, which cable_resistance comes from")
    i, v, label = np.concatenate(currents), np.concatenate(volts), np.concatenate(labels)
    if np.ptp(i) < LEAST_SPAN:
        raise InputError(
            f"{rides[0].name}: inverter_current of {i.min():.1f} to {i.max():.1f} A spans too little for a resistance; "
            f"{LEAST_SPAN:g} A are needed"
        )
    columns = {"cable_resistance": i, "offset": np.ones_like(i)}
    found = linear(columns, v, groups=label if len(rides) > 2 else None)
    if found["cable_resistance"] < -3 * found.sd("cable_resistance"):
        raise InputError(f"{rides[0].name}: inverter_voltage rises over pack_voltage with current: a sign is wrong")
    model = found["cable_resistance"] * i + found["offset"]
    source = f"{len(rides)} rides, {len(i)} means of 1 s, pack less inverter voltage over inverter current"
    fitted = label % 2 == 0 if len(rides) > 1 else split(len(i))
    half = linear({name: column[fitted] for name, column in columns.items()}, v[fitted])
    outside = half["cable_resistance"] * i + half["offset"]
    result.fits += [
        score("voltage between pack and inverter", "V", v, model, held_out=False, source=source),
        score(
            "voltage between pack and inverter",
            "V",
            v[~fitted],
            outside[~fitted],
            held_out=True,
            source="every second ride",
        ),
    ]
    sag = abs(linear(columns, np.concatenate(packs), groups=label if len(rides) > 2 else None)["cable_resistance"])
    gains = 2**0.5 * VOLTAGE_GAIN_SD * sag
    result.parameters["cable_resistance"] = Found(
        max(found["cable_resistance"], 0.0),
        float(np.hypot(found.sd("cable_resistance"), gains)),
        "ohm",
        f"{source}; {found['offset']:+.3f} V at no current",
    )
    result.panels += _panels("Voltage between pack and inverter", i, v, model, "pack less inverter voltage [V]")
    return result


def pack_series_resistance(rides: Sequence[Samples], vehicle: Vehicle, pulses: Sequence[Measurements] = ()) -> Result:
    """pack_series_resistance [ohm]: 0.2 s steps of warm rides less what the cells alone give in that time.

    pulses: pulse tests of a cell at two temperatures or more, with `time`, `current`, `voltage` and `cell_temperature`:
    their steps of the same length are the cells' part. Without them it is R0 and the RC pair of the vehicle file, which
    stand for a longer time than a step and so leave less.
    Raises InputError if there are too few steps of more than `LEAST_STEP`. Gives a refusal instead of a number where
    the cells' own doubt is greater than what is left.
    """
    battery, p = vehicle.pack, vehicle.parameters
    n, m = battery.cells_series, battery.cells_parallel
    result, steps, drops, cells, labels = Result("pack_series_resistance"), [], [], [], []
    by_temperature = cell_steps(pulses) if pulses else (np.empty(0), np.empty(0))
    origin = "the pulse tests' steps" if pulses else "the cell tables"
    for k, ride in enumerate(rides):
        temperature = _mean_of(ride, "cell_temperature")
        if temperature < WARM:
            result.notes.append(f"{ride.name}: cells at {temperature:.0f} degC, left out: {WARM:g} degC are needed")
            continue
        time, current = ride.columns["pack_current"]
        voltage = np.interp(time, *ride.columns["pack_voltage"])
        current = (current - p["pack_current_offset"]) / p["pack_current_gain"]
        stride = max(round(STEP_TIME / float(np.median(np.diff(time)))), 1)
        step, drop = current[stride:] - current[:-stride], -(voltage[stride:] - voltage[:-stride])
        big = np.abs(step) > LEAST_STEP
        if not big.any():
            continue
        if pulses and not by_temperature[0][0] <= temperature <= by_temperature[0][-1]:
            low, high = by_temperature[0][[0, -1]]
            result.notes.append(
                f"{ride.name}: cells at {temperature:.0f} degC, outside the tests' {low:.0f} to {high:.0f}, left out"
            )
            continue
        if pulses:
            cell_ohm = float(np.exp(np.interp(temperature, *by_temperature)))
        else:
            soc = _soc(ride, vehicle)
            r0, r1, c1 = (mesh.at(soc, temperature)[0] for mesh in (battery.r0, battery.r1, battery.c1))
            cell_ohm = r0 + r1 * (1 - float(np.exp(-STEP_TIME / 2 / (r1 * c1))))
        steps.append(step[big])
        drops.append(drop[big])
        cells.append(np.full(int(big.sum()), n / m * cell_ohm))
        labels.append(np.full(int(big.sum()), k))
    if sum(map(len, steps)) < LEAST_STEPS:
        count = sum(map(len, steps))
        raise InputError(
            f"{count} steps of more than {LEAST_STEP:g} A within {STEP_TIME:g} s above {WARM:g} degC are "
            f"too few for pack_series_resistance; {LEAST_STEPS} are needed"
        )
    di, dv, cell, label = (np.concatenate(column) for column in (steps, drops, cells, labels))
    found = linear({"series": di}, dv - cell * di, groups=label if len(np.unique(label)) > 2 else None)
    doubt = CELL_SHARE_SD * float(cell.mean())
    sd = float(np.hypot(found.sd("series"), doubt))
    whole = linear({"whole": di}, dv)["whole"]
    source = (
        f"{len(di)} steps above {LEAST_STEP:g} A within {STEP_TIME:g} s of {len(np.unique(label))} rides above "
        f"{WARM:g} degC: {1e3 * whole:.1f} mohm, less {1e3 * cell.mean():.1f} mohm of {origin}"
    )
    model = (cell + found["series"]) * di
    result.fits.append(score("voltage step", "V", dv, model, held_out=False, source=source))
    result.panels += _panels("Steps of pack voltage", di, dv, model, "fall of voltage [V]")
    if found["series"] < 2 * sd:
        result.refusals.append(
            f"pack_series_resistance: {1e3 * found['series']:+.1f} ± {1e3 * sd:.1f} mohm is left of {1e3 * whole:.1f} "
            f"mohm ({100 * CELL_SHARE_SD:.0f} % of the cells' own in doubt): the value of the vehicle file stays"
        )
    else:
        result.parameters["pack_series_resistance"] = Found(found["series"], sd, "ohm", source)
    return result


def cell_steps(pulses: Sequence[Measurements]) -> tuple[Array, Array]:
    """(temperatures [degC], logarithms of the resistance [ohm] that a cell shows `STEP_TIME` after a step of current),
    by temperature; the median over states of charge above 0.1 of the charge passed. InputError for tests without steps.
    """
    rows = []
    for pulse in pulses:
        time, current, voltage = pulse["time"], pulse["current"], pulse["voltage"]
        charge = np.concatenate([[0.0], np.cumsum(np.diff(time) * current[:-1])])
        jump = np.flatnonzero(np.abs(np.diff(current)) > 0.3 * np.max(np.abs(current)))
        ohm = []
        for k in jump:
            after = int(np.searchsorted(time, time[k + 1] + 0.5 * STEP_TIME - 1e-6))  # mean age of a ride's steps
            if after == len(time) or time[after] > time[k + 1] + STEP_TIME:
                continue
            steady = abs(current[after] - current[k + 1]) < 0.05 * abs(current[k + 1] - current[k])
            if steady and charge[k] < 0.9 * charge.max():
                ohm.append(-(voltage[after] - voltage[k]) / (current[after] - current[k]))
        if len(ohm) < 5:
            raise pulse.error(f"{len(ohm)} steps of current followed by a sample within {STEP_TIME:g} s are too few")
        rows.append((float(np.mean(pulse["cell_temperature"])), float(np.log(np.median(ohm)))))
    temperature, logarithm = np.array(sorted(rows)).T
    return temperature, logarithm


def _mean_of(ride: Samples, role: str) -> float:
    if role not in ride.columns:
        raise InputError(f"{ride.name}: no {role}, without which the cells' part of a step is unknown")
    return float(ride.columns[role][1].mean())


def _soc(ride: Samples, vehicle: Vehicle) -> float:
    """The state of charge in the middle of a ride, by its first voltage and its charge."""
    battery = vehicle.pack
    first = float(np.median(ride.columns["pack_voltage"][1][:5]))
    start = battery.soc_at((first - vehicle.parameters["pack_voltage_offset"]) / battery.cells_series)
    time, current = ride.columns["pack_current"]
    charge = float(np.trapezoid(current, time)) / 3600
    return start - 0.5 * charge / battery.pack_capacity(25.0)


def _panels(title: str, x: Array, data: Array, model: Array, y_label: str) -> list[Panel]:
    order = np.argsort(x)
    traces = PlotLine("measured", x, data, "."), PlotLine("model", x[order], model[order])
    return [
        Panel(title, "current [A]", y_label, traces),
        Panel(f"{title}: residual", "current [A]", "measured less model [V]", (PlotLine("", x, data - model, "."),)),
    ]
