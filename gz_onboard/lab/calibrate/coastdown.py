"""Coast-downs: rolling resistance and drag area out of rolling to rest (Lord 2016, sec. 3.2; SAE J1263, J2263).

    (m + J/r²)·dV/dt = -m·g·(c0·cos θ + c1·V + sin θ) - ½·ρ·CdA·(V + w)·|V + w| - P_motor(V/r)/V

Runs in both directions of one track: its slope changes sign with the direction, the rest does not. Each run has a
constant headwind w of its own, unknown but for a prior. The motor turns with the wheel: what it takes without current
is taken off by the vehicle's own motor model. Air density is that of the measured temperature and altitude.

Force over spans of two seconds is fitted by generalised least squares, all runs at once. What is left over has two
parts, both found by maximum likelihood: gusts, whose force grows with speed and lasts some seconds, and noise of the
speed, which two neighbouring spans share with opposite signs. Without that, samples would count as independent and
the standard deviations would be too small (Kariya & Kurata 2004).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import sqrt
from typing import Any

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize, minimize_scalar

from gz_onboard.errors import InputError, nearest
from gz_onboard.lab.calibrate.fit import Solution, linear, score
from gz_onboard.lab.calibrate.result import Array, Fit, Found, Panel, Result, Trace
from gz_onboard.lab.calibrate.table import Table
from gz_onboard.physics.effect import QUANTITIES, Effect, Port
from gz_onboard.physics.model import G, air_density
from gz_onboard.simulation.samples import Samples, read_facts
from gz_onboard.vehicle import Vehicle

NAMES = ("rolling_resistance_constant", "rolling_resistance_speed", "drag_area")
WIND_SD = 1.0  # m/s: a constant wind along the track on a day that was chosen for coast-downs
SLOPE_SD = 0.01  # sine: a track that was chosen for coast-downs
SPEED_PRIOR = 1e-3  # s/m: no tyre's rolling resistance grows faster (SAE J2452)
SPAN = 2.0  # s
FASTEST, SLOWEST = 12.5, 1.0  # m/s: within these the run is fitted
SHORTEST, LEAST_FALL = 10.0, 3.0  # s, m/s: less than this tells nothing
DRIVING = 2.0  # A of the motor beside its offset, mean of a span of coasting
RISING = 0.2  # m/s from one `RISE_TIME` to the next
RISE_TIME = 5.0  # s
CLOSED = 0.02  # of the throttle: below is noise

_ENTERED_MASS_SD = 1.0  # kg: of a rider who was weighed, with clothes
_DENSITY_SD = 0.015  # relative: of weather's pressure and of the thermometer


@dataclass(frozen=True)
class Coast:
    """The part of a run in which the vehicle rolls, in spans.

    time: ends of the spans [s], shape (n + 1,); speed: there [m/s]. direction: +1 or -1 along the track.
    """

    name: str
    time: Array
    speed: Array
    direction: int
    payload: float | None  # kg; None if only the total is known
    mass: float  # kg, all
    temperature: float  # degC
    altitude: float  # m
    samples: tuple[Array, Array]  # time, speed as measured

    @property
    def middle(self) -> Array:
        """Mean speed of the spans [m/s]."""
        return (self.speed[1:] + self.speed[:-1]) / 2

    @property
    def slowing(self) -> Array:
        """Deceleration over the spans [m/s²]."""
        result: Array = -np.diff(self.speed) / np.diff(self.time)
        return result


@dataclass(frozen=True)
class Noise:
    """What no parameter explains: speed noise at the ends of a span [m/s]; gusts [m/s], lasting [s]."""

    speed: float
    gust: float
    lasting: float


# --- what is measured ---------------------------------------------------------------------------------------------


_ROLES = {"speed": "vehicle_speed"} | dict.fromkeys(
    ("vehicle_speed", "motor_speed", "wheel_speed_rear", "throttle", "brake_switch", "motor_current",
     "ambient_temperature", "gps_altitude", "gps_course"), ""
)  # fmt: skip


def samples(table: Table, facts: Mapping[str, object] | None = None) -> Samples:
    """The coast-down in `table`, of ``time`` and ``speed`` [m/s] (or ``motor_speed``) and, if it has them, more roles.

    facts: what was written down of it; None: in a ``rides.json`` beside the table. It needs ``direction`` (``up`` or
    ``down``, or any two words for the two ways), ``rider_mass_kg`` or ``total_mass_kg``, and ``ambient_C`` if there is
    no column ambient_temperature. Raises InputError naming file, line and column.
    """
    time = table["time"]
    again = np.flatnonzero(np.diff(time) <= 0)
    if len(again):
        raise table.error(f"time: {time[again[0] + 1]:g} s does not increase", int(again[0]) + 1)
    if "motor_speed" not in table and "vehicle_speed" not in table:
        table["speed"]  # which is missing, or of no use
    name = table.file.name.removesuffix(".gz").rpartition(".")[0]
    notes = table.file.parent / "rides.json"
    known = dict(read_facts(notes).get(name, {}) if facts is None else facts)
    for keys in (("direction",), ("total_mass_kg", "rider_mass_kg")):
        if not known.keys() & set(keys):
            close = nearest(keys[0], [str(key) for key in known])
            raise table.error(f"{notes.name} beside it says no {' or '.join(keys)} of {name!r}{close}")
    if "ambient_temperature" not in table and "ambient_C" not in known:
        raise table.error(f"no column ambient_temperature, and {notes.name} beside it says no ambient_C of {name!r}")
    for key in ("total_mass_kg", "rider_mass_kg", "ambient_C"):
        if key in known and (isinstance(known[key], bool) or not isinstance(known[key], int | float)):
            raise table.error(f"{notes.name} beside it: {key} of {name!r} is {known[key]!r}, no number")
    return Samples(name, {new or old: (time, table[old]) for old, new in _ROLES.items() if old in table}, known)


def coast(run: Samples, vehicle: Vehicle, direction: int) -> Coast:
    """The longest coasting of `run`: throttle closed, no brake, no current, from `FASTEST` down to `SLOWEST`.

    Raises InputError for a run that has no speed, is too short, in which the motor drives or the speed rises.
    """
    p = vehicle.parameters
    time, speed = _speed(run, p)
    rolling = np.ones(len(time), dtype=bool)
    if "throttle" in run.columns:
        rolling &= np.interp(time, *run.columns["throttle"]) < CLOSED
    if "brake_switch" in run.columns:
        rolling &= np.interp(time, *run.columns["brake_switch"]) < 0.5
    told = "throttle" in run.columns or "brake_switch" in run.columns
    first, last = _longest(rolling, time)
    settle = 0.5 if told else 0.0  # s, until the current has died away
    keep = slice(int(np.searchsorted(time, time[first] + settle)), last)
    time, speed = time[keep], speed[keep]
    if not told and len(speed):  # nothing but speed: from its greatest on
        time, speed = time[int(np.argmax(speed)) :], speed[int(np.argmax(speed)) :]
    from_top = int(np.argmax(speed <= FASTEST)) if len(speed) and speed[0] > FASTEST else 0
    slow = np.flatnonzero(speed < SLOWEST)
    until = int(slow[0]) if len(slow) else len(speed)
    time, speed = time[from_top:until], speed[from_top:until]
    lasts = float(time[-1] - time[0]) if len(time) > 1 else 0.0
    falls = float(speed[0] - speed[-1]) if len(speed) > 1 else 0.0
    if lasts < SHORTEST or -RISING < falls < LEAST_FALL:
        raise InputError(
            f"{run.name}: too short a coast-down: {lasts:.1f} s in which the speed falls by {falls:.1f} m/s; at least "
            f"{SHORTEST:g} s and {LEAST_FALL:g} m/s are needed (throttle below {CLOSED:.0%}, no brake)"
        )
    _check_current(run, time)
    n = max(int(lasts / SPAN), 1)
    ends = time[0] + SPAN * np.arange(n + 1)
    at = _smooth(time, speed, ends)
    _check_falling(run, time, speed)
    total = run.facts.get("total_mass_kg")
    payload = run.rider_mass if run.rider_mass is not None else p["payload_mass"]
    mass = float(total) if isinstance(total, int | float) else p["vehicle_mass"] + payload
    altitude = float(np.median(run.columns["gps_altitude"][1])) if "gps_altitude" in run.columns else 0.0
    return Coast(run.name, ends, at, direction, None if total is not None else payload, mass,
                 _temperature(run), altitude, (time, speed))  # fmt: skip


def run_start(run: Samples) -> float:
    """The time of the first sample [s]."""
    return float(min(t[0] for t, _ in run.columns.values()))


def _speed(run: Samples, p: Mapping[str, float]) -> tuple[Array, Array]:
    factors = {"motor_speed": p["gear_ratio"] * p["wheel_radius"], "wheel_speed_rear": p["wheel_radius"],
               "vehicle_speed": 1.0, "gps_speed": 1.0}  # fmt: skip
    for role, factor in factors.items():
        if role in run.columns:
            time, speed = run.columns[role]
            return time, speed * factor
    raise InputError(f"{run.name}: has no speed: none of {', '.join(factors)}")


def _temperature(run: Samples) -> float:
    if "ambient_temperature" in run.columns:
        return float(run.columns["ambient_temperature"][1].mean())
    noted = run.facts.get("ambient_C")
    if isinstance(noted, int | float):
        return float(noted)
    raise InputError(f"{run.name}: air temperature is neither measured nor noted (ambient_C): it gives the air density")


def _longest(rolling: Any, time: Array) -> tuple[int, int]:
    """The longest stretch of `rolling` as (first, end), blinks of a tenth of a second passed over."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], rolling, [False])).astype(int)))
    starts, ends = list(edges[::2]), list(edges[1::2])
    if not starts:
        return 0, 0
    merged = [[starts[0], ends[0]]]
    for a, b in zip(starts[1:], ends[1:], strict=True):
        if time[a] - time[merged[-1][1] - 1] < 0.1:
            merged[-1][1] = b
        else:
            merged.append([a, b])
    best = max(merged, key=lambda piece: time[piece[1] - 1] - time[piece[0]])
    return int(best[0]), int(best[1])


