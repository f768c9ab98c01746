"""R0, R1 and C1 over state of charge and temperature from pulse tests of one cell (Lord 2016, sec. 2.2).

One table per temperature. Each test begins at full and rests before its pulses; its rest voltages show how much charge
there is between full and empty at its temperature. Many RC pairs of fixed time constants are fitted, linear in every
table (see `circuit`). Of these the slow ones become an effect, and the one pair that is nearest to the rest under a
load like riding the tables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize, minimize_scalar
from scipy.sparse import csr_matrix, diags, hstack
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from gz_onboard.arrays import Array, Mask, bends
from gz_onboard.calibration.cell import FLAT, TESTER, CellTest, cell_test, increasing
from gz_onboard.calibration.circuit import (
    FOUND,
    NO_REACTION,
    PAIR_FIT,
    TIMES,
    Branches,
    Circuit,
    Pieces,
    Reaction,
    Reduction,
    filtered,
    fit_branches,
    follow_profile,
    hats,
    jackknife,
    pieces,
    riding_current,
    smoothness,
    voltage,
    weighted_columns,
)
from gz_onboard.calibration.fit import score
from gz_onboard.calibration.result import Curve, Fit, Found, Panel, PlotLine, Result, compared
from gz_onboard.calibration.table import Measurements
from gz_onboard.constants import BENCH_TEMPERATURE, HOUR, KELVIN
from gz_onboard.errors import InputError
from gz_onboard.model.effects import charge_transfer as transfer_effect
from gz_onboard.model.effects import slow_relaxation as slow_effect
from gz_onboard.model.series import extended_over

CHARGE_TRANSFER, SLOW_RELAXATION = (e.__name__.rpartition(".")[2] for e in (transfer_effect, slow_effect))
SOC = np.array([0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
MIDDLE = (SOC > 0.15) & (SOC < 0.95)  # nodes whose tables change little with the state of charge


@dataclass(frozen=True)
class PulseConfig:
    """Requirements of a pulse test, and limits from which on its results are believed."""

    fewest_pulses: int = 6
    fewest_levels: int = 3  # states of charge with a long rest
    min_drawn: float = 0.5  # of the slow test's capacity
    max_drawn: float = 1.3  # of the slow test's capacity: more is another cell
    rest: float = 1200.0  # s without current, after which a voltage is that of rest
    full_within: float = 0.03  # V: a first voltage so near to the full cell's is that of a full cell
    capacity_sd_limit: float = (
        0.03  # relative sd of a capacity that the rests do not tell: they lie where the OCV is flat
    )
    taken_sd: float = 0.1  # relative: of the slow test's capacity where it is taken for another temperature
    capacity_difference: float = (
        0.03  # relative: how far the capacities of a pulse test and a slow test may differ without a note
    )
    nearest: float = 2.0  # K between two tests
    level_slope: float = 0.15  # relative: how far a time constant may change over 0.1 of SOC
    pooled: float = 0.1  # of SOC: how far the scatter of pulses is taken to be alike
    smooth: float = 0.08  # relative: how far ln of a table may bend over 0.1 of SOC, where the data say little
    rests_confidence: float = 0.99  # how surely the rests must show that temperature moves them
    slow_time: float = 300.0  # s: slower pairs are the effect `slow_relaxation`; one for riding has a minute
    significance: float = 3.0  # sd that a resistance is above zero, before the file gets its effect
    reaction_chance: float = 1e-3  # that tests without charge transfer show as much
    reaction_share: float = 0.3  # of R0 in the warmest test: where the search begins
    reaction_time_sd: float = 1.5  # of ln time, before the pulses
    reaction_trials: int = 150
    grid: float = 10.0  # s between the residuals whose square and correlation are taken
    empty: float = 0.1  # SOC up to which `cell_voltage_error_empty` counts
    longest_error: float = 3600.0  # s: beyond, two residuals have nothing to do with each other
    profile_volts: float = 0.02  # V: what Lord 2016 gives for a cell on a road profile


PULSE = PulseConfig()
REACTION_STEPS = np.array([0.05, 200.0, 0.05])  # of ln resistance, activation [K] and ln time: for the curvature


def calibrate_cell(
    tables: Sequence[Measurements],
    ocv: Curve,
    capacity: Found,
    *,
    loads: Sequence[Array] | None = None,
    held_out: Sequence[Measurements] = (),
) -> Result:
    """``battery.r0``, ``r1``, ``c1``, ``capacity`` and ``ocv``.

    Also how far they err (see `_errors`), and ``battery.rest_shift``, if the rests show one (see `_shift_of_rests`).

    tables: one for each temperature. ocv, capacity: from `cell.open_circuit`. loads: currents [any unit, one value a
    second, each from rest] that the pair is to follow; synthetic rides if None. held_out: profiles to validate with.
    Raises InputError for tables that are no pulse tests (see `cell_test`), too few pulses, too narrow a range, or two
    tests at one temperature.
    """
    result = Result("pulse")
    tests = _tests(tables, ocv, capacity, result)
    nodes, volts = ocv.axes["soc"], ocv.value
    names = ", ".join(t.test.name for t in tests)
    reaction = _charge_transfer(tests, nodes, volts, names, result)
    measured, tests = tests, [_without(reaction, t) for t in tests]
    split = _moved_pieces(tests, nodes, volts)
    fitted = [fit_branches(x, leave_out=True) for x in split]
    rides = [riding_current(seed=k) for k in range(1, 4)] if loads is None else loads
    slow = _slow_relaxation(fitted, capacity.value, names, result)
    reduction = Reduction(rides, slow)
    one = _meshes(fitted, reduction)
    _rests(fitted, tests, ocv, names, result)
    temperature, amount, amount_sd = np.array([(t.temperature, t.capacity, t.capacity_sd) for t in tests]).T
    source = f"{names}: charge that lays the rest voltages on the OCV"
    result.curves["battery.capacity"] = Curve({"temperature": temperature}, amount, amount_sd, "A·h", source)
    how = f"{names}: {len(TIMES)} RC pairs, reduced over {'synthetic rides' if loads is None else 'the loads given'}"
    covered = np.array([f.covered for f in fitted])
    _tables(result, {"soc": SOC, "temperature": temperature}, covered, how, one)
    for t, there in zip(tests, covered, strict=True):
        if not np.all(there):
            result.refusals.append(
                f"{t.test.name}: no pulses near SOC {', '.join(f'{s:g}' for s in SOC[~there])} at "
                f"{t.temperature:g} degC; the table there only continues its neighbours (no sd)"
            )
    _errors(result, measured, names)
    _mesh_quality(result, tests, split, reduction, names)
    _validate(result, held_out, capacity)
    return result


def circuit(result: Result) -> Circuit:
    """The cell that `calibrate_cell` found, as on board."""
    curves, found = result.curves, result.parameters
    ocv, axes = curves["battery.ocv"], curves["battery.r0"].axes
    r0, r1, c1, capacity = (curves[f"battery.{name}"].value for name in ("r0", "r1", "c1", "capacity"))
    cell = Circuit(ocv.axes["soc"], ocv.value, axes["soc"], axes["temperature"], capacity, r0, r1, c1)
    if result.effects[SLOW_RELAXATION]:
        resistance, time = (found[p.name].value for p in slow_effect.PARAMETERS)
        cell = replace(cell, slow=(resistance, time))
    if result.effects.get(CHARGE_TRANSFER):
        cell = replace(cell, reaction=Reaction(*(found[p.name].value for p in FOUND)))
    if "battery.rest_shift" in curves:
        cell = replace(cell, rest_shift=curves["battery.rest_shift"].value)
    return cell


# --- tests and their state of charge -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tested:
    """A pulse test with its state of charge."""

    test: CellTest
    temperature: float  # degC, nominal
    capacity: float  # A·h between full and empty
    capacity_sd: float
    level: Array
    rests: NDArray[np.int_]  # rows at the ends of rests


def _tests(tables: Sequence[Measurements], ocv: Curve, capacity: Found, result: Result) -> list[Tested]:
    """The tests by temperature; InputError for none, or two at one temperature."""
    if not tables:
        raise InputError("no pulse test is given")
    tests = sorted((_tested(t, ocv, capacity, result) for t in tables), key=lambda t: t.temperature)
    for cold, warm in pairwise(tests):
        if warm.temperature - cold.temperature < PULSE.nearest:
            raise InputError(
                f"{cold.test.table.file} and {warm.test.table.file} are both at {warm.temperature:g} degC: one of them"
            )
    rated = tests[_nearest_to_bench(tests)]
    if abs(rated.capacity / capacity.value - 1) > PULSE.capacity_difference:
        result.notes.append(
            f"{rated.test.name}: the rests ask for a capacity of {rated.capacity:.3f} A·h at {rated.temperature:g} "
            f"degC, cell_capacity is {capacity.value:.3f}: another cell, an aged one, or tests between other ends. "
            "cell_capacity stays; battery.capacity only says how it depends on temperature"
        )
    return tests


def _tested(table: Measurements, ocv: Curve, capacity: Found, result: Result) -> Tested:
    """`table` with its capacity: the one with which its rest voltages lie best on the OCV above 12 % SOC."""
    test, nodes, volts, c = cell_test(table), ocv.axes["soc"], ocv.value, PULSE
    if not test.rest[0]:
        raise table.error(
            f"begins under a current of {test.current[0]:.3g} A: its first voltage must be one at rest", 0
        )
    rests = _long_rests(test, capacity)
    start = 1.0
    if test.voltage[0] < volts[-1] - c.full_within:
        start = float(np.interp(test.voltage[0], volts, nodes))
        if np.interp(start, nodes, ocv.sd / np.gradient(volts, nodes)) > FLAT:
            raise table.error(
                f"begins at {test.voltage[0]:.3f} V, not full and where the open-circuit voltage is flat: how much "
                "charge it holds is not known; let it begin full"
            )
        result.notes.append(f"{test.name}: begins at {test.voltage[0]:.3f} V, SOC {start:.3f}, not full")
    drawn, at_rest = test.drawn[rests], test.voltage[rests]

    def rest_errors(share: float) -> Array:
        """How far the rests lie off the OCV [V], those above 0.12 of SOC and less their common offset."""
        level = start - drawn / (share * capacity.value)
        error = at_rest - extended_over(nodes, volts, level)
        weight = np.where(level > 0.12, 1.0, 0.0)
        offset = float(np.sum(weight * error) / (np.sum(weight) + 1.0))  # prior: 5 mV, as one rest counts
        return np.asarray(np.sqrt(weight) * (error - offset))

    share = float(minimize_scalar(lambda x: float(np.sum(rest_errors(x) ** 2)), bounds=(0.6, 1.15), method="bounded").x)
    error = rest_errors(share)
    curvature = (np.sum((rest_errors(share + 1e-3) - error) ** 2)) / 1e-6
    sd = float(np.sqrt(max(np.sum(error**2) / max(len(error) - 2, 1), 1e-6) / max(curvature, 1e-12)))
    temperature = float(np.round(np.median(test.temperature[rests]))) + 0.0  # no -0
    if sd > c.capacity_sd_limit:
        result.refusals.append(
            f"{test.name}: the rests at {temperature:g} degC lie where the open-circuit voltage is flat and do not "
            f"tell the capacity (± {100 * sd:.0f} %): that of the slow test is taken, ± {100 * c.taken_sd:.0f} %"
        )
        share, sd = max(1.0, float(drawn.max()) / (start * capacity.value)), c.taken_sd
    found = share * capacity.value
    what, rms = f"rest voltage at {temperature:g} degC, SOC above 0.12", float(np.sqrt(np.mean(error**2)))
    result.fits.append(Fit(what, "V", rms, float(np.abs(error).max()), None, len(error), False, test.name))
    found_sd = float(np.hypot(sd * capacity.value, TESTER * found))
    return Tested(test, temperature, found, found_sd, start - test.drawn / found, rests)


def _long_rests(test: CellTest, capacity: Found) -> NDArray[np.int_]:
    """The rows at the ends of long rests; InputError for too few pulses, or too narrow a range."""
    c, table, pulses = PULSE, test.table, int(test.block[-1])
    if pulses < c.fewest_pulses:
        raise table.error(f"has {pulses} pulses; at least {c.fewest_pulses} are needed")
    ends = np.flatnonzero(test.rest & ~np.concatenate([test.rest[1:], [False]]))
    rests: NDArray[np.int_] = ends[np.array([test.rested(int(k)) >= c.rest for k in ends])]
    used = float(test.drawn.max() - test.drawn.min())
    levels = np.unique(np.round(test.drawn[rests] / max(used, 1e-9) * 50))
    draws = f"draws {used:.3f} of {capacity.value:.3f} A·h"
    if len(levels) < c.fewest_levels:
        raise table.error(
            f"rests of {c.rest / 60:.0f} min at {len(levels)} states of charge; at least {c.fewest_levels} are needed"
        )
    if used > c.max_drawn * capacity.value:
        raise table.error(f"{draws}: more than the cell holds. Is it the cell of the slow test, and the current in A?")
    if used < c.min_drawn * capacity.value:
        raise table.error(f"{draws}: pulses over at least half of the range of SOC are needed")
    return rests


def _nearest_to_bench(tests: Sequence[Tested]) -> int:
    """Which of the tests is nearest to the temperature at which capacities are given."""
    return min(range(len(tests)), key=lambda k: abs(tests[k].temperature - BENCH_TEMPERATURE))


def _moved_pieces(tests: Sequence[Tested], nodes: Array, volts: Array) -> list[Pieces]:
    """Every test's pieces, moved to its nominal temperature by the activation seen between the tests."""
    relaxing = [filtered(t.test) for t in tests]

    def split(activation: Sequence[tuple[float, float]]) -> list[Pieces]:
        return [
            pieces(t.test, t.level, _ocv_and_slope(nodes, volts, t.level), SOC, t.temperature, x, a)
            for t, x, a in zip(tests, relaxing, activation, strict=True)
        ]

    nominal = split([(0.0, 0.0)] * len(tests))
    if len(tests) == 1:
        return nominal
    fitted = [fit_branches(x) for x in nominal]
    inverse = np.array([1 / (t.temperature + KELVIN) for t in tests])
    slopes = []
    for part in (slice(0, 1), slice(1, None)):
        size = np.array([np.median(np.sum(f.resistance[part][:, MIDDLE], axis=0)) for f in fitted])
        seen = (
            size.min() > PAIR_FIT.min_resistance
        )  # charge transfer may leave nothing of R0, whose activation nobody sees then
        slopes.append(np.clip(np.gradient(np.log(size), inverse), 0, 8000) if seen else np.zeros(len(size)))
    return split([(float(a), float(b)) for a, b in zip(*slopes, strict=True)])


