"""Six RC pairs of fixed time constants fitted to a pulse test, and their reduction to one pair or two.

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

from gz_onboard.lab.calibrate.cell_circuit import KELVIN, follow, follow_slope, hats
from gz_onboard.lab.calibrate.cell_data import CellTest
from gz_onboard.lab.calibrate.result import Array

TIMES = (1.0, 4.0, 15.0, 60.0, 240.0, 1500.0)  # s
VOLTAGE_SD = 0.004  # V: what the model leaves, independent every CORRELATED samples
SOC_SD = 0.003  # how far the state of charge may be off, which matters where the OCV is steep
CORRELATED = 20
BEND_SD = 0.3  # relative: how far a table may bend from node to node, per 0.05 of SOC
LEAST = 1e-6  # ohm
TIME_BEND = 0.5  # of ln τ, as BEND_SD
TURNS = 8  # of Gauss and Newton
SHIFT_SD, SHIFT_SD_EMPTY = 0.01, 0.05  # V: rest voltage of this test against the OCV; below 10 % SOC


@dataclass(frozen=True)
class Branches:
    """Six pairs at one temperature.

    resistance: (1 + len(TIMES), n) [ohm], R0 first; shift: (n,) [V] of the rest voltage against the OCV. covariance: of
    both, flattened in this order, from the scatter between pulses; it weighs nodes against each other. jackknife: the
    same from leaving out each pulse, which is what few pulses for many numbers tell honestly (`left_out`). covered:
    (n,), False at nodes without a pulse near. residual: (m,) [V], measured less model.
    """

    soc: Array
    temperature: float
    resistance: Array
    shift: Array
    covariance: Array
    jackknife: Array
    covered: NDArray[np.bool_]
    residual: Array

    def at_node(self, covariance: Array, k: int) -> Array:
        """Of a covariance its (1 + len(TIMES),)² at node k."""
        n = len(self.soc)
        i = np.arange(len(self.resistance)) * n + k
        return np.asarray(covariance[np.ix_(i, i)])


def fit_branches(
    test: CellTest,
    level: Array,
    ocv: tuple[Array, Array],
    soc: Array,
    temperature: float,
    activation: tuple[float, float] = (0.0, 0.0),
    keep: NDArray[np.bool_] | None = None,
) -> Branches:
    """The six pairs of `test`, whose state of charge is `level` (m,), over nodes `soc` (n,) at `temperature` [degC].

    ocv: (voltage (m,) [V], slope (m,) [V]) at `level`. activation: of R0 and of the pairs [K]: R goes as
    exp(activation/T), which moves samples at other temperatures than the nominal one. keep: True for samples to use.
    """
    rows = np.ones(len(test), dtype=bool) if keep is None else keep
    inverse = 1 / (test.temperature + KELVIN) - 1 / (temperature + KELVIN)
    hat = hats(soc, level)
    columns = [-(test.current * np.exp(activation[0] * inverse))[:, None] * hat]
    warm = np.exp(activation[1] * inverse)
    columns += [-(follow(test.flowed, test.dt, tau) * warm)[:, None] * hat for tau in TIMES]
    weight = 1 / (np.hypot(VOLTAGE_SD, SOC_SD * ocv[1]) * np.sqrt(CORRELATED))
    matrix = np.hstack([*columns, hat])
    target = test.voltage - ocv[0]
    a, b = (matrix * weight[:, None])[rows], (target * weight)[rows]
    n, branches = len(soc), len(columns)
    data = a.T @ a
    scale = np.full(branches, 0.02)  # ohm
    floor = np.concatenate([np.zeros(n * branches), np.ones(n)])
    for _ in range(2):  # how far a table may bend is relative to its size, which the first turn tells
        normal = data + _smoothness(soc, scale, n, branches)
        upper = cholesky(normal, lower=False)
        right = solve_triangular(upper, a.T @ b, trans="T")
        # Resistances are not negative; shifts may be, so they are counted from -1 V.
        p = nnls(upper, right + upper @ floor)[0] - floor
        scale = np.maximum(np.median(p[: n * branches].reshape(branches, n), axis=1), 2e-3)
    residual = target - matrix @ p
    weighted = b - a @ p
    labels = test.block[rows]
    scores = np.array([a[labels == k].T @ weighted[labels == k] for k in np.unique(labels)])
    bread = cho_solve(cho_factor(normal), np.eye(len(normal)))
    covariance = bread @ (scores.T @ scores + normal - data) @ bread
    jackknife = left_out(a, weighted, labels, normal) + bread @ (normal - data) @ bread
    used = rows & ~test.rest
    covered = hat[used].sum(axis=0) > 3
    return Branches(soc, temperature, p[: n * branches].reshape(branches, n), p[n * branches :], covariance, jackknife,
                    covered, residual)  # fmt: skip


def left_out(a: Array, residual: Array, labels: NDArray[Any], normal: Array) -> Array:
    """The covariance of a least-squares fit from what leaving out each piece of the data changes (the jackknife).

    a: (m, n), residual: (m,), weighted; labels: the piece of each row; normal: (n, n), with priors. A piece pulls the
    fit towards itself, so that the scatter of what is left over tells too little where pieces are few; the jackknife
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


