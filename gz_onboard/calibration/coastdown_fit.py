"""Road load fitted to coast-downs: generalised least squares, all runs at once.

What the fit leaves over has two parts, both found by maximum likelihood: gusts, whose force grows with speed and lasts
some seconds, and noise of the speed, which two neighbouring spans share with opposite signs. Without that, samples
would count as independent and the standard deviations would be too small (Kariya & Kurata 2004).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations
from math import sqrt

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize

from gz_onboard.arrays import Array
from gz_onboard.calibration.coastdown_run import SPAN, Coast
from gz_onboard.calibration.fit import Solution, linear
from gz_onboard.calibration.road_load import NAMES, RoadLoad
from gz_onboard.model.effect import Port
from gz_onboard.model.model import air_density
from gz_onboard.priors import correlations
from gz_onboard.vehicle import Vehicle

SPEED_PRIOR = 1e-3  # s/m: no tyre's rolling resistance grows faster (SAE J2452)
_ENTERED_MASS_SD = 1.0  # kg: of a rider who was weighed, with clothes
_DENSITY_SD = 0.015  # relative: of weather's pressure and of the thermometer
_STEP = {"rolling_resistance_constant": 1e-4, "rolling_resistance_speed": 1e-5, "drag_area": 1e-3, "slope": 1e-5}


@dataclass(frozen=True)
class CoastdownNoise:
    """What no parameter explains: speed noise at the ends of a span [m/s]; gusts [m/s], lasting [s]."""

    speed: float
    gust: float
    lasting: float


START_NOISE = CoastdownNoise(0.02, 0.5, 5.0)


@dataclass(frozen=True)
class RoadFit:
    """A fit of all runs: its solution over `NAMES` (but for those held), ``slope`` and each run's ``wind NAME``."""

    solution: Solution
    noise: CoastdownNoise
    held: dict[str, float]

    def value(self, name: str) -> float:
        """Of a parameter, fitted or held."""
        return self.held[name] if name in self.held else self.solution[name]

    def values(self) -> dict[str, float]:
        """All, held ones too."""
        return dict(zip(self.solution.names, self.solution.value.tolist(), strict=True)) | self.held

    def force(self, vehicle: Vehicle) -> RoadLoad:
        """The force with these parameters."""
        return RoadLoad(vehicle, {name: self.value(name) for name in NAMES})


def fit_road(
    runs: Sequence[Coast],
    vehicle: Vehicle,
    held: Mapping[str, float],
    wind_sd: float,
    slope_sd: float,
    noise: CoastdownNoise | None = None,
    start: RoadFit | None = None,
) -> RoadFit:
    """All runs at once: Gauss-Newton in the parameters and, unless given, maximum likelihood of the noise.

    start: from there in one step, linear about it.
    """
    winds = [f"wind {run.name}" for run in runs]
    names = [*(name for name in NAMES if name not in held), "slope", *winds]
    prior = {"slope": (0.0, slope_sd), **dict.fromkeys(winds, (0.0, wind_sd))}
    if "rolling_resistance_speed" in names:
        prior["rolling_resistance_speed"] = (0.0, SPEED_PRIOR)
    value = {"rolling_resistance_constant": 0.012, "rolling_resistance_speed": 0.0, "drag_area": 0.5}
    value |= dict.fromkeys(("slope", *winds), 0.0) | (start.values() if start else {}) | dict(held)
    now, solution = noise or START_NOISE, None
    for step in range(1 if start else 4):
        here = _linearised(runs, vehicle, value, names, now.gust)
        if noise is None and step == 1:
            now = _likely(here, prior, now)
        whole = np.vstack([white for _, white in here.whitened(now)])
        target = whole[:, -1] + whole[:, :-1] @ here.centre  # such that the solution is the whole value
        solution = linear({name: whole[:, i] for i, name in enumerate(names)}, target, 1.0, prior=prior)
        value |= {name: solution[name] for name in names}
    assert solution
    return RoadFit(solution, now, dict(held))