def _check_current(run: Samples, time: Array) -> None:
    """Refuse a run in which the motor drives or brakes: current beyond its median, which is the sensor's offset."""
    if "motor_current" not in run.columns:
        return
    t, current = run.columns["motor_current"]
    inside = (t >= time[0]) & (t <= time[-1])
    if inside.sum() < 10:
        return
    offset = float(np.median(current[inside]))
    count = max(int((time[-1] - time[0]) / SPAN), 1)
    means = np.array([part.mean() for part in np.array_split(current[inside], count)])
    worst = int(np.argmax(np.abs(means)))
    if abs(offset) > DRIVING or abs(means[worst]) > DRIVING:
        raise InputError(
            f"{run.name}: the motor {'drives' if means[worst] > 0 else 'brakes'} while it should coast: "
            f"{means[worst]:.1f} A in mean over {SPAN:g} s, {offset:.1f} A in all; at most {DRIVING:g} A"
        )


def _check_falling(run: Samples, time: Array, speed: Array) -> None:
    """Refuse a run whose mean speed rises from one `RISE_TIME` to the next by more than its noise explains."""
    count = max(int((time[-1] - time[0]) / RISE_TIME), 1)
    means, sds = [], []
    for begin in time[0] + RISE_TIME * np.arange(count):
        inside = (time >= begin) & (time < begin + RISE_TIME)
        x, y = time[inside], speed[inside]
        left = y - np.polyval(np.polyfit(x - begin, y, 1), x - begin) if len(x) > 2 else np.zeros(1)
        means.append(float(y.mean()) if len(y) else float("nan"))
        sds.append(float(np.sqrt(left @ left) / max(len(x) - 2, 1)))
    rises = np.diff(means) - 3 * np.hypot(sds[1:], sds[:-1])
    if len(rises) and np.nanmax(rises) > RISING:
        i = int(np.nanargmax(rises))
        begin = time[0] + i * RISE_TIME - run_start(run)
        raise InputError(
            f"{run.name}: the speed rises from {means[i]:.2f} to {means[i + 1]:.2f} m/s between {begin:.0f} and "
            f"{begin + 2 * RISE_TIME:.0f} s: the motor drives, or the track falls too steeply"
        )


