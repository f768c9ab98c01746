"""The four cooling networks out of warm-up and cool-down (Lord 2016, eqs. 2.25-2.31, figs. 2.22-2.27).

The networks are the simulation's own, stepped at 1 s with the heat that was measured (bench) or that the vehicle's own
losses give (rides), and fitted by nonlinear least squares to all runs together. Bench and rides are one network: they
differ in the air that moves past it, which each run states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gz_onboard.calibration import cooling_network as network
from gz_onboard.calibration.cooling_fit import Job, halves
from gz_onboard.calibration.cooling_network import ENTROPY, ENTROPY_SOC
from gz_onboard.calibration.cooling_run import CoolingRun
from gz_onboard.calibration.fit import Solution, score
from gz_onboard.calibration.result import Curve, Panel, PlotLine, Result
from gz_onboard.errors import InputError
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.vehicle import Vehicle

LEAST_RISE = 3.0  # K
SHARE_KNOWN = 0.5  # of its prior's sd: what the data tell of a share that is wider is no more than the prior
ENTROPY_SD = 5e-4  # V/K: lithium-ion cells are within ± 0.5 mV/K but near empty (Viswanathan 2010)
SURE = 2.0  # sd
BOARD_LEAST = 0.25  # of the resistance of bars, fuse and BMS, in the BMS: its transistors and its shunt


def _usable(runs: Sequence[CoolingRun], sensor: str, result: Result) -> list[CoolingRun]:
    """The runs with that sensor in which it changes enough to be of use."""
    good, least = [], 1.0 if sensor == "cell_temperature" else LEAST_RISE
    for run in runs:
        if sensor not in run.measured:
            result.notes.append(f"{run.name}: no {sensor}, left out")
        elif (rise := float(np.ptp(run.measured[sensor]))) < least:
            result.notes.append(f"{run.name}: {sensor} changes by {rise:.1f} K only, left out")
        else:
            good.append(run)
    if not good:
        raise InputError(f"no run tells anything of {sensor}: it is not measured, or changes by less than {least:g} K")
    return good


def _score(job: Job, values: network.Values, runs: Sequence[CoolingRun], held_out: bool, result: Result) -> None:
    """A fit for each sensor over the runs on a bench, and one over the rides."""
    for kind in ("bench", "riding"):
        some = [run for run in runs if run.bench == (kind == "bench")]
        modelled = [job.model(values, run) for run in some]
        for sensor in modelled[0] if some else ():
            pairs = [
                (r.measured[sensor], m[sensor]) for r, m in zip(some, modelled, strict=True) if sensor in r.measured
            ]
            if pairs:
                data, model = (np.concatenate(column) for column in zip(*pairs, strict=True))
                what, names = f"{sensor.replace('_', ' ')}, {kind}", ", ".join(run.name for run in some)
                result.fits.append(score(what, "degC", data, model, held_out=held_out, source=names))


def _panels(job: Job, values: network.Values, runs: Sequence[CoolingRun], held: Sequence[CoolingRun]) -> list[Panel]:
    panels = []
    for run in [*runs, *held]:
        x, traces, modelled = run.time - run.time[0], [], job.model(values, run)
        for sensor, model in modelled.items():
            if sensor in run.measured:
                label = sensor.removesuffix("_temperature").replace("_", " ")
                traces += [
                    PlotLine(f"{label}, measured", x, run.measured[sensor], "."),
                    PlotLine(f"{label}, model", x, model),
                ]
        title = f"{run.name}{' (held out)' if run in held else ''}"
        panels.append(Panel(title, "time [s]", "temperature [degC]", tuple(traces)))
    return panels


def _solve(
    result: Result, job: Job, runs: Sequence[CoolingRun], validation: Sequence[CoolingRun], hold_out: bool = True
) -> Solution:
    """The fit of all `runs`, put into `result` with its scores: in sample, on every second ride (fitted without them)
    and on `validation`."""
    (found, values), more = job.fit(runs), job.further_sd
    _score(job, values, runs, False, result)
    part, held = halves(runs)
    if hold_out and held and part:
        _score(job, job.fit(part)[1], held, True, result)
    if validation:
        _score(job, values, validation, True, result)
    result.panels += _panels(job, values, runs, validation)
    source = f"{_source(runs)}; rms {job.rms(values, runs):.2g} K"
    tied = tuple(name for name in job.start if name in found.names and name not in ENTROPY)
    for name in tied:
        result.parameters[name] = found.found(name, _UNITS[name.rpartition("_")[2]], source, more.get(name, 0.0))
    extra = np.diag([more.get(name, 0.0) ** 2 for name in tied])
    result.covariance.append((tied, found.part(tied) + extra))
    if job.per_speed:
        _airflow_notes(result, job, found, values)
    return found


_UNITS = {
    "capacity": "J/K",
    "conductance": "W/K",
    "ambient": "W/K",
    "box": "W/K",
    "speed": "W·s/(K·m)",
    "share": "1",
    "resistance": "ohm",
}


def _with_source(result: Result, names: Sequence[str], more: str) -> None:
    """Put what is known of them together to the source of parameters."""
    for name in names:
        found = result.parameters[name]
        result.parameters[name] = replace(found, source=f"{found.source}; {more}")


def _source(runs: Sequence[CoolingRun]) -> str:
    names = [run.name for run in runs]
    listed = ", ".join(names if len(names) < 4 else [names[0], "...", names[-1]])
    return f"{listed}: {sum(len(run.time) for run in runs)} s"


def _airflow_notes(result: Result, job: Job, found: Solution, values: network.Values) -> None:
    """What moving air adds to the conductance to the ambient, or that no run tells it."""
    name = job.per_speed
    if name not in found.names:
        result.refusals.append(f"{name}: no air moved in any of the runs: {values[name]:g} W·s/(K·m) of the file stays")
        return
    still = name.replace("per_speed", "to_ambient")
    sure = "" if found[name] > SURE * found.sd(name) else ", which is not distinguishable from none"
    result.notes.append(
        f"{still}: {found[still]:.2f} ± {found.sd(still):.2f} W/K in still air, and {found[name]:.3f} ± "
        f"{found.sd(name):.3f} W/K more for each m/s of moving air{sure}"
    )


def motor_cooling(
    runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = (), hold_out: bool = True
) -> Result:
    """Capacities of stator and rotor, the gap's conductance, the rotor's to the ambient over the speed of the air, and
    the stator's share of the heat that comes without current.

    `validation` is never fitted. hold_out: also fit parts of the runs and score the rest, which takes twice as long.
    Raises InputError if the motor's temperature changes in none of the runs.
    """
    share, speed = "motor_iron_share", "motor_rotor_per_speed"
    names = ("motor_stator_capacity", "motor_rotor_capacity", "motor_gap_conductance", "motor_rotor_to_ambient")
    result = Result("motor_cooling")
    runs = _usable(runs, "motor_temperature", result)
    known = declared_parameters()[share]
    prior = _priors(vehicle, (*names, speed)) | {share: (known.prior, known.prior_sd)}
    job = Job(network.motor_temperatures, _starts(vehicle, (*names, speed, share)), {}, prior, speed)
    found = _solve(result, job, runs, validation, hold_out)
    if found.sd(share) > SHARE_KNOWN * known.prior_sd:
        result.refusals.append(
            f"{share}: {found[share]:.2f} ± {found.sd(share):.2f}: the data cannot separate it from the capacities and "
            f"the rotor's cooling; it leans on its prior, {known.prior:g} ± {known.prior_sd:g}"
        )
    return result


def _starts(vehicle: Vehicle, names: Sequence[str]) -> dict[str, float]:
    """What the file says; where that is nothing, its sd, as a search needs a size."""
    return {name: vehicle.parameters[name] or vehicle.parameters.sd(name) for name in names}


def _priors(vehicle: Vehicle, names: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Wide ones, three sd: they only stop what the data do not bound."""
    known = vehicle.parameters.known
    return {name: (known[name].value, 3 * max(known[name].sd, 0.3 * known[name].value)) for name in names}


