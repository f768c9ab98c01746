"""The four cooling networks out of warm-up and cool-down (Lord 2016, eqs. 2.25-2.31, figs. 2.22-2.27).

The networks are the simulation's own, stepped at 1 s with the heat that was measured (bench) or that the vehicle's own
losses give (rides), and fitted by nonlinear least squares. A closed room has no airflow: capacities and the
conductances inside come from the bench, where the heat is measured, with a conductance to the ambient that is the
room's; that of riding comes from rides, and is what the vehicle file gets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import truncnorm

from gz_onboard.errors import InputError
from gz_onboard.lab.calibrate import cooling_network as network
from gz_onboard.lab.calibrate.cooling_fit import Fitted, Job, fit_networks, halves, with_doubt_of_held
from gz_onboard.lab.calibrate.cooling_run import CoolingRun
from gz_onboard.lab.calibrate.fit import score
from gz_onboard.lab.calibrate.result import Found, Panel, PlotLine, Result
from gz_onboard.physics.parameters import declared_parameters
from gz_onboard.vehicle import Vehicle

LEAST_RISE = 3.0  # K
BETTER, MUCH_BETTER = 0.95, 0.8  # of the rms on held-out runs: what a term more must bring to be asked for, to be noted
SAME = 1.05  # between the rms of fits that the data cannot tell apart
LITTLE = 0.1  # of a conductance or a heat: less counts as none


def _likely(vehicle: Vehicle, name: str) -> tuple[float, float]:
    """One sd below and above the mean of what is known of `name`, within its limits."""
    known, declared = vehicle.parameters.known[name], declared_parameters()[name]
    limits = ((edge - known.value) / known.sd for edge in (declared.low, declared.high))
    within = truncnorm(*limits, loc=known.value, scale=known.sd)
    return float(within.mean() - within.std()), float(within.mean() + within.std())


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
    """A fit for each sensor over the still runs, and one over the rides."""
    for kind in ("closed room", "riding"):
        some = [run for run in runs if run.still == (kind == "closed room")]
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
        x, traces, left, modelled = run.time - run.time[0], [], [], job.model(values, run)
        for sensor, model in modelled.items():
            if sensor in run.measured:
                label = sensor.removesuffix("_temperature").replace("_", " ")
                traces += [
                    PlotLine(f"{label}, measured", x, run.measured[sensor], "."),
                    PlotLine(f"{label}, model", x, model),
                ]
                left.append(PlotLine(label, x, run.measured[sensor] - model))
        title = f"{run.name}{' (held out)' if run in held else ''}"
        panels += [
            Panel(title, "time [s]", "temperature [degC]", tuple(traces)),
            Panel(f"{title}: residual", "time [s]", "measured less model [K]", tuple(left)),
        ]
    return panels


def _solve(
    result: Result, job: Job, runs: Sequence[CoolingRun], validation: Sequence[CoolingRun], hold_out: bool = True
) -> Fitted:
    """The fit of all `runs`, put into `result` with its scores: in sample, on every second ride (fitted without them)
    and on `validation`."""
    fitted, more = with_doubt_of_held(job, fit_networks(job, runs), runs), job.further_sd
    _score(job, fitted.values, runs, False, result)
    part, held = halves(runs)
    if hold_out and held and part:
        _score(job, fit_networks(job, part).values, held, True, result)
    if validation:
        _score(job, fitted.values, validation, True, result)
    result.panels += _panels(job, fitted.values, runs, validation)
    for found in (fitted.still, fitted.riding):
        tied = tuple(name for name in job.start if found is not None and name in found.names)
        if found is None or not tied:
            continue
        some = [run for run in runs if run.still == (found is fitted.still)] if job.outside else runs
        source = f"{_source(some)}; rms {job.rms(fitted.values, some):.2g} K"
        for name in tied:
            result.parameters[name] = found.found(name, _UNITS[name.rpartition("_")[2]], source, more.get(name, 0.0))
        if len(tied) > 1:
            extra = np.diag([more.get(name, 0.0) ** 2 for name in tied])
            result.covariance.append((tied, found.part(tied) + extra))
    if job.outside:
        _outside_notes(result, job, fitted, runs, hold_out)
    return fitted


_UNITS = {"capacity": "J/K", "conductance": "W/K", "ambient": "W/K", "box": "W/K", "air": "W/K", "resistance": "ohm"}


def _source(runs: Sequence[CoolingRun]) -> str:
    names = [run.name for run in runs]
    listed = ", ".join(names if len(names) < 4 else [names[0], "...", names[-1]])
    return f"{listed}: {sum(len(run.time) for run in runs)} s"


def _outside_notes(result: Result, job: Job, fitted: Fitted, runs: Sequence[CoolingRun], hold_out: bool) -> None:
    """How the airflow of riding differs from a closed room, and whether it grows with speed."""
    name, still, riding = job.outside, fitted.still, fitted.riding
    if still is None or riding is None:
        if still is not None:
            sd = float(np.hypot(still.sd("room"), 0.5 * still["room"]))
            result.parameters[name] = Found(still["room"], sd, "W/K", f"{_source(runs)}; closed room")
            result.refusals.append(
                f"{name}: {still['room']:.2f} W/K is that of a closed room; without a ride that of riding is unknown "
                "(half of it is taken as its sd)"
            )
        return
    rides = [run for run in runs if not run.still]
    at_room = {**fitted.values, name: still["room"]}
    result.notes.append(
        f"{name}: {riding[name]:.2f} ± {riding.sd(name):.2f} W/K riding, {still['room']:.2f} ± {still.sd('room'):.2f} "
        f"in a closed room, which would leave {job.rms(at_room, rides):.2f} K rms on the rides instead of "
        f"{job.rms(fitted.values, rides):.2f} K"
    )
    part, held = halves(rides)
    if not held or not hold_out:
        return
    inner = {key: value for key, value in fitted.values.items() if key != name}
    outer = job.of_outside(job.start[name], inner)
    plain, (found, values) = outer.fit(part)[1], outer.fit(part, per_speed=0.01)
    slope, sd = found["per_speed"], found.sd("per_speed")
    before, after = job.rms(plain, held), job.rms(values, held)
    if slope < 2 * sd or after > BETTER * before:
        verdict = "not asked for"
    elif values[name] < LITTLE * plain[name]:
        verdict = "no airflow that is zero at standstill: something else that grows with speed is meant"
    else:
        verdict = "asked for, but the network has one constant"
    result.notes.append(
        f"{name} over speed: {values[name]:.2f} + ({slope:.3f} ± {sd:.3f})·V W/K, V in m/s; held-out rides "
        f"{before:.2f} K rms without, {after:.2f} K with: {verdict}"
    )


def motor_cooling(
    runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = (), hold_out: bool = True
) -> Result:
    """Capacities of stator and rotor, the gap's conductance and the rotor's to the ambient.

    `validation` is never fitted. hold_out: also fit parts of the runs and score the rest, and say what other networks
    would do, which takes five times as long. Raises InputError if the motor's temperature changes in none of the runs.
    """
    p = vehicle.parameters
    names = ("motor_stator_capacity", "motor_rotor_capacity", "motor_gap_conductance", "motor_rotor_to_ambient")
    result = Result("motor_cooling")
    runs = _usable(runs, "motor_temperature", result)
    held = {"motor_stator_share": p["motor_stator_share"]}
    start, doubted = {name: p[name] for name in names}, {name: _likely(vehicle, name) for name in held}
    job = Job(network.motor_temperatures, start, held, _priors(vehicle, names[:3]), names[3], doubted)
    _solve(result, job, runs, validation, hold_out)
    if hold_out:
        _share_refusal(result, job, runs)
        _iron_note(result, job, runs, validation)
    return result


def _priors(vehicle: Vehicle, names: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Wide ones, three sd: they only stop what the data do not bound."""
    known = vehicle.parameters.known
    return {name: (known[name].value, 3 * max(known[name].sd, 0.3 * known[name].value)) for name in names}


