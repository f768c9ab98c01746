"""Charge transfer of a cell out of its pulse tests: resistance that falls with the current, more so in the cold.

Of the circuit only the effect `charge_transfer` is not linear in what is to be found. So its three numbers are searched
for, and at each trial all tables are solved for at once (variable projection: Golub & Pereyra 1973).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.sparse import csr_matrix, diags, hstack
from scipy.stats import f as f_distribution

from gz_onboard.arrays import Array
from gz_onboard.calibration.cell_circuit import FOUND, NO_REACTION, Reaction, hats
from gz_onboard.calibration.cell_fit import (
    CORRELATED,
    LEAST,
    TIMES,
    filtered,
    fit_branches,
    smoothness,
    weighted_columns,
)
from gz_onboard.calibration.pulse_test import Tested, moved_pieces, ocv_and_slope
from gz_onboard.calibration.result import Result

START_SHARE = 0.3  # of R0 in the warmest test: where the search begins
STEPS = np.array([0.05, 200.0, 0.05])  # of ln resistance, activation [K] and ln time: for the curvature
TIME_SD = 1.5  # of ln time, before the pulses
MOST_TRIALS = 150
CHANCE = 1e-3  # that tests without charge transfer show as much
SURE = 3.0  # sd that R_ct is above zero


@dataclass(frozen=True)
class _Problem:
    """A test as least squares: what is linear, factored, and the samples that an overpotential is added to."""

    test: Tested
    columns: csr_matrix  # (m, p), weighted
    weight: Array
    target: Array
    normal: tuple[Array, bool]

    def cost(self, reaction: Reaction) -> float:
        """Sum of squares that the best tables leave, with the priors' share."""
        test = self.test.test
        target = self.target + self.weight * reaction.overpotential(test.flowed, test.dt, test.temperature)
        right = self.columns.T @ target
        return float(target @ target - right @ cho_solve(self.normal, right))


def charge_transfer(tests: Sequence[Tested], nodes: Array, volts: Array, soc: Array, result: Result) -> Reaction:
    """What pulses of several currents show of it; none, with a note, if they do not."""
    split, _ = moved_pieces(list(tests), nodes, volts, soc)
    first = [fit_branches(x).resistance for x in split]
    problems = [_problem(t, nodes, volts, soc, r) for t, r in zip(tests, first, strict=True)]
    known = FOUND

    def reaction(x: Array) -> Reaction:
        values = (float(np.exp(x[0])), float(x[1]), float(np.exp(x[2])))
        inside = [min(max(v, p.low), p.high) for v, p in zip(values, known, strict=True)]
        return Reaction(inside[0], inside[1], inside[2])

    def cost(x: Array) -> float:
        doubt = (x[1] - known[1].prior) / known[1].prior_sd, (x[2] - np.log(known[2].prior)) / TIME_SD
        return sum(p.cost(reaction(x)) for p in problems) + float(np.sum(np.square(doubt)))

    start = np.array(
        [np.log(START_SHARE * max(np.median(first[-1][0]), LEAST)), known[1].prior, np.log(known[2].prior)]
    )
    simplex = start + np.vstack([np.zeros(3), np.diag(10 * STEPS)])
    options = {"initial_simplex": simplex, "xatol": 0.01, "fatol": 0.1, "maxfev": MOST_TRIALS}
    found = minimize(cost, start, method="Nelder-Mead", options=options)
    free = sum(len(t.test) for t in tests) / CORRELATED
    left, none = float(found.fun), sum(p.cost(NO_REACTION) for p in problems)
    values, vectors = np.linalg.eigh(_curvature(cost, found.x))
    spread = 2 * max(left / free, 1.0) / np.maximum(values, np.finfo(float).tiny)  # endless where nothing bends it
    sd = np.sqrt(vectors**2 @ spread)
    chance = float(f_distribution.sf((none - left) / 3 / (left / free), 3, free))
    best = reaction(found.x)
    if chance > CHANCE or not 0 < sd[0] < 1 / SURE:
        result.notes.append(
            "no resistance that falls with current is seen: the pulses need several currents to show it"
        )
        return NO_REACTION
    result.notes.append(
        f"resistance falls with current: {1e3 * best.resistance:.3g} mΩ of charge transfer at 25 degC and no current, "
        f"activation {best.activation:.0f} K, settling in {best.time:.2g} s; without "
        f"it what is left is {np.sqrt(none / left):.2f} times as large"
    )
    return replace(best, sd=(best.resistance * float(sd[0]), float(sd[1]), best.time * float(sd[2])))


def linear(tested: Tested, reaction: Reaction) -> Tested:
    """The test as a cell without `reaction` would show it."""
    test = tested.test
    more = reaction.overpotential(test.flowed, test.dt, test.temperature)
    return replace(tested, test=replace(test, voltage=test.voltage + more))


def _problem(tested: Tested, nodes: Array, volts: Array, soc: Array, resistance: Array) -> _Problem:
    """`resistance` (1 + len(TIMES), n) [ohm], as fitted without charge transfer: the size that the priors refer to."""
    test = tested.test
    ocv = ocv_and_slope(nodes, volts, tested.level)
    columns, weight = weighted_columns(test, ocv, filtered(test))
    hat = csr_matrix(hats(soc, tested.level))
    matrix = csr_matrix(hstack([diags(column) @ hat for column in columns.T]))
    scale = np.maximum(np.median(resistance, axis=1), 2e-3)
    normal = (matrix.T @ matrix).toarray() + smoothness(soc, scale, len(soc), 1 + len(TIMES))
    return _Problem(tested, matrix, weight, (test.voltage - ocv[0]) * weight, cho_factor(normal))


def _curvature(cost: Callable[[Array], float], x: Array) -> Array:
    """The second derivatives (3, 3) of `cost` at `x`, by differences of `STEPS`."""
    result = np.empty((3, 3))
    for i, a in enumerate(np.diag(STEPS)):
        for j, b in enumerate(np.diag(STEPS)):
            corners = cost(x + a + b) - cost(x + a - b) - cost(x - a + b) + cost(x - a - b)
            result[i, j] = corners / (4 * STEPS[i] * STEPS[j])
    return result