def _ocv_and_slope(nodes: Array, volts: Array, level: Array) -> tuple[Array, Array]:
    """The open-circuit voltage [V] and its slope [V] over SOC, at `level`, each (m,)."""
    up, down = extended_over(nodes, volts, level + 0.005), extended_over(nodes, volts, level - 0.005)
    return extended_over(nodes, volts, level), (up - down) / 0.01


# --- charge transfer -----------------------------------------------------------------------------------------------


def _charge_transfer(tests: Sequence[Tested], nodes: Array, volts: Array, names: str, result: Result) -> Reaction:
    """The effect `charge_transfer`, if pulses of several currents show it: resistance that falls with the current.

    Only this part of the circuit is not linear in its parameters. So its three numbers are searched for, and at each
    trial all tables are solved for at once (variable projection: Golub & Pereyra 1973).
    """
    first = [fit_branches(x).resistance for x in _moved_pieces(tests, nodes, volts)]
    costs = [_cost_of(t, nodes, volts, r) for t, r in zip(tests, first, strict=True)]
    known, c = FOUND, PULSE

    def reaction(x: Array) -> Reaction:
        values = (float(np.exp(x[0])), float(x[1]), float(np.exp(x[2])))
        inside = [min(max(v, p.low), p.high) for v, p in zip(values, known, strict=True)]
        return Reaction(inside[0], inside[1], inside[2])

    def cost(x: Array) -> float:
        doubt = (x[1] - known[1].prior) / known[1].prior_sd, (x[2] - np.log(known[2].prior)) / c.reaction_time_sd
        return sum(residual(reaction(x)) for residual in costs) + float(np.sum(np.square(doubt)))

    size = max(np.median(first[-1][0]), PAIR_FIT.min_resistance)
    start = np.array([np.log(c.reaction_share * size), known[1].prior, np.log(known[2].prior)])
    simplex = start + np.vstack([np.zeros(3), np.diag(10 * REACTION_STEPS)])
    options = {"initial_simplex": simplex, "xatol": 0.01, "fatol": 0.1, "maxfev": c.reaction_trials}
    found = minimize(cost, start, method="Nelder-Mead", options=options)
    free = sum(len(t.test) for t in tests) / PAIR_FIT.correlated
    best_cost, no_reaction_cost = float(found.fun), sum(residual(NO_REACTION) for residual in costs)
    values, vectors = np.linalg.eigh(_curvature(cost, found.x))
    spread = 2 * max(best_cost / free, 1.0) / np.maximum(values, np.finfo(float).tiny)  # inf: flat
    sd = np.sqrt(vectors**2 @ spread)
    chance = float(f_distribution.sf((no_reaction_cost - best_cost) / 3 / (best_cost / free), 3, free))
    best = reaction(found.x)
    result.effects[CHARGE_TRANSFER] = seen = chance <= c.reaction_chance and 0 < sd[0] < 1 / c.significance
    if not seen:
        result.notes.append(
            "no resistance that falls with current is seen: the pulses need several currents to show it"
        )
        return NO_REACTION
    result.notes.append(
        f"resistance falls with current: {1e3 * best.resistance:.3g} mΩ of charge transfer at 25 degC and no current, "
        f"activation {best.activation:.0f} K, settling in {best.time:.2g} s; without "
        f"it what is left is {np.sqrt(no_reaction_cost / best_cost):.2f} times as large"
    )
    sds = best.resistance * float(sd[0]), float(sd[1]), best.time * float(sd[2])
    for parameter, value, doubt in zip(known, (best.resistance, best.activation, best.time), sds, strict=True):
        source = f"{names}: pulses of several currents"
        result.parameters[parameter.name] = Found(value, doubt, parameter.unit, source)
    return best


