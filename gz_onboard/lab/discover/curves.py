"""Smooth curves over quantities: what a channel's residual looks like when no cause has its name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.discover.channels import over_blocks
from gz_onboard.lab.discover.grid import STEP, Ride, smooth
from gz_onboard.lab.discover.linear import LinearChannel, LinearRide, Noise, Normal, fit_mixed, marginal, whitened
from gz_onboard.lab.discover.mixed_model import HealthyCurve, MixedModel
from gz_onboard.lab.discover.search import evidence_of

# knots of the hat functions, the middle one left out (it is the level); unit
QUANTITIES: dict[str, tuple[tuple[float, ...], str]] = {
    "speed": ((2.0, 4.5, 6.5, 8.5, 10.0, 11.5, 13.0, 15.0), "m/s"),
    "acceleration": ((-2.0, -1.0, -0.3, 0.0, 0.3, 1.0, 2.0), "m/s²"),
    "lateral_acceleration": ((-4.0, -2.0, -0.7, 0.0, 0.7, 2.0, 4.0), "m/s²"),
    "grade": ((-0.08, -0.04, -0.015, 0.0, 0.015, 0.04, 0.08), "1"),
    "heading": ((0.0, 0.9, 1.8, 2.7, 3.6, 4.5, 5.4), "rad"),
    "motor_temperature": ((0.0, 15.0, 30.0, 40.0, 50.0, 65.0, 80.0), "degC"),
    "time": ((0.0, 120.0, 240.0, 400.0, 600.0, 800.0, 1200.0), "s"),
    "motor_current": ((-40.0, 0.0, 20.0, 50.0, 90.0, 140.0, 200.0), "A"),
    "current_change": ((0.0, 5.0, 15.0, 30.0, 60.0, 100.0), "A"),
    "pack_current": ((-15.0, 0.0, 8.0, 20.0, 40.0, 60.0, 90.0), "A"),
    "soc": ((0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0), "1"),
    "steering": ((-0.5, -0.2, -0.06, 0.0, 0.06, 0.2, 0.5), "rad"),
    "vibration": ((0.3, 0.7, 1.0, 1.4, 1.9, 2.5, 3.3), "m/s²"),
    "suspension_speed": ((0.02, 0.06, 0.1, 0.14, 0.19, 0.25, 0.35), "m/s"),
    "since_braking": ((0.0, 4.0, 8.0, 15.0, 30.0, 60.0), "s"),
}
PAIRS: tuple[tuple[str, tuple[str, ...]], ...] = (
    (
        "road_force",
        (
            "speed",
            "acceleration",
            "lateral_acceleration",
            "grade",
            "heading",
            "motor_temperature",
            "time",
            "motor_current",
            "current_change",
            "steering",
            "vibration",
            "suspension_speed",
            "since_braking",
        ),
    ),
    ("inverter_power", ("speed", "motor_current", "motor_temperature", "time", "current_change")),
    ("auxiliary", ("speed", "motor_temperature", "time", "pack_current", "vibration")),
    ("pack_balance", ("speed", "pack_current", "motor_temperature", "time")),
    ("cell_voltage", ("pack_current", "soc", "time", "current_change", "vibration")),
)


ROUND = ("heading",)
IN_PROPORTION = ("time", "current_change", "steering", "vibration", "suspension_speed")
"""Quantities that something may be in proportion to and that no candidate is: each is a try of its own."""


@dataclass(frozen=True)
class CurveForm:
    """What a channel may leave over a quantity: a curve, or what is in proportion, which needs less to be seen."""

    channel: str
    quantity: str
    straight: bool = False

    @property
    def name(self) -> str:
        """``channel over quantity`` of a curve."""
        return f"{self.channel} {'along' if self.straight else 'over'} {self.quantity}"

    @property
    def size(self) -> float:
        """Unit of its coefficients, in the channel's."""
        return COEFFICIENT_UNITS[self.channel]

    @property
    def scatter(self) -> float:
        """By how much its coefficients differ between rides, in `size`."""
        return SCATTERS.get(self.channel, SCATTER)

    @property
    def basis(self) -> Array:
        """Its values at the knots for coefficients of one, (knots, k); what is in proportion has one."""
        knots = np.array(QUANTITIES[self.quantity][0])
        if not self.straight:
            return np.eye(len(knots))
        return np.asarray(knots[:, None] / np.abs(knots).max())