def _smooth(time: Array, speed: Array, ends: Array) -> Array:
    """The speed at `ends`: a straight line through the samples within half a second around each."""
    result = np.empty(len(ends))
    for i, at in enumerate(ends):
        a, b = np.searchsorted(time, [at - 0.25, at + 0.25])
        if b - a < 4:
            result[i] = np.interp(at, time, speed)
        else:
            x, y = time[a:b] - at, speed[a:b]
            spread = x - x.mean()
            result[i] = y.mean() - x.mean() * float(spread @ y) / float(spread @ spread)
    return result


def directions(runs: Sequence[Samples]) -> list[int]:
    """+1 or -1 for each run: as noted (``direction``; the first alphabetically but ``up`` is +1), else by GPS course.

    Raises InputError if neither tells.
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


# --- the model ----------------------------------------------------------------------------------------------------


class Force:
    """What holds a coasting vehicle back, by the effects of its own model."""

    def __init__(self, vehicle: Vehicle, values: Mapping[str, float] | None = None) -> None:
        p = dict(vehicle.parameters) | dict(values or {})
        self.p = p
        bound = [(e, {name: p[name] for name in e.keywords}) for e in vehicle.model.effects]
        self._road = [(e, values) for e, values in bound
                      if e.port in (Port.WHEEL_FORCE, Port.TYRE) and "acceleration" not in e.quantities]  # fmt: skip
        self._motor = [(e, values) for e, values in bound if e.port is Port.MOTOR_LOSS]
        self.rotating = (p["wheel_inertia_front"] + p["wheel_inertia_rear"]) / p["wheel_radius"] ** 2

    def __call__(self, speed: Any, run: Coast, slope: float, wind: float, density: float = 1.0) -> Any:
        """Force [N] at `speed` [m/s] (above zero). slope: sine, uphill in direction +1. wind [m/s]: against it.

        density: factor on the air's density.
        """
        grade = run.direction * slope
        q: dict[str, Any] = dict.fromkeys(QUANTITIES, 0.0) | {  # straight on, no current
            "speed": speed,
            "grade": grade,
            "grade_cosine": sqrt(1 - grade * grade),
            "mass": run.mass + self.p.get("_mass", 0.0),
            "air_density": density * air_density(run.temperature, run.altitude),
            "headwind": wind,
            "motor_speed": speed / (self.p["wheel_radius"] * self.p["gear_ratio"]),
            "motor_temperature": run.temperature,
            "ambient_temperature": run.temperature,
        }
        return _sum(self._road, q) + _sum(self._motor, q) / speed

    def slowing(self, speed: Any, run: Coast, slope: float, wind: float, density: float = 1.0) -> Any:
        """Deceleration [m/s²]."""
        return self(speed, run, slope, wind, density) / (run.mass + self.p.get("_mass", 0.0) + self.rotating)


def _sum(effects: Sequence[tuple[Effect, dict[str, float]]], q: Mapping[str, Any]) -> Any:
    return sum(effect.term(*[q[name] for name in effect.quantities], **values) for effect, values in effects)


def roll(force: Force, run: Coast, slope: float, wind: float, time: Array) -> Array:
    """Speed [m/s] at `time` [s] from the run's first speed on: Runge-Kutta of fourth order; zero after standstill."""
    speed = np.empty(len(time))
    v = float(run.speed[0])
    speed[0] = v
    for i, dt in enumerate(np.diff(time).tolist()):
        if v > 0.05:
            k1 = force.slowing(v, run, slope, wind)
            k2 = force.slowing(max(v - dt / 2 * k1, 1e-3), run, slope, wind)
            k3 = force.slowing(max(v - dt / 2 * k2, 1e-3), run, slope, wind)
            k4 = force.slowing(max(v - dt * k3, 1e-3), run, slope, wind)
            v = max(v - dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), 0.0)
        speed[i + 1] = v
    return speed