def _without(reaction: Reaction, tested: Tested) -> Tested:
    """The test as a cell without `reaction` would show it."""
    test = tested.test
    more = reaction.overpotential(test.flowed, test.dt, test.temperature)
    return replace(tested, test=replace(test, voltage=test.voltage + more))


def _cost_of(tested: Tested, nodes: Array, volts: Array, resistance: Array) -> Callable[[Reaction], float]:
    """The sum of squares that the best tables leave of a test with a reaction, priors included.

    `resistance` (1 + len(TIMES), n) [ohm], as fitted without charge transfer: the size that the priors refer to.
    """
    test = tested.test
    ocv = _ocv_and_slope(nodes, volts, tested.level)
    columns, weight = weighted_columns(test, ocv, filtered(test))
    hat = csr_matrix(hats(SOC, tested.level))
    matrix = csr_matrix(hstack([diags(column) @ hat for column in columns.T]))
    scale = np.maximum(np.median(resistance, axis=1), 2e-3)
    normal = cho_factor((matrix.T @ matrix).toarray() + smoothness(SOC, scale))
    base = (test.voltage - ocv[0]) * weight

    def cost(reaction: Reaction) -> float:
        target = base + weight * reaction.overpotential(test.flowed, test.dt, test.temperature)
        right = matrix.T @ target
        return float(target @ target - right @ cho_solve(normal, right))

    return cost


