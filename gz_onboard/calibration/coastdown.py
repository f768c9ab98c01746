"""Coast-downs: rolling resistance and drag area out of rolling to rest (Lord 2016, sec. 3.2; SAE J1263, J2263).

    (m + J/r²)·dV/dt = -m·g·(c0·cos θ + c1·V + sin θ) - ½·ρ·CdA·(V + w)·|V + w| - P_motor(V/r)/V

Runs in both directions of one track: its slope changes sign with the direction, the rest does not. Each run has a
constant headwind w, unknown but for a prior. The motor turns with the wheel: its drag without current is taken off by
the vehicle's motor model. Air density is that of the measured temperature and altitude.

Force over spans of two seconds is fitted by generalised least squares, all runs at once. The residual has two parts,
both found by maximum likelihood: gusts, whose force grows with speed and lasts some seconds, and noise of the speed,
which two neighbouring spans share with opposite signs. Without that, samples would count as independent and the
standard deviations would be too small (Kariya & Kurata 2004).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from math import sqrt
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize

from gz_onboard.arrays import Array, Mask, stretches
from gz_onboard.calibration.fit import Solution, linear, score
from gz_onboard.calibration.result import Fit, Found, Panel, PlotLine, Result
from gz_onboard.constants import GRAVITY
from gz_onboard.errors import InputError
from gz_onboard.model.effect import ROAD_LOAD, Port
from gz_onboard.model.effects.inertia import rotating_mass
from gz_onboard.model.model import Bound, air_density
from gz_onboard.model.series import all_quantities, total
from gz_onboard.priors import correlations
from gz_onboard.recording.recording import Recording
from gz_onboard.recording.sensors import road_speed, speed_role, true_columns
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class CoastdownConfig:
    """Which part of a run counts, and priors."""

    span: float = 2.0  # s
    slowest: float = 1.0  # m/s: down to it the run is fitted
    shortest: float = 10.0  # s
    least_fall: float = 3.0  # m/s
    driving: float = 0.01  # of the motor's greatest current, without its offset: mean of a span of coasting
    rising: float = 0.2  # m/s from one `rise_time` to the next: noise of a mean is less
    rise_time: float = 5.0  # s
    closed: float = 0.02  # of the throttle: below is noise
    wind_sd: float = 1.0  # m/s: a constant wind along the track on a day that was chosen for coast-downs
    slope_sd: float = 0.01  # sine: a track that was chosen for coast-downs
    speed_sd: float = 1e-3  # s/m: no tyre's rolling resistance grows faster (SAE J2452)
    entered_mass_sd: float = 1.0  # kg: of a rider who was weighed, with clothes
    density_sd: float = 0.015  # relative: of weather's pressure and of the thermometer


COASTDOWN = CoastdownConfig()
NAMES = ("rolling_resistance_constant", "rolling_resistance_speed", "drag_area")
UNITS = dict(zip(NAMES, ("1", "s/m", "m²"), strict=True))
START = {"rolling_resistance_constant": 0.012, "rolling_resistance_speed": 0.0, "drag_area": 0.5}
_STEP = {"rolling_resistance_constant": 1e-4, "rolling_resistance_speed": 1e-5, "drag_area": 1e-3, "slope": 1e-5}


def coast_downs(
    runs: Sequence[Recording],
    vehicle: Vehicle,
    *,
    wind_sd: float = COASTDOWN.wind_sd,
    slope_sd: float = COASTDOWN.slope_sd,
    hold_out: bool = True,
) -> Result:
    """Rolling resistance and drag area of `vehicle` from coast-downs.

    runs: with ``motor_speed``, a wheel's or the vehicle's speed, and if at hand ``throttle``, ``brake_switch``,
    ``motor_current``, ``ambient_temperature``, ``gps_altitude``; facts ``rider_mass_kg`` or ``total_mass_kg``,
    ``direction``, ``ambient_C``. wind_sd [m/s]: of the constant wind of a run; slope_sd: of the track's slope (sine).
    hold_out: also fit without one pair of runs at a time and say how well these are followed.

    Raises InputError for a run that is too short, driven, or speeds up, for less than two runs or a run given twice.
    """
    if len(runs) < 2:
        raise InputError(f"{len(runs)} coast-down; at least 2 are needed, in both directions of one track")
    if twice := {run.name for run in runs if [r.name for r in runs].count(run.name) > 1}:
        raise InputError(f"coast-down {sorted(twice)[0]} is given twice")
    signs = directions(runs)
    coasts = [coast(run, vehicle, sign) for run, sign in zip(runs, signs, strict=True)]
    result, fit = Result("coastdown"), RoadFitter(coasts, vehicle, wind_sd, slope_sd)
    best, covariance = _fitted(fit, result)
    both = len(set(signs)) == 2
    if not both:
        together = best.value[NAMES[0]] + signs[0] * best.value["slope"]
        result.refusals.append(
            f"rolling_resistance_constant: all runs go one way ({runs[0].facts.get('direction', 'by GPS course')}), so "
            f"that the track's slope and rolling resistance are not separable: together {together:.4f}, apart known to "
            f"± {sqrt(covariance[0, 0]):.4f} only (the slope's prior, ± {slope_sd:g}); coast down the other way too"
        )
    _report(result, fit, best, NAMES if both else NAMES[1:], covariance)
    if hold_out and len(coasts) > 2:
        result.fits += _held_out(fit, best.held)
    return result


def _report(result: Result, fit: RoadFitter, road: RoadFit, names: Sequence[str], covariance: Array) -> None:
    """Parameters, notes and plots of `road` into `result`; `covariance` is over all `NAMES`."""
    runs, value, span = fit.runs, road.value, COASTDOWN.span
    force = RoadLoad(fit.vehicle, value)
    speeds = [roll(force, run, value["slope"], value[f"wind {run.name}"]) for run in runs]
    data, model = np.concatenate([run.speed for run in runs]), np.concatenate(speeds)
    names_of_runs = ", ".join(run.name for run in runs)
    scored = score("speed, coasting, own wind", "m/s", data, model, held_out=False, source=names_of_runs)
    result.fits.append(scored)
    cold, warm = min(run.temperature for run in runs), max(run.temperature for run in runs)
    ups = [run.name for run in runs if run.direction > 0]
    points = sum(len(run.middle) for run in runs)
    source = (
        f"{len(runs)} coast-downs ({len(ups)} one way, {len(runs) - len(ups)} the other), {points} spans of "
        f"{span:g} s, {cold:.0f} to {warm:.0f} degC, {data.min():.1f} to {data.max():.1f} m/s, "
        f"own wind of {fit.wind_sd:g} m/s sd; speed follows within {scored.rms:.2f} m/s rms"
    )
    index = [NAMES.index(name) for name in names]
    for name, i in zip(names, index, strict=True):
        how = "held at zero: not distinguishable from it; " if name in road.held else ""
        result.parameters[name] = Found(value[name], float(np.sqrt(covariance[i, i])), UNITS[name], how + source)
    result.covariance.append((tuple(names), covariance[np.ix_(index, index)]))
    slope, slope_sd = 100 * value["slope"], 100 * road.solution.sd("slope")
    up = ups[0] if ups else "none"
    result.notes.append(f"slope of the track {slope:.3f} ± {slope_sd:.3f} %, uphill in the direction of {up}")
    winds = ", ".join(f"{run.name} {value[f'wind {run.name}']:+.1f}" for run in runs)
    sd = float(np.mean([road.solution.sd(f"wind {run.name}") for run in runs]))
    result.notes.append(f"headwind of each run, m/s, ± {sd:.1f}: {winds}")
    noise = road.noise
    result.notes.append(
        f"left over: gusts of {noise.gust:.2f} m/s lasting {noise.lasting:.0f} s, speed noise of {noise.speed:.4f} m/s"
    )
    lines, errors, loads = [], [], []
    for run, speed in zip(runs, speeds, strict=True):
        time = run.time - run.time[0]
        lines += [PlotLine(run.name, time, run.speed, "."), PlotLine("", time, speed, "-")]
        errors.append(PlotLine(run.name, time, run.speed - speed, "-"))
        level = run.slowing * (run.mass + force.rotating) - run.direction * value["slope"] * run.mass * GRAVITY
        loads.append(PlotLine(run.name, run.middle, level, "."))
    v = np.linspace(COASTDOWN.slowest, max(float(run.speed.max()) for run in runs), 50)
    mass, temperature = (float(np.mean(c)) for c in zip(*((r.mass, r.temperature) for r in runs), strict=True))
    still = force(v, Coast("", v, v, 1, mass, temperature, 0.0), 0.0, 0.0)
    loads.append(PlotLine("model, still air, motor included", v, still, "-"))
    result.panels += [
        Panel("Coast-downs", "time [s]", "speed [m/s]", tuple(lines)),
        Panel("Coast-downs: residual", "time [s]", "measured less model [m/s]", tuple(errors)),
        Panel("Road load, slope taken off", "speed [m/s]", "force [N]", tuple(loads)),
    ]


def _held_out(fit: RoadFitter, held: Mapping[str, float]) -> list[Fit]:
    """Each pair of runs, one each way, followed at no wind by a fit of the others."""
    by_direction = [[run for run in fit.runs if run.direction == sign] for sign in (1, -1)]
    both = all(by_direction)
    pairs = list(zip(*by_direction, strict=False)) if both else [(run,) for run in fit.runs]
    measured, modelled = [], []
    for pair in pairs:
        rest = [run for run in fit.runs if run not in pair]
        if not rest or (both and len({run.direction for run in rest}) < 2):
            continue
        road = replace(fit, runs=rest).fit(held)
        force = RoadLoad(fit.vehicle, road.value)
        for run in pair:
            measured.append(run.speed)
            modelled.append(roll(force, run, road.value["slope"], 0.0))
    if not measured:
        return []
    data, model = np.concatenate(measured), np.concatenate(modelled)
    source = f"one {'pair' if both else 'run'} at a time left out of {', '.join(run.name for run in fit.runs)}"
    return [score("speed, no wind", "m/s", data, model, held_out=True, source=source)]


# --- runs ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Coast:
    """The part of a run in which the vehicle rolls, in spans.

    time: ends of the spans [s], shape (n + 1,); speed: there [m/s]. direction: +1 or -1 along the track.
    """

    name: str
    time: Array
    speed: Array
    direction: int
    mass: float  # kg, all
    temperature: float  # degC
    altitude: float  # m

    @property
    def middle(self) -> Array:
        """Mean speed of the spans [m/s]."""
        return (self.speed[1:] + self.speed[:-1]) / 2

    @property
    def slowing(self) -> Array:
        """Deceleration over the spans [m/s²]."""
        return np.asarray(-np.diff(self.speed) / np.diff(self.time))


def coast(run: Recording, vehicle: Vehicle, direction: int) -> Coast:
    """The longest coasting of `run`: throttle closed, no brake, no current, down to a walk.

    Raises InputError for a run that has no speed, is too short, in which the motor drives or the speed rises.
    """
    p, c = vehicle.parameters, COASTDOWN
    columns = true_columns(run.columns, p)
    role, factor = speed_role(run.name, columns, p)
    time, speed = columns[role][0], columns[role][1] * factor
    rolling = np.ones(len(time), dtype=bool)
    for switch, limit in (("throttle", c.closed), ("brake_switch", 0.5)):
        if switch in run.columns:
            rolling &= np.interp(time, *run.columns[switch]) < limit
    switched = "throttle" in run.columns or "brake_switch" in run.columns
    first, last = _longest(rolling, time)
    settle = 0.5 if switched else 0.0  # s, until the current has died away
    keep = slice(int(np.searchsorted(time, time[first] + settle)), last)
    time, speed = time[keep], speed[keep]
    if not switched and len(speed):  # nothing but speed: from its greatest on
        time, speed = time[int(np.argmax(speed)) :], speed[int(np.argmax(speed)) :]
    slow = np.flatnonzero(speed < c.slowest)
    until = int(slow[0]) if len(slow) else len(speed)
    time, speed = time[:until], speed[:until]
    lasts, falls = (float(x[-1] - x[0]) if len(x) > 1 else 0.0 for x in (time, -speed))
    if lasts < c.shortest or -c.rising < falls < c.least_fall:
        raise InputError(
            f"{run.name}: too short a coast-down: {lasts:.1f} s in which the speed falls by {falls:.1f} m/s; at least "
            f"{c.shortest:g} s and {c.least_fall:g} m/s are needed (throttle below {c.closed:.0%}, no brake)"
        )
    _check_current(run, time, c.driving * p["motor_current_limit"])
    _check_falling(run, time, speed)
    ends = time[0] + c.span * np.arange(max(int(lasts / c.span), 1) + 1)
    mass = run.facts.get("total_mass_kg")
    if not isinstance(mass, int | float):
        mass = p["vehicle_mass"] + (run.rider_mass if run.rider_mass is not None else p["payload_mass"])
    if "ambient_temperature" in run.columns:
        temperature = float(run.columns["ambient_temperature"][1].mean())
    elif isinstance(noted := run.facts.get("ambient_C"), int | float):
        temperature = float(noted)
    else:
        raise InputError(
            f"{run.name}: air temperature is neither measured nor noted (ambient_C): it gives the air density"
        )
    altitude = float(np.median(run.columns["gps_altitude"][1])) if "gps_altitude" in run.columns else 0.0
    return Coast(run.name, ends, _at_ends(time, speed, ends), direction, float(mass), temperature, altitude)


def _longest(rolling: Mask, time: Array) -> tuple[int, int]:
    """The longest stretch of `rolling` as (first, end), blinks of a tenth of a second passed over."""
    joined: list[tuple[int, int]] = []
    for first, end in stretches(rolling):
        if joined and time[first] - time[joined[-1][1] - 1] < 0.1:
            joined[-1] = joined[-1][0], end
        else:
            joined.append((first, end))
    return max(joined, key=lambda part: time[part[1] - 1] - time[part[0]], default=(0, 0))


def _check_current(run: Recording, time: Array, driving: float) -> None:
    """Refuse a run with a current beyond `driving` [A] over its median, the sensor's offset: the motor works."""
    if "motor_current" not in run.columns:
        return
    t, current = run.columns["motor_current"]
    inside = (t >= time[0]) & (t <= time[-1])
    if inside.sum() < 10:
        return
    offset, span = float(np.median(current[inside])), COASTDOWN.span
    means = np.array([x.mean() for x in np.array_split(current[inside], max(int((time[-1] - time[0]) / span), 1))])
    worst = float(means[int(np.argmax(np.abs(means)))])
    if abs(offset) > driving or abs(worst) > driving:
        raise InputError(
            f"{run.name}: the motor {'drives' if worst > 0 else 'brakes'} while it should coast: "
            f"{worst:.1f} A in mean over {span:g} s, {offset:.1f} A in all; at most {driving:.2g} A"
        )