def curve_forms() -> list[CurveForm]:
    """A curve for every pair of channel and quantity, and what is in proportion to some."""
    every = [CurveForm(channel, quantity) for channel, quantities in PAIRS for quantity in quantities]
    return [*every, *(replace(form, straight=True) for form in every if form.quantity in IN_PROPORTION)]


def quantity(ride: Ride, name: str, table: LinearChannel) -> Array | None:
    """The quantity over the blocks of `table`, (m,); None if the ride has it not."""
    channel = table.channel
    q = ride.quantities
    if name == "time":
        values = ride.time
    elif name == "current_change":
        n = round(channel.block / STEP)
        mean = over_blocks(channel, ride.signals["motor_current"])
        square = over_blocks(channel, ride.signals["motor_current"] ** 2)
        return np.asarray(np.sqrt(np.maximum(square - mean**2, 0))[table.used]) if n > 1 else None
    elif name == "pack_current":
        if name not in ride.signals:
            return None
        values = ride.signals[name]
    elif name in ("soc", "vibration", "suspension_speed"):
        if name not in q:
            return None
        values = q[name]
    elif name == "grade" and "gps_altitude" in ride.signals:  # not of the accelerometer, whose noise is in the channel
        rise = np.gradient(smooth(ride.signals["gps_altitude"], 8.0), STEP)
        values = smooth(rise, 8.0) / np.maximum(smooth(np.abs(q["speed"]), 8.0), 2.0)
    elif name == "steering":  # of a bicycle without slip: wheelbase over the radius of the bend
        speed = np.maximum(np.abs(q["speed"]), 1.0)
        values = np.clip(1.32 * q["lateral_acceleration"] / speed**2, -0.6, 0.6)
    else:
        values = q[name]
    return over_blocks(channel, values)[table.used]


def hat_functions(x: Array, knots: Sequence[float], periodic: bool = False) -> Array:
    """Linear hat functions over `knots` but the one that most is at, (m, k)."""
    at = np.array(knots)
    if periodic:
        at = np.append(at, 2 * np.pi)
        full = np.array([np.interp(np.mod(x, 2 * np.pi), at, np.eye(len(at))[i]) for i in range(len(at))]).T
        full[:, 0] += full[:, -1]
        full = full[:, :-1]
    else:
        full = np.array([np.interp(x, at, np.eye(len(at))[i]) for i in range(len(at))]).T
    return np.asarray(full)


def columns(ride: Ride, name: str, table: LinearChannel) -> Array | None:
    """The curve's columns over the blocks of `table`, (m, k), in the channel's unit."""
    x = quantity(ride, name, table)
    if x is None:
        return None
    return hat_functions(x, QUANTITIES[name][0], name in ROUND)


def extended(linear: LinearRide, normal: Normal, form: CurveForm, noise: Noise) -> Normal | None:
    """`normal` with the columns of `form`."""
    table = linear.tables.get(form.channel)
    if table is None:
        return None
    knots = columns(linear.ride, form.quantity, table)
    if knots is None:
        return None
    curve = knots @ form.basis * form.size / table.unit[:, None]
    k, p = curve.shape[1], len(normal.b)
    both = whitened(table, noise[form.channel], np.column_stack([curve, table.a, table.y]))
    b, a, y = both[:, :k], both[:, k:-1], both[:, -1]
    n = np.zeros((p + k, p + k))
    n[:p, :p] = normal.n
    n[p:, p:] = b.T @ b
    n[p:, :p] = b.T @ a
    n[:p, p:] = n[p:, :p].T
    return Normal(n, np.concatenate([normal.b, b.T @ y]))