def _share_refusal(result: Result, job: Job, runs: Sequence[CoolingRun]) -> None:
    """Whether the data determine the stator's share of the heat: the rest fitted anew at two other shares."""
    some = [run for run in runs if run.still] or list(runs)
    rms = {}
    for share in (0.75, job.held["motor_stator_share"], 1.0):
        other = replace(job, held={"motor_stator_share": share})
        rms[share] = other.rms(other.fit(some)[1], some)
    text = ", ".join(f"{value:.3f} K at {share:g}" for share, value in rms.items())
    if max(rms.values()) < SAME * min(rms.values()):
        result.refusals.append(
            f"motor_stator_share: the data cannot separate it from the two capacities (profile: rms {text}); held at "
            f"{job.held['motor_stator_share']:g}"
        )
    else:
        result.notes.append(f"motor_stator_share held at {job.held['motor_stator_share']:g}; rms {text}")


def _iron_note(result: Result, job: Job, runs: Sequence[CoolingRun], validation: Sequence[CoolingRun]) -> None:
    """What a share of its own for the iron loss would do, which the network does not know."""
    part, held = halves(runs)
    if not held or not any(run.iron.sum() > LITTLE * run.motor_heat.sum() for run in runs):
        return
    check = [*held, *validation]
    before = job.rms(fit_networks(job, part).values, check)
    found, values = replace(job, held={"motor_stator_share": 1.0}).fit(part, iron_share=0.8)
    after = job.rms(values, check)
    if after < MUCH_BETTER * before:
        result.notes.append(
            f"if iron loss had a share of its own, {found['iron_share']:.2f} ± {found.sd('iron_share'):.2f} of it "
            f"would warm the stator: held-out rms {after:.2f} K instead of {before:.2f} K, {job.outside} "
            f"{found[job.outside]:.2f} W/K. One share for all heat makes fast rides too warm"
        )