def _curvature(cost: Callable[[Array], float], x: Array) -> Array:
    """The second derivatives (3, 3) of `cost` at `x`, by differences of `REACTION_STEPS`."""
    result = np.empty((3, 3))
    for i, a in enumerate(np.diag(REACTION_STEPS)):
        for j, b in enumerate(np.diag(REACTION_STEPS)):
            corners = cost(x + a + b) - cost(x + a - b) - cost(x - a + b) + cost(x - a - b)
            result[i, j] = corners / (4 * REACTION_STEPS[i] * REACTION_STEPS[j])
    return result


# --- tables --------------------------------------------------------------------------------------------------------


class CellTables(NamedTuple):
    """R0, R1 [ohm] and C1 [F], each (temperatures, soc), and their relative sd."""

    value: Array  # (3, temperatures, soc)
    sd: Array


def _meshes(fitted: Sequence[Branches], reduction: Reduction) -> CellTables:
    """Smooth tables; the sd is that of the whole way from pulses to them, a part of each pulse left out in turn."""
    tables, sds = [], []
    for f in fitted:
        weights = np.array(
            [np.sqrt(np.diag(reduction.spread(r, c))) for r, c in zip(f.resistance.T, f.covariance, strict=True)]
        )
        smooth = _smooth(reduction.logs(f.resistance), weights)
        without = np.array([[_smooth(reduction.logs(x[:-1]), weights) for x in part] for part in f.without])
        tables.append(np.exp(smooth))
        sd = jackknife(smooth, without.reshape(len(f.without), -1, *smooth.shape))
        # The covered neighbours' scatter counts too: the few pulses at one node show it badly.
        near = np.exp(-0.5 * ((SOC[:, None] - SOC) / PULSE.pooled) ** 2) * f.covered
        near[~f.covered] = np.eye(len(SOC))[~f.covered]
        sds.append(np.sqrt(near @ sd**2 / near.sum(axis=1)[:, None]))
    value, sd = (np.array(rows)[:, :, [0, 1, 3]].transpose(2, 0, 1) for rows in (tables, sds))
    return CellTables(value, sd)


