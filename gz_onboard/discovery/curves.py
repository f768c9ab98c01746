"""Smooth curves over quantities: the form of a residual that no cause has a name for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.grid import STEP, Ride, smooth
from gz_onboard.discovery.mixed_model import (
    HealthyCurve,
    LinearChannel,
    LinearRide,
    MixedModel,
    Population,
    Statistics,
    one_degree,
)
from gz_onboard.priors import USUAL_SIZES, Sizes

CONSTANT = "constant"  # the quantity of a residual that is the same everywhere
KNOTS: dict[str, tuple[tuple[float, ...], str, str]] = {  # knots in a vehicle of size 1, unit, size they grow with
    "speed": ((2.0, 4.5, 6.5, 8.5, 10.0, 11.5, 13.0, 15.0), "m/s", "speed"),
    "acceleration": ((-2.0, -1.0, -0.3, 0.0, 0.3, 1.0, 2.0), "m/s²", ""),
    "lateral_acceleration": ((-4.0, -2.0, -0.7, 0.0, 0.7, 2.0, 4.0), "m/s²", ""),
    "grade": ((-0.08, -0.04, -0.015, 0.0, 0.015, 0.04, 0.08), "1", ""),
    "heading": ((0.0, 0.9, 1.8, 2.7, 3.6, 4.5, 5.4), "rad", ""),
    "motor_temperature": ((0.0, 15.0, 30.0, 40.0, 50.0, 65.0, 80.0), "degC", ""),
    "time": ((0.0, 120.0, 240.0, 400.0, 600.0, 800.0, 1200.0), "s", ""),
    "motor_current": ((-40.0, 0.0, 20.0, 50.0, 90.0, 140.0, 200.0), "A", "current"),
    "current_change": ((0.0, 5.0, 15.0, 30.0, 60.0, 100.0), "A", "current"),
    "pack_current": ((-15.0, 0.0, 8.0, 20.0, 40.0, 60.0, 90.0), "A", "current"),
    "soc": ((0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0), "1", ""),
    "steering": ((-0.5, -0.2, -0.06, 0.0, 0.06, 0.2, 0.5), "rad", ""),
    "vibration": ((0.3, 0.7, 1.0, 1.4, 1.9, 2.5, 3.3), "m/s²", ""),
    "since_braking": ((0.0, 4.0, 8.0, 15.0, 30.0, 60.0), "s", ""),
    CONSTANT: ((0.0,), "1", ""),
}
# channel: (unit of a curve's coefficients in that of the channel, in a vehicle of size 1; their scatter between rides
# in this unit; quantities)
CURVES: dict[str, tuple[float, float, tuple[str, ...]]] = {
    "road_force": (5.0, 0.3, tuple(name for name in KNOTS if name not in ("pack_current", "soc", CONSTANT))),
    "inverter_power": (10.0, 0.3, ("speed", "motor_current", "motor_temperature", "time", "current_change")),
    "pack_power": (
        40.0,
        0.3,
        ("speed", "acceleration", "lateral_acceleration", "grade", "heading", "time", "vibration", CONSTANT),
    ),
    "auxiliary": (2.0, 0.3, ("speed", "motor_temperature", "time", "pack_current", "vibration")),
    "pack_balance": (0.1, 0.3, ("speed", "pack_current", "motor_temperature", "time")),
    "cell_voltage": (0.005, 1.0, ("pack_current", "soc", "time", "current_change", "vibration")),
}
IN_PROPORTION = ("time", "current_change", "steering", "vibration")
"""Quantities that a residual may be in proportion to and no candidate is: each counts as a try."""


@dataclass(frozen=True)
class CurveConfig:
    """When a curve is determined by rides."""

    ridge: float = 2e-3  # information that bounds knots without data
    own_rounds: int = 10  # of expectation and maximisation
    own_free: float = 100.0  # variance of the common curve while its scatter between rides is sought
    least_spread: float = 0.05  # sd of a quantity over the distance of two knots
    learned: float = 1e-12  # variance in scales of a parameter that a curve does not move
    visited: float = 1.0  # sum of squared weights of a ride's blocks at a knot


FITTING = CurveConfig()


@dataclass(frozen=True)
class CurveForm:
    """A curve of a channel over a quantity, or a straight line through 0, which needs less to be seen.

    size: unit of its coefficients, in the channel's. scatter: by which they differ between rides, in `size`.
    """

    channel: str
    quantity: str
    straight: bool
    knots: tuple[float, ...]
    size: float
    scatter: float

    @property
    def name(self) -> str:
        """``channel over quantity``; of a straight line ``channel along quantity``."""
        return f"{self.channel} {'along' if self.straight else 'over'} {self.quantity}"

    @property
    def basis(self) -> Array:
        """Values at the knots for coefficients of one, (knots, k)."""
        knots = np.array(self.knots)
        return np.asarray(knots[:, None] / np.abs(knots).max()) if self.straight else np.eye(len(knots))


def curve_form(channel: str, quantity: str, straight: bool = False, sizes: Sizes = USUAL_SIZES) -> CurveForm:
    """The curve of `channel` over `quantity` in a vehicle of `sizes`."""
    knots, _, grows = KNOTS[quantity]
    size, scatter, _ = CURVES[channel]
    scaled = tuple(knot * sizes.of(grows) for knot in knots)
    return CurveForm(channel, quantity, straight, scaled, size * sizes.of(CHANNEL[channel].size), scatter)


def curve_forms(sizes: Sizes = USUAL_SIZES) -> list[CurveForm]:
    """All curves, then all straight lines, of a vehicle of `sizes`."""
    pairs = [(channel, quantity) for channel, (_, _, quantities) in CURVES.items() for quantity in quantities]
    forms = [curve_form(*pair, sizes=sizes) for pair in pairs]
    return [*forms, *(replace(form, straight=True) for form in forms if form.quantity in IN_PROPORTION)]


def quantity(ride: Ride, name: str, table: LinearChannel) -> Array | None:
    """The quantity over the blocks of `table`, (m,); None if the ride did not measure it."""
    if not ride.shows(name):
        return None
    if name == CONSTANT:
        return np.zeros(len(table.y))
    values = ride.quantities.get(name)
    if name == "current_change":
        current = ride.signals["motor_current"]
        return np.asarray(np.sqrt(np.maximum(table.over(current**2) - table.over(current) ** 2, 0)))
    if name == "grade" and "gps_altitude" in ride.signals:  # the accelerometer's noise is in the channel
        rise = np.gradient(smooth(ride.signals["gps_altitude"], 8.0), STEP)
        values = smooth(rise, 8.0) / np.maximum(smooth(np.abs(ride.quantities["speed"]), 8.0), 2.0)
    return None if values is None else table.over(values)


def hat_functions(x: Array, knots: Sequence[float], periodic: bool = False) -> Array:
    """Linear hat functions over `knots`, (m, k); periodic: of an angle [rad], the last meets the first."""
    at = [*knots, 2 * np.pi] if periodic else knots
    inside = np.mod(x, 2 * np.pi) if periodic else x
    full: Array = np.array([np.interp(inside, at, hat) for hat in np.eye(len(at))]).T
    if periodic:
        full[:, 0] += full[:, -1]
        full = full[:, :-1]
    return full


def columns_of(line: LinearRide, form: CurveForm) -> Array | None:
    """The hat functions over the blocks of the channel, (m, knots); None if the ride did not measure the quantity."""
    table = line.tables.get(form.channel)
    x = quantity(line.ride, form.quantity, table) if table is not None else None
    return None if x is None else hat_functions(x, form.knots, form.quantity == "heading")


def extended(mixed: MixedModel, line: LinearRide, form: CurveForm) -> Statistics | None:
    """The statistics of `line` with the coefficients of `form` as further parameters; None as of `columns_of`."""
    knots = columns_of(line, form)
    if knots is None:
        return None
    table = line.tables[form.channel]
    curve = knots @ form.basis * form.size / table.unit[:, None]
    return line.statistics.padded(curve.shape[1]).with_columns(table, mixed.noise[form.channel], curve)


def bordered(mixed: MixedModel, form: CurveForm, covariance: Array) -> Population:
    """`mixed` with the coefficients of `form`, known within `covariance` (k, k)."""
    k, healthy = len(covariance), mixed.shapes.get(form.name)
    return mixed.bordered(healthy.mean if healthy else np.zeros(k), covariance, np.full(k, form.scatter**2))


@dataclass(frozen=True)
class CurveFit:
    """A curve that rides show. chi2: twice the rise of the log likelihood, with `k` degrees of freedom.

    healthy_chi2: over the inflation of healthy rides; score: the same as of one degree of freedom. values (knots,): at
    the knots [the channel's unit]; covariance (knots, knots).
    """

    form: CurveForm
    chi2: float
    healthy_chi2: float
    score: float
    k: int
    values: Array
    covariance: Array


def supported_knots(form: CurveForm, lines: Sequence[LinearRide]) -> Array:
    """Coefficients that the rides determine, (k, free).

    A knot that fewer than two rides visit moves with its nearest visited neighbour, so that no curve bends where
    nothing was measured. No coefficient is free where the quantity hardly varies: the curve would be a constant.
    """
    none = np.zeros((form.basis.shape[1], 0))
    found = [knots for line in lines if (knots := columns_of(line, form)) is not None]
    if not found:
        return none
    is_constant = form.quantity == CONSTANT
    spread = float(np.concatenate(found).var(axis=0).sum())
    if not is_constant and spread <= 2 * FITTING.least_spread**2:
        return none
    if form.straight:
        return np.eye(1)
    visits = np.array([(knots**2).sum(axis=0) >= FITTING.visited for knots in found])
    good = np.flatnonzero(visits.sum(axis=0) >= min(2, len(lines)))
    if len(good) < (1 if is_constant else 2):
        return none
    nearest = np.abs(np.arange(len(form.knots))[:, None] - good).argmin(axis=1)
    return np.asarray(np.eye(len(good))[nearest])


def fit_curve(
    mixed: MixedModel, lines: Sequence[LinearRide], form: CurveForm, fixed: Sequence[int], own: bool = False
) -> CurveFit | None:
    """The curve of `form` with the parameters at `fixed` refitted; None if too little of it was measured.

    own: with the scatter of its coefficients that these rides show, if it is more than usual.
    """
    free = supported_knots(form, lines)
    if not free.shape[1]:
        return None
    rides = [ride for line in lines if (ride := extended(mixed, line, form)) is not None]
    p, k = len(mixed.mean), len(free)
    healthy = mixed.shapes.get(form.name)
    covariance = healthy.covariance if healthy else np.eye(k) * form.scatter**2
    known = bordered(mixed, form, covariance)
    if own and len(rides) > 1:
        wide = bordered(mixed, form, covariance + np.eye(k) * FITTING.own_free)
        shown = wide.fit(rides, 1.0, np.arange(p + k) >= p, FITTING.own_rounds).scatter
        known = replace(known, scatter=np.maximum(known.scatter, shown))
    shown_by = known.evidence(rides).profiled(range(p, p + k), fixed)
    inner = free.T @ (shown_by.information + FITTING.ridge * np.eye(k)) @ free
    gradient = free.T @ shown_by.score
    estimate, at = np.linalg.solve(inner, gradient), form.basis @ free * form.size
    chi2, count = float(gradient @ estimate), free.shape[1]
    healthy_chi2 = chi2 / (healthy.inflation if healthy else 1.0)
    score = one_degree(healthy_chi2, count, mixed.freedom)
    covariance = at @ np.linalg.inv(inner) @ at.T
    return CurveFit(form, chi2, healthy_chi2, score, count, at @ estimate, covariance)


def healthy_curves(mixed: MixedModel, lines: Sequence[LinearRide]) -> dict[str, HealthyCurve]:
    """The curves that healthy rides leave with the parameters of `mixed` as they were learned."""
    found, p = {}, len(mixed.mean)
    learned = Population(mixed.mean, FITTING.learned * np.eye(p), mixed.scatter)
    for form in curve_forms(mixed.system.sizes):
        rides = [ride for line in lines if (ride := extended(mixed, line, form)) is not None]
        if rides:
            k = len(rides[0].score) - p
            post = learned.bordered(np.zeros(k), np.eye(k), np.full(k, form.scatter**2)).fit(rides)
            found[form.name] = HealthyCurve(post.mean[p:], post.covariance[p:, p:], 1.0)
    return found


def with_inflation(
    mixed: MixedModel, folds: Sequence[tuple[MixedModel, Sequence[int]]], lines: Sequence[LinearRide]
) -> dict[str, HealthyCurve]:
    """The healthy curves of `mixed` with the inflation of their scores on rides left out of `folds`."""
    total: dict[str, list[float]] = {}
    for learned, held in folds:
        blind = replace(learned, shapes=healthy_curves(learned, [x for i, x in enumerate(lines) if i not in held]))
        for form in curve_forms(mixed.system.sizes):
            found = fit_curve(blind, [lines[i] for i in held], form, [])
            if found:
                total.setdefault(form.name, []).append(found.chi2 / found.k)
    result = {}
    for name, shape in healthy_curves(mixed, lines).items():
        ratios = total.get(name, [])
        result[name] = replace(shape, inflation=max(1.0, (2 + sum(ratios)) / (2 + len(ratios))))
    return result
