"""The four cooling networks out of warm-up and cool-down (Lord 2016, eqs. 2.25-2.31, figs. 2.22-2.27).

The networks are the simulation's own, stepped at 1 s with the heat that was measured (bench) or that the vehicle's own
losses give (rides), and fitted by nonlinear least squares. A closed room has no airflow: capacities and the
conductances inside come from the bench, where the heat is measured, with a conductance to the ambient that is the
room's; that of riding comes from rides, and is what the vehicle file gets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import truncnorm

from gz_onboard.arrays import Array
from gz_onboard.errors import InputError
from gz_onboard.lab.calibrate.cooling_run import Run
from gz_onboard.lab.calibrate.fit import Solution, nonlinear, score
from gz_onboard.lab.calibrate.result import Found, Panel, Result, Trace
from gz_onboard.physics.cooling import PERIOD, InverterCooling, LumpedCooling, MotorCooling, temperatures
from gz_onboard.physics.parameters import declared_parameters
from gz_onboard.vehicle import Vehicle

LEAST_RISE = 3.0  # K
BLOCK = 300.0  # s: what is left over is taken to depend on itself for that long
MANY = 6  # runs: whole runs are then the independent pieces
START_SD = 0.15  # K
BENCH_SD, RIDE_SD = 0.2, 0.5  # K: resolution and noise of the sensors


# --- the networks: parameters by their names in the vehicle file, ``room`` for the conductance of a closed room

Values = Mapping[str, float]
Model = Callable[[Values, Run], dict[str, Array]]
"""The temperatures [degC] of a network over a run, by sensor, each of shape (n,)."""


def motor_temperatures(p: Values, run: Run) -> dict[str, Array]:
    """Of the stator. The rotor has no sensor and starts as warm as the stator.

    ``iron_share``: of the iron loss in the stator, if it has one of its own.
    """
    stator = _first(p, run, "motor_temperature")
    share, iron_share = p["motor_stator_share"], p.get("iron_share")
    network = MotorCooling.of({**p, "motor_rotor_to_ambient": 1.0}, stator)
    shares = np.full_like(run.time, share)
    if iron_share is not None:
        fraction = run.iron / np.where(np.abs(run.motor_heat) > 1.0, run.motor_heat, np.inf)
        shares = share + (iron_share - share) * fraction
    outside = _outside(p, run, "motor_rotor_to_ambient")
    result = np.empty_like(run.time)
    rows = zip(run.motor_heat.tolist(), run.ambient.tolist(), shares.tolist(), outside.tolist(), strict=True)
    for k, (heat, ambient, network.stator_share, conductance) in enumerate(rows):
        result[k] = network.stator
        network.step(PERIOD, heat, ambient, conductance)
    return {"motor_temperature": result}


def inverter_temperatures(p: Values, run: Run) -> dict[str, Array]:
    """Of board and box; without a sensor on it the box starts as warm as the board."""
    board = _first(p, run, "inverter_temperature")
    box = _first(
        p, run, "inverter_box_temperature" if "inverter_box_temperature" in run.measured else "inverter_temperature"
    )
    network = InverterCooling.of({**p, "inverter_box_to_ambient": 1.0}, board, box)
    outside = _outside(p, run, "inverter_box_to_ambient")
    result = np.empty((2, len(run.time)))
    rows = zip(run.inverter_heat.tolist(), run.ambient.tolist(), outside.tolist(), strict=True)
    for k, (heat, ambient, conductance) in enumerate(rows):
        result[:, k] = network.board, network.box
        network.step(PERIOD, heat, ambient, conductance)
    return {"inverter_temperature": result[0], "inverter_box_temperature": result[1]}


def pack_temperatures(p: Values, run: Run) -> dict[str, Array]:
    """Of the cells."""
    start = _first(p, run, "cell_temperature")
    return {"cell_temperature": _lumped(LumpedCooling.of(p, "pack", start), run.pack_heat, run.ambient)}


def bms_temperatures(p: Values, run: Run) -> dict[str, Array]:
    """Of the BMS, over the pack's temperature as measured."""
    start = _first(p, run, "bms_temperature")
    heat, cells = p["bms_resistance"] * run.pack_square, run.measured["cell_temperature"]
    return {"bms_temperature": _lumped(LumpedCooling.of(p, "bms", start), heat, cells)}


