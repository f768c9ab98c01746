"""Tables over state of charge and temperature from the pairs of each test, made smooth, and how good they are."""

from __future__ import annotations

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.calibration.cell_fit import Branches, Pieces, Reduction, fit_branches, fit_direct, jackknife
from gz_onboard.calibration.fit import score
from gz_onboard.calibration.pulse_test import Tested, ocv_and_slope
from gz_onboard.calibration.result import Result
from gz_onboard.offline.arrays import bends

LEVEL = 0.15  # relative: how far a time constant may change over 0.1 of SOC
POOLED = 0.1  # of SOC: how far the scatter of pulses is taken to be alike
SMOOTH = 0.08  # relative: how far ln of a table may bend over 0.1 of SOC, where the data say little


def meshes(fitted: list[Branches], reduction: Reduction) -> tuple[list[Array], list[Array]]:
    """(R0, R of each pair, τ of each pair), each (temperatures, soc), smooth; their relative sd, and last that of C1.

    The sd is that of the whole way from pulses to smooth tables, a part of each pulse left out in turn.
    """
    tables, sds = [], []
    for f in fitted:
        raw = reduction.logs(f.resistance)
        others = np.array([[reduction.logs(x[:-1]) for x in part] for part in f.without])
        weights = np.array(
            [np.sqrt(np.diag(reduction.spread(r, c))) for r, c in zip(f.resistance.T, f.covariance, strict=True)]
        )
        smooth = _with_c1(_smooth(f.soc, raw, weights))
        without = np.array([[_with_c1(_smooth(f.soc, x, weights)) for x in part] for part in others])
        without = without.reshape(len(others), -1, *smooth.shape)
        tables.append(np.exp(smooth))
        sds.append(_pooled(f.soc, jackknife(smooth, without), f.covered))
    return list(np.array(tables).transpose(2, 0, 1)[:-1]), list(np.array(sds).transpose(2, 0, 1))


def direct(
    tests: list[Tested],
    fitted: list[Branches],
    activation: list[tuple[float, float]],
    nodes: Array,
    volts: Array,
    start: list[Array],
) -> tuple[list[Array], list[Array]]:
    """As `meshes` for one pair, from the pulses themselves."""
    found = [
        fit_direct(t.test, t.level, ocv_and_slope(nodes, volts, t.level), f, (start[0][k], start[1][k], start[2][k]), a)
        for k, (t, f, a) in enumerate(zip(tests, fitted, activation, strict=True))
    ]
    tables, sds = (np.array(part).swapaxes(0, 1) for part in zip(*found, strict=True))
    return list(tables), list(sds)


def _pooled(soc: Array, sd: Array, covered: Mask) -> Array:
    """`sd` (n, parts) with what the covered neighbours' say: the few pulses at one node show a scatter badly."""
    near = np.exp(-0.5 * ((soc[:, None] - soc) / POOLED) ** 2) * covered
    near[~covered] = np.eye(len(soc))[~covered]
    return np.asarray(np.sqrt(near @ sd**2 / near.sum(axis=1)[:, None]))


def _with_c1(logs: Array) -> Array:
    """`logs` (n, 1 + 2 count) with ln C1 as a further column."""
    first = (logs.shape[1] + 1) // 2
    return np.column_stack([logs, logs[:, first] - logs[:, 1]])


def _smooth(soc: Array, logs: Array, sds: Array) -> Array:
    """Each column of `logs` (n, parts) made to bend little where its sd is large."""
    n = len(soc)
    result = np.empty_like(logs)
    for j in range(logs.shape[1]):
        weight = 1 / np.maximum(sds[:, j], 0.02)
        rows = [np.diag(weight), bends(soc) / (SMOOTH * np.maximum(soc[2:] - soc[:-2], 0.1) / 0.2)[:, None]]
        if j >= (logs.shape[1] + 1) // 2:  # time constants hardly depend on SOC, and are known worst
            slope = np.diff(np.eye(n), axis=0) / (LEVEL * np.maximum(np.diff(soc), 0.05) / 0.1)[:, None]
            rows.append(slope)
        matrix = np.vstack(rows)
        result[:, j] = np.linalg.solve(matrix.T @ matrix, weight**2 * logs[:, j])
    return result


def mesh_quality(
    result: Result,
    tests: list[Tested],
    fitted: list[Branches],
    split: list[Pieces],
    one: Reduction,
    tables: list[Array],
) -> None:
    """R² of the meshes: of the smooth one against each node's own, and of what half the pulse groups say of the other.

    A group is what lies between two long rests; every other one makes a mesh, which the rest's is compared with.
    """
    soc = fitted[0].soc
    halves, covered = [], np.tile((soc > 0.19) & (soc < 0.91), (len(tests), 1))
    for odd in (0, 1):
        part = []
        for t, x in zip(tests, split, strict=True):
            step = np.zeros(len(t.test), dtype=int)
            step[t.rests] = 1
            group = np.cumsum(step) - step
            part.append(fit_branches(x, group[np.searchsorted(t.test.block, x.label)] % 2 == odd))
        covered &= np.array([f.covered for f in part])
        halves.append(meshes(part, one)[0])
    if not covered.any():
        result.refusals.append("meshes: the pulses are too few to compare half of them with the other half")
        return
    single = list(np.exp([one.logs(f.resistance) for f in fitted]).transpose(2, 0, 1))
    names = ", ".join(t.test.name for t in tests)
    for name, unit, number in (("R0", "ohm", 0), ("R1", "ohm", 1), ("C1", "F", 2)):
        every = [x[number] / x[1] if number == 2 else x[number] for x in (tables, single, *halves)]
        mesh, own, even, other = (x[covered] for x in every)
        for what, a, b, held_out in (("node by node", own, mesh, False), ("half against half", even, other, True)):
            result.fits.append(
                score(f"mesh of {name}, SOC 0.2 to 0.9, {what}", unit, a, b, held_out=held_out, source=names)
            )
