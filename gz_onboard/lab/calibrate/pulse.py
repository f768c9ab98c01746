"""R0, R1 and C1 over state of charge and temperature from pulse tests of one cell (Lord 2016, sec. 2.2).

One table per temperature. Each test begins at full and rests before its pulses; what it rests at tells how much charge
there is between full and empty at its temperature. Many RC pairs of fixed time constants are fitted, linear in every
table; then the one pair (and beside it the two) that is nearest to them under a load like riding (see `cell_fit`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from gz_onboard.arrays import Array
from gz_onboard.errors import InputError, nearest
from gz_onboard.lab.calibrate.cell_circuit import KELVIN, Circuit, riding_current, voltage
from gz_onboard.lab.calibrate.cell_data import CellTest, cell_test
from gz_onboard.lab.calibrate.cell_fit import (
    TIMES,
    Branches,
    Pieces,
    Reduction,
    filtered,
    fit_branches,
    fit_direct,
    jackknife,
    pieces,
)
from gz_onboard.lab.calibrate.fit import score
from gz_onboard.lab.calibrate.ocv import TESTER
from gz_onboard.lab.calibrate.result import Curve, Fit, Found, Panel, Result, Trace
from gz_onboard.lab.calibrate.table import Table
from gz_onboard.physics.tables import extended_over

SOC = np.array([0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
FEWEST_PULSES = 6
FEWEST_LEVELS = 3
REST = 1200.0  # s without current, after which a voltage is that of rest
FULL_WITHIN = 0.03  # V: a first voltage so near to the full cell's is that of a full cell
LEVEL = 0.15  # relative: how far a time constant may change over 0.1 of SOC
SURE = 0.99  # how surely the rests must tell that temperature moves them, before the vehicle file says so
POOLED = 0.1  # of SOC: how far the scatter of pulses is taken to be alike
SMOOTH = 0.08  # relative: how far ln of a table may bend over 0.1 of SOC, where the data say little


@dataclass(frozen=True)
class Tested:
    """A pulse test with its state of charge."""

    test: CellTest
    temperature: float  # degC, nominal
    capacity: float  # A·h between full and empty
    capacity_sd: float
    level: Array
    rests: Array  # rows at the ends of rests
    offset: float  # V: how far the rests lie above the OCV, in the mean


def calibrate(
    tables: Sequence[Table],
    ocv: Curve,
    capacity: Found,
    *,
    loads: Sequence[Array] | None = None,
    method: str = "reduced",
    soc: Array = SOC,
) -> Result:
    """``battery.r0``, ``r1``, ``c1``, ``capacity``, ``ocv``, and beside them a slow pair.

    Also ``battery.rest_shift``, if the rests tell that temperature moves the open-circuit voltage (`_shift_of_rests`).

    tables: one for each temperature. ocv, capacity: from `ocv.calibrate`. loads: currents [any unit, one value a
    second, each from rest] that the pair is to follow; synthetic rides if None. Raises InputError for tables that are
    no pulse tests (see `cell_data.cell_test`), too few pulses, too narrow a range, or two tests at one temperature.
    method: ``reduced``, the pair that follows a load best; or ``direct``, the pair that is nearest to the pulses
    themselves, which gives back the numbers of a cell that has but one pair, and follows a ride worse.
    """
    if method not in ("reduced", "direct"):
        raise InputError(f"method {method!r} is not known{nearest(method, ('reduced', 'direct'))}: reduced or direct")
    if not tables:
        raise InputError("no pulse test is given")
    result = Result("pulse")
    nodes, volts = ocv.axes["soc"], ocv.value
    tested = sorted((_tested(t, nodes, volts, capacity, result) for t in tables), key=lambda t: t.temperature)
    for cold, warm in pairwise(tested):
        if warm.temperature - cold.temperature < 2:
            raise InputError(
                f"{cold.test.table.file} and {warm.test.table.file} are both at {warm.temperature:g} degC: one of them"
            )
    split, activation = _pieces(tested, nodes, volts, soc)
    fitted = [fit_branches(x, leave_out=True) for x in split]
    rides = [riding_current(seed=k) for k in range(1, 4)] if loads is None else loads
    one, two = Reduction(rides), Reduction(rides, count=2)
    tables_one, sd_one = _meshes(fitted, one)
    if method == "direct":
        tables_one, sd_one = _direct(tested, fitted, activation, nodes, volts, tables_one)
    tables_two, sd_two = _meshes(fitted, two)
    r0, r1, tau = tables_one
    sd_one, sd_two = ([np.hypot(x, TESTER) for x in sds] for sds in (sd_one, sd_two))
    covered = np.array([f.covered for f in fitted])
    shift, ocv_sd = _rest_shift(fitted, tested, nodes, ocv)
    names = ", ".join(t.test.name for t in tested)
    rests = _rests_over_soc(fitted, tested, names)
    result.curves["rest_shift"] = rests
    rest_shift = _shift_of_rests(rests, tested, names, result)
    cell = Circuit(
        nodes,
        volts + shift,
        soc,
        np.array([t.temperature for t in tested]),
        np.array([t.capacity for t in tested]),
        r0,
        r1,
        tau / r1,
        rest_shift=rest_shift,
    )
    slow = Circuit(
        nodes,
        volts + shift,
        soc,
        cell.temperature,
        cell.capacity,
        tables_two[0],
        tables_two[1],
        tables_two[3] / tables_two[1],
        tables_two[2],
        tables_two[4],
        rest_shift,
    )
    axes = {"soc": soc, "temperature": cell.temperature}
    how = f"{names}: {len(TIMES)} RC pairs, reduced over {'synthetic rides' if loads is None else 'the loads given'}"
    if method == "direct":
        how = f"{names}: least squares of one RC pair"

    def curve(value: Array, sd: Array, unit: str, what: str) -> Curve:
        return Curve(axes, value, np.where(covered, sd, np.nan), unit, f"{how}; {what}")

    result.curves["battery.ocv"] = Curve({"soc": nodes}, cell.ocv, ocv_sd, "V", f"{ocv.source}; moved to the rests")
    result.curves["battery.capacity"] = Curve(
        {"temperature": cell.temperature},
        cell.capacity,
        np.array([t.capacity_sd for t in tested]),
        "A·h",
        f"{names}: charge that lays the rest voltages on the OCV",
    )
    result.curves["battery.r0"] = curve(r0, r0 * sd_one[0], "ohm", "R0")
    result.curves["battery.r1"] = curve(r1, r1 * sd_one[1], "ohm", "R1")
    result.curves["battery.c1"] = curve(cell.c1, cell.c1 * sd_one[3], "F", "τ1/R1")
    result.curves["slow_r0"] = curve(slow.r0, slow.r0 * sd_two[0], "ohm", "R0 beside two pairs")
    result.curves["slow_r1"] = curve(slow.r1, slow.r1 * sd_two[1], "ohm", "R1 beside a slow pair")
    result.curves["slow_c1"] = curve(slow.c1, slow.c1 * sd_two[5], "F", "C1 beside a slow pair")
    result.curves["slow_resistance"] = curve(tables_two[2], tables_two[2] * sd_two[2], "ohm", "slow pair")
    result.curves["slow_time"] = curve(tables_two[4], tables_two[4] * sd_two[4], "s", "slow pair")
    for t, f in zip(tested, fitted, strict=True):
        if not np.all(f.covered):
            result.refusals.append(
                f"{t.test.name}: no pulses near SOC {', '.join(f'{s:g}' for s in soc[~f.covered])} at "
                f"{t.temperature:g} degC; the table there only continues its neighbours (no sd)"
            )
    _voltages(result, tested, cell, slow)
    if method == "reduced":  # the halves are
        _mesh_quality(result, tested, fitted, split, one, tables_one)
    return result


def circuit(result: Result, slow: bool = False) -> Circuit:
    """The cell that `calibrate` found; with `slow`, of two RC pairs."""
    c = result.curves
    ocv, axes = c["battery.ocv"], c["battery.r0"].axes
    base = (ocv.axes["soc"], ocv.value, axes["soc"], axes["temperature"], c["battery.capacity"].value)
    cold = c["battery.rest_shift"].value if "battery.rest_shift" in c else None
    if slow:
        return Circuit(
            *base,
            c["slow_r0"].value,
            c["slow_r1"].value,
            c["slow_c1"].value,
            c["slow_resistance"].value,
            c["slow_time"].value,
            cold,
        )
    return Circuit(*base, c["battery.r0"].value, c["battery.r1"].value, c["battery.c1"].value, rest_shift=cold)


def follow_profile(cell: Circuit, test: CellTest) -> tuple[Array, Array]:
    """(model, measured) voltage (m,) [V]: from the SOC of the first voltage, at rest, on by the current alone."""
    slope = np.interp(test.temperature, cell.temperature, cell.capacity)
    order = np.argsort(cell.ocv)
    rest = test.voltage[0] - cell.ocv_shift(test.temperature[:1])[0]
    start = float(np.interp(rest, cell.ocv[order], cell.ocv_soc[order]))
    level = start - np.cumsum(np.diff(test.drawn, prepend=0.0) / slope)
    return voltage(cell, test.flowed, test.current, test.dt, level, test.temperature), test.voltage


def _tested(table: Table, nodes: Array, volts: Array, capacity: Found, result: Result) -> Tested:
    """`table` with its capacity: the one with which its rest voltages lie best on the OCV above 10 % SOC."""
    test = cell_test(table)
    pulses = int(test.block[-1])
    if pulses < FEWEST_PULSES:
        raise table.error(f"has {pulses} pulses; at least {FEWEST_PULSES} are needed")
    ends = np.flatnonzero(test.rest & ~np.concatenate([test.rest[1:], [False]]))
    began = np.array([_began(test, int(k)) for k in ends])
    rests = ends[test.time[ends] - test.time[began] >= REST]
    used = float(test.drawn.max() - test.drawn.min())
    levels = np.unique(np.round(test.drawn[rests] / max(used, 1e-9) * 50))
    if len(levels) < FEWEST_LEVELS:
        raise table.error(
            f"rests of {REST / 60:.0f} min at {len(levels)} states of charge; at least {FEWEST_LEVELS} are needed"
        )
    if used < 0.5 * capacity.value:
        raise table.error(
            f"draws {used:.3f} of {capacity.value:.3f} A·h: pulses over at least half of the range of SOC are needed"
        )
    start = 1.0
    if test.voltage[0] < volts[-1] - FULL_WITHIN:
        start = float(np.interp(test.voltage[0], volts, nodes))
        result.notes.append(f"{test.name}: begins at {test.voltage[0]:.3f} V, SOC {start:.3f}, not full")
    drawn, at_rest = test.drawn[rests], test.voltage[rests]

    def misses(share: float) -> tuple[Array, float]:
        level = start - drawn / (share * capacity.value)
        error = at_rest - extended_over(nodes, volts, level)
        weight = np.where(level > 0.12, 1.0, 0.0)
        offset = float(np.sum(weight * error) / (np.sum(weight) + 1.0))  # prior: 5 mV, as one rest counts
        return np.sqrt(weight) * (error - offset), offset

    best = minimize_scalar(lambda x: float(np.sum(misses(x)[0] ** 2)), bounds=(0.6, 1.15), method="bounded")
    share = float(best.x)
    error, offset = misses(share)
    curvature = (np.sum((misses(share + 1e-3)[0] - error) ** 2)) / 1e-6
    sd = float(np.sqrt(max(np.sum(error**2) / max(len(error) - 2, 1), 1e-6) / max(curvature, 1e-12)))
    found = share * capacity.value
    temperature = float(np.round(np.median(test.temperature[rests]))) + 0.0  # no -0
    result.fits.append(
        Fit(
            f"rest voltage at {temperature:g} degC, SOC above 0.12",
            "V",
            float(np.sqrt(np.mean(error**2))),
            float(np.abs(error).max()),
            None,
            len(error),
            False,
            test.name,
        )
    )
    return Tested(
        test,
        temperature,
        found,
        float(np.hypot(sd * capacity.value, 0.005 * found)),
        start - test.drawn / found,
        rests,
        offset,
    )


def _began(test: CellTest, end: int) -> int:
    """The first row of the rest that ends at row `end`."""
    moving = np.flatnonzero(~test.rest[:end])
    return int(moving[-1]) + 1 if len(moving) else 0


def _pieces(
    tested: list[Tested], nodes: Array, volts: Array, soc: Array
) -> tuple[list[Pieces], list[tuple[float, float]]]:
    """Every test's pieces, moved to its nominal temperature by the activation seen between the tests, and that."""
    relaxing = [filtered(t.test) for t in tested]

    def split(activation: list[tuple[float, float]]) -> list[Pieces]:
        return [
            pieces(t.test, t.level, _ocv(nodes, volts, t.level), soc, t.temperature, x, a)
            for t, x, a in zip(tested, relaxing, activation, strict=True)
        ]

    activation = [(0.0, 0.0)] * len(tested)
    if len(tested) == 1:
        return split(activation), activation
    fitted = [fit_branches(x) for x in split(activation)]
    middle = (soc > 0.15) & (soc < 0.95)
    inverse = np.array([1 / (t.temperature + KELVIN) for t in tested])
    logs = [
        np.log([np.median(np.sum(f.resistance[part][:, middle], axis=0)) for f in fitted])
        for part in (slice(0, 1), slice(1, None))
    ]
    slopes = [np.clip(np.gradient(x, inverse), 0, 8000) for x in logs]
    activation = [(float(a), float(b)) for a, b in zip(*slopes, strict=True)]
    return split(activation), activation