def inverter_cooling(
    runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = (), hold_out: bool = True
) -> Result:
    """Capacities of board and box, the conductance between them and the box's to the ambient.

    Between board and box act board_to_box and, beside it, the two to the air in series: the air has no sensor and no
    capacity, so that only the sum is determined; the two to the air stay as they are.
    """
    p = vehicle.parameters
    names = ("inverter_board_capacity", "inverter_box_capacity", "inverter_board_to_box", "inverter_box_to_ambient")
    air = ("inverter_board_to_air", "inverter_box_to_air")
    result = Result("inverter_cooling")
    runs = _usable(runs, "inverter_temperature", result)
    held = {name: p[name] for name in air}
    b, c = held.values()
    series, sds = b * c / (b + c), [p.known[name].sd for name in air]
    series_sd = float(np.hypot(sds[0] * (c / (b + c)) ** 2, sds[1] * (b / (b + c)) ** 2))
    start, further_sd = {name: p[name] for name in names}, {names[2]: series_sd}
    job = Job(network.inverter_temperatures, start, held, _priors(vehicle, names[:3]), names[3], further_sd=further_sd)
    fitted = _solve(result, job, runs, validation, hold_out)
    found = fitted.solution(names[2])
    assert found is not None
    result.refusals.append(
        f"inverter_board_to_air, inverter_box_to_air: only board_to_box + b·c/(b + c) = {found[names[2]] + series:.2f} "
        f"± {found.sd(names[2]):.2f} W/K acts between board and box; the two are held at {b:g} and {c:g} W/K"
    )
    if not any("inverter_box_temperature" in run.measured for run in runs):
        result.refusals.append(f"{names[1]}, {names[2]}: no sensor on the box, so that both lean on their priors")
    return result


def pack_cooling(runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = ()) -> Result:
    """pack_heat_capacity and pack_conductance out of rides and dynamometer runs; InputError without pack heat."""
    names = ("pack_heat_capacity", "pack_conductance")
    result = Result("pack_cooling")
    runs = _usable([run for run in runs if run.pack_heat.any()], "cell_temperature", result)
    start = {name: vehicle.parameters[name] for name in names}
    job = Job(network.pack_temperatures, start, {}, _priors(vehicle, names[1:]))
    found = _solve(result, job, runs, validation).riding
    assert found is not None
    if found.sd(names[1]) > 0.3 * found[names[1]]:
        result.refusals.append(
            f"pack_conductance: {found[names[1]]:.2f} ± {found.sd(names[1]):.2f} W/K: these runs hardly cool the pack"
        )
    return result


def bms_cooling(runs: Sequence[CoolingRun], vehicle: Vehicle, validation: Sequence[CoolingRun] = ()) -> Result:
    """bms_resistance, bms_heat_capacity, bms_conductance: the board over the cells it sits on.

    Temperatures determine their ratios only (heat scales with all three), so that the scale is that of the priors.
    """
    p = vehicle.parameters
    names = ("bms_resistance", "bms_heat_capacity", "bms_conductance")
    result = Result("bms_cooling")
    runs = _usable([run for run in runs if "cell_temperature" in run.measured], "bms_temperature", result)
    prior = {name: (p.known[name].value, p.known[name].sd) for name in names}
    job = Job(network.bms_temperatures, {name: p[name] for name in names}, {}, prior)
    found = _solve(result, job, runs, validation).riding
    assert found is not None
    r, c, g = (found[name] for name in names)
    result.refusals.append(
        f"bms_resistance, bms_heat_capacity, bms_conductance: the data tell resistance/conductance = {1e3 * r / g:.2f} "
        f"mohm·K/W and capacity/conductance = {c / g:.0f} s only; their scale is that of the priors"
    )
    return result