COEFFICIENT_UNITS = {
    "road_force": 5.0,
    "inverter_power": 10.0,
    "auxiliary": 2.0,
    "pack_balance": 0.1,
    "cell_voltage": 0.005,
}
"""Unit of a curve's coefficients, in the channel's; `SCATTER` of it is taken to differ between rides."""
SCATTER = 0.3
ENOUGH = 1.0  # sum of squared weights of a ride's blocks at a knot, from which on it counts as visited
CURVE_RIDGE = 1e-3  # information, in `CurveForm.size`, that keeps knots without data from running away
OWN_FREE = 100.0  # variance in `CurveForm.size` of the common curve while its scatter between rides is sought
SCATTERS = {"cell_voltage": 1.0}  # whose model lacks more


@dataclass(frozen=True)
class CurveFit:
    """What rides show over a quantity. chi2: twice the rise of the log likelihood, of `k` degrees of freedom.

    values (knots,): of the curve at each knot [the channel's unit]; covariance (knots, knots); weights (knots,): how
    much of the rides is at each, together 1.
    """

    chi2: float
    k: int
    values: Array
    covariance: Array
    weights: Array

    @property
    def sd(self) -> Array:
        """Of the values, (k,)."""
        return np.asarray(np.sqrt(np.abs(np.diag(self.covariance))))

    def contrasts(self) -> tuple[Array, Array]:
        """(values less their mean, standard deviations of these), each (k,): what no constant could be."""
        d = np.eye(len(self.values)) - self.weights
        return d @ self.values, np.sqrt(np.abs(np.diag(d @ self.covariance @ d.T)))


def supported_knots(form: CurveForm, linears: Sequence[LinearRide]) -> Array:
    """The coefficients of `form` that these rides can tell, (k, free): a knot that less than `ENOUGH` of two rides is
    at goes with the nearest that has it, so that no curve bends where hardly anything was measured.
    """
    k = form.basis.shape[1]
    if form.straight:
        return np.eye(1)
    at = np.zeros(k)
    for line in linears:
        table = line.tables.get(form.channel)
        knots = columns(line.ride, form.quantity, table) if table is not None else None
        if knots is not None:
            at += (knots**2).sum(axis=0) >= ENOUGH
    good = np.flatnonzero(at >= min(2, len(linears)))
    if not len(good):
        return np.zeros((k, 0))
    nearest = np.abs(np.arange(k)[:, None] - good).argmin(axis=1)
    return np.asarray(np.eye(len(good))[nearest])


def fit_curve(
    mixed: MixedModel,
    linears: Sequence[LinearRide],
    normals: Sequence[Normal],
    form: CurveForm,
    fixed: Sequence[int],
    own: bool = False,
) -> CurveFit | None:
    """What `form` is beside changes at `fixed`; None where no ride has it, or not enough of it.

    own: with the scatter of its coefficients that these rides show, where it is more than `CurveForm.scatter`.
    """
    free = supported_knots(form, linears)
    if not free.shape[1]:
        return None
    rides = _with_columns(mixed, linears, normals, form)
    if not rides:
        return None
    p = len(mixed.mean)
    k = len(rides[0].b) - p
    healthy = mixed.shapes.get(form.name)
    mean = np.concatenate([mixed.mean, healthy.mean if healthy else np.zeros(k)])
    prior = np.zeros((p + k, p + k))
    prior[:p, :p] = mixed.prior
    prior[p:, p:] = healthy.covariance if healthy else np.eye(k) * form.scatter**2
    scatter = np.concatenate([mixed.scatter, np.full(k, form.scatter**2)])
    if own and len(rides) > 1:
        wide = prior.copy()
        wide[p:, p:] += np.eye(k) * OWN_FREE
        learns = np.arange(p + k) >= p
        scatter = np.maximum(scatter, fit_mixed(rides, mean, wide, scatter, 1.0, learns, 10).scatter)
    e = evidence_of(mean, prior, scatter, rides)
    inner, score = e.given(range(p, p + k), fixed, CURVE_RIDGE)
    inner = free.T @ (inner + CURVE_RIDGE * np.eye(k)) @ free
    score = free.T @ score
    estimate = np.linalg.solve(inner, score)
    at = form.basis @ free * form.size
    visits = _visits(form, linears)
    return CurveFit(
        float(score @ estimate), free.shape[1], at @ estimate, at @ np.linalg.inv(inner) @ at.T, visits / np.sum(visits)
    )