def _direct(
    tested: list[Tested],
    fitted: list[Branches],
    activation: list[tuple[float, float]],
    nodes: Array,
    volts: Array,
    start: list[Array],
) -> tuple[list[Array], list[Array]]:
    """As `_meshes` for one pair, from the pulses themselves."""
    found = [
        fit_direct(t.test, t.level, _ocv(nodes, volts, t.level), f, (start[0][k], start[1][k], start[2][k]), a)
        for k, (t, f, a) in enumerate(zip(tested, fitted, activation, strict=True))
    ]
    tables = [np.array([d.r0 for d in found]), np.array([d.r1 for d in found]), np.array([d.time for d in found])]
    return tables, [np.array([d.sd[j] for d in found]) for j in range(4)]


def _ocv(nodes: Array, volts: Array, level: Array) -> tuple[Array, Array]:
    up, down = extended_over(nodes, volts, level + 0.005), extended_over(nodes, volts, level - 0.005)
    return extended_over(nodes, volts, level), (up - down) / 0.01


def _meshes(fitted: list[Branches], reduction: Reduction) -> tuple[list[Array], list[Array]]:
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


def _pooled(soc: Array, sd: Array, covered: NDArray[np.bool_]) -> Array:
    """`sd` (n, parts) with what the covered neighbours' say: the few pulses at one node tell a scatter badly."""
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
        rows = [np.diag(weight)]
        for k in range(n - 2):
            left, right = soc[k + 1] - soc[k], soc[k + 2] - soc[k + 1]
            bend = np.zeros(n)
            w = right / (left + right)
            bend[k : k + 3] = np.array([w, -1.0, 1 - w]) / (SMOOTH * max(left + right, 0.1) / 0.2)
            rows.append(bend[None])
        if j >= (logs.shape[1] + 1) // 2:  # time constants hardly depend on SOC, and are known worst
            slope = np.diff(np.eye(n), axis=0) / (LEVEL * np.maximum(np.diff(soc), 0.05) / 0.1)[:, None]
            rows.append(slope)
        matrix = np.vstack(rows)
        result[:, j] = np.linalg.solve(matrix.T @ matrix, weight**2 * logs[:, j])
    return result