def _check_falling(run: Recording, time: Array, speed: Array) -> None:
    """Refuse a run whose mean speed rises from one `rise_time` to the next."""
    number = np.floor((time - time[0]) / COASTDOWN.rise_time).astype(int)
    means = np.bincount(number, speed) / np.maximum(np.bincount(number), 1)
    means = means[np.bincount(number) > 0]
    rises = np.diff(means)
    if len(rises) and rises.max() > COASTDOWN.rising:
        i = int(np.argmax(rises))
        begin = time[0] + i * COASTDOWN.rise_time - min(t[0] for t, _ in run.columns.values())
        raise InputError(
            f"{run.name}: the speed rises from {means[i]:.2f} to {means[i + 1]:.2f} m/s between {begin:.0f} and "
            f"{begin + 2 * COASTDOWN.rise_time:.0f} s: the motor drives, or the track falls too steeply"
        )


def _at_ends(time: Array, speed: Array, ends: Array) -> Array:
    """The speed at `ends`: a straight line through the samples within a quarter of a second around each."""
    result = np.interp(ends, time, speed)
    for i, at in enumerate(ends):
        near = slice(*np.searchsorted(time, [at - 0.25, at + 0.25]))
        if len(time[near]) >= 4:
            result[i] = np.polyfit(time[near] - at, speed[near], 1)[1]
    return result