def inverter_cooling(
    runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = (), hold_out: bool = True
) -> Result:
    """Capacities of board and box, the conductance between them and the box's to the ambient over the air's speed.

    Between board and box act board_to_box and, beside it, the two to the air in series: the air has no sensor and no
    capacity, so that only the sum is determined; the two to the air stay as they are.
    """
    p = vehicle.parameters
    names = ("inverter_board_capacity", "inverter_box_capacity", "inverter_board_to_box", "inverter_box_to_ambient")
    air, speed = ("inverter_board_to_air", "inverter_box_to_air"), "inverter_box_per_speed"
    result = Result("inverter_cooling")
    runs = _usable(runs, "inverter_temperature", result)
    held = {name: p[name] for name in air}
    b, c = held.values()
    series, sds = b * c / (b + c), [p.known[name].sd for name in air]
    series_sd = float(np.hypot(sds[0] * (c / (b + c)) ** 2, sds[1] * (b / (b + c)) ** 2))
    further_sd, free = {names[2]: series_sd}, (*names, speed)
    job = Job(network.inverter_temperatures, _starts(vehicle, free), held, _priors(vehicle, free), speed, further_sd)
    found = _solve(result, job, runs, validation, hold_out)
    acts = f"only board_to_box + b·c/(b + c) = {found[names[2]] + series:.2f} ± {found.sd(names[2]):.2f} W/K acts"
    _with_source(result, names[2:3], f"{acts}, of which the air's part is held")
    result.refusals.append(
        f"inverter_board_to_air, inverter_box_to_air: {acts} between board and box; the two are held at {b:g} and "
        f"{c:g} W/K"
    )
    if not any("inverter_box_temperature" in run.measured for run in runs):
        result.refusals.append(f"{names[1]}, {names[2]}: no sensor on the box, so that both lean on their priors")
    return result