# --- the fit ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Road:
    """A fit of all runs: its solution over `NAMES` (but for those held), ``slope`` and each run's ``wind NAME``."""

    solution: Solution
    noise: Noise
    held: dict[str, float]

    def value(self, name: str) -> float:
        """Of a parameter, fitted or held."""
        return self.held[name] if name in self.held else self.solution[name]

    def values(self) -> dict[str, float]:
        """All, held ones too."""
        return dict(zip(self.solution.names, self.solution.value.tolist(), strict=True)) | self.held

    def force(self, vehicle: Vehicle) -> Force:
        """The force with these parameters."""
        return Force(vehicle, {name: self.value(name) for name in NAMES})


def _fit(
    runs: Sequence[Coast],
    vehicle: Vehicle,
    held: Mapping[str, float],
    wind_sd: float,
    slope_sd: float,
    noise: Noise | None = None,
    start: Road | None = None,
) -> Road:
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
    known, solution = noise, None
    for step in range(1 if start else 4):
        now = known or Noise(0.02, 0.5, 5.0)
        columns, left = _linearised(runs, vehicle, value, names, now.gust)
        if noise is None and step == 1:
            known = now = _likely(runs, vehicle, value, columns, left, names, prior, now)
        whitened, target = _whiten(runs, value, now, columns, left, names, value)
        solution = linear(whitened, target, 1.0, prior=prior)
        value |= {name: solution[name] for name in names}
    assert solution
    return Road(solution, known or Noise(0.02, 0.5, 5.0), dict(held))