def directions(runs: Sequence[Recording]) -> list[int]:
    """+1 or -1 for each run: as noted (``direction``; the first alphabetically but ``up`` is +1), else by GPS course.

    Raises InputError if there is neither.
    """
    noted = [run.facts.get("direction") for run in runs]
    if all(isinstance(word, str) for word in noted):
        words = sorted({str(word) for word in noted}, key=lambda word: (word != "up", word))
        if len(words) > 2:
            raise InputError(f"coast-downs in {len(words)} directions: {', '.join(words)}; a track has two")
        return [1 if word == words[0] else -1 for word in noted]
    courses = []
    for run in runs:
        if "gps_course" not in run.columns:
            raise InputError(f"{run.name}: its direction is neither noted (direction) nor told by a gps_course")
        course = run.columns["gps_course"][1]
        courses.append(complex(np.cos(course).mean(), np.sin(course).mean()))
    return [1 if (c * courses[0].conjugate()).real > 0 else -1 for c in courses]


# --- road load -----------------------------------------------------------------------------------------------------


class RoadLoad:
    """Forces on a coasting vehicle, by the effects of its model."""

    def __init__(self, vehicle: Vehicle, values: Mapping[str, float] | None = None, heavier: float = 0.0) -> None:
        """values: in place of the vehicle's own. heavier [kg]: than the run says."""
        p = dict(vehicle.parameters) | dict(values or {})
        self.p, self.heavier = p, heavier
        effects = [Bound(effect, p) for effect in vehicle.model.effects]
        self._road = [e for e in effects if e.effect.port in ROAD_LOAD and "acceleration" not in e.effect.reads]
        self._motor = [e for e in effects if e.effect.port is Port.MOTOR_LOSS]
        self._vibration = vehicle.riding.vibration  # a coast-down shows no road that is rougher than others
        self.rotating = rotating_mass(p)

    def __call__(self, speed: Any, run: Coast, slope: float, wind: float, density: float = 1.0) -> Any:
        """Force [N] at `speed` [m/s] (above zero). slope: sine, uphill in direction +1. wind [m/s]: against it.

        density: factor on the air's density.
        """
        q = all_quantities(  # straight on, no current
            speed=speed,
            grade=run.direction * slope,
            mass=run.mass + self.heavier,
            air_density=density * air_density(run.temperature, run.altitude),
            headwind=wind,
            motor_speed=speed / road_speed(1.0, self.p),
            motor_temperature=run.temperature,
            ambient_temperature=run.temperature,
            vibration=self._vibration,
        )
        return total(self._road, q) + total(self._motor, q) / speed

    def slowing(self, speed: Any, run: Coast, slope: float, wind: float, density: float = 1.0) -> Any:
        """Deceleration [m/s²]."""
        return self(speed, run, slope, wind, density) / (run.mass + self.heavier + self.rotating)