@dataclass(frozen=True)
class _Linear:
    """The deceleration of the runs, linear about `value`.

    blocks: of each run its derivatives by `names`, and last what is measured over what is modelled.
    """

    runs: Sequence[Coast]
    names: Sequence[str]
    value: Mapping[str, float]
    blocks: list[Array]

    @property
    def centre(self) -> Array:
        """The values that it is linear about, in the order of `names`."""
        return np.array([self.value[name] for name in self.names])

    def whitened(self, noise: CoastdownNoise) -> Iterator[tuple[float, Array]]:
        """Of each run the ln of the determinant of its covariance, and its block in units of independent noise of 1."""
        drag_area = max(self.value["drag_area"], 0.02)
        for run, block in zip(self.runs, self.blocks, strict=True):
            root = cholesky(_covariance(run, drag_area, noise), lower=True, check_finite=False)
            yield 2 * float(np.log(np.diag(root)).sum()), solve_triangular(root, block, lower=True, check_finite=False)


def _linearised(
    runs: Sequence[Coast], vehicle: Vehicle, value: Mapping[str, float], names: Sequence[str], gust: float
) -> _Linear:
    """The runs' deceleration about `value`. Gusts of `gust` [m/s] add their mean square to that of the flow."""
    here = RoadLoad(vehicle, {name: value[name] for name in NAMES})
    moved = {
        name: RoadLoad(vehicle, {n: value[n] + (_STEP[n] if n == name else 0.0) for n in NAMES})
        for name in names
        if name in NAMES
    }
    blocks = []
    for run in runs:
        v, slope, wind = run.middle, value["slope"], value[f"wind {run.name}"]
        base = here.slowing(v, run, slope, wind)
        gusty = 0.5 * air_density(run.temperature, run.altitude) * value["drag_area"] * gust**2 / run.mass
        columns = []
        for name in names:
            if name in NAMES:
                column = (moved[name].slowing(v, run, slope, wind) - base) / _STEP[name]
            elif name == "slope":
                column = (here.slowing(v, run, slope + _STEP["slope"], wind) - base) / _STEP["slope"]
            elif name == f"wind {run.name}":
                column = (here.slowing(v, run, slope, wind + 1e-3) - here.slowing(v, run, slope, wind - 1e-3)) / 2e-3
            else:
                column = np.zeros(len(v))
            columns.append(np.broadcast_to(column, v.shape))
        blocks.append(np.column_stack([*columns, run.slowing - base - gusty]))
    return _Linear(runs, names, value, blocks)


def _covariance(run: Coast, drag_area: float, noise: CoastdownNoise) -> Array:
    """Of the deceleration of the spans: gusts that last, and speed noise that neighbouring spans share."""
    n, dt = len(run.middle), SPAN
    at = (run.time[1:] + run.time[:-1]) / 2
    push = air_density(run.temperature, run.altitude) * drag_area * run.middle / run.mass * noise.gust
    gusts = np.outer(push, push) * np.exp(-np.abs(at[:, None] - at[None, :]) / noise.lasting)
    ends = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    return np.asarray(gusts + (noise.speed / dt) ** 2 * ends + 1e-10 * np.eye(n))


