"""Smooth curves over quantities: what a channel's residual looks like when no cause has its name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.curve_forms import CurveForm, columns_of, curve_forms
from gz_onboard.discovery.linear import LinearRide, Noise, Normal, Population, fit_mixed, marginal
from gz_onboard.discovery.mixed_model import HealthyCurve, MixedModel
from gz_onboard.discovery.result import CONSTANT
from gz_onboard.discovery.search import evidence


def extended(linear: LinearRide, normal: Normal, form: CurveForm, noise: Noise) -> Normal | None:
    """`normal` with the columns of `form`."""
    knots = columns_of(linear, form)
    if knots is None:
        return None
    table = linear.tables[form.channel]
    curve = knots @ form.basis * form.size / table.unit[:, None]
    return normal.padded(curve.shape[1]).with_columns(table, noise[form.channel], curve, slice(len(normal.b)))


CURVE_RIDGE = 1e-3  # information, in `CurveForm.size`, that keeps knots without data from running away
OWN_ROUNDS = 10  # of expectation and maximisation
OWN_FREE = 100.0  # variance in `CurveForm.size` of the common curve while its scatter between rides is sought
LEAST_SPREAD = 0.05  # standard deviation of a quantity, over the distance of two knots, of which a curve can be told
ENOUGH = 1.0  # sum of squared weights of a ride's blocks at a knot, from which on it counts as visited


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


def visits(form: CurveForm, linears: Sequence[LinearRide]) -> Array:
    """The sum of squared weights of each ride's blocks at each knot, (rides that have it, knots)."""
    columns = (columns_of(line, form) for line in linears)
    rows = [(knots**2).sum(axis=0) for knots in columns if knots is not None]
    return np.array(rows).reshape(-1, len(form.knots))


def varies(form: CurveForm, linears: Sequence[LinearRide]) -> bool:
    """Whether the rides differ in the quantity of `form`, within or between them, by `LEAST_SPREAD` or more."""
    found = [knots for line in linears if (knots := columns_of(line, form)) is not None]
    return bool(found) and float(np.concatenate(found).var(axis=0).sum()) > 2 * LEAST_SPREAD**2


def supported_knots(form: CurveForm, linears: Sequence[LinearRide]) -> Array:
    """The coefficients of `form` that these rides determine, (k, free): a knot that less than `ENOUGH` of two rides is
    at goes with the nearest that has it, so that no curve bends where hardly anything was measured. None of them where
    the rides hardly differ in the quantity: it would be a constant by another name.
    """
    if form.quantity != CONSTANT and not varies(form, linears):
        return np.zeros((form.basis.shape[1], 0))
    if form.straight:
        return np.eye(1)
    good = np.flatnonzero((visits(form, linears) >= ENOUGH).sum(axis=0) >= min(2, len(linears)))
    if not len(good):
        return np.zeros((len(form.knots), 0))
    if len(good) == 1 and form.quantity != CONSTANT:
        return np.zeros((len(form.knots), 0))
    nearest = np.abs(np.arange(len(form.knots))[:, None] - good).argmin(axis=1)
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
    rides = _with_columns(mixed, linears, normals, form)
    if not rides or not free.shape[1]:
        return None
    p = len(mixed.mean)
    k = len(rides[0].b) - p
    healthy = mixed.shapes.get(form.name)
    covariance = healthy.covariance if healthy else np.eye(k) * form.scatter**2
    known = bordered(mixed, form, covariance)
    if own and len(rides) > 1:
        wide = bordered(mixed, form, covariance + np.eye(k) * OWN_FREE)
        shown = fit_mixed(rides, wide, 1.0, np.arange(p + k) >= p, OWN_ROUNDS).scatter
        known = replace(known, scatter=np.maximum(known.scatter, shown))
    inner, score = evidence(known, rides).profiled(range(p, p + k), fixed, CURVE_RIDGE)
    inner = free.T @ (inner + CURVE_RIDGE * np.eye(k)) @ free
    score = free.T @ score
    estimate = np.linalg.solve(inner, score)
    at = form.basis @ free * form.size
    visited = visits(form, linears).sum(axis=0)
    weights = visited / np.sum(visited)
    return CurveFit(float(score @ estimate), free.shape[1], at @ estimate, at @ np.linalg.inv(inner) @ at.T, weights)


def bordered(mixed: MixedModel, form: CurveForm, covariance: Array) -> Population:
    """`mixed` with the coefficients of `form`, which are known within `covariance` (k, k)."""
    k, healthy = len(covariance), mixed.shapes.get(form.name)
    return mixed.bordered(healthy.mean if healthy else np.zeros(k), covariance, np.full(k, form.scatter**2))


def _with_columns(
    mixed: MixedModel, linears: Sequence[LinearRide], normals: Sequence[Normal], form: CurveForm
) -> list[Normal]:
    """The normal equations of the rides that have `form`, with its columns."""
    every = (extended(line, normal, form, mixed.noise) for line, normal in zip(linears, normals, strict=True))
    return [ride for ride in every if ride is not None]


def learn_healthy_curves(
    mixed: MixedModel, linears: Sequence[LinearRide], normals: Sequence[Normal]
) -> dict[str, HealthyCurve]:
    """What the healthy rides leave over each quantity, beside what the parameters of `mixed` explain."""
    found = {}
    for form in curve_forms(mixed.sizes):
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
        for form in curve_forms(mixed.sizes):
            found = fit_curve(blind, [linears[i] for i in held], [normals[i] for i in held], form, [])
            if found:
                total.setdefault(form.name, []).append(found.chi2 / found.k)
    whole = learn_healthy_curves(mixed, linears, normals)
    return {
        name: replace(shape, inflation=max(1.0, (2 + sum(total.get(name, []))) / (2 + len(total.get(name, [])))))
        for name, shape in whole.items()
    }