def roll(force: RoadLoad, run: Coast, slope: float, wind: float) -> Array:
    """Speed [m/s] at the run's times from its first speed on; zero after standstill."""

    def acceleration(_: float, speed: Array) -> Any:
        return -force.slowing(np.maximum(speed, 1e-3), run, slope, wind)

    span, start = (run.time[0], run.time[-1]), run.speed[:1]
    rolled = solve_ivp(acceleration, span, start, t_eval=run.time, rtol=1e-8)
    return np.asarray(np.maximum(rolled.y[0], 0.0))


# --- the fit -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CoastdownNoise:
    """What no parameter explains: speed noise at the ends of a span [m/s]; gusts [m/s], lasting [s]."""

    speed: float = 0.02
    gust: float = 0.5
    lasting: float = 5.0


@dataclass(frozen=True)
class RoadFit:
    """A fit of all runs. value: of all `NAMES`, those `held` too, of ``slope`` and of each run's ``wind NAME``."""

    solution: Solution
    noise: CoastdownNoise
    held: dict[str, float]
    value: dict[str, float]


@dataclass(frozen=True)
class RoadFitter:
    """Fits the road load to runs: Gauss-Newton in the parameters, maximum likelihood in the noise."""

    runs: Sequence[Coast]
    vehicle: Vehicle
    wind_sd: float
    slope_sd: float

    def fit(
        self, held: Mapping[str, float], noise: CoastdownNoise | None = None, start: RoadFit | None = None
    ) -> RoadFit:
        """All runs at once, without the parameters `held`. noise: known; start: from there in one step."""
        winds = [f"wind {run.name}" for run in self.runs]
        names = [*(name for name in NAMES if name not in held), "slope", *winds]
        prior = {"slope": (0.0, self.slope_sd), **dict.fromkeys(winds, (0.0, self.wind_sd))}
        if "rolling_resistance_speed" in names:
            prior["rolling_resistance_speed"] = (0.0, COASTDOWN.speed_sd)
        value = START | dict.fromkeys(("slope", *winds), 0.0) | (start.value if start else {}) | dict(held)
        now, solution = noise or CoastdownNoise(), None
        for step in range(1 if start else 4):
            blocks = self._linearised(value, names, now.gust)
            centre = np.array([value[name] for name in names])
            if noise is None and step == 1:
                now = self._likely(blocks, value["drag_area"], names, centre, prior)
            whole = np.vstack([white for _, white in self._whitened(blocks, value["drag_area"], now)])
            target = whole[:, -1] + whole[:, :-1] @ centre  # such that the solution is the whole value
            solution = linear({name: whole[:, i] for i, name in enumerate(names)}, target, 1.0, prior=prior)
            value |= {name: solution[name] for name in names}
        assert solution
        return RoadFit(solution, now, dict(held), value)

    def _linearised(self, value: Mapping[str, float], names: Sequence[str], gust: float) -> list[Array]:
        """The deceleration of each run about `value`: its derivatives by `names`, and last measured less modelled.

        Gusts of `gust` [m/s] add their mean square to that of the flow.
        """
        base = {name: value[name] for name in NAMES}
        here = RoadLoad(self.vehicle, base)
        moved = {n: RoadLoad(self.vehicle, base | {n: value[n] + _STEP[n]}) for n in names if n in NAMES}
        blocks = []
        for run in self.runs:
            v, slope, wind = run.middle, value["slope"], value[f"wind {run.name}"]
            now = here.slowing(v, run, slope, wind)
            gusty = 0.5 * air_density(run.temperature, run.altitude) * value["drag_area"] * gust**2 / run.mass
            columns = []
            for name in names:
                column: Any = 0.0
                if name in NAMES:
                    column = (moved[name].slowing(v, run, slope, wind) - now) / _STEP[name]
                elif name == "slope":
                    column = (here.slowing(v, run, slope + _STEP["slope"], wind) - now) / _STEP["slope"]
                elif name == f"wind {run.name}":
                    up, down = (here.slowing(v, run, slope, wind + step) for step in (1e-3, -1e-3))
                    column = (up - down) / 2e-3
                columns.append(np.broadcast_to(column, v.shape))
            blocks.append(np.column_stack([*columns, run.slowing - now - gusty]))
        return blocks

    def _whitened(
        self, blocks: Sequence[Array], drag_area: float, noise: CoastdownNoise
    ) -> Iterator[tuple[float, Array]]:
        """Of each run the ln of the determinant of its covariance, and its block in units of independent noise of 1.

        The covariance of the deceleration of the spans: gusts that last, and speed noise that neighbours share.
        """
        for run, block in zip(self.runs, blocks, strict=True):
            n, at = len(run.middle), (run.time[1:] + run.time[:-1]) / 2
            push = air_density(run.temperature, run.altitude) * max(drag_area, 0.02) * run.middle / run.mass
            gusts = np.outer(push, push) * noise.gust**2 * np.exp(-np.abs(at[:, None] - at[None, :]) / noise.lasting)
            ends = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
            covariance = gusts + (noise.speed / COASTDOWN.span) ** 2 * ends + 1e-10 * np.eye(n)
            root = cholesky(covariance, lower=True, check_finite=False)
            yield 2 * float(np.log(np.diag(root)).sum()), solve_triangular(root, block, lower=True, check_finite=False)

    def _likely(
        self,
        blocks: Sequence[Array],
        drag_area: float,
        names: Sequence[str],
        centre: Array,
        prior: Mapping[str, tuple[float, float]],
    ) -> CoastdownNoise:
        """The noise of greatest restricted likelihood (REML: Patterson & Thompson 1971), the parameters marginal."""
        precision, pull = np.zeros((2, len(centre)))
        for name, (mean, sd) in prior.items():
            precision[names.index(name)], pull[names.index(name)] = sd**-2, mean
        start = CoastdownNoise()

        def minus_log(x: Array) -> float:
            logs, normal, right, square = 0.0, np.diag(precision).copy(), precision * (pull - centre), 0.0
            for log_determinant, white in self._whitened(blocks, drag_area, CoastdownNoise(*np.exp(x).tolist())):
                a, y = white[:, :-1], white[:, -1]
                logs += log_determinant
                normal += a.T @ a
                right = right + a.T @ y
                square += float(y @ y)
            square += float(precision @ (pull - centre) ** 2)
            logs += float(np.linalg.slogdet(normal)[1])
            # Weak priors keep the noise where it can be: a few tenths of m/s of gusts for a few seconds.
            weak = (x[1] - np.log(start.gust)) ** 2 / 4 + (x[2] - np.log(start.lasting)) ** 2 / 2
            return float(logs + square - float(right @ np.linalg.solve(normal, right)) + weak)

        x0 = np.log([start.speed, start.gust, start.lasting])
        best = minimize(minus_log, x0, method="Nelder-Mead", options={"xatol": 0.1, "fatol": 0.1, "maxiter": 120})
        return CoastdownNoise(*np.exp(best.x).tolist())

    def covariance(self, road: RoadFit, about: RoadFit) -> Array:
        """The covariance of `NAMES`, with that of what else is not known well.

        Mass, inertia, radius, the motor's own drag and air density are taken as given in the fit. The shift by one
        sd of each is added: -(X'X)⁻¹·X'·D, with D the derivative of the deceleration by them, about `about`.
        """
        p, value, solution = self.vehicle.parameters, about.value, road.solution
        base = {name: value[name] for name in NAMES}
        effects = [e for e in self.vehicle.model.effects if e.port is Port.MOTOR_LOSS]
        motor = [name for effect in effects for name in effect.term.parameters]
        names = dict.fromkeys(("wheel_inertia_front", "wheel_inertia_rear", "wheel_radius", *motor))
        given = [name for name in names if p.sd(name) > 0]
        here = RoadLoad(self.vehicle, base)
        heavier = sqrt(p.sd("vehicle_mass") ** 2 + COASTDOWN.entered_mass_sd**2)
        # Force, factor on the air's density, factor on the deceleration: a larger wheel has been faster.
        moved = []
        for name in given:
            faster = 1 + p.sd(name) / p[name] if name == "wheel_radius" else 1.0
            moved.append((RoadLoad(self.vehicle, base | {name: p[name] + p.sd(name)}), 1.0, faster))
        moved += [(RoadLoad(self.vehicle, base, heavier), 1.0, 1.0), (here, 1 + COASTDOWN.density_sd, 1.0)]
        rows = []
        for run, block in zip(self.runs, self._linearised(value, solution.names, road.noise.gust), strict=True):
            at = run.middle, run, value["slope"], value[f"wind {run.name}"]
            now = here.slowing(*at)
            moves = [force.slowing(*at, density) - now * scale for force, density, scale in moved]
            rows.append(np.column_stack([block, *moves]))
        white = np.vstack([white for _, white in self._whitened(rows, value["drag_area"], road.noise)])
        x, d = white[:, : len(solution.names)], white[:, -len(moved) :]
        shift = -solution.covariance / solution.variance @ x.T @ d  # by one sd of each
        tied, matrix = correlations(self.vehicle), np.eye(len(moved))
        for (i, a), (j, b) in permutations(enumerate(given), 2):
            matrix[i, j] = tied.get(frozenset((a, b)), 0.0)
        index = [solution.names.index(name) for name in NAMES]
        return np.asarray(solution.part(NAMES) + (shift @ matrix @ shift.T)[np.ix_(index, index)])