def _first(p: Values, run: Run, sensor: str) -> float:
    """Where the node of `sensor` starts [degC]: on a line through the sensor's first ten seconds, as a board warms
    fast. ``start:RUN:SENSOR`` is what is added to that."""
    first = run.measured[sensor][:10]
    line = np.polyfit(np.arange(len(first)) * PERIOD, first, 1)
    return float(line[1]) + p.get(f"start:{run.name}:{sensor}", 0.0)


def _lumped(network: LumpedCooling, heat: Array, ambient: Array) -> Array:
    return np.array(temperatures(network, PERIOD, heat.tolist(), ambient.tolist()))


def _outside(p: Values, run: Run, name: str) -> Array:
    """The conductance to the ambient [W/K], shape (n,)."""
    if run.still and "room" in p:
        return np.full_like(run.time, p["room"])
    conductance: Array = np.full_like(run.time, p[name]) + p.get("per_speed", 0.0) * run.speed
    return conductance


# --- the procedures


@dataclass(frozen=True)
class Job:
    """What is fitted: a network, its free parameters with start, those held, priors as (value, sd).

    outside: the conductance to the ambient, if a room has one of its own.
    """

    model: Model
    start: dict[str, float]
    held: dict[str, float]
    prior: dict[str, tuple[float, float]]
    outside: str = ""

    def error(self, values: Values, run: Run) -> Array:
        """Model less measured [K], all sensors of the run after one another."""
        modelled = self.model(values, run)
        return np.concatenate([modelled[name] - run.measured[name] for name in modelled if name in run.measured])

    def rms(self, values: Values, runs: Sequence[Run]) -> float:
        """[K], of all runs and sensors."""
        return float(np.sqrt(np.mean(np.concatenate([self.error(values, run) for run in runs]) ** 2)))

    def fit(self, runs: Sequence[Run], **more: float) -> tuple[Solution, dict[str, float]]:
        """(The solution, all values with it); `more`: further free parameters, with their starts."""
        start = {**self.start, **more}
        if self.outside in start:
            if any(run.still for run in runs):
                start["room"] = start[self.outside]
            if all(run.still for run in runs):
                del start[self.outside]
        prior = {name: known for name, known in self.prior.items() if name in start}
        least = {name: known.low for name, known in declared_parameters().items()}
        bounds = {name: (max(1e-4 * value, least.get(name, 0.0)), 1e3 * value) for name, value in start.items()}
        bounds |= {"per_speed": (-np.inf, np.inf), "iron_share": (0.0, 1.0)}
        if len(runs) < MANY:  # the noise of where a run starts lasts; of many runs the pieces are whole runs
            modelled = self.model({**self.held, **start}, runs[0])
            nodes = [f"start:{run.name}:{name}" for run in runs for name in modelled if name in run.measured]
            start |= dict.fromkeys(nodes, 0.0)
            prior |= dict.fromkeys(nodes, (0.0, START_SD))
            bounds |= dict.fromkeys(nodes, (-np.inf, np.inf))
        names = tuple(start)
        guess = {**self.held, **start}
        sd = np.concatenate([np.full(len(self.error(guess, run)), BENCH_SD if run.still else RIDE_SD) for run in runs])

        def residual(x: Array) -> Array:
            values = {**self.held, **dict(zip(names, x.tolist(), strict=True))}
            error: Array = np.concatenate([self.error(values, run) for run in runs]) / sd
            return error

        found = nonlinear(residual, start, bounds=bounds, prior=prior, known_sd=True, groups=self._pieces(runs))
        return found, {**self.held, **dict(zip(names, found.value.tolist(), strict=True))}

    def _pieces(self, runs: Sequence[Run]) -> Array:
        """For each residual the piece it belongs to: its run if there are `MANY`, else its `BLOCK`."""
        labels, first = [], 0.0
        for run in runs:
            piece = np.zeros_like(run.time) if len(runs) >= MANY else np.floor((run.time - run.time[0]) / BLOCK)
            sensors = len(self.error({**self.held, **self.start}, run)) // len(run.time)
            labels += [first + piece] * sensors
            first += piece[-1] + 1
        return np.concatenate(labels)


@dataclass(frozen=True)
class _Fitted:
    """What came out: of the closed room, if there was one, and of the rides; both are one without either."""

    still: Solution | None
    riding: Solution | None
    values: dict[str, float]

    def solution(self, name: str) -> Solution | None:
        """The fit that gave `name`."""
        return next((s for s in (self.riding, self.still) if s and name in s.names), None)