def _nearest(tested: list[Tested]) -> int:
    return min(range(len(tested)), key=lambda k: abs(tested[k].temperature - 25))


def _rest_shift(fitted: list[Branches], tested: list[Tested], nodes: Array, ocv: Curve) -> tuple[Array, Array]:
    """(shift, sd) (len(nodes),) [V] from the OCV to where the cell rests after discharging, near 25 degC."""
    nearest = _nearest(tested)
    shift = np.interp(nodes, fitted[nearest].soc, fitted[nearest].shift)
    scatter = np.std([np.interp(nodes, f.soc, f.shift) for f in fitted], axis=0) if len(fitted) > 1 else np.abs(shift)
    shift[nodes == 1] = 0.0 if abs(tested[nearest].test.voltage[0] - ocv.value[-1]) < FULL_WITHIN else shift[-1]
    moved = ocv.value + shift
    shift = np.maximum.accumulate(moved + 1e-3 * (nodes[-1] - nodes)) - 1e-3 * (nodes[-1] - nodes) - ocv.value
    return shift, np.hypot(np.minimum(ocv.sd, np.abs(shift) + 0.003), scatter)


def _rests_over_soc(fitted: list[Branches], tested: list[Tested], names: str) -> Curve:
    """How much higher the cell rests at each temperature and SOC than near 25 degC."""
    shifts = np.array([f.shift for f in fitted])
    sd = np.array([np.hypot(jackknife(f.shift, f.without[:, :, -1]), f.shift_prior) for f in fitted])
    axes = {"soc": fitted[0].soc, "temperature": np.array([t.temperature for t in tested])}
    covered = np.array([f.covered for f in fitted])
    return Curve(
        axes,
        shifts - shifts[_nearest(tested)],
        np.where(covered, sd, np.nan),
        "V",
        f"{names}: rest voltage against that near 25 degC",
    )


