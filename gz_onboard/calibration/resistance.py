"""Resistances beside the cells, out of rides: from pack to inverter, and in the pack up to where the BMS measures.

- cable_resistance: voltage of pack less inverter over the inverter's current (a line, its offset left to the sensors).
- pack_series_resistance: voltage over current at fast steps, less what the cells' own R0 and RC pair give in that time.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gz_onboard.arrays import Array, held_integral
from gz_onboard.calibration.fit import as_groups, every_second, line, linear, score
from gz_onboard.calibration.offsets import read_pair, window_means
from gz_onboard.calibration.result import Found, Result, compared
from gz_onboard.calibration.table import Measurements
from gz_onboard.errors import InputError
from gz_onboard.model.battery import discharged
from gz_onboard.model.effect import Port
from gz_onboard.model.model import standing_load
from gz_onboard.model.series import first_soc
from gz_onboard.priors import sizes_of
from gz_onboard.recording.recording import Recording
from gz_onboard.recording.sensors import true_columns
from gz_onboard.vehicle import Vehicle

STEP_TIME = 0.2  # s
LEAST_STEP = 15.0  # A, in a vehicle of size 1
LEAST_STEPS = 20
FIRST = 5  # readings whose medians tell the state of charge at the start
LEAST_SPAN = 10.0  # A, in a vehicle of size 1: of current, for a line
MEAN_OF = 1.0  # s: timing counts less then
WARM = 20.0  # degC: below the cells' resistance is many times that of bars and fuse
VOLTAGE_GAIN_SD = 1e-3  # of each voltage sensor: a volt of either's gain over the sag of the pack looks like resistance
CELL_SHARE_SD = 0.05  # of the cells' resistance, from cell to cell and from table to step


def cable_resistance(rides: Sequence[Recording], vehicle: Vehicle) -> Result:
    """cable_resistance [ohm] between the two voltage sensors. InputError for rides without current."""
    result = Result("cable_resistance")
    rows, labels = [], []
    for k, ride in enumerate(rides):
        pair = read_pair(ride, vehicle)
        columns = (pair.inverter, pair.pack_voltage - pair.inverter_voltage, pair.pack_voltage)
        rows.append([window_means(pair, column, MEAN_OF) for column in columns])
        labels.append(np.full(len(rows[-1][0]), k))
    if not rows:
        raise InputError("no ride, which cable_resistance comes from")
    (i, v, pack), label = (np.concatenate(column) for column in zip(*rows, strict=True)), np.concatenate(labels)
    span = LEAST_SPAN * sizes_of(vehicle).current
    if np.ptp(i) < span:
        raise InputError(
            f"{rides[0].name}: inverter_current of {i.min():.1f} to {i.max():.1f} A spans too little for a resistance; "
            f"{span:g} A are needed"
        )
    fitted = every_second(label)
    found, model, outside = line("cable_resistance", i, v, fitted, as_groups(label))
    if found["cable_resistance"] < -3 * found.sd("cable_resistance"):
        raise InputError(f"{rides[0].name}: inverter_voltage rises over pack_voltage with current: a sign is wrong")
    what, source = "voltage between pack and inverter", f"{len(rides)} rides, {len(i)} means of 1 s, "
    source += "pack less inverter voltage over inverter current"
    result.fits += [
        score(what, "V", v, model, held_out=False, source=source),
        score(what, "V", v[~fitted], outside[~fitted], held_out=True, source="every second ride"),
    ]
    sag = abs(line("sag", i, pack, fitted)[0]["sag"])
    gains = 2**0.5 * VOLTAGE_GAIN_SD * sag
    result.parameters["cable_resistance"] = Found(
        max(found["cable_resistance"], 0.0),
        float(np.hypot(found.sd("cable_resistance"), gains)),
        "ohm",
        f"{source}; {found['offset']:+.3f} V at no current",
        "pack_voltage less inverter_voltage over inverter_current",
    )
    y_label = "pack less inverter voltage [V]"
    result.panels += compared("Voltage between pack and inverter", "current [A]", y_label, i, v, model)
    return result


def pack_series_resistance(rides: Sequence[Recording], vehicle: Vehicle, pulses: Sequence[Measurements] = ()) -> Result:
    """pack_series_resistance [ohm]: 0.2 s steps of warm rides less what the cells alone give in that time.

    pulses: pulse tests of a cell at two temperatures or more, with `time`, `current`, `voltage` and `cell_temperature`:
    their steps of the same length are the cells' part. Without them it is R0 and the RC pair of the vehicle file, which
    stand for a longer time than a step and so leave less.
    Raises InputError if there are too few steps of more than `LEAST_STEP`. Gives a refusal instead of a number where
    the cells' own doubt is greater than what is left.
    """
    result = Result("pack_series_resistance")
    by_temperature, least = cell_steps(pulses) if pulses else None, LEAST_STEP * sizes_of(vehicle).current
    of_rides = [_ride_steps(ride, vehicle, by_temperature, least, result) for ride in rides]
    steps = [columns for columns in of_rides if columns is not None]
    count = sum(len(di) for di, _, _ in steps)
    if count < LEAST_STEPS:
        raise InputError(
            f"{count} steps of more than {least:g} A within {STEP_TIME:g} s above {WARM:g} degC are "
            f"too few for pack_series_resistance; {LEAST_STEPS} are needed"
        )
    di, dv, cell = (np.concatenate(column) for column in zip(*steps, strict=True))
    label = np.repeat(np.arange(len(steps)), [len(columns[0]) for columns in steps])
    found = linear({"series": di}, dv - cell * di, groups=as_groups(label))
    doubt = CELL_SHARE_SD * float(cell.mean())
    sd = float(np.hypot(found.sd("series"), doubt))
    whole = linear({"whole": di}, dv)["whole"]
    origin = "the pulse tests' steps" if pulses else "the cell tables"
    source = (
        f"{len(di)} steps above {least:g} A within {STEP_TIME:g} s of {len(steps)} rides above {WARM:g} degC: "
        f"{1e3 * whole:.1f} mohm, less {1e3 * cell.mean():.1f} mohm of {origin}"
    )
    model = (cell + found["series"]) * di
    result.fits.append(score("voltage step", "V", dv, model, held_out=False, source=source))
    result.panels += compared("Steps of pack voltage", "current [A]", "fall of voltage [V]", di, dv, model)
    if found["series"] < 2 * sd:
        result.refusals.append(
            f"pack_series_resistance: {1e3 * found['series']:+.1f} ± {1e3 * sd:.1f} mohm is left of {1e3 * whole:.1f} "
            f"mohm ({100 * CELL_SHARE_SD:.0f} % of the cells' own in doubt): the value of the vehicle file stays"
        )
    else:
        result.parameters["pack_series_resistance"] = Found(
            found["series"], sd, "ohm", source, "steps of pack_voltage over those of pack_current"
        )
    return result


def _ride_steps(
    ride: Recording, vehicle: Vehicle, by_temperature: tuple[Array, Array] | None, least: float, result: Result
) -> tuple[Array, Array, Array] | None:
    """(steps of current [A], falls of voltage [V], the cells' part of the resistance [ohm]) of a ride, each (m,).

    None for a ride without steps above `least` [A], or at a temperature at which the cells' part is too large or not
    known.
    """
    battery = vehicle.pack
    temperature = _mean_of(ride, "cell_temperature")
    if temperature < WARM:
        result.notes.append(f"{ride.name}: cells at {temperature:.0f} degC, left out: {WARM:g} degC are needed")
        return None
    columns = true_columns(ride.columns, vehicle.parameters)
    time, current = columns["pack_current"]
    voltage = np.interp(time, *columns["pack_voltage"])
    stride = max(round(STEP_TIME / float(np.median(np.diff(time)))), 1)
    step, drop = current[stride:] - current[:-stride], -(voltage[stride:] - voltage[:-stride])
    big = np.abs(step) > least
    if not big.any():
        return None
    if by_temperature is None:
        volts, amperes = float(np.median(voltage[:FIRST])), float(np.median(current[:FIRST]))
        load = standing_load(amperes, volts, vehicle.parameters["auxiliary_power"])
        start = first_soc(vehicle.model.at(Port.CELL_VOLTAGE), battery, (volts, amperes), temperature, load)
        charge = float(np.trapezoid(current, time))  # A·s; what half of it takes is the middle of the ride
        soc = start - discharged(charge, 0.5, battery.pack_capacity(temperature))
        r0, r1, c1 = battery.circuit(soc, temperature)
        cell_ohm = r0 + r1 * (1 - np.exp(-STEP_TIME / 2 / (r1 * c1)))
    else:
        low, high = by_temperature[0][[0, -1]]
        if not low <= temperature <= high:
            result.notes.append(
                f"{ride.name}: cells at {temperature:.0f} degC, outside the tests' {low:.0f} to {high:.0f}, left out"
            )
            return None
        cell_ohm = float(np.exp(np.interp(temperature, *by_temperature)))
    cells = battery.cells_series / battery.cells_parallel * cell_ohm
    return step[big], drop[big], np.full(int(big.sum()), cells)


def cell_steps(pulses: Sequence[Measurements]) -> tuple[Array, Array]:
    """(temperatures [degC], logarithms of the resistance [ohm] that a cell shows `STEP_TIME` after a step of current),
    by temperature; the median over states of charge above 0.1 of the charge passed. InputError for tests without steps.
    """
    rows = []
    for pulse in pulses:
        time, current, voltage = pulse["time"], pulse["current"], pulse["voltage"]
        charge = held_integral(time, current)
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


def _mean_of(ride: Recording, role: str) -> float:
    if role not in ride.columns:
        raise InputError(f"{ride.name}: no {role}, without which the cells' part of a step is unknown")
    return float(ride.columns[role][1].mean())