def _fit(job: Job, runs: Sequence[Run]) -> _Fitted:
    """The closed room first, then the conductance to the ambient out of the rides; either alone gives all."""
    still, rides = [run for run in runs if run.still], [run for run in runs if not run.still]
    if not job.outside or not (still and rides):
        found, values = job.fit(runs)
        return _Fitted(found if still and job.outside else None, None if still and job.outside else found, values)
    first, values = job.fit(still)
    held = {key: value for key, value in values.items() if key != job.outside}
    second, values = Job(job.model, {job.outside: job.start[job.outside]}, held, {}, job.outside).fit(rides)
    return _Fitted(first, _with_doubt(job, first, second, values, rides), values)


def _with_doubt(job: Job, first: Solution, second: Solution, values: Values, rides: Sequence[Run]) -> Solution:
    """`second`, its variance more by what the doubt of `first` about the inside of the network adds to it."""
    inner = [name for name in first.names if name in job.start]
    more = 0.0
    for shift in np.linalg.cholesky(first.part(inner)).T:  # each as likely as one sd, and independent
        moved = {**values, **{name: values[name] + d for name, d in zip(inner, shift.tolist(), strict=True)}}
        del moved[job.outside]
        again = Job(job.model, {job.outside: second[job.outside]}, moved, {}, job.outside).fit(rides)[0]
        more += (again[job.outside] - second[job.outside]) ** 2
    return replace(second, covariance=second.covariance + more)


def _with_doubt_of_held(
    job: Job, fitted: _Fitted, runs: Sequence[Run], doubted: Mapping[str, tuple[float, float]]
) -> _Fitted:
    """`fitted`, its covariances more by what holding a parameter at its (lower, upper) likely value would change."""
    still, riding = fitted.still, fitted.riding
    for name, values in doubted.items():
        for value in values:
            other = _fit(replace(job, held={**job.held, name: value}), runs)
            still = _moved(still, fitted.still, other.still)
            riding = _moved(riding, fitted.riding, other.riding)
    return _Fitted(still, riding, fitted.values)


def _moved(sum_: Solution | None, one: Solution | None, other: Solution | None) -> Solution | None:
    """`sum_` with half the square of `other` less `one` in its covariance: of two values as likely as each other."""
    if sum_ is None or one is None or other is None:
        return sum_
    change = other.value - one.value
    return replace(sum_, covariance=sum_.covariance + 0.5 * np.outer(change, change))


def _likely(vehicle: Vehicle, name: str) -> tuple[float, float]:
    """One sd below and above the mean of what is known of `name`, within its limits."""
    known, declared = vehicle.parameters.known[name], declared_parameters()[name]
    limits = ((edge - known.value) / known.sd for edge in (declared.low, declared.high))
    within = truncnorm(*limits, loc=known.value, scale=known.sd)
    return float(within.mean() - within.std()), float(within.mean() + within.std())


def _usable(runs: Sequence[Run], sensor: str, result: Result) -> list[Run]:
    """The runs with that sensor in which it changes enough to tell anything."""
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


def _score(job: Job, values: Values, runs: Sequence[Run], held_out: bool, result: Result) -> None:
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


def _panels(job: Job, values: Values, runs: Sequence[Run], held: Sequence[Run]) -> list[Panel]:
    panels = []
    for run in [*runs, *held]:
        x, traces, left, modelled = run.time - run.time[0], [], [], job.model(values, run)
        for sensor, model in modelled.items():
            if sensor in run.measured:
                label = sensor.removesuffix("_temperature").replace("_", " ")
                traces += [
                    Trace(f"{label}, measured", x, run.measured[sensor], "."),
                    Trace(f"{label}, model", x, model),
                ]
                left.append(Trace(label, x, model - run.measured[sensor]))
        title = f"{run.name}{' (held out)' if run in held else ''}"
        panels += [
            Panel(title, "time [s]", "temperature [degC]", tuple(traces)),
            Panel(f"{title}: residual", "time [s]", "model less measured [K]", tuple(left)),
        ]
    return panels


def _halves(runs: Sequence[Run]) -> tuple[list[Run], list[Run]]:
    """(to fit, held out): every second ride is held out, if there are two or more."""
    held = {run.name for run in [run for run in runs if not run.still][1::2]}
    return [run for run in runs if run.name not in held], [run for run in runs if run.name in held]