def _smooth(logs: Array, sds: Array) -> Array:
    """Columns of `logs` (n, 3), ln of R0, R1, τ1, made to bend little where their sd is large; a fourth: ln C1."""
    bend = bends(SOC) / (PULSE.smooth * np.maximum(SOC[2:] - SOC[:-2], 0.1) / 0.2)[:, None]
    slope = np.diff(np.eye(len(SOC)), axis=0) / (PULSE.level_slope * np.maximum(np.diff(SOC), 0.05) / 0.1)[:, None]
    time_prior = np.vstack([bend, slope])  # time constants hardly depend on SOC, and are known worst
    columns = []
    for log, sd, prior in zip(logs.T, sds.T, (bend, bend, time_prior), strict=True):
        weight = 1 / np.maximum(sd, 0.02)
        columns.append(np.linalg.solve(np.diag(weight**2) + prior.T @ prior, weight**2 * log))
    r0, r1, time = columns
    return np.column_stack([r0, r1, time, time - r1])


def _tables(result: Result, axes: dict[str, Array], covered: Mask, how: str, cell: CellTables) -> None:
    """The tables of R0, R1 and C1, without an sd where not covered, with their pictures."""
    rows = (("R0", "ohm", "R0", 1e3, "mΩ"), ("R1", "ohm", "R1", 1e3, "mΩ"), ("C1", "F", "τ1/R1", 1.0, "F"))
    for (title, unit, what, scale, shown), value, share in zip(rows, *cell, strict=True):
        sd = np.where(covered, value * np.hypot(share, TESTER), np.nan)
        result.curves[f"battery.{title.lower()}"] = Curve(axes, value, sd, unit, f"{how}; {what}")
        by_temperature = zip(axes["temperature"], scale * value, strict=True)
        lines = tuple(PlotLine(f"{t:g} °C", SOC, row) for t, row in by_temperature)
        result.panels.append(Panel(title, "state of charge", shown, lines))