_STEP = {"rolling_resistance_constant": 1e-4, "rolling_resistance_speed": 1e-5, "drag_area": 1e-3, "slope": 1e-5}


def _linearised(
    runs: Sequence[Coast], vehicle: Vehicle, value: Mapping[str, float], names: Sequence[str], gust: float
) -> tuple[dict[str, list[Array]], list[Array]]:
    """Derivative of each run's deceleration by each of `names`, and what is measured over what is modelled.

    Gusts of `gust` [m/s] add their mean square to that of the flow.
    """
    here = Force(vehicle, {name: value[name] for name in NAMES})
    moved = {name: Force(vehicle, {n: value[n] + (_STEP[n] if n == name else 0.0) for n in NAMES})
             for name in names if name in NAMES}  # fmt: skip
    columns: dict[str, list[Array]] = {name: [] for name in names}
    left = []
    for run in runs:
        v, slope, wind = run.middle, value["slope"], value[f"wind {run.name}"]
        base = here.slowing(v, run, slope, wind)
        gusty = 0.5 * air_density(run.temperature, run.altitude) * value["drag_area"] * gust**2 / run.mass
        left.append(run.slowing - base - gusty)
        for name in names:
            if name in NAMES:
                column = (moved[name].slowing(v, run, slope, wind) - base) / _STEP[name]
            elif name == "slope":
                column = (here.slowing(v, run, slope + _STEP["slope"], wind) - base) / _STEP["slope"]
            elif name == f"wind {run.name}":
                column = (here.slowing(v, run, slope, wind + 1e-3) - here.slowing(v, run, slope, wind - 1e-3)) / 2e-3
            else:
                column = np.zeros(len(v))
            columns[name].append(np.broadcast_to(column, v.shape))
    return columns, left


def _covariance(run: Coast, drag_area: float, noise: Noise) -> Array:
    """Of the deceleration of the spans: gusts that last, and speed noise that neighbouring spans share."""
    n, dt = len(run.middle), SPAN
    at = (run.time[1:] + run.time[:-1]) / 2
    push = air_density(run.temperature, run.altitude) * drag_area * run.middle / run.mass * noise.gust
    gusts = np.outer(push, push) * np.exp(-np.abs(at[:, None] - at[None, :]) / noise.lasting)
    ends = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    result: Array = gusts + (noise.speed / dt) ** 2 * ends + 1e-10 * np.eye(n)
    return result


def _whiten(
    runs: Sequence[Coast],
    value: Mapping[str, float],
    noise: Noise,
    columns: Mapping[str, list[Array]],
    left: Sequence[Array],
    names: Sequence[str],
    about: Mapping[str, float],
) -> tuple[dict[str, Array], Array]:
    """Columns and target in units of independent noise of 1, the target such that the solution is the whole value."""
    tall: list[Array] = []
    for i, run in enumerate(runs):
        root = cholesky(_covariance(run, max(value["drag_area"], 0.02), noise), lower=True)
        block = np.column_stack([*(columns[name][i] for name in names), left[i]])
        tall.append(solve_triangular(root, block, lower=True))
    whole = np.vstack(tall)
    centre = np.array([about[name] for name in names])
    return {name: whole[:, i] for i, name in enumerate(names)}, whole[:, -1] + whole[:, :-1] @ centre


def _likely(
    runs: Sequence[Coast],
    vehicle: Vehicle,
    value: Mapping[str, float],
    columns: Mapping[str, list[Array]],
    left: Sequence[Array],
    names: Sequence[str],
    prior: Mapping[str, tuple[float, float]],
    start: Noise,
) -> Noise:
    """The noise of greatest restricted likelihood (REML: Patterson & Thompson 1971), the parameters marginal."""
    drag = max(value["drag_area"], 0.02)
    blocks = [np.column_stack([*(columns[name][i] for name in names), left[i]]) for i in range(len(runs))]
    centre = np.array([value[name] for name in names])
    precision = np.zeros(len(names))
    pull = np.zeros(len(names))
    for name, (mean, sd) in prior.items():
        precision[names.index(name)] = sd**-2
        pull[names.index(name)] = mean

    def minus_log(x: Array) -> float:
        noise = Noise(*np.exp(x).tolist())
        logs, normal, right, square = 0.0, np.diag(precision).copy(), precision * (pull - centre), 0.0
        for run, block in zip(runs, blocks, strict=True):
            root = cholesky(_covariance(run, drag, noise), lower=True, check_finite=False)
            white = solve_triangular(root, block, lower=True, check_finite=False)
            a, y = white[:, :-1], white[:, -1]
            logs += 2 * float(np.log(np.diag(root)).sum())
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
    return Noise(*np.exp(best.x).tolist())


