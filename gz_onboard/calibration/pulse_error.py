"""How far the circuit that was found is off the pulse tests, by temperature, and for how long it errs the same way.

Of the residual over time, not over samples, of which most are in the pulses. Rest and load count the same: a test rests
nine tenths of its time, a ride does not, and under a load that stays the circuit errs several times as much. What
changes with the load the filter reckons with beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.calibration.result import Curve, Found, Result
from gz_onboard.offline.series import relaxation

GRID = 10.0  # s: between the values whose square and correlation are taken
EMPTY = 0.1  # SOC up to which `cell_voltage_error_empty` counts
LONGEST = 3600.0  # s: beyond, two residuals have nothing to do with each other
SLOW_TIMES = 600.0 * 2.0 ** np.arange(0, 4.5, 0.5)
"""From what pulse tests with rests of tens of minutes still show, to over two hours [s]."""
LEAST_TIME = 2 * GRID  # s: no shorter time can be told


class Residual(NamedTuple):
    """What a pulse test is off the circuit; arrays (m,)."""

    temperature: float  # degC, nominal
    time: Array  # s
    voltage: Array  # V, measured less the circuit's
    level: Array  # state of charge
    rest: Mask  # where no current flows


def voltage_errors(residuals: Sequence[Residual], names: str, result: Result) -> None:
    """``battery.voltage_error`` and the mean time, ``cell_voltage_error_time``, into `result`.

    Beside them ``voltage_error_time`` over temperature, which no vehicle file gets from here.
    """
    found = [(r.temperature, *_evenly(r)) for r in residuals]
    known = [(at, left, rest) for at, left, rest in found if len(left) > LONGEST / GRID]
    if not known:
        return
    sizes = np.array([_size(left, rest) for _, left, rest in known])
    times = np.array([_correlation_time(left) for _, left, _ in known])
    axes = {"temperature": np.array([at for at, _, _ in known])}
    shares = np.sqrt(times / np.array([GRID * len(left) for _, left, _ in known]))
    result.curves["battery.voltage_error"] = Curve(
        axes, sizes, sizes * shares, "V", f"{names}: rms of the circuit above 10 % SOC, rest and load alike"
    )
    middle = float(np.exp(np.mean(np.log(times))))
    spread = middle * float(np.std(np.log(times))) if len(known) > 1 else middle
    source = f"{names}: correlation of what the circuit leaves falls to 1/e"
    result.curves["voltage_error_time"] = Curve(axes, times, times * shares, "s", source)
    result.parameters["cell_voltage_error_time"] = Found(middle, spread, "s", source)


class SlowPair(NamedTuple):
    """What a pair slower than those of the circuit would explain of a profile, found on its first half."""

    resistance: float  # ohm
    time: float  # s
    without: float  # V, the largest residual of the second half
    largest: float  # V, with the pair

    def words(self) -> str:
        """As a note says it."""
        return (
            f"a further pair of {1e3 * self.resistance:.0f} mΩ and {self.time / 60:.0f} min, found on the first half, "
            f"leaves {1e3 * self.largest:.0f} mV at most on the second; without it {1e3 * self.without:.0f} mV"
        )


def slow_pair(flowed: Array, dt: Array, left: Array) -> SlowPair:
    """Of the residual `left` [V] (measured less the circuit's) under the mean currents `flowed` [A] over `dt` [s]."""
    half = len(left) // 2
    best: tuple[float, SlowPair] | None = None
    for time in SLOW_TIMES:
        columns = np.column_stack([-relaxation(flowed, np.exp(-dt / time), before=False), np.ones(len(left))])
        found, *_ = np.linalg.lstsq(columns[:half], left[:half], rcond=None)
        rest = left - columns @ found
        sizes = float(np.max(np.abs(left[half:]))), float(np.max(np.abs(rest[half:])))
        cost = float(np.sum(rest[:half] ** 2))
        if best is None or cost < best[0]:
            best = cost, SlowPair(float(found[0]), time, *sizes)
    assert best
    return best[1]


def _evenly(residual: Residual) -> tuple[Array, Mask]:
    """The residual each `GRID` seconds, above `EMPTY`, and where the cell rests."""
    at = np.arange(residual.time[0], residual.time[-1], GRID)
    values, level = (np.interp(at, residual.time, x) for x in (residual.voltage, residual.level))
    rest = residual.rest[np.searchsorted(residual.time, at)]
    return values[level > EMPTY], rest[level > EMPTY]


def _size(values: Array, rest: Mask) -> float:
    """The rms of `values`, those at rest and those under load counted alike."""
    return float(np.sqrt(np.mean([np.mean(values[part] ** 2) for part in (rest, ~rest) if np.any(part)])))


def _correlation_time(values: Array) -> float:
    """The lag [s] at which the correlation of `values`, one each `GRID` seconds, falls to 1/e."""
    lags = np.arange(1, int(LONGEST / GRID))
    square = float(np.mean(values**2))
    correlation = np.array([np.mean(values[:-k] * values[k:]) for k in lags]) / square
    below = np.flatnonzero(correlation < np.exp(-1))
    return float(max(GRID * lags[below[0]], LEAST_TIME)) if len(below) else LONGEST