def _shift_of_rests(rests: Curve, tested: list[Tested], names: str, result: Result) -> Array | None:
    """The shift (temperatures,) [V] of the open-circuit voltage, as ``battery.rest_shift``; None if it is not sure.

    The mean over 15 to 95 % SOC; its sd holds how it varies there, since one number is to stand for all of it.
    """
    reference = _nearest(tested)
    soc = rests.axes["soc"]
    middle = (soc > 0.15) & (soc < 0.95)
    if len(tested) < 2:
        return None
    known = [row[middle & np.isfinite(sd)] for row, sd in zip(rests.value, rests.sd, strict=True)]
    within = [sd[middle & np.isfinite(sd)] for sd in rests.sd]
    if not all(map(len, known)):
        return None
    mean = np.array([row.mean() for row in known])
    sd = np.array([np.hypot(row.std(), s.mean()) for row, s in zip(known, within, strict=True)])
    others = np.arange(len(tested)) != reference
    chance = float(chi2.sf(np.sum((mean[others] / np.maximum(sd[others], 1e-3)) ** 2), len(tested) - 1))
    told = ", ".join(
        f"{1e3 * m:+.1f} ± {1e3 * s:.1f} mV at {t.temperature:g} degC"
        for t, m, s, other in zip(tested, mean, sd, others, strict=True)
        if other
    )
    if chance > 1 - SURE:
        result.notes.append(
            f"rests do not move with temperature beyond how they scatter over the state of charge: {told}; "
            "the open-circuit voltage is one for all temperatures"
        )
        return None
    result.notes.append(f"the cell rests {told} against {tested[reference].temperature:g} degC")
    result.curves["battery.rest_shift"] = Curve(
        {"temperature": rests.axes["temperature"]},
        mean,
        sd,
        "V",
        f"{names}: mean over 15 to 95 % SOC of the rests against those near 25 degC",
    )
    return mean