def _with_nuisance(
    road: Road, about: Road, runs: Sequence[Coast], vehicle: Vehicle, names: Sequence[str]
) -> tuple[Array, dict[str, float]]:
    """(covariance of `names` with what else is not known well; the share of each of these in the sd of drag area).

    Mass, inertia, radius, the motor's own drag and air density are taken as given in the fit. What they shift, were
    they one sd off, is added: -(X'X)⁻¹·X'·D, with D the derivative of the deceleration by them, about `about`.
    """
    p = vehicle.parameters
    solution = road.solution
    value = about.values()
    columns, left = _linearised(runs, vehicle, value, solution.names, road.noise.gust)
    base = {name: value[name] for name in NAMES}
    motor = [n for e in vehicle.model.effects if e.port is Port.MOTOR_LOSS for n in e.keywords if p.sd(n) > 0]
    drag = [n for n in dict.fromkeys(["wheel_inertia_front", "wheel_inertia_rear", "wheel_radius", *motor])
            if p.sd(n) > 0]  # fmt: skip
    here = Force(vehicle, base)
    moved: list[tuple[str, Callable[[Coast], Array]]] = []

    def at(force: Force, run: Coast, density: float = 1.0) -> Array:
        result: Array = force.slowing(run.middle, run, value["slope"], value[f"wind {run.name}"], density)
        return result

    def shifted(force: Force, scale: float, run: Coast) -> Array:
        return at(force, run) - at(here, run) * scale

    for name in drag:
        force = Force(vehicle, base | {name: p[name] + p.sd(name)})
        scale = (p[name] + p.sd(name)) / p[name] if name == "wheel_radius" else 1.0  # a larger wheel has been faster
        moved.append((name, partial(shifted, force, scale)))
    mass_sd = sqrt(p.sd("vehicle_mass") ** 2 + _ENTERED_MASS_SD**2)
    heavy = Force(vehicle, base | {"_mass": mass_sd})
    moved.append(("mass", lambda run: at(heavy, run) - at(here, run)))
    moved.append(("air density", lambda run: at(here, run, 1 + _DENSITY_SD) - at(here, run)))
    wide = {**columns, **{name: [shift(run) for run in runs] for name, shift in moved}}
    every = [*solution.names, *(name for name, _ in moved)]
    white, _ = _whiten(runs, value, road.noise, wide, left, every, dict.fromkeys(every, 0.0))
    x = np.column_stack([white[name] for name in solution.names])
    d = np.column_stack([white[name] for name, _ in moved])
    shift = -solution.covariance / solution.variance @ x.T @ d  # by one sd of each
    correlation = np.eye(len(moved))
    known = p.covariance(drag)
    for i, a in enumerate(drag):
        for j, b in enumerate(drag):
            correlation[i, j] = known[i][j] / (p.sd(a) * p.sd(b))
    at_names = [solution.names.index(name) for name in names]
    covariance = solution.part(list(names)) + (shift @ correlation @ shift.T)[np.ix_(at_names, at_names)]
    row = solution.names.index("drag_area")
    return covariance, {name: float(shift[row, i]) for i, (name, _) in enumerate(moved)}