def _mesh_quality(result: Result, tests: Sequence[Tested], split: Sequence[Pieces], one: Reduction, names: str) -> None:
    """R² of the meshes that half the pulse groups make, against those of the other half.

    A group lies between two long rests.
    """
    halves, covered = [], np.tile((SOC > 0.19) & (SOC < 0.91), (len(tests), 1))
    for half in (0, 1):
        part = []
        for t, x in zip(tests, split, strict=True):
            group = np.searchsorted(t.rests, np.searchsorted(t.test.block, x.label))
            part.append(fit_branches(x, group % 2 == half))
        covered &= np.array([f.covered for f in part])
        halves.append(_meshes(part, one).value)
    if not covered.any():
        result.refusals.append("meshes: the pulses are too few to compare half of them with the other half")
        return
    for name, unit, even, odd in zip(("R0", "R1", "C1"), ("ohm", "ohm", "F"), *halves, strict=True):
        what = f"mesh of {name}, SOC 0.2 to 0.9, half against half"
        result.fits.append(score(what, unit, even[covered], odd[covered], held_out=True, source=names))


# --- rests and slow relaxation -------------------------------------------------------------------------------------


def _rests(fitted: Sequence[Branches], tests: Sequence[Tested], ocv: Curve, names: str, result: Result) -> None:
    """``battery.ocv`` moved to where the cell rests after discharging near 25 degC; ``rest_shift`` over temperature."""
    nearest, nodes = _nearest_to_bench(tests), ocv.axes["soc"]
    every = np.array([np.interp(nodes, SOC, f.shift) for f in fitted])
    shift = every[nearest]
    scatter = np.std(every, axis=0) if len(fitted) > 1 else np.abs(shift)
    full = abs(tests[nearest].test.voltage[0] - ocv.value[-1]) < PULSE.full_within
    shift = np.where(nodes == 1, 0.0 if full else shift[-1], shift)
    shift = increasing(nodes, ocv.value + shift) - ocv.value
    sd = np.hypot(np.minimum(ocv.sd, np.abs(shift) + 0.003), scatter)
    source = f"{ocv.source}; moved to the rests"
    shifts = np.array([f.shift for f in fitted])
    sds = [
        np.where(f.covered, np.hypot(jackknife(f.shift, f.without[:, :, -1]), f.shift_prior), np.nan) for f in fitted
    ]
    temperature = np.array([t.temperature for t in tests])
    _shift_of_rests(temperature, shifts - shifts[nearest], np.array(sds), nearest, names, result)
    result.curves["battery.ocv"] = Curve({"soc": nodes}, ocv.value + shift, sd, "V", source)