def _with_columns(
    mixed: MixedModel, linears: Sequence[LinearRide], normals: Sequence[Normal], form: CurveForm
) -> list[Normal]:
    """The normal equations of the rides that have `form`, with its columns."""
    every = (extended(line, normal, form, mixed.noise) for line, normal in zip(linears, normals, strict=True))
    return [ride for ride in every if ride is not None]


def _visits(form: CurveForm, linears: Sequence[LinearRide]) -> Array:
    """The sum of squared weights of all blocks at each knot, (knots,)."""
    visits = np.zeros(len(form.basis))
    for line in linears:
        if form.channel in line.tables:
            knots = columns(line.ride, form.quantity, line.tables[form.channel])
            visits += 0.0 if knots is None else (knots**2).sum(axis=0)
    return visits


def learn_healthy_curves(
    mixed: MixedModel, linears: Sequence[LinearRide], normals: Sequence[Normal]
) -> dict[str, HealthyCurve]:
    """What the healthy rides leave over each quantity, beside what the parameters of `mixed` explain."""
    found = {}
    for form in curve_forms():
        rides = _with_columns(mixed, linears, normals, form)
        if not rides:
            continue
        p = len(mixed.mean)
        k = len(rides[0].b) - p
        # the parameters stay as they were learned: their values at the mean, the curve what is left
        m, c = np.zeros((k, k)), np.zeros(k)
        for ride in rides:
            v = np.linalg.inv(np.diag(1 / mixed.scatter) + ride.n[:p, :p])
            u = mixed.mean + v @ (ride.b[:p] - ride.n[:p, :p] @ mixed.mean)
            inner = ride.n[p:, p:] - ride.n[p:, :p] @ v @ ride.n[:p, p:]
            score = ride.b[p:] - ride.n[p:, :p] @ u
            part = marginal(Normal((inner + inner.T) / 2, score), np.full(k, form.scatter**2))
            m, c = m + part.n, c + part.b
        covariance = np.linalg.inv(m + np.eye(k))
        found[form.name] = HealthyCurve(np.asarray(covariance @ c), np.asarray(covariance), 1.0)
    return found


def with_inflation(
    mixed: MixedModel,
    folds: Sequence[tuple[MixedModel, Sequence[int]]],
    linears: Sequence[LinearRide],
    normals: Sequence[Normal],
) -> dict[str, HealthyCurve]:
    """The shapes of `mixed`, each with how much too high its score is on healthy rides left out of `folds`."""
    total: dict[str, list[float]] = {}
    for learned, held in folds:
        rest = [i for i in range(len(linears)) if i not in held]
        shapes = learn_healthy_curves(learned, [linears[i] for i in rest], [normals[i] for i in rest])
        blind = replace(learned, shapes=shapes)
        for form in curve_forms():
            found = fit_curve(blind, [linears[i] for i in held], [normals[i] for i in held], form, [])
            if found:
                total.setdefault(form.name, []).append(found.chi2 / found.k)
    whole = learn_healthy_curves(mixed, linears, normals)
    return {
        name: replace(shape, inflation=max(1.0, (2 + sum(total.get(name, []))) / (2 + len(total.get(name, [])))))
        for name, shape in whole.items()
    }
