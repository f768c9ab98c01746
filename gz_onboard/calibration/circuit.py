"""A cell's equivalent circuit over arrays, and many RC pairs fitted to pulse tests and reduced to one or two.

    V = V_oc(SOC) + shift(T) - R0·I - η - Σ R_k·x_k,    dx_k/dt = (I - x_k)/τ_k

V_k = R_k·x_k (Lord 2016, eqs. 2.22 and 2.23); the shift is zero unless rests show one, and so is η (the effect
`charge_transfer`) unless pulses of several currents do. I is the cell's current [A], positive when discharging.

With the time constants and η given, V is linear in every table: the fit has one minimum and needs no start. The pairs
span a test, from charge transfer in a second to diffusion in half an hour (a discrete distribution of relaxation
times: Schmidt et al. 2013). One pair cannot follow all of that; which part it should depends on the load, so it is the
one whose voltage is nearest under a given current, node by node.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import nnls
from scipy.signal import lfilter

from gz_onboard.arrays import Array, bends
from gz_onboard.calibration.cell import CellTest
from gz_onboard.constants import KELVIN
from gz_onboard.model.effects import charge_transfer
from gz_onboard.model.series import bilinear_over, extended_over, relaxation, terminal_voltage

# The number of reactions stays as declared: pulses alone would take more, and held-out road profiles then err more.
*FOUND, REACTIONS = charge_transfer.PARAMETERS

# s. A pair between two of them is made of both, and one pair made of these is off by the square of their distance: C1
# of a pair of 30 s by -10 % for a factor of 4 from each to the next, -1 % for the 1.75 of these.
TIMES = np.geomspace(1.0, 1500.0, 14)


@dataclass(frozen=True)
class PairFitConfig:
    """How far pulses, tables and open-circuit voltage are believed."""

    voltage_sd: float = 0.004  # V: what the model leaves, independent every `correlated` samples
    soc_sd: float = 0.003  # how far the state of charge may be off, which matters where the OCV is steep
    correlated: int = 20
    bend_sd: float = 0.3  # relative: how far a table may bend from node to node, per 0.05 of SOC
    shift_sd: float = 0.01  # V: rest voltage of this test against the OCV
    shift_sd_empty: float = 0.05  # V: the same below 10 % SOC
    min_resistance: float = 2e-5  # ohm: of a pair that the data do not show; with the longest time its C1 fits a file
    left_out: tuple[float, float] = (0.1, 1.0)  # of a piece's weight, to see how much hangs on it: see `jackknife`


PAIR_FIT = PairFitConfig()


@dataclass(frozen=True)
class Reaction:
    """The parameters of the effect `charge_transfer`: resistance [ohm], activation [K] and time [s]."""

    resistance: float = 0.0
    activation: float = 0.0
    time: float = 1.0

    def overpotential(self, flowed: Array, dt: Array, temperature: Array) -> Array:
        """Overpotential (m,) [V] of a cell that has rested.

        flowed: the mean current [A] over the `dt` [s] before each sample, temperature [degC]; all (m,).
        """
        settled = charge_transfer.term(
            flowed,
            temperature,
            charge_transfer_resistance=self.resistance,
            charge_transfer_activation=self.activation,
            charge_transfer_reactions=REACTIONS.prior,
        )
        return follow(settled, dt, self.time)


NO_REACTION = Reaction()


@dataclass(frozen=True)
class Circuit:
    """Tables of one cell, and the effects that it shows.

    ocv: (n,) [V] over ocv_soc. r0, r1 [ohm], c1 [F]: (temperatures, soc). capacity: (temperatures,) [A·h]. slow:
    resistance [ohm] and time [s] of the effect `slow_relaxation`. rest_shift: (temperatures,) [V], rest voltage above
    `ocv`.
    """

    ocv_soc: Array
    ocv: Array
    soc: Array
    temperature: Array
    capacity: Array
    r0: Array
    r1: Array
    c1: Array
    slow: tuple[float, float] | None = None
    rest_shift: Array | None = None
    reaction: Reaction = NO_REACTION

    def ocv_shift(self, temperature: Array) -> Array:
        """Open-circuit voltage less `ocv` (m,) [V] at `temperature` (m,) [degC]."""
        if self.rest_shift is None:
            return np.zeros(np.shape(temperature))
        return np.asarray(np.interp(temperature, self.temperature, self.rest_shift))


def hats(nodes: Array, x: Array) -> Array:
    """(len(x), len(nodes)): the weights of linear interpolation between `nodes`, constant beyond them."""
    x = np.clip(x, nodes[0], nodes[-1])
    i = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
    w = (x - nodes[i]) / (nodes[i + 1] - nodes[i])
    result = np.zeros((len(x), len(nodes)))
    rows = np.arange(len(x))
    result[rows, i], result[rows, i + 1] = 1 - w, w
    return result


def follow(target: Array, dt: Array, tau: float | Array) -> Array:
    """x (m,) that follows `target` (m,), which holds for the `dt` (m,) [s] before each sample, with `tau` [s].

    A target of R·I gives the voltage of an RC pair, exact for a current constant over each step (eq. 2.22).
    """
    return relaxation(target, np.exp(-dt / tau * np.ones(len(target))))


def voltage(cell: Circuit, flowed: Array, current: Array, dt: Array, soc: Array, temperature: Array) -> Array:
    """The cell's voltage (m,) [V] as the on-board model steps it.

    flowed: the mean current over the `dt` before each sample; current: at the sample. The cell has rested: all
    RC pairs start at zero.
    """
    tables, over = (cell.r0, cell.r1, cell.c1), (cell.soc, cell.temperature)
    r0, r1, c1 = (bilinear_over(*over, t, soc, temperature, geometric=True) for t in tables)
    pairs = follow(r1 * flowed, dt, r1 * c1)
    if cell.slow is not None:
        resistance, time = cell.slow
        pairs = pairs + follow(resistance * flowed, dt, time)
    pairs = pairs + cell.reaction.overpotential(flowed, dt, temperature)
    rest = extended_over(cell.ocv_soc, cell.ocv, soc) + cell.ocv_shift(temperature)
    return np.asarray(terminal_voltage(rest, r0, current, pairs))


def follow_profile(cell: Circuit, test: CellTest) -> tuple[Array, Array]:
    """(model, measured) voltage (m,) [V]: from the SOC of the first voltage, at rest, on by the current alone."""
    capacity = np.interp(test.temperature, cell.temperature, cell.capacity)
    order = np.argsort(cell.ocv)
    rest = test.voltage[0] - cell.ocv_shift(test.temperature[:1])[0]
    start = float(np.interp(rest, cell.ocv[order], cell.ocv_soc[order]))
    level = start - np.cumsum(np.diff(test.drawn, prepend=0.0) / capacity)
    return voltage(cell, test.flowed, test.current, test.dt, level, test.temperature), test.voltage


def riding_current(duration: int = 1200, seed: int = 1) -> Array:
    """A current (duration,) [any unit, each for 1 s] such as a scooter in town draws, after a minute's rest.

    Pulling away, cruising, braking with recuperation, waiting, with shares of time and of current as in
    urban riding (mean over RMS about 0.6). Only its shape counts: the reduction over it is linear.
    """
    rng = np.random.default_rng(seed)
    parts = [np.zeros(60)]
    while sum(map(len, parts)) < duration:
        parts.append(np.full(rng.integers(5, 13), rng.uniform(3.0, 5.0)))
        for _ in range(rng.integers(1, 5)):
            parts.append(np.full(rng.integers(5, 25), rng.uniform(0.4, 2.2)))
        parts.append(np.full(rng.integers(3, 8), rng.uniform(-0.9, -0.2)))
        parts.append(np.full(rng.integers(2, 30), 0.0))
    return np.concatenate(parts)[:duration]


# --- many pairs ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pieces:
    """A pulse test as normal equations, one piece for each pulse with the rest after it.

    Of R0, the pairs and the shift of the rest voltage, each over the nodes `soc` (n,), flattened in this order to p
    numbers. label: (pieces,) of `CellTest.block`; gram: (pieces, p, p), right: (pieces, p), weighted; samples:
    (pieces, n), how many with a current are near each node.
    """

    soc: Array
    label: NDArray[np.int_]
    gram: Array
    right: Array
    samples: Array


@dataclass(frozen=True)
class Branches:
    """The pairs at one temperature.

    resistance: (1 + len(TIMES), n) [ohm], R0 first; shift: (n,) [V] of the rest voltage against the OCV.
    covariance: (n,) of those of the resistances at a node, from the scatter of the pieces' residuals, as if a
    resistance could be negative; it weighs nodes against each other. without: (2, pieces, 2 + len(TIMES), n), both with
    `left_out` of each piece left out, if that was asked for. shift_prior: (n,) [V], the sd of the shift that the
    priors' own doubt leaves. covered: (n,), False at nodes without a pulse near.
    """

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
    gram, right = np.zeros((len(labels), size, size)), np.zeros((len(labels), size))
    samples = np.zeros((len(labels), n))
    for k, (start, end) in enumerate(zip(first, [*first[1:], len(test)], strict=True)):
        rows = slice(start, end)
        near = np.flatnonzero(hat[rows].any(axis=0))  # a pulse touches few nodes
        a = (columns[rows, :, None] * hat[rows, None, near]).reshape(end - start, -1)
        places = (np.arange(columns.shape[1])[:, None] * n + near).ravel()
        gram[k][np.ix_(places, places)] = a.T @ a
        right[k, places] = a.T @ target[rows]
        samples[k] = hat[rows][~test.rest[rows]].sum(axis=0)
    return Pieces(soc, labels, gram, right, samples)


def weighted_columns(
    test: CellTest, ocv: tuple[Array, Array], relaxing: Array, warm: tuple[Array, Array] | None = None
) -> tuple[Array, Array]:
    """(derivatives of the voltage by R0, each pair and the shift, (m, 2 + len(TIMES)); weights (m,)).

    ocv, relaxing: see `pieces`. warm: factors (m,) on R0 and on the pairs.
    """
    c = PAIR_FIT
    weight = 1 / (np.hypot(c.voltage_sd, c.soc_sd * ocv[1]) * np.sqrt(c.correlated))
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
        prior = smoothness(of.soc, scale)
        p = _positive(gram + prior, right, n)
        scale = np.maximum(np.median(p[:-n].reshape(branches, n), axis=1), 2e-3)
    without = [
        [_positive(gram + prior - part * of.gram[k], right - part * of.right[k], n) for k in np.flatnonzero(used)]
        for part in PAIR_FIT.left_out
        if leave_out
    ]
    bread = np.linalg.inv(gram + prior)
    scores = of.right[used] - of.gram[used] @ p
    covariance = (bread @ (scores.T @ scores + prior) @ bread).reshape(branches + 1, n, branches + 1, n)
    return Branches(
        p[:-n].reshape(branches, n),
        p[-n:],
        np.array([covariance[:-1, k, :-1, k] for k in range(n)]),
        np.reshape(without, (2, -1, branches + 1, n)),
        np.sqrt(np.diag(bread @ prior @ bread)[-n:]),
        of.samples[used].sum(axis=0) > 3,
    )


def _positive(normal: Array, right: Array, n: int) -> Array:
    """The solution of normal equations whose first numbers are not negative; the last `n`, shifts, may be, to -1 V."""
    upper = cholesky(normal, lower=False)
    floor = np.concatenate([np.zeros(len(right) - n), np.ones(n)])
    return np.asarray(nnls(upper, solve_triangular(upper, right, trans="T") + upper @ floor)[0] - floor)


def jackknife(whole: Array, without: Array) -> Array:
    """The sd of `whole` (...) from its values with `left_out` of each piece of the data left out, (2, pieces, ...).

    A piece pulls the fit towards itself, by its leverage h. Leaving out a little of it moves the fit by the residual
    of the piece, whose variance is (1 - h)·σ²: too little. Leaving it out whole, as the jackknife does, moves it by
    1/(1 - h) of that: too much. The product of both has the mean σ² (HC2 of MacKinnon & White 1985).
    """
    little, all_of_it = ((x - whole) / part for x, part in zip(without, PAIR_FIT.left_out, strict=True))
    return np.asarray(np.sqrt(np.maximum(np.sum(little * all_of_it, axis=0), 0.0)))


def smoothness(soc: Array, scale: Array) -> Array:
    """The normal matrix of the priors: tables bend little from node to node, rest voltages stay near the OCV.

    scale: (tables,) [ohm], size of each table.
    """
    c, n, tables = PAIR_FIT, len(soc), len(scale)
    total = np.zeros((n * (tables + 1), n * (tables + 1)))
    left, right = np.diff(soc)[:-1], np.diff(soc)[1:]
    bend = bends(soc) / np.maximum(2 * left * right / (left + right) / 0.05, 0.3)[:, None]  # in steps of 0.05
    for j in range(tables):
        block = slice(j * n, (j + 1) * n)
        total[block, block] = bend.T @ bend / (c.bend_sd * scale[j]) ** 2 + 1e-4 / scale[j] ** 2 * np.eye(n)
    block = slice(tables * n, (tables + 1) * n)
    sd = np.where(soc < 0.1, c.shift_sd_empty, c.shift_sd)
    total[block, block] = np.diag(1 / sd**2) + bend.T @ (bend / (0.5 * np.minimum(sd[:-2], sd[1:-1])[:, None]) ** 2)
    return total


class Reduction:
    """From many RC pairs to the one that is nearest under `loads`: currents from rest, one value a second.

    slow: (resistance [ohm], time constant [s]) of a further pair, which the one found leaves out.
    """

    def __init__(self, loads: Sequence[Array], slow: tuple[float, float] | None = None) -> None:
        def relaxing(tau: float) -> Array:
            a = np.exp(-1.0 / tau)
            return np.concatenate([lfilter([1 - a], [1, -a], x) for x in loads])

        load = np.concatenate(list(loads))
        self._slow = [-slow[0]] if slow else []
        many = np.column_stack([load, *map(relaxing, TIMES), *([relaxing(slow[1])] if slow else [])])
        gram = many.T @ many
        self._times = np.geomspace(3, 300, 50)
        solved, residual_gram = [], []
        for tau in self._times.tolist():
            one = np.column_stack([load, relaxing(tau)])
            cross = one.T @ many
            best = np.linalg.solve(one.T @ one, cross)
            solved.append(best)
            residual_gram.append(gram - cross.T @ best)
        self._solved, self._residual_gram = np.array(solved), np.array(residual_gram)

    def logs(self, resistances: Array) -> Array:
        """(n, 3): ln of R0, R1 and τ1, for `resistances` (1 + len(TIMES), n) [ohm]."""
        resistances = np.vstack([resistances, np.tile(np.reshape(self._slow, (-1, 1)), resistances.shape[1])])
        costs = np.einsum("kin,in->nk", self._residual_gram @ resistances, resistances)
        solutions = np.moveaxis(self._solved @ resistances, -1, 0)
        return np.array([self._nearest(*row) for row in zip(costs, solutions, strict=True)])

    def _nearest(self, cost: Array, solution: Array) -> Array:
        """The row of `logs` at the least `cost` (times,) of the `solution` (times, 2) for each time constant."""
        positive = np.all(solution > 0, axis=1)
        if np.any(positive):
            cost = np.where(positive, cost, np.inf)
        else:  # there is nothing that a pair could follow
            solution = np.maximum(solution, PAIR_FIT.min_resistance)
        k = int(np.argmin(cost))
        found, time = solution[k], np.log(self._times[k])
        if 0 < k < len(cost) - 1 and np.all(np.isfinite(cost[k - 1 : k + 2])):  # between the times, by a parabola
            down, here, up = cost[k - 1 : k + 2]
            move = 0.5 * (down - up) / max(down - 2 * here + up, 1e-30)
            j = k + (1 if move > 0 else -1)
            found = found + abs(move) * (solution[j] - found)
            time = time + abs(move) * (np.log(self._times[j]) - time)
        return np.append(np.log(found), time)

    def spread(self, resistance: Array, covariance: Array) -> Array:
        """Covariance of a row of `logs`, from that of `resistance`: moved by one sd along the axes of its ellipsoid."""
        values, vectors = np.linalg.eigh(covariance)
        axes = (np.sqrt(np.maximum(values, 0.0)) * vectors)[:, values > 1e-9 * values[-1]]
        change = 0.5 * (self.logs(resistance[:, None] + axes) - self.logs(resistance[:, None] - axes))
        return np.asarray(change.T @ change)