def _mesh_quality(
    result: Result,
    tested: list[Tested],
    fitted: list[Branches],
    split: list[Pieces],
    one: Reduction,
    tables: list[Array],
) -> None:
    """R² of the meshes: of the smooth one against each node's own, and of what half the pulse groups say of the other.

    A group is what lies between two long rests; every other one makes a mesh, which the rest's is compared with.
    """
    soc = fitted[0].soc
    halves, covered = [], np.tile((soc > 0.19) & (soc < 0.91), (len(tested), 1))
    for odd in (0, 1):
        part = []
        for t, x in zip(tested, split, strict=True):
            step = np.zeros(len(t.test), dtype=int)
            step[t.rests] = 1
            group = np.cumsum(step) - step
            part.append(fit_branches(x, group[np.searchsorted(t.test.block, x.label)] % 2 == odd))
        covered &= np.array([f.covered for f in part])
        halves.append(_meshes(part, one)[0])
    single = list(np.exp([one.logs(f.resistance) for f in fitted]).transpose(2, 0, 1))
    names = ", ".join(t.test.name for t in tested)
    for name, unit, number in (("R0", "ohm", 0), ("R1", "ohm", 1), ("C1", "F", 2)):
        every = [x[number] / x[1] if number == 2 else x[number] for x in (tables, single, *halves)]
        mesh, own, even, other = (x[covered] for x in every)
        for what, a, b, held_out in (("node by node", own, mesh, False), ("half against half", even, other, True)):
            result.fits.append(
                score(f"mesh of {name}, SOC 0.2 to 0.9, {what}", unit, a, b, held_out=held_out, source=names)
            )


