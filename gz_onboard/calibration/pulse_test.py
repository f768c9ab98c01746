"""Pulse tests with their state of charge, each the pieces that `cell_fit` takes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from gz_onboard.arrays import Array
from gz_onboard.calibration.cell_data import CellTest, cell_test
from gz_onboard.calibration.cell_fit import LEAST, Pieces, filtered, fit_branches, pieces
from gz_onboard.calibration.ocv import FLAT
from gz_onboard.calibration.result import Curve, Fit, Found, Result
from gz_onboard.calibration.table import Measurements
from gz_onboard.constants import BENCH_TEMPERATURE, KELVIN
from gz_onboard.offline.series import extended_over

FEWEST_PULSES = 6
FEWEST_LEVELS = 3
MOST_DRAWN = 1.3  # of the capacity of the slow test: what no cell like that holds
UNTOLD = 0.03  # relative sd of a capacity that the rests do not tell: they lie where the OCV is flat
TAKEN = 0.1  # relative sd of the slow test's capacity where it is taken for another temperature
APART = 0.03  # relative: how far the capacities of a pulse test and a slow test may differ unsaid
REST = 1200.0  # s without current, after which a voltage is that of rest
FULL_WITHIN = 0.03  # V: a first voltage so near to the full cell's is that of a full cell


@dataclass(frozen=True)
class Tested:
    """A pulse test with its state of charge."""

    test: CellTest
    temperature: float  # degC, nominal
    capacity: float  # A·h between full and empty
    capacity_sd: float
    level: Array
    rests: NDArray[np.int_]  # rows at the ends of rests


def tested(table: Measurements, ocv: Curve, capacity: Found, result: Result) -> Tested:
    """`table` with its capacity: the one with which its rest voltages lie best on the OCV above 10 % SOC."""
    test, nodes, volts = cell_test(table), ocv.axes["soc"], ocv.value
    if not test.rest[0]:
        raise table.error(
            f"begins under a current of {test.current[0]:.3g} A: its first voltage must be one at rest", 0
        )
    rests = _long_rests(test, capacity)
    start = 1.0
    if test.voltage[0] < volts[-1] - FULL_WITHIN:
        start = float(np.interp(test.voltage[0], volts, nodes))
        if np.interp(start, nodes, ocv.sd / np.gradient(volts, nodes)) > FLAT:
            raise table.error(
                f"begins at {test.voltage[0]:.3f} V, not full and where the open-circuit voltage is flat: how much "
                "charge it holds is not known; let it begin full"
            )
        result.notes.append(f"{test.name}: begins at {test.voltage[0]:.3f} V, SOC {start:.3f}, not full")
    drawn, at_rest = test.drawn[rests], test.voltage[rests]

    def misses(share: float) -> Array:
        """What the rests lie off the OCV [V], those above 0.12 of SOC and less their common offset."""
        level = start - drawn / (share * capacity.value)
        error = at_rest - extended_over(nodes, volts, level)
        weight = np.where(level > 0.12, 1.0, 0.0)
        offset = float(np.sum(weight * error) / (np.sum(weight) + 1.0))  # prior: 5 mV, as one rest counts
        return np.asarray(np.sqrt(weight) * (error - offset))

    best = minimize_scalar(lambda x: float(np.sum(misses(x) ** 2)), bounds=(0.6, 1.15), method="bounded")
    share = float(best.x)
    error = misses(share)
    curvature = (np.sum((misses(share + 1e-3) - error) ** 2)) / 1e-6
    sd = float(np.sqrt(max(np.sum(error**2) / max(len(error) - 2, 1), 1e-6) / max(curvature, 1e-12)))
    temperature = float(np.round(np.median(test.temperature[rests]))) + 0.0  # no -0
    if sd > UNTOLD:
        result.refusals.append(
            f"{test.name}: the rests at {temperature:g} degC lie where the open-circuit voltage is flat and do not "
            f"tell the capacity (± {100 * sd:.0f} %): that of the slow test is taken, ± {100 * TAKEN:.0f} %"
        )
        share, sd = max(1.0, float(drawn.max()) / (start * capacity.value)), TAKEN
    found = share * capacity.value
    what, rms = f"rest voltage at {temperature:g} degC, SOC above 0.12", float(np.sqrt(np.mean(error**2)))
    result.fits.append(Fit(what, "V", rms, float(np.abs(error).max()), None, len(error), False, test.name))
    found_sd = float(np.hypot(sd * capacity.value, 0.005 * found))
    return Tested(test, temperature, found, found_sd, start - test.drawn / found, rests)


def _long_rests(test: CellTest, capacity: Found) -> NDArray[np.int_]:
    """The rows at the ends of rests of `REST` or longer; InputError for too few pulses, or too narrow a range."""
    table, pulses = test.table, int(test.block[-1])
    if pulses < FEWEST_PULSES:
        raise table.error(f"has {pulses} pulses; at least {FEWEST_PULSES} are needed")
    ends = np.flatnonzero(test.rest & ~np.concatenate([test.rest[1:], [False]]))
    rests: NDArray[np.int_] = ends[np.array([test.rested(int(k)) >= REST for k in ends])]
    used = float(test.drawn.max() - test.drawn.min())
    levels = np.unique(np.round(test.drawn[rests] / max(used, 1e-9) * 50))
    if len(levels) < FEWEST_LEVELS:
        raise table.error(
            f"rests of {REST / 60:.0f} min at {len(levels)} states of charge; at least {FEWEST_LEVELS} are needed"
        )
    if used > MOST_DRAWN * capacity.value:
        raise table.error(
            f"draws {used:.3f} of {capacity.value:.3f} A·h: more than the cell holds. Is it the cell of the slow test, "
            "and the current in A?"
        )
    if used < 0.5 * capacity.value:
        raise table.error(
            f"draws {used:.3f} of {capacity.value:.3f} A·h: pulses over at least half of the range of SOC are needed"
        )
    return rests


def nearest_to_bench(tests: list[Tested]) -> int:
    """Which of the tests is nearest to the temperature at which capacities are given."""
    return min(range(len(tests)), key=lambda k: abs(tests[k].temperature - BENCH_TEMPERATURE))


def moved_pieces(
    tests: list[Tested], nodes: Array, volts: Array, soc: Array
) -> tuple[list[Pieces], list[tuple[float, float]]]:
    """Every test's pieces, moved to its nominal temperature by the activation seen between the tests, and that."""
    relaxing = [filtered(t.test) for t in tests]

    def split(activation: list[tuple[float, float]]) -> list[Pieces]:
        return [
            pieces(t.test, t.level, ocv_and_slope(nodes, volts, t.level), soc, t.temperature, x, a)
            for t, x, a in zip(tests, relaxing, activation, strict=True)
        ]

    activation = [(0.0, 0.0)] * len(tests)
    if len(tests) == 1:
        return split(activation), activation
    fitted = [fit_branches(x) for x in split(activation)]
    middle = (soc > 0.15) & (soc < 0.95)
    inverse = np.array([1 / (t.temperature + KELVIN) for t in tests])
    slopes = []
    for part in (slice(0, 1), slice(1, None)):
        size = np.array([np.median(np.sum(f.resistance[part][:, middle], axis=0)) for f in fitted])
        seen = size.min() > LEAST  # charge transfer may leave nothing of R0, whose activation nobody sees then
        slopes.append(np.clip(np.gradient(np.log(size), inverse), 0, 8000) if seen else np.zeros(len(size)))
    activation = [(float(a), float(b)) for a, b in zip(*slopes, strict=True)]
    return split(activation), activation


def ocv_and_slope(nodes: Array, volts: Array, level: Array) -> tuple[Array, Array]:
    """The open-circuit voltage [V] and its slope [V] over SOC, at `level`, each (m,)."""
    up, down = extended_over(nodes, volts, level + 0.005), extended_over(nodes, volts, level - 0.005)
    return extended_over(nodes, volts, level), (up - down) / 0.01