def _solve(
    result: Result,
    job: Job,
    runs: Sequence[Run],
    validation: Sequence[Run],
    names: Sequence[str],
    more: Mapping[str, float],
    doubted: Mapping[str, tuple[float, float]] | None = None,
    hold_out: bool = True,
) -> _Fitted:
    """The fit of all `runs`, put into `result` with its scores: in sample, on every second ride (fitted without them)
    and on `validation`. more: an sd that no sample shows, by parameter; doubted: as for `_with_doubt_of_held`."""
    fitted = _with_doubt_of_held(job, _fit(job, runs), runs, doubted or {})
    _score(job, fitted.values, runs, False, result)
    part, held = _halves(runs)
    if hold_out and held and part:
        _score(job, _fit(job, part).values, held, True, result)
    if validation:
        _score(job, fitted.values, validation, True, result)
    result.panels += _panels(job, fitted.values, runs, validation)
    for found in (fitted.still, fitted.riding):
        tied = tuple(name for name in names if found is not None and name in found.names)
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


def _source(runs: Sequence[Run]) -> str:
    names = [run.name for run in runs]
    listed = ", ".join(names if len(names) < 4 else [names[0], "...", names[-1]])
    return f"{listed}: {sum(len(run.time) for run in runs)} s"


def _outside_notes(result: Result, job: Job, fitted: _Fitted, runs: Sequence[Run], hold_out: bool) -> None:
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
    part, held = _halves(rides)
    if not held or not hold_out:
        return
    inner = {key: value for key, value in fitted.values.items() if key != name}
    alone = Job(job.model, {name: job.start[name]}, inner, {}, name)
    plain, (found, values) = alone.fit(part)[1], alone.fit(part, per_speed=0.01)
    slope, sd = found["per_speed"], found.sd("per_speed")
    before, after = job.rms(plain, held), job.rms(values, held)
    if slope < 2 * sd or after > 0.95 * before:
        verdict = "not asked for"
    elif values[name] < 0.1 * plain[name]:
        verdict = "no airflow that is zero at standstill: something else that grows with speed is meant"
    else:
        verdict = "asked for, but the network has one constant"
    result.notes.append(
        f"{name} over speed: {values[name]:.2f} + ({slope:.3f} ± {sd:.3f})·V W/K, V in m/s; held-out rides "
        f"{before:.2f} K rms without, {after:.2f} K with: {verdict}"
    )