def calibrate(
    runs: Sequence[Samples],
    vehicle: Vehicle,
    *,
    wind_sd: float = WIND_SD,
    slope_sd: float = SLOPE_SD,
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
    twice = {run.name for run in runs if [r.name for r in runs].count(run.name) > 1}
    if twice:
        raise InputError(f"coast-down {sorted(twice)[0]} is given twice")
    ways = directions(runs)
    coasts = [coast(run, vehicle, way) for run, way in zip(runs, ways, strict=True)]
    result = Result("coastdown")
    both = len(set(ways)) == 2
    free = _fit(coasts, vehicle, {}, wind_sd, slope_sd)
    names = list(NAMES)
    best = free
    covariance, shares = _with_nuisance(free, free, coasts, vehicle, names)
    if free.value(NAMES[1]) < 2 * sqrt(covariance[1, 1]) or free.value(NAMES[2]) <= 0:
        best = _fit(coasts, vehicle, {NAMES[1]: 0.0}, wind_sd, slope_sd, free.noise)
        wide = _fit(coasts, vehicle, {}, wind_sd, slope_sd, free.noise, best)
        covariance, shares = _with_nuisance(wide, best, coasts, vehicle, names)
        speed_term, speed_sd = wide.value(NAMES[1]), sqrt(covariance[1, 1])
        tie = covariance[:, 1] / covariance[1, 1]
        # About the value that is held, not about the most likely one: its distance counts as an error too.
        covariance = covariance + np.outer(tie, tie) * speed_term**2
        told = f"({1e5 * speed_term:.1f} ± {1e5 * speed_sd:.1f})·10⁻⁵ s/m"
        why = (
            f"{told} cannot be told from zero (less than 2 sd)"
            if free.value(NAMES[2]) > 0
            else f"{told} cannot be told from drag, whose area would be {free.value(NAMES[2]):.2f} m² beside it"
        )
        result.refusals.append(
            f"rolling_resistance_speed: {why}; held at 0 ± {1e5 * sqrt(covariance[1, 1]):.1f}·10⁻⁵, which the other "
            "two carry"
        )
    if not both:
        c0_sd = sqrt(covariance[0, 0])
        together = best.value(NAMES[0]) + ways[0] * best.solution["slope"]
        way = runs[0].facts.get("direction", "by GPS course")
        result.refusals.append(
            f"rolling_resistance_constant: all runs go one way ({way}), so that the track's slope and rolling "
            f"resistance are not separable: together {together:.4f}, apart known to ± {c0_sd:.4f} only (the "
            f"slope's prior, ± {slope_sd:g}); coast down the other way too"
        )
    _tell(result, best, coasts, vehicle, names if both else names[1:], covariance, wind_sd)
    result.notes.append(
        "part of the sd of drag_area from what was taken as given: "
        + ", ".join(f"{name} {abs(s):.4f}" for name, s in sorted(shares.items(), key=lambda item: -abs(item[1]))[:4])
        + " m²"
    )
    _correlation_note(result, names, covariance)
    if "motor_current" in runs[0].columns:
        offset = np.mean([_coasting_current(run, c) for run, c in zip(runs, coasts, strict=True)])
        result.notes.append(f"motor current while coasting reads {offset:.2f} A in mean, taken as its sensor's offset")
    if hold_out and len(coasts) > 2:
        result.fits += _held_out(coasts, vehicle, best.held, wind_sd, slope_sd)
    return result


def _coasting_current(run: Samples, c: Coast) -> float:
    if "motor_current" not in run.columns:
        return 0.0
    t, current = run.columns["motor_current"]
    inside = (t >= c.time[0]) & (t <= c.time[-1])
    return float(current[inside].mean()) if inside.any() else 0.0


def _correlation_note(result: Result, names: Sequence[str], covariance: Array) -> None:
    sd = np.sqrt(np.diag(covariance))
    r = covariance / np.outer(sd, sd)
    pairs = [f"{a} and {b} {r[i, j]:+.2f}" for i, a in enumerate(names) for j, b in enumerate(names) if i < j]
    result.notes.append(f"correlations: {', '.join(pairs)}")


def _tell(
    result: Result,
    road: Road,
    runs: Sequence[Coast],
    vehicle: Vehicle,
    names: Sequence[str],
    covariance: Array,
    wind_sd: float,
) -> None:
    """Parameters, notes and plots of `road` into `result`; `covariance` is over all `NAMES`."""
    solution = road.solution
    force = road.force(vehicle)
    speeds = [roll(force, run, solution["slope"], solution[f"wind {run.name}"], run.time) for run in runs]
    data, model = np.concatenate([run.speed for run in runs]), np.concatenate(speeds)
    fit = score("speed, coasting, own wind", "m/s", data, model, held_out=False, source=_names(runs))
    result.fits.append(fit)
    cold, warm = min(run.temperature for run in runs), max(run.temperature for run in runs)
    ups = sum(run.direction > 0 for run in runs)
    points = sum(len(run.middle) for run in runs)
    source = (
        f"{len(runs)} coast-downs ({ups} one way, {len(runs) - ups} the other), {points} spans of {SPAN:g} s, "
        f"{cold:.0f} to {warm:.0f} degC, {data.min():.1f} to {data.max():.1f} m/s, "
        f"own wind of {wind_sd:g} m/s sd; speed follows within {fit.rms:.2f} m/s rms"
    )
    units = {NAMES[0]: "1", NAMES[1]: "s/m", NAMES[2]: "m²"}
    index = [NAMES.index(name) for name in names]
    for name, i in zip(names, index, strict=True):
        how = "held at zero: not distinguishable from it; " if name in road.held else ""
        result.parameters[name] = Found(road.value(name), float(np.sqrt(covariance[i, i])), units[name], how + source)
    result.covariance.append((tuple(names), covariance[np.ix_(index, index)]))
    up = next((run.name for run in runs if run.direction > 0), "none")
    slope, slope_sd = 100 * solution["slope"], 100 * solution.sd("slope")
    result.notes.append(f"slope of the track {slope:.3f} ± {slope_sd:.3f} %, uphill in the direction of {up}")
    winds = ", ".join(f"{run.name} {solution[f'wind {run.name}']:+.1f}" for run in runs)
    sd = float(np.mean([solution.sd(f"wind {run.name}") for run in runs]))
    result.notes.append(f"headwind of each run, m/s, ± {sd:.1f}: {winds}")
    noise = road.noise
    result.notes.append(
        f"left over: gusts of {noise.gust:.2f} m/s lasting {noise.lasting:.0f} s, speed noise of {noise.speed:.4f} m/s"
    )
    result.panels += _panels(force, road, runs, speeds)


def _names(runs: Sequence[Coast]) -> str:
    return ", ".join(run.name for run in runs)


def _panels(force: Force, road: Road, runs: Sequence[Coast], speeds: Sequence[Array]) -> list[Panel]:
    slope = road.solution["slope"]
    lines, errors, loads = [], [], []
    for run, model in zip(runs, speeds, strict=True):
        time = run.time - run.time[0]
        lines += [Trace(run.name, time, run.speed, "."), Trace("", time, model, "-")]
        errors.append(Trace(run.name, time, model - run.speed, "-"))
        level = run.slowing * (run.mass + force.rotating) - run.direction * slope * run.mass * G
        loads.append(Trace(run.name, run.middle, level, "."))
    v = np.linspace(SLOWEST, FASTEST, 50)
    still = Coast("", v, v, 1, None, float(np.mean([run.mass for run in runs])),
                  float(np.mean([run.temperature for run in runs])), 0.0, (v, v))  # fmt: skip
    loads.append(Trace("model, still air, motor included", v, force(v, still, 0.0, 0.0), "-"))
    return [
        Panel("Coast-downs", "time [s]", "speed [m/s]", tuple(lines)),
        Panel("Speed, modelled less measured", "time [s]", "error [m/s]", tuple(errors)),
        Panel("Road load, slope taken off", "speed [m/s]", "force [N]", tuple(loads)),
    ]


def _held_out(
    runs: Sequence[Coast], vehicle: Vehicle, held: Mapping[str, float], wind_sd: float, slope_sd: float
) -> list[Fit]:
    """Each pair of runs, one each way, followed by a fit of the others: with its own wind free, and at no wind."""
    ways = [[i for i, run in enumerate(runs) if run.direction == way] for way in (1, -1)]
    pairs = [list(pair) for pair in zip(*ways, strict=False)] if all(ways) else [[i] for i in range(len(runs))]
    data: list[Array] = []
    free: list[Array] = []
    still: list[Array] = []
    for pair in pairs:
        rest = [run for i, run in enumerate(runs) if i not in pair]
        if not rest or (all(ways) and len({run.direction for run in rest}) < 2):
            continue
        road = _fit(rest, vehicle, held, wind_sd, slope_sd)
        force, slope = road.force(vehicle), road.solution["slope"]
        for i in pair:
            run = runs[i]
            data.append(run.speed)
            still.append(roll(force, run, slope, 0.0, run.time))
            free.append(roll(force, run, slope, own_wind(force, run, slope), run.time))
    if not data:
        return []
    source = f"one {'pair' if all(ways) else 'run'} at a time left out of {_names(runs)}"
    measured = np.concatenate(data)
    return [
        score("speed, own wind free", "m/s", measured, np.concatenate(free), held_out=True, source=source),
        score("speed, no wind", "m/s", measured, np.concatenate(still), held_out=True, source=source),
    ]


def own_wind(force: Force, run: Coast, slope: float) -> float:
    """The constant headwind [m/s] with which `run` is followed best."""
    best = minimize_scalar(
        lambda wind: float(np.sum((roll(force, run, slope, wind, run.time) - run.speed) ** 2)),
        bounds=(-8.0, 8.0), method="bounded", options={"xatol": 0.01},
    )  # fmt: skip
    return float(best.x)