def _likely(here: _Linear, prior: Mapping[str, tuple[float, float]], start: CoastdownNoise) -> CoastdownNoise:
    """The noise of greatest restricted likelihood (REML: Patterson & Thompson 1971), the parameters marginal."""
    centre = here.centre
    precision, pull = np.zeros((2, len(centre)))
    for name, (mean, sd) in prior.items():
        precision[here.names.index(name)] = sd**-2
        pull[here.names.index(name)] = mean

    def minus_log(x: Array) -> float:
        logs, normal, right, square = 0.0, np.diag(precision).copy(), precision * (pull - centre), 0.0
        for log_determinant, white in here.whitened(CoastdownNoise(*np.exp(x).tolist())):
            a, y = white[:, :-1], white[:, -1]
            logs += log_determinant
            normal += a.T @ a
            right = right + a.T @ y
            square += float(y @ y)
        square += float(precision @ (pull - centre) ** 2)
        best = np.linalg.solve(normal, right)
        logs += float(np.linalg.slogdet(normal)[1])
        # Weak priors keep the noise where it can be: a few tenths of m/s of gusts for a few seconds.
        weak = (x[1] - np.log(0.5)) ** 2 / 4 + (x[2] - np.log(5.0)) ** 2 / 2
        return float(logs + square - float(right @ best) + weak)

    x0 = np.log([start.speed, start.gust, start.lasting])
    best = minimize(minus_log, x0, method="Nelder-Mead", options={"xatol": 0.1, "fatol": 0.1, "maxiter": 120})
    return CoastdownNoise(*np.exp(best.x).tolist())


def covariance_with_inputs(
    road: RoadFit, about: RoadFit, runs: Sequence[Coast], vehicle: Vehicle, names: Sequence[str]
) -> tuple[Array, dict[str, float]]:
    """(covariance of `names` with what else is not known well; the share of each of these in the sd of drag area).

    Mass, inertia, radius, the motor's own drag and air density are taken as given in the fit. What they shift, were
    they one sd off, is added: -(X'X)⁻¹·X'·D, with D the derivative of the deceleration by them, about `about`.
    """
    p = vehicle.parameters
    solution = road.solution
    value = about.values()
    base = {name: value[name] for name in NAMES}
    motor = [n for e in vehicle.model.effects if e.port is Port.MOTOR_LOSS for n in e.term.parameters if p.sd(n) > 0]
    drag = [
        n for n in dict.fromkeys(["wheel_inertia_front", "wheel_inertia_rear", "wheel_radius", *motor]) if p.sd(n) > 0
    ]
    here = RoadLoad(vehicle, base)
    moved: list[tuple[str, Callable[[Coast], Array]]] = []

    def at(force: RoadLoad, run: Coast, density: float = 1.0) -> Array:
        return np.asarray(force.slowing(run.middle, run, value["slope"], value[f"wind {run.name}"], density))

    def shifted(force: RoadLoad, scale: float, run: Coast) -> Array:
        return at(force, run) - at(here, run) * scale

    for name in drag:
        force = RoadLoad(vehicle, base | {name: p[name] + p.sd(name)})
        scale = (p[name] + p.sd(name)) / p[name] if name == "wheel_radius" else 1.0  # a larger wheel has been faster
        moved.append((name, partial(shifted, force, scale)))
    mass_sd = sqrt(p.sd("vehicle_mass") ** 2 + _ENTERED_MASS_SD**2)
    heavy = RoadLoad(vehicle, base | {"_mass": mass_sd})
    moved.append(("mass", lambda run: at(heavy, run) - at(here, run)))
    moved.append(("air density", lambda run: at(here, run, 1 + _DENSITY_SD) - at(here, run)))
    local = _linearised(runs, vehicle, value, solution.names, road.noise.gust)
    moves = [np.column_stack([move(run) for _, move in moved]) for run in runs]
    wide = replace(local, blocks=[np.hstack(pair) for pair in zip(local.blocks, moves, strict=True)])
    white = np.vstack([white for _, white in wide.whitened(road.noise)])
    x, d = white[:, : len(solution.names)], white[:, -len(moved) :]
    shift = -solution.covariance / solution.variance @ x.T @ d  # by one sd of each
    correlation = np.eye(len(moved))
    tied = correlations(vehicle)
    for (i, a), (j, b) in permutations(enumerate(drag), 2):
        correlation[i, j] = tied.get(frozenset((a, b)), 0.0)
    at_names = [solution.names.index(name) for name in names]
    covariance = solution.part(list(names)) + (shift @ correlation @ shift.T)[np.ix_(at_names, at_names)]
    row = solution.names.index("drag_area")
    return covariance, {name: float(shift[row, i]) for i, (name, _) in enumerate(moved)}
