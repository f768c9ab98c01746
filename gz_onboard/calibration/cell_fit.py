"""Many RC pairs of fixed time constants fitted to a pulse test, and their reduction to one pair or two.

With the time constants fixed the voltage is linear in every table, so the fit has one minimum and needs no start. The
pairs span what a test shows, charge transfer in a second to diffusion in half an hour (a discrete distribution of
relaxation times: Schmidt et al. 2013). One pair cannot follow all of that; which part it should depends on the load, so
it is the one whose voltage is nearest under a given current, node by node.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.optimize import nnls
from scipy.signal import lfilter

from gz_onboard.arrays import Array
from gz_onboard.calibration.cell_circuit import follow, follow_slope, hats
from gz_onboard.calibration.cell_data import CellTest
from gz_onboard.constants import KELVIN
from gz_onboard.offline.arrays import bends

# s. A pair between two of them is made of both, and one pair made of these is off by the square of their distance: C1
# of a pair of 30 s by -10 % for a factor of 4 from each to the next, -1 % for the 1.75 of these.
TIMES = tuple(float(tau) for tau in np.geomspace(1.0, 1500.0, 14))
VOLTAGE_SD = 0.004  # V: what the model leaves, independent every CORRELATED samples
SOC_SD = 0.003  # how far the state of charge may be off, which matters where the OCV is steep
CORRELATED = 20
BEND_SD = 0.3  # relative: how far a table may bend from node to node, per 0.05 of SOC
LEAST = 2e-5  # ohm: of a pair that the data do not show; with the longest of TIMES its C1 is what a file can hold
LEFT_OUT = (0.1, 1.0)  # of a piece's weight, to see how much hangs on it: see `jackknife`
TIME_BEND = 0.5  # of ln τ, as BEND_SD
TURNS = 8  # of Gauss and Newton
SHIFT_SD, SHIFT_SD_EMPTY = 0.01, 0.05  # V: rest voltage of this test against the OCV; below 10 % SOC


@dataclass(frozen=True)
class Pieces:
    """A pulse test as normal equations, one piece for each pulse with the rest after it.

    Of R0, the pairs and the shift of the rest voltage, each over the nodes `soc` (n,), flattened in this order to p
    numbers. label: (pieces,) of `CellTest.block`; gram: (pieces, p, p), right: (pieces, p), weighted; samples:
    (pieces, n), how many with a current are near each node.
    """

    soc: Array
    temperature: float
    label: NDArray[np.int_]
    gram: Array
    right: Array
    samples: Array


@dataclass(frozen=True)
class Branches:
    """The pairs at one temperature.

    resistance: (1 + len(TIMES), n) [ohm], R0 first; shift: (n,) [V] of the rest voltage against the OCV.
    covariance: (n,) of those of the resistances at a node, from the scatter of what the pieces leave over, as if a
    resistance could be negative; it weighs nodes against each other. without:
    (2, pieces, 2 + len(TIMES), n), both as they are with `LEFT_OUT` of each piece left out, if that was asked for.
    shift_prior: (n,) [V], the sd of the shift that the priors' own doubt leaves. covered: (n,), False at nodes without
    a pulse near.
    """

    soc: Array
    temperature: float
    resistance: Array
    shift: Array
    covariance: Array
    without: Array
    shift_prior: Array
    covered: NDArray[np.bool_]


def filtered(test: CellTest) -> Array:
    """(m, len(TIMES)) [A]: the current that flows in the resistance of each pair."""
    return np.column_stack([follow(test.flowed, test.dt, tau) for tau in TIMES])


def pieces(
    test: CellTest,
    level: Array,
    ocv: tuple[Array, Array],
    soc: Array,
    temperature: float,
    relaxing: Array,
    activation: tuple[float, float] = (0.0, 0.0),
) -> Pieces:
    """`test`, whose state of charge is `level` (m,), over nodes `soc` (n,) at `temperature` [degC].

    ocv: (voltage (m,) [V], slope (m,) [V]) at `level`. relaxing: `filtered` of the test. activation: of R0 and of the
    pairs [K]: R goes as exp(activation/T), which moves samples at other temperatures than the nominal one.
    """
    inverse = 1 / (test.temperature + KELVIN) - 1 / (temperature + KELVIN)
    warm = np.exp(activation[0] * inverse), np.exp(activation[1] * inverse)
    columns, weight = weighted_columns(test, ocv, relaxing, warm)
    target = (test.voltage - ocv[0]) * weight
    hat = hats(soc, level)
    labels, first = np.unique(test.block, return_index=True)  # the number of the block never falls
    n, size = len(soc), columns.shape[1] * len(soc)
    gram, right, samples = (
        np.zeros((len(labels), size, size)),
        np.zeros((len(labels), size)),
        np.zeros((len(labels), n)),
    )
    for k, (start, end) in enumerate(zip(first, [*first[1:], len(test)], strict=True)):
        rows = slice(start, end)
        near = np.flatnonzero(hat[rows].any(axis=0))  # a pulse touches few nodes
        a = (columns[rows, :, None] * hat[rows, None, near]).reshape(end - start, -1)
        places = (np.arange(columns.shape[1])[:, None] * n + near).ravel()
        gram[k][np.ix_(places, places)] = a.T @ a
        right[k, places] = a.T @ target[rows]
        samples[k] = hat[rows][~test.rest[rows]].sum(axis=0)
    return Pieces(soc, temperature, labels, gram, right, samples)


def weighted_columns(
    test: CellTest, ocv: tuple[Array, Array], relaxing: Array, warm: tuple[Array, Array] | None = None
) -> tuple[Array, Array]:
    """(what the voltage is of R0, each pair and the shift at every sample, (m, 2 + len(TIMES)); weights (m,)).

    ocv, relaxing: see `pieces`. warm: factors (m,) on R0 and on the pairs.
    """
    weight = 1 / (np.hypot(VOLTAGE_SD, SOC_SD * ocv[1]) * np.sqrt(CORRELATED))
    columns = np.column_stack([-test.current, -relaxing, np.ones(len(test))])
    if warm:
        columns[:, 0] *= warm[0]
        columns[:, 1:-1] *= warm[1][:, None]
    return columns * weight[:, None], weight


def fit_branches(of: Pieces, keep: NDArray[np.bool_] | None = None, leave_out: bool = False) -> Branches:
    """The pairs that fit the pieces best. keep: (pieces,), True for those to use; leave_out: of each left out too."""
    used = np.ones(len(of.label), dtype=bool) if keep is None else keep
    n, branches = len(of.soc), 1 + len(TIMES)
    gram, right = of.gram[used].sum(axis=0), of.right[used].sum(axis=0)
    scale = np.full(branches, 0.02)  # ohm
    for _ in range(2):  # how far a table may bend is relative to its size, which the first turn gives
        prior = smoothness(of.soc, scale, n, branches)
        p = _positive(gram + prior, right, n)
        scale = np.maximum(np.median(p[:-n].reshape(branches, n), axis=1), 2e-3)
    without = [
        [_positive(gram + prior - part * of.gram[k], right - part * of.right[k], n) for k in np.flatnonzero(used)]
        for part in LEFT_OUT
        if leave_out
    ]
    bread = np.linalg.inv(gram + prior)
    scores = of.right[used] - of.gram[used] @ p
    covariance = (bread @ (scores.T @ scores + prior) @ bread).reshape(branches + 1, n, branches + 1, n)
    shift_prior = np.sqrt(np.diag(bread @ prior @ bread)[-n:])
    at_node = np.array([covariance[:-1, k, :-1, k] for k in range(n)])
    return Branches(
        of.soc,
        of.temperature,
        p[:-n].reshape(branches, n),
        p[-n:],
        at_node,
        np.reshape(without, (2, -1, branches + 1, n)),
        shift_prior,
        of.samples[used].sum(axis=0) > 3,
    )


def _positive(normal: Array, right: Array, n: int) -> Array:
    """The solution of normal equations whose first numbers are not negative; the last `n`, shifts, may be, to -1 V."""
    upper = cholesky(normal, lower=False)
    floor = np.concatenate([np.zeros(len(right) - n), np.ones(n)])
    return np.asarray(nnls(upper, solve_triangular(upper, right, trans="T") + upper @ floor)[0] - floor)


def jackknife(whole: Array, without: Array) -> Array:
    """The sd of `whole` (...) from what it is with `LEFT_OUT` of each piece of the data left out, (2, pieces, ...).

    A piece pulls the fit towards itself, by its leverage h. Leaving out a little of it moves the fit by what the piece
    leaves over, whose variance is (1 - h)·σ²: too little. Leaving it out whole, as the jackknife does, moves it by
    1/(1 - h) of that: too much. The product of both has the mean σ² (HC2 of MacKinnon & White 1985).
    """
    little, all_of_it = ((x - whole) / part for x, part in zip(without, LEFT_OUT, strict=True))
    return np.asarray(np.sqrt(np.maximum(np.sum(little * all_of_it, axis=0), 0.0)))


def left_out(a: Array, residual: Array, labels: NDArray[Any], normal: Array) -> Array:
    """The covariance of a least-squares fit from what leaving out each piece of the data changes (the jackknife).

    a: (m, n), residual: (m,), weighted; labels: the piece of each row; normal: (n, n), with priors. A piece pulls the
    fit towards itself, so that the scatter of what is left over shows too little where pieces are few; the jackknife
    does not suffer from that (CR3 of Bell & McCaffrey 2002).
    """
    total = np.zeros_like(normal)
    pieces = np.unique(labels)
    for piece in pieces:
        rows = labels == piece
        part = a[rows]
        change = np.linalg.solve(normal - part.T @ part, part.T @ residual[rows])
        total += np.outer(change, change)
    return total * (len(pieces) - 1) / max(len(pieces), 1)


def smoothness(soc: Array, scale: Array, n: int, branches: int) -> Array:
    """The normal matrix of the priors: tables bend little from node to node, rest voltages stay near the OCV."""
    total = np.zeros((n * (branches + 1), n * (branches + 1)))
    left, right = np.diff(soc)[:-1], np.diff(soc)[1:]
    bend = bends(soc) / np.maximum(2 * left * right / (left + right) / 0.05, 0.3)[:, None]  # in steps of 0.05
    for j in range(branches):
        block = slice(j * n, (j + 1) * n)
        total[block, block] = bend.T @ bend / (BEND_SD * scale[j]) ** 2 + 1e-4 / scale[j] ** 2 * np.eye(n)
    block = slice(branches * n, (branches + 1) * n)
    sd = np.where(soc < 0.1, SHIFT_SD_EMPTY, SHIFT_SD)
    total[block, block] = np.diag(1 / sd**2) + bend.T @ (bend / (0.5 * np.minimum(sd[:-2], sd[1:-1])[:, None]) ** 2)
    return total


@dataclass(frozen=True)
class Pairs:
    """R0 [ohm], then resistance [ohm] and time constant [s] of each pair."""

    r0: float
    resistance: tuple[float, ...]
    time: tuple[float, ...]


class Reduction:
    """From many pairs to `count` pairs, under `loads`: currents from rest, one value a second.

    beside: (resistance [ohm], time constant [s]) of a further pair that is given; the `count` are what it lacks.
    """

    def __init__(self, loads: Sequence[Array], count: int = 1, beside: tuple[float, float] | None = None) -> None:
        def filtered_by(tau: float) -> Array:
            a = np.exp(-1.0 / tau)
            return np.concatenate([lfilter([1 - a], [1, -a], x) for x in loads])

        load = np.concatenate(list(loads))
        given = [beside] if beside else []
        self._beside = np.array([-resistance for resistance, _ in given])
        self._many = np.column_stack([load, *(filtered_by(tau) for tau in (*TIMES, *(time for _, time in given)))])
        fast = np.geomspace(3, 300, 50) if count == 1 else np.geomspace(1.5, 120, 26)
        slow = np.geomspace(150, 3000, 16)
        filtered = {float(tau): filtered_by(float(tau)) for tau in (*fast, *(slow if count == 2 else ()))}
        times = [(float(t),) for t in fast] if count == 1 else [(float(t), float(u)) for t in fast for u in slow]
        self._times = np.array(times)
        self._count = count
        gram = self._many.T @ self._many
        solved, left = [], []
        for row in times:
            g = np.column_stack([load, *(filtered[t] for t in row)])
            cross = g.T @ self._many
            m = np.linalg.solve(g.T @ g, cross)
            solved.append(m)
            left.append(gram - cross.T @ m)
        self._solved, self._left = np.array(solved), np.array(left)

    def __call__(self, resistance: Array) -> Pairs:
        """The pairs nearest to the many of `resistance` (1 + len(TIMES),) [ohm]."""
        resistance = np.concatenate([resistance, self._beside])
        return self._nearest(np.einsum("i,kij,j->k", resistance, self._left, resistance), self._solved @ resistance)

    def _nearest(self, cost: Array, best: Array) -> Pairs:
        """The pairs of the least `cost` (times,) among the `best` (times, 1 + count) of each of the times tried."""
        positive = np.all(best > 0, axis=1)
        if np.any(positive):
            cost = np.where(positive, cost, np.inf)
        else:  # there is nothing that pairs could follow
            best = np.maximum(best, LEAST)
        k = int(np.argmin(cost))
        solution, times = best[k], self._times[k]
        if self._count == 1 and 0 < k < len(cost) - 1 and np.all(np.isfinite(cost[k - 1 : k + 2])):
            down, here, up = cost[k - 1 : k + 2]
            move = 0.5 * (down - up) / max(down - 2 * here + up, 1e-30)
            j = k + (1 if move > 0 else -1)
            solution = best[k] + abs(move) * (best[j] - best[k])
            times = np.exp(np.log(times) + abs(move) * (np.log(self._times[j]) - np.log(times)))
        return Pairs(float(solution[0]), tuple(map(float, solution[1:])), tuple(map(float, times)))

    def spread(self, resistance: Array, covariance: Array) -> Array:
        """Covariance of a row of `logs`, from that of `resistance`: moved by one sd along the axes of its ellipsoid."""
        values, vectors = np.linalg.eigh(covariance)
        axes = (np.sqrt(np.maximum(values, 0.0)) * vectors)[:, values > 1e-9 * values[-1]]
        change = 0.5 * (self.logs(resistance[:, None] + axes) - self.logs(resistance[:, None] - axes))
        return np.asarray(change.T @ change)

    def logs(self, resistances: Array) -> Array:
        """(n, 1 + 2 count): ln of R0, R of each pair, τ of each pair, for `resistances` (1 + len(TIMES), n) [ohm]."""
        resistances = np.vstack([resistances, np.tile(self._beside[:, None], resistances.shape[1])])
        costs = np.einsum("kin,in->nk", self._left @ resistances, resistances)
        every = np.moveaxis(self._solved @ resistances, -1, 0)
        found = [self._nearest(cost, best) for cost, best in zip(costs, every, strict=True)]
        return np.log([[pairs.r0, *pairs.resistance, *pairs.time] for pairs in found])


def fit_direct(
    test: CellTest,
    level: Array,
    ocv: tuple[Array, Array],
    start: Branches,
    pairs: tuple[Array, Array, Array],
    activation: tuple[float, float] = (0.0, 0.0),
) -> tuple[Array, Array]:
    """The one pair whose voltage is nearest to that of `test`, from `pairs` (R0, R1, τ over the nodes of `start`).

    Gives R0, R1 [ohm], τ [s], (3, n), and the relative sd of these and of C1, (4, n).

    Gauss and Newton: the voltage is linear in R0, R1 and the shift of the rest voltage, and its slope over ln τ is
    that of the filtered current. The rest as for `fit_branches`.
    """
    soc, n = start.soc, len(start.soc)
    inverse = 1 / (test.temperature + KELVIN) - 1 / (start.temperature + KELVIN)
    hat = hats(soc, level)
    weight = 1 / (np.hypot(VOLTAGE_SD, SOC_SD * ocv[1]) * np.sqrt(CORRELATED))
    warm = np.exp(activation[1] * inverse)
    resistive = -(test.current * np.exp(activation[0] * inverse))[:, None] * hat
    p = np.concatenate([pairs[0], pairs[1], np.log(pairs[2]), start.shift])
    scale = np.array([np.median(pairs[0]), np.median(pairs[1]), TIME_BEND / BEND_SD])
    prior = smoothness(soc, scale, n, 3)
    for _ in range(TURNS):
        tau = np.exp(hat @ p[2 * n : 3 * n])
        x, slope = follow_slope(test.flowed, test.dt, tau)
        relaxing = -(x * warm)[:, None] * hat
        turning = -(slope * warm * (hat @ p[n : 2 * n]))[:, None] * hat
        a = np.hstack([resistive, relaxing, turning, hat]) * weight[:, None]
        model = resistive @ p[:n] + relaxing @ p[n : 2 * n] + hat @ p[3 * n :]
        b = (test.voltage - ocv[0] - model) * weight
        normal = a.T @ a + prior
        step = cho_solve(cho_factor(normal), a.T @ b - prior @ p)
        step[2 * n : 3 * n] = np.clip(step[2 * n : 3 * n], -0.5, 0.5)
        p = p + step
        p[: 2 * n] = np.maximum(p[: 2 * n], LEAST)
        p[2 * n : 3 * n] = np.clip(p[2 * n : 3 * n], np.log(TIMES[0]), np.log(TIMES[-1]))
    bread = cho_solve(cho_factor(normal), np.eye(len(normal)))
    covariance = left_out(a, b, test.block, normal) + bread @ prior @ bread
    of_logs = np.zeros((4 * n, 4 * n))  # ln R0, ln R1, ln τ, and ln τ less ln R1, from R0, R1, ln τ
    of_logs[: 3 * n, : 3 * n] = np.diag(1 / np.concatenate([p[: 2 * n], np.ones(n)]))
    of_logs[3 * n :] = of_logs[2 * n : 3 * n] - of_logs[n : 2 * n]
    sd = np.sqrt(np.diag(of_logs @ covariance @ of_logs.T)).reshape(4, n)
    return np.array([p[:n], p[n : 2 * n], np.exp(p[2 * n : 3 * n])]), sd
