"""Least squares with covariance, held-out data, and errors for parameters that the data cannot separate.

Two fits, `linear` and `nonlinear`, give a `Solution`. Its covariance is that of independent residuals; for samples
that depend on each other (one run, one ride) give `groups`: then it is the sandwich of Liang & Zeger (1986), which
takes whole groups as the independent pieces.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from gz_onboard.arrays import Array, Mask
from gz_onboard.calibration.result import Fit, Found
from gz_onboard.errors import InputError

Residual = Callable[[Array], Array]


@dataclass(frozen=True)
class Solution:
    """Parameters that fit best.

    value: shape (n,) in the order of `names`. covariance: (n, n). residual: (m,), weighted (in units of its sd if one
    was given), model less data. variance: of a weighted residual, by which the covariance was scaled: 1 if the sd given
    is right.
    """

    names: tuple[str, ...]
    value: Array
    covariance: Array
    residual: Array
    variance: float

    def __getitem__(self, name: str) -> float:
        return float(self.value[self.names.index(name)])

    def sd(self, name: str) -> float:
        """The standard deviation of `name`."""
        i = self.names.index(name)
        return float(np.sqrt(self.covariance[i, i]))

    def part(self, names: Sequence[str]) -> Array:
        """The covariance of `names`, in that order."""
        i = [self.names.index(name) for name in names]
        return self.covariance[np.ix_(i, i)]

    def found(self, name: str, unit: str, source: str, sd_more: float = 0.0, channel: str = "") -> Found:
        """`name` as a result. sd_more: a further standard deviation that no sample shows, such as of the sensor."""
        return Found(self[name], float(np.hypot(self.sd(name), sd_more)), unit, source, channel)


def correlation(covariance: Array) -> Array:
    """The correlation of a covariance, exactly symmetric; a value without spread is not correlated."""
    sd = np.sqrt(np.diag(covariance))
    scale = np.where(sd > 0, sd, np.inf)
    matrix = np.clip(covariance / np.outer(scale, scale), -1.0, 1.0)
    matrix = (matrix + matrix.T) / 2
    np.fill_diagonal(matrix, 1.0)
    return np.asarray(matrix)


def linear(
    columns: Mapping[str, Array],
    y: Array,
    sd: Array | float | None = None,
    *,
    prior: Mapping[str, tuple[float, float]] | None = None,
    groups: NDArray[Any] | None = None,
) -> Solution:
    """The parameters p (one for each of `columns`, shape (m,)) for which sum(p·column) is nearest to y, shape (m,).

    sd: of y, of one sample or of each; without it the residuals give it. prior: (value, sd) of parameters that more is
    known of; it needs the sd of y. groups: label of each sample, (m,), where samples of one label depend on each other.
    Raises InputError for fewer samples than parameters, or columns that depend on each other without a prior.
    """
    names = tuple(columns)
    a = np.column_stack([np.broadcast_to(np.asarray(c, dtype=float), y.shape) for c in columns.values()])
    weight = np.broadcast_to(1.0 if sd is None else 1.0 / np.asarray(sd, dtype=float), y.shape)
    jacobian = a * weight[:, None]
    rows, targets = _prior_rows(names, prior, sd is not None)
    full, target = np.vstack([jacobian, rows]), np.concatenate([y * weight, targets])
    size = np.linalg.norm(full, axis=0)
    _check(names, full, len(y), size)
    value = np.linalg.lstsq(full / size, target, rcond=None)[0] / size
    return _solution(names, value, jacobian, jacobian @ value - y * weight, rows, sd is not None, groups)


def line(name: str, x: Array, y: Array, groups: NDArray[Any] | None = None) -> tuple[Solution, Array]:
    """(slope `name` and ``offset`` of the line through y over x; its y at x)."""
    found = linear({name: x, "offset": np.ones_like(x)}, y, groups=groups)
    return found, found[name] * x + found["offset"]


def as_groups(labels: NDArray[Any]) -> NDArray[Any] | None:
    """`labels` as groups for `linear`; None for two or fewer, whose scatter says nothing."""
    return labels if len(np.unique(labels)) > 2 else None


def nonlinear(
    residual: Residual,
    start: Mapping[str, float],
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    groups: NDArray[Any] | None = None,
    known_sd: bool = False,
) -> Solution:
    """The parameters near `start` for which `residual` (of an array in its order, weighted, shape (m,)) is least.

    known_sd: the residual is in units of its true sd, so that its size is not scaled to 1 (a size above 1 still is:
    a poor model makes parameters less sure); a prior needs it. The rest as for `linear`.
    """
    names = tuple(start)
    x0 = np.array([start[name] for name in names], dtype=float)
    low = np.array([(bounds or {}).get(name, (-np.inf, np.inf))[0] for name in names])
    high = np.array([(bounds or {}).get(name, (-np.inf, np.inf))[1] for name in names])
    scale = np.where(x0 != 0, np.abs(x0), 1.0)
    rows, targets = _prior_rows(names, prior, known_sd)

    def everything(x: Array) -> Array:
        return np.concatenate([residual(x), rows @ x - targets])

    best = least_squares(everything, x0, bounds=(low, high), x_scale=scale)
    m = len(best.fun) - len(rows)
    jacobian = best.jac[:m]
    _check(names, best.jac, m, np.linalg.norm(best.jac, axis=0))
    return _solution(names, best.x, jacobian, best.fun[:m], rows, known_sd, groups)


def _prior_rows(
    names: tuple[str, ...], prior: Mapping[str, tuple[float, float]] | None, known_sd: bool
) -> tuple[Array, Array]:
    """A row for each prior, as one more measurement whose weighted residual has an sd of 1."""
    if prior and not known_sd:
        raise ValueError("a prior needs a residual in units of its sd to be weighed against")
    rows = np.zeros((len(prior or {}), len(names)))
    for row, (name, (_, sd)) in zip(rows, (prior or {}).items(), strict=True):
        row[names.index(name)] = 1.0 / sd
    return rows, np.array([value / sd for value, sd in (prior or {}).values()])


def _check(names: tuple[str, ...], jacobian: Array, points: int, size: Array) -> None:
    if points < len(names) and len(jacobian) < len(names):
        raise InputError(f"{points} points are too few for {len(names)} parameters ({', '.join(names)})")
    for name, length in zip(names, size, strict=True):
        if not length > 0:
            raise InputError(f"{name} is not identifiable from these data: no point changes with it")
    if (scaled := np.linalg.svd(jacobian / size, compute_uv=False))[-1] < 1e-9 * scaled[0]:
        direction = np.linalg.svd(jacobian / size)[2][-1]
        tied = [name for name, part in zip(names, direction, strict=True) if abs(part) > 0.1]
        raise InputError(f"the data cannot separate {' and '.join(tied)}: they change every point in the same way")


def _solution(
    names: tuple[str, ...],
    value: Array,
    jacobian: Array,
    residual: Array,
    rows: Array,
    known_sd: bool,
    groups: NDArray[Any] | None,
) -> Solution:
    freedom = len(residual) + len(rows) - len(names)
    mean_square = float(residual @ residual) / freedom if freedom > 0 else float("nan")
    variance = max(1.0, mean_square) if known_sd else mean_square
    # Prior rows are in units of a weighted residual's sd: of 1 where that is known.
    prior = rows.T @ rows * (variance if known_sd else 1.0)
    bread = jacobian.T @ jacobian + prior
    size = np.sqrt(np.diag(bread))
    inverse = np.linalg.inv(bread / np.outer(size, size)) / np.outer(size, size)
    if groups is None:
        covariance = inverse * variance
    else:
        labels = np.unique(groups)
        scores = np.array([jacobian[groups == label].T @ residual[groups == label] for label in labels])
        factor = len(labels) / max(len(labels) - 1, 1)
        meat = factor * scores.T @ scores + variance * prior
        # Few groups give few directions: no parameter is surer than independent samples would make it.
        covariance = inverse @ meat @ inverse
        independent = inverse * variance
        short = np.sqrt(np.maximum(np.diag(independent) / np.maximum(np.diag(covariance), 1e-300), 1.0))
        covariance = covariance * np.outer(short, short)
    return Solution(names, value, covariance, residual, variance)


def split(count: int, share: float = 1 / 3, seed: int = 0) -> Mask:
    """True for the points to fit, shape (count,); a random `share` of them is held out."""
    keep = np.ones(count, dtype=bool)
    keep[np.random.default_rng(seed).permutation(count)[: round(share * count)]] = False
    return keep


def score(what: str, unit: str, data: Array, model: Array, *, held_out: bool, source: str) -> Fit:
    """How well `model` follows `data`, both of shape (m,). r2 is None for data without spread."""
    error = np.asarray(data) - np.asarray(model)
    spread = float(np.sum((data - np.mean(data)) ** 2))
    r2 = 1 - float(error @ error) / spread if spread > 0 else None
    rms = float(np.sqrt(np.mean(error**2)))
    return Fit(what, unit, rms, float(np.max(np.abs(error))), r2, len(error), held_out, source)