def pack_cooling(
    runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = (), hold_out: bool = True
) -> Result:
    """pack_heat_capacity, pack_conductance and the cells' entropy over SOC out of rides and dynamometer runs.

    What a cell's reaction gives as heat turns its sign with SOC and is as large as what it loses, so that the three can
    only be found together. InputError without pack heat.
    """
    names = ("pack_heat_capacity", "pack_conductance")
    result = Result("pack_cooling")
    runs = _usable([run for run in runs if run.pack_heat.any()], "cell_temperature", result)
    start = {name: vehicle.parameters[name] for name in names} | dict.fromkeys(ENTROPY, -ENTROPY_SD)
    prior = _priors(vehicle, names[1:]) | dict.fromkeys(ENTROPY, (0.0, ENTROPY_SD))
    found = _solve(result, Job(network.pack_temperatures, start, {}, prior), runs, validation, hold_out)
    sd = np.array([found.sd(name) for name in ENTROPY])
    value = np.array([found[name] for name in ENTROPY])
    covered = sd < SHARE_KNOWN * ENTROPY_SD
    if covered.any():
        axis = np.array(ENTROPY_SOC)
        value = np.interp(axis, axis[covered], value[covered])
        curve = Curve({"soc": axis}, value, np.where(covered, sd, np.nan), "V/K", f"{_source(runs)}: heat of the cells")
        result.curves["battery.entropy"] = curve
    else:
        result.refusals.append("battery.entropy: these runs do not tell it from heat capacity and conductance")
    if found.sd(names[1]) > 0.3 * found[names[1]]:
        result.refusals.append(
            f"pack_conductance: {found[names[1]]:.2f} ± {found.sd(names[1]):.2f} W/K: these runs hardly cool the pack"
        )
    return result


def board_resistance(vehicle: Vehicle) -> tuple[float, float]:
    """(value, sd) of bms_resistance [ohm]: of the measured drop beside the cells anything from `BOARD_LEAST` to all.

    Where that drop is not measured, what the file says of the board.
    """
    known = vehicle.parameters.known
    series = known["pack_series_resistance"]
    if series.status != "measured":
        return known["bms_resistance"].value, known["bms_resistance"].sd
    share, share_sd = (1 + BOARD_LEAST) / 2, (1 - BOARD_LEAST) / 12**0.5
    return share * series.value, float(np.hypot(share_sd * series.value, share * series.sd))


def bms_cooling(runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = ()) -> Result:
    """bms_resistance, bms_heat_capacity, bms_conductance: the board over the cells it sits on.

    Temperatures determine their ratios only: heat scales with all three. The scale is that of the priors, for the
    resistance `board_resistance`.
    """
    p = vehicle.parameters
    names = ("bms_resistance", "bms_heat_capacity", "bms_conductance")
    result = Result("bms_cooling")
    runs = _usable([run for run in runs if "cell_temperature" in run.measured], "bms_temperature", result)
    prior = {name: (p.known[name].value, p.known[name].sd) for name in names}
    prior[names[0]] = board_resistance(vehicle)
    job = Job(network.bms_temperatures, {name: p[name] for name in names}, {}, prior)
    found = _solve(result, job, runs, validation)
    r, c, g = (found[name] for name in names)
    known = f"resistance/conductance = {1e3 * r / g:.2f} mohm·K/W and capacity/conductance = {c / g:.0f} s only"
    value, sd = (1e3 * x for x in prior[names[0]])
    scale = f"the scale is that of the priors, {value:.1f} ± {sd:.1f} mohm for the resistance"
    _with_source(result, names, f"tells {known}; {scale}")
    result.refusals.append(f"{', '.join(names)}: the data tell {known}; {scale}")
    return result