def motor_cooling(
    runs: Sequence[Run], vehicle: Vehicle, validation: Sequence[Run] = (), hold_out: bool = True
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
    job = Job(motor_temperatures, {name: p[name] for name in names}, held, _priors(vehicle, names[:3]), names[3])
    doubted = {"motor_stator_share": _likely(vehicle, "motor_stator_share")}
    fitted = _solve(result, job, runs, validation, names, {}, doubted, hold_out)
    if hold_out:
        _share_refusal(result, job, runs)
        _iron_note(result, job, fitted, runs, validation)
    return result


def _priors(vehicle: Vehicle, names: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Wide ones, three sd: they only stop what the data do not bound."""
    known = vehicle.parameters.known
    return {name: (known[name].value, 3 * max(known[name].sd, 0.3 * known[name].value)) for name in names}


def _share_refusal(result: Result, job: Job, runs: Sequence[Run]) -> None:
    """Whether the data tell the stator's share of the heat: the rest fitted anew at two other shares."""
    some = [run for run in runs if run.still] or list(runs)
    rms = {}
    for share in (0.75, job.held["motor_stator_share"], 1.0):
        other = Job(job.model, job.start, {"motor_stator_share": share}, job.prior, job.outside)
        rms[share] = other.rms(other.fit(some)[1], some)
    text = ", ".join(f"{value:.3f} K at {share:g}" for share, value in rms.items())
    if max(rms.values()) < 1.05 * min(rms.values()):
        result.refusals.append(
            f"motor_stator_share: the data cannot separate it from the two capacities (profile: rms {text}); held at "
            f"{job.held['motor_stator_share']:g}"
        )
    else:
        result.notes.append(f"motor_stator_share held at {job.held['motor_stator_share']:g}; rms {text}")


def _iron_note(result: Result, job: Job, fitted: _Fitted, runs: Sequence[Run], validation: Sequence[Run]) -> None:
    """What a share of its own for the iron loss would do, which the network does not know."""
    part, held = _halves(runs)
    if not held or not any(run.iron.sum() > 0.1 * run.motor_heat.sum() for run in runs):
        return
    check = [*held, *validation]
    before = job.rms(_fit(job, part).values, check)
    found, values = Job(job.model, job.start, {"motor_stator_share": 1.0}, job.prior, job.outside).fit(
        part, iron_share=0.8
    )
    after = job.rms(values, check)
    if after < 0.8 * before:
        result.notes.append(
            f"if iron loss had a share of its own, {found['iron_share']:.2f} ± {found.sd('iron_share'):.2f} of it "
            f"would warm the stator: held-out rms {after:.2f} K instead of {before:.2f} K, {job.outside} "
            f"{found[job.outside]:.2f} W/K. One share for all heat makes fast rides too warm"
        )


def inverter_cooling(
    runs: Sequence[Run], vehicle: Vehicle, validation: Sequence[Run] = (), hold_out: bool = True
) -> Result:
    """Capacities of board and box, the conductance between them and the box's to the ambient.

    Between board and box act board_to_box and, beside it, the two to the air in series: the air has no sensor and no
    capacity, so that only the sum can be told; the two to the air stay as they are.
    """
    p = vehicle.parameters
    names = ("inverter_board_capacity", "inverter_box_capacity", "inverter_board_to_box", "inverter_box_to_ambient")
    air = ("inverter_board_to_air", "inverter_box_to_air")
    result = Result("inverter_cooling")
    runs = _usable(runs, "inverter_temperature", result)
    held = {name: p[name] for name in air}
    job = Job(inverter_temperatures, {name: p[name] for name in names}, held, _priors(vehicle, names[:3]), names[3])
    b, c = held.values()
    series, sds = b * c / (b + c), [p.known[name].sd for name in air]
    series_sd = float(np.hypot(sds[0] * (c / (b + c)) ** 2, sds[1] * (b / (b + c)) ** 2))
    fitted = _solve(result, job, runs, validation, names, {names[2]: series_sd}, hold_out=hold_out)
    found = fitted.solution(names[2])
    assert found is not None
    result.refusals.append(
        f"inverter_board_to_air, inverter_box_to_air: only board_to_box + b·c/(b + c) = {found[names[2]] + series:.2f} "
        f"± {found.sd(names[2]):.2f} W/K acts between board and box; the two are held at {b:g} and {c:g} W/K"
    )
    if not any("inverter_box_temperature" in run.measured for run in runs):
        result.refusals.append(f"{names[1]}, {names[2]}: no sensor on the box, so that both lean on their priors")
    return result


def pack_cooling(runs: Sequence[Run], vehicle: Vehicle, validation: Sequence[Run] = ()) -> Result:
    """pack_heat_capacity and pack_conductance out of rides and dynamometer runs; InputError without pack heat."""
    names = ("pack_heat_capacity", "pack_conductance")
    result = Result("pack_cooling")
    runs = _usable([run for run in runs if run.pack_heat.any()], "cell_temperature", result)
    start = {name: vehicle.parameters[name] for name in names}
    job = Job(pack_temperatures, start, {}, _priors(vehicle, names[1:]))
    found = _solve(result, job, runs, validation, names, {}).riding
    assert found is not None
    if found.sd(names[1]) > 0.3 * found[names[1]]:
        result.refusals.append(
            f"pack_conductance: {found[names[1]]:.2f} ± {found.sd(names[1]):.2f} W/K: these runs hardly cool the pack"
        )
    return result


def bms_cooling(runs: Sequence[Run], vehicle: Vehicle, validation: Sequence[Run] = ()) -> Result:
    """bms_resistance, bms_heat_capacity, bms_conductance: the board over the cells it sits on.

    Temperatures tell their ratios only (heat scales with all three), so that the scale is that of the priors.
    """
    p = vehicle.parameters
    names = ("bms_resistance", "bms_heat_capacity", "bms_conductance")
    result = Result("bms_cooling")
    runs = _usable([run for run in runs if "cell_temperature" in run.measured], "bms_temperature", result)
    prior = {name: (p.known[name].value, p.known[name].sd) for name in names}
    job = Job(bms_temperatures, {name: p[name] for name in names}, {}, prior)
    found = _solve(result, job, runs, validation, names, {}).riding
    assert found is not None
    r, c, g = (found[name] for name in names)
    result.refusals.append(
        f"bms_resistance, bms_heat_capacity, bms_conductance: the data tell resistance/conductance = {1e3 * r / g:.2f} "
        f"mohm·K/W and capacity/conductance = {c / g:.0f} s only; their scale is that of the priors"
    )
    return result