def _voltages(result: Result, tested: list[Tested], cell: Circuit, slow: Circuit) -> None:
    """How well the tables follow the tests that they came from: voltage, and what is left over time."""
    residuals: list[float] = []
    empties: list[float] = []
    for t in tested:
        test = t.test
        for what, c in (("one pair", cell), ("two pairs", slow)):
            model = voltage(c, test.flowed, test.current, test.dt, t.level, test.temperature)
            error = model - test.voltage
            for name, part in (("above", t.level > 0.1), ("below", t.level <= 0.1)):
                if np.count_nonzero(part) > 20:
                    spread = float(np.sum((test.voltage[part] - test.voltage[part].mean()) ** 2))
                    result.fits.append(
                        Fit(
                            f"voltage, {what}, {t.temperature:g} degC, SOC {name} 0.1",
                            "V",
                            float(np.sqrt(np.mean(error[part] ** 2))),
                            float(np.abs(error[part]).max()),
                            1 - float(np.sum(error[part] ** 2)) / spread,
                            int(np.count_nonzero(part)),
                            False,
                            test.name,
                        )
                    )
                    if what == "one pair":
                        (residuals if name == "above" else empties).append(float(np.mean(error[part] ** 2)))
        model = voltage(cell, test.flowed, test.current, test.dt, t.level, test.temperature)
        hours = test.time / 3600
        result.panels += [
            Panel(
                f"Pulse test at {t.temperature:g} °C",
                "time [h]",
                "voltage [V]",
                (Trace("measured", hours, test.voltage, "."), Trace("model", hours, model)),
            ),
            Panel(
                f"Pulse test at {t.temperature:g} °C: residual",
                "time [h]",
                "model less measured [mV]",
                (Trace("", hours, 1000 * (model - test.voltage)),),
            ),
        ]
    for key, unit, factor in (("r0", "mΩ", 1e3), ("r1", "mΩ", 1e3), ("c1", "F", 1.0)):
        mesh = result.curves[f"battery.{key}"]
        result.panels.append(
            Panel(
                key.upper(),
                "state of charge",
                unit,
                tuple(
                    Trace(f"{degrees:g} °C", mesh.axes["soc"], factor * row)
                    for degrees, row in zip(mesh.axes["temperature"], mesh.value, strict=True)
                ),
            )
        )
    names = ", ".join(t.test.name for t in tested)
    result.parameters["cell_voltage_error"] = Found(
        0.0, float(np.sqrt(np.mean(residuals))), "V", f"{names}: rms of one RC pair above 10 % SOC"
    )
    if empties:
        result.parameters["cell_voltage_error_empty"] = Found(
            0.0, float(np.sqrt(np.mean(empties))), "V", f"{names}: rms of one RC pair below 10 % SOC"
        )
