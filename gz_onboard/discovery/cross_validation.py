"""Rides held out of the fit: what a model that was fitted to the others leaves of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.candidates import Candidate
from gz_onboard.discovery.curve_forms import CurveForm, columns_of
from gz_onboard.discovery.curves import bordered, extended
from gz_onboard.discovery.linear import LinearRide, Normal, fit_mixed, normal
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.prior import EACH_RIDES_OWN

PART = 0.1  # of the evidence: a channel with less has no say
WIDE = 100.0  # variance of a curve's coefficients, in units of `CurveForm.size`


@dataclass(frozen=True)
class Fold:
    """What is free on the rides that a model is fitted to: causes, and the curve of what has no name."""

    causes: Sequence[Candidate] = ()
    form: CurveForm | None = None

    def fit(self, mixed: MixedModel, lines: Sequence[LinearRide], normals: Sequence[Normal]) -> tuple[Array, Array]:
        """(the common part (p,), the curve's coefficients (k,)) from these rides."""
        free = mixed.freed(mixed.index_of(self.causes))
        if (form := self.form) is None:
            return free.fit(normals).mean, np.zeros(0)
        k = form.basis.shape[1]
        pairs = zip(lines, normals, strict=True)
        rides = [extended(line, plain, form, mixed.noise) or plain.padded(k) for line, plain in pairs]
        both = fit_mixed(rides, bordered(free, form, WIDE * np.eye(k))).mean
        return both[:-k], both[-k:]

    def shown(self, line: LinearRide, curve: Array) -> LinearRide:
        """`line` less the curve of these coefficients (k,)."""
        knots = columns_of(line, self.form) if self.form is not None else None
        if self.form is None or knots is None:
            return line
        table = line.tables[self.form.channel]
        less = knots @ self.form.basis @ curve * self.form.size / table.unit
        return LinearRide(line.ride, {**line.tables, self.form.channel: replace(table, y=table.y - less)})


Triple = tuple[float, float, float]  # before, with the control, after
Squares = dict[str, Triple]  # by channel: mean squares


def held_out(
    mixed: MixedModel,
    lines: Sequence[LinearRide],
    normals: Sequence[Normal],
    after: Fold,
    control: Fold,
    folds: Sequence[Sequence[int]] | None = None,
) -> Iterator[list[tuple[LinearRide, Array]]]:
    """Of each ride in turn, held out of the fit with those of its fold: it, and its parameters (p,) with its own start,
    before (the causes of `control` alone moved), with `control` refitted, with `after`.

    folds: which rides are held out together; each alone if not given.
    """
    for fold in [[i] for i in range(len(lines))] if folds is None else folds:
        rest = [i for i in range(len(lines)) if i not in fold]
        some, theirs = [lines[i] for i in rest], [normals[i] for i in rest]
        plain, _ = control.fit(mixed, some, theirs)
        before = mixed.mean.copy()
        index = mixed.index_of(control.causes)
        before[index] = plain[index]
        full, curve = after.fit(mixed, some, theirs)
        for line in (lines[i] for i in fold):
            models = ((line, before), (line, plain), (after.shown(line, curve), full))
            yield [(shown, with_own_start(mixed, start_equations(mixed, shown), theta)) for shown, theta in models]


def squares(held: Iterator[list[tuple[LinearRide, Array]]]) -> Iterator[Squares]:
    """The mean squares of what `held_out` leaves of the residuals."""
    for models in held:
        before, control, after = (
            {name: float(np.mean((table.y - table.a @ theta) ** 2)) for name, table in shown.tables.items()}
            for shown, theta in models
        )
        yield {name: (before[name], control[name], after[name]) for name in before}


def worsened(held: Iterator[Squares], shares: Mapping[str, float]) -> dict[str, float]:
    """By how much rides held out are known worse after than before or with the control, whichever is better: ln of the
    mean square, negative if better, of each channel that has a part of the evidence (`shares`).
    """
    rows = list(held)
    found = {}
    for channel in (name for name, part in shares.items() if part > PART):
        if mine := [row[channel] for row in rows if channel in row]:
            before, control, after = (sum(column) for column in zip(*mine, strict=True))
            found[channel] = float(np.log(after / min(before, control)))
    return found


def improves(held: Iterator[Squares], shares: Mapping[str, float]) -> bool:
    """Whether `worsened` is negative for all channels together, each by its share."""
    return sum(shares[channel] * more for channel, more in worsened(held, shares).items()) < 0


def start_equations(mixed: MixedModel, line: LinearRide) -> Normal:
    """What shows how a ride began: not force and power, whose mean would be taken for the accelerometer's bias."""
    return normal(line, mixed.noise, [name for name in line.tables if name not in ("road_force", "pack_power")])


def with_own_start(mixed: MixedModel, ride: Normal, theta: Array) -> Array:
    """`theta` (p,) with what is the ride's own of `prior.EACH_RIDES_OWN`, which is no merit or fault of a model."""
    m = [i for i, name in enumerate(mixed.names) if name in EACH_RIDES_OWN]
    variance = mixed.scatter[m] + np.diag(mixed.prior)[m]
    rest = ride.b[m] - ride.n[m] @ theta
    moved = theta.copy()
    moved[m] += np.linalg.solve(np.diag(1 / variance) + ride.n[np.ix_(m, m)], rest)
    return moved