def _fitted(fit: RoadFitter, result: Result) -> tuple[RoadFit, Array]:
    """(the fit, covariance of `NAMES`).

    Rolling resistance is held independent of speed, with a refusal, where that cannot be separated from drag.
    """
    free = fit.fit({})
    covariance = fit.covariance(free, free)
    drag = free.value["drag_area"]
    if free.value[NAMES[1]] >= 2 * sqrt(covariance[1, 1]) and drag > 0:
        return free, covariance
    best = fit.fit({NAMES[1]: 0.0}, free.noise)
    wide = fit.fit({}, free.noise, best)
    covariance = fit.covariance(wide, best)
    speed_term, speed_sd = wide.value[NAMES[1]], sqrt(covariance[1, 1])
    tie = covariance[:, 1] / covariance[1, 1]
    # About the value that is held, not about the most likely one: its distance counts as an error too.
    covariance = covariance + np.outer(tie, tie) * speed_term**2
    why = "zero (less than 2 sd)" if drag > 0 else f"drag, whose area would be {drag:.2f} m² then"
    result.refusals.append(
        f"rolling_resistance_speed: ({1e5 * speed_term:.1f} ± {1e5 * speed_sd:.1f})·10⁻⁵ s/m is indistinguishable from "
        f"{why}; held at 0 ± {1e5 * sqrt(covariance[1, 1]):.1f}·10⁻⁵, which the other two carry"
    )
    return best, covariance