def _smoothness(soc: Array, scale: Array, n: int, branches: int) -> Array:
    """The normal matrix of the priors: tables bend little from node to node, rest voltages stay near the OCV."""
    total = np.zeros((n * (branches + 1), n * (branches + 1)))
    bend = np.zeros((n - 2, n))
    for k in range(n - 2):
        left, right = soc[k + 1] - soc[k], soc[k + 2] - soc[k + 1]
        # As far as a straight line through the neighbours misses the middle one, in steps of 0.05.
        w = right / (left + right)
        bend[k, k : k + 3] = np.array([w, -1.0, 1 - w]) / max(2 * left * right / (left + right) / 0.05, 0.3)
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
    rms: float  # V per A RMS of the load: what the pairs leave of six


class Reduction:
    """From six pairs to `count` pairs, under `loads`: currents from rest, one value for each `step` [s]."""

    def __init__(self, loads: Sequence[Array], step: float = 1.0, count: int = 1) -> None:
        def filtered_by(tau: float) -> Array:
            return np.concatenate([follow(x, np.full(len(x), step), tau) for x in loads])

        load = np.concatenate(list(loads))
        self._six = np.column_stack([load, *(filtered_by(tau) for tau in TIMES)])
        self._square = float(np.mean(load**2))
        fast = np.geomspace(3, 300, 50) if count == 1 else np.geomspace(1.5, 120, 26)
        slow = np.geomspace(150, 3000, 16)
        filtered = {float(tau): filtered_by(float(tau)) for tau in (*fast, *(slow if count == 2 else ()))}
        times = [(float(t),) for t in fast] if count == 1 else [(float(t), float(u)) for t in fast for u in slow]
        self._times = np.array(times)
        self._count = count
        gram = self._six.T @ self._six
        solved, left = [], []
        for row in times:
            g = np.column_stack([load, *(filtered[t] for t in row)])
            cross = g.T @ self._six
            m = np.linalg.solve(g.T @ g, cross)
            solved.append(m)
            left.append(gram - cross.T @ m)
        self._solved, self._left = np.array(solved), np.array(left)

    def __call__(self, resistance: Array) -> Pairs:
        """The pairs nearest to the six of `resistance` (1 + len(TIMES),) [ohm]."""
        cost = np.einsum("i,kij,j->k", resistance, self._left, resistance)
        best = self._solved @ resistance
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
        rms = float(np.sqrt(max(cost[k], 0.0) / len(self._six) / self._square)) if np.isfinite(cost[k]) else np.nan
        return Pairs(float(solution[0]), tuple(map(float, solution[1:])), tuple(map(float, times)), rms)

    def spread(self, resistance: Array, covariance: Array) -> Array:
        """Covariance of ln(R0, R of each pair, τ of each pair), by differences from that of the six."""
        sd = np.sqrt(np.maximum(np.diag(covariance), 0))
        base = _logs(self(resistance))
        slopes = np.zeros((len(base), len(sd)))
        for k, s in enumerate(sd):
            if s > 0:
                step = 0.3 * s
                moved = resistance.copy()
                moved[k] += step
                slopes[:, k] = (_logs(self(moved)) - base) / step
        return np.asarray(slopes @ covariance @ slopes.T)


def _logs(pairs: Pairs) -> Array:
    return np.log([pairs.r0, *pairs.resistance, *pairs.time])


@dataclass(frozen=True)
class Direct:
    """One pair at one temperature: R0, R1 [ohm], τ [s], each (n,), and the sd of their logarithms, (3, n)."""

    r0: Array
    r1: Array
    time: Array
    sd: Array


def fit_direct(
    test: CellTest,
    level: Array,
    ocv: tuple[Array, Array],
    start: Branches,
    pairs: tuple[Array, Array, Array],
    activation: tuple[float, float] = (0.0, 0.0),
) -> Direct:
    """The one pair whose voltage is nearest to that of `test`, from `pairs` (R0, R1, τ over the nodes of `start`).

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
    prior = _smoothness(soc, scale, n, 3)
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
    bread = cho_solve(cho_factor(normal), np.eye(len(normal)))
    sd = np.sqrt(np.diag(left_out(a, b, test.block, normal) + bread @ prior @ bread)).reshape(4, n)
    return Direct(p[:n], p[n : 2 * n], np.exp(p[2 * n : 3 * n]), sd[:3] / np.array([p[:n], p[n : 2 * n], np.ones(n)]))