def _shift_of_rests(temperature: Array, shifts: Array, sds: Array, reference: int, names: str, result: Result) -> None:
    """The shift (temperatures,) [V] of the open-circuit voltage, as ``battery.rest_shift``, if it is sure.

    shifts, sds: (temperatures, len(SOC)) [V] against the test `reference`. The mean is over 15 to 95 % SOC; its sd
    holds how it varies there.
    """
    known = [MIDDLE & np.isfinite(sd) for sd in sds]
    if len(temperature) < 2 or not all(map(np.any, known)):
        return
    rows = [(row[k], sd[k]) for row, sd, k in zip(shifts, sds, known, strict=True)]
    mean, sd = np.array([(row.mean(), np.hypot(row.std(), s.mean())) for row, s in rows]).T
    others = np.arange(len(temperature)) != reference
    chance = float(chi2.sf(np.sum((mean[others] / np.maximum(sd[others], 1e-3)) ** 2), len(temperature) - 1))
    moves = ", ".join(
        f"{1e3 * m:+.1f} ± {1e3 * s:.1f} mV at {t:g} degC"
        for t, m, s in zip(temperature[others], mean[others], sd[others], strict=True)
    )
    if chance > 1 - PULSE.rests_confidence:
        result.notes.append(
            f"rests do not move with temperature beyond how they scatter over the state of charge: {moves}; "
            "the open-circuit voltage is one for all temperatures"
        )
        return
    result.notes.append(f"the cell rests {moves} against {temperature[reference]:g} degC")
    source = f"{names}: mean over 15 to 95 % SOC of the rests against those near 25 degC"
    result.curves["battery.rest_shift"] = Curve({"temperature": temperature}, mean, sd, "V", source)


def _slow_relaxation(
    fitted: Sequence[Branches], capacity: float, names: str, result: Result
) -> tuple[float, float] | None:
    """(resistance [ohm], time [s]) of the effect `slow_relaxation`; None, with a note, if the pairs do not show it.

    What relaxes over tens of minutes: diffusion in the particles. It changes little with temperature and, away from
    full and empty, with the state of charge, so that one number replaces each table: the median, as the resistance
    grows steeply where the open-circuit voltage is steep; the fast pair takes the rest.
    """
    slow, logs, c = 1 + np.flatnonzero(PULSE.slow_time < TIMES), np.log(TIMES), PULSE
    tables, times, doubts = [], [], []
    for f in fitted:
        if (counts := f.covered & MIDDLE).any():
            pairs = f.resistance[slow][:, counts]
            ohm, without = pairs.sum(axis=0), f.without[:, :, slow][..., counts].sum(axis=2)
            tables.append(ohm)
            times.append(logs[slow - 1] @ pairs / np.maximum(ohm, np.finfo(float).tiny))
            doubts.append(float(jackknife(np.median(ohm), np.median(without, axis=-1))))
    result.effects[SLOW_RELAXATION] = False
    if not tables:
        return None
    ohm, log = np.concatenate(tables), np.concatenate(times)
    value, doubt = float(np.median(ohm)), float(np.sqrt(np.sum(np.square(doubts)))) / len(doubts)
    if (
        value < c.significance * doubt or value * capacity < PAIR_FIT.voltage_sd
    ):  # at a current of 1 C, more than the fit leaves
        result.notes.append(f"no slow relaxation is told from the rest: {1e3 * value:.2g} ± {1e3 * doubt:.2g} mΩ")
        return None
    seconds = float(np.exp(np.median(log[ohm > 0])))
    longest = " (the longest that is fitted)" if seconds > TIMES[-2] else ""
    result.notes.append(
        f"slow relaxation: {1e3 * value:.3g} ± {1e3 * doubt:.2g} mΩ, {seconds / 60:.0f} min{longest}; by temperature "
        f"{', '.join(f'{1e3 * np.median(x):.3g}' for x in tables)} mΩ"
    )
    spread = float(np.hypot(np.std(log[ohm > 0]), (logs[-1] - logs[-2]) / 2))  # of ln: between two of TIMES
    sds = float(np.hypot(ohm.std(), doubt)), seconds * spread
    source = f"{names}: pairs slower than {c.slow_time:g} s, median over SOC and temperature"
    for parameter, best, sd in zip(slow_effect.PARAMETERS, (value, seconds), sds, strict=True):
        result.parameters[parameter.name] = Found(best, sd, parameter.unit, source)
    result.effects[SLOW_RELAXATION] = True
    return value, seconds


# --- errors of the circuit -----------------------------------------------------------------------------------------


class Residual(NamedTuple):
    """How far a pulse test is off the circuit; arrays (m,)."""

    temperature: float  # degC, nominal
    time: Array  # s
    voltage: Array  # V, measured less the circuit's
    level: Array  # state of charge
    rest: Mask  # where no current flows


def _errors(result: Result, tests: Sequence[Tested], names: str) -> None:
    """How well the circuit follows the tests that it comes from: fits, pictures and ``cell_voltage_error``."""
    cell = circuit(result)
    rms: dict[str, list[float]] = {"above": [], "below": []}  # 0.1 of SOC
    residuals = []
    for t in tests:
        test, at = t.test, f"{t.temperature:g}"
        model = voltage(cell, test.flowed, test.current, test.dt, t.level, test.temperature)
        for name, part in (("above", t.level > PULSE.empty), ("below", t.level <= PULSE.empty)):
            if np.count_nonzero(part) > 20:
                about, data = f"voltage, on board, {at} degC, SOC {name} 0.1", test.voltage[part]
                result.fits.append(score(about, "V", data, model[part], held_out=False, source=test.name))
                rms[name].append(result.fits[-1].rms)
        residuals.append(Residual(t.temperature, test.time, test.voltage - model, t.level, test.rest))
        title = f"Pulse test at {at} °C"
        result.panels += compared(title, "time [h]", "voltage [V]", test.time / HOUR, test.voltage, model)
    voltage_errors(residuals, names, result)
    for parameter, where in (("cell_voltage_error", "above"), ("cell_voltage_error_empty", "below")):
        if rms[where] or where == "above":
            sd, source = float(np.sqrt(np.mean(np.square(rms[where])))), f"rms of the circuit {where} 10 % SOC"
            result.parameters[parameter] = Found(0.0, sd, "V", f"{names}: {source}")


def voltage_errors(residuals: Sequence[Residual], names: str, result: Result) -> None:
    """``battery.voltage_error`` and the mean time, ``cell_voltage_error_time``, into `result`.

    Of the residual over time, not over samples, most of which are in the pulses. Rest and load count the same: a test
    rests nine tenths of its time, a ride does not, and under a load that stays the circuit errs several times as much.
    Also ``voltage_error_time`` over temperature, which no vehicle file gets from here.
    """
    c, rows = PULSE, []
    for r in residuals:
        at = np.arange(r.time[0], r.time[-1], c.grid)
        values, level = (np.interp(at, r.time, x) for x in (r.voltage, r.level))
        values, rest = values[level > c.empty], r.rest[np.searchsorted(r.time, at)][level > c.empty]
        if len(values) > c.longest_error / c.grid:
            size = np.sqrt(np.mean([np.mean(values[part] ** 2) for part in (rest, ~rest) if np.any(part)]))
            rows.append((r.temperature, size, _correlation_time(values), c.grid * len(values)))
    if not rows:
        return
    temperature, sizes, times, lengths = np.array(rows).T
    axes, shares = {"temperature": temperature}, np.sqrt(times / lengths)
    result.curves["battery.voltage_error"] = Curve(
        axes, sizes, sizes * shares, "V", f"{names}: rms of the circuit above 10 % SOC, rest and load alike"
    )
    middle = float(np.exp(np.mean(np.log(times))))
    spread = middle * float(np.std(np.log(times))) if len(rows) > 1 else middle
    source = f"{names}: correlation of what the circuit leaves falls to 1/e"
    result.curves["voltage_error_time"] = Curve(axes, times, times * shares, "s", source)
    result.parameters["cell_voltage_error_time"] = Found(middle, spread, "s", source)


def _correlation_time(values: Array) -> float:
    """The lag [s] at which the correlation of `values`, one each `grid` seconds, falls to 1/e; two steps at least."""
    lags = np.arange(1, int(PULSE.longest_error / PULSE.grid))
    correlation = np.array([np.mean(values[:-k] * values[k:]) for k in lags]) / float(np.mean(values**2))
    below = np.flatnonzero(correlation < np.exp(-1))
    return PULSE.grid * float(max(lags[below[0]], 2)) if len(below) else PULSE.longest_error


def _validate(result: Result, profiles: Sequence[Measurements], capacity: Found) -> None:
    """Scores on road profiles; ``cell_voltage_error`` is theirs if it is larger: no fit has seen them."""
    cell, squares = circuit(result), []
    for table in profiles:
        test, name = cell_test(table), table.file.name
        model, measured = follow_profile(cell, test)
        result.fits.append(score("cell voltage", "V", measured, model, held_out=True, source=name))
        near = float(np.mean(np.abs(model - measured) <= PULSE.profile_volts))
        result.notes.append(f"{name}: {100 * near:.0f} % of the samples within ±{PULSE.profile_volts:g} V")
        squares.append(float(np.mean((model - measured)[test.drawn < 0.9 * capacity.value] ** 2)))
        minutes, title = test.time / 60, f"{name}, held out"
        result.panels += compared(title, "time [min]", "cell voltage [V]", minutes, measured, model)
    error, held_out = result.parameters["cell_voltage_error"], float(np.sqrt(np.mean(squares or [0.0])))
    if held_out > error.sd:
        source = f"{', '.join(table.file.name for table in profiles)}: rms, held out"
        result.parameters["cell_voltage_error"] = replace(error, sd=held_out, source=source)
