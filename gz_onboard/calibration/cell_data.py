"""A cell's bench test as taken from a table, checked: what all procedures on cells begin with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gz_onboard.arrays import Array
from gz_onboard.calibration.table import Measurements
from gz_onboard.constants import HOUR
from gz_onboard.model.tables import LIMITS

FEWEST = 50  # samples
VOLTAGE = (0.2, 6.0)  # V: of one cell of any chemistry, under any load
SHORTEST = 600.0  # s: no test of a cell is shorter
LONGEST_GAP = 150.0  # s between samples while a current flows
STEP = 0.1  # of the largest current: what counts as switching it
REST_CURRENT = 0.02  # of the largest current: up to it the cell rests
EDGE_STEP = 0.2  # of the largest current: a step whose voltage shows the sign
EQUAL, REGULAR = 0.02, 0.99  # relative: times between samples that are alike; the share of them in a regular record
SAMPLED, GAP = 0.3, 5.0  # s: quicker samples show a switch by themselves; over longer ones the counter counts


@dataclass(frozen=True)
class CellTest:
    """One test of one cell.

    All (m,): time [s], dt [s] before each sample, flowed [A]: the mean current over that dt, current [A] at the sample,
    voltage [V], temperature [degC], drawn [A·h] since the first sample. block: number of the pulse with the rest after
    it, 0 before the first; rest: True where no current flows.
    """

    table: Measurements
    time: Array
    dt: Array
    flowed: Array
    current: Array
    voltage: Array
    temperature: Array
    drawn: Array
    block: NDArray[np.int_]
    rest: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.time)

    @property
    def name(self) -> str:
        """The file's name."""
        return self.table.file.name

    def rested(self, row: int) -> float:
        """How long [s] no current has flowed at `row`; below zero while one flows."""
        moving = np.flatnonzero(~self.rest[: row + 1])
        return float(self.time[row] - self.time[min(moving[-1] + 1, len(self) - 1) if len(moving) else 0])


def cell_test(table: Measurements) -> CellTest:
    """The test in `table`: columns time, current, voltage, cell_temperature and, where it has one, charge.

    ``charge`` [A·h] is the tester's own counter, of either sign; with it a gap in the samples does no harm. Raises
    InputError, with the line: missing columns, too few samples, values that no cell has, a gap while a current flows, a
    current of the wrong sign, a voltage that is clipped.
    """
    time, current, volts = table["time"], table["current"], table["voltage"]
    temperature = table["cell_temperature"]
    if len(time) < FEWEST:
        raise table.error(f"{len(time)} samples are too few for a test of a cell, at least {FEWEST} are needed")
    _check_units(table)
    largest = float(np.max(np.abs(current)))
    if largest < 1e-3:
        raise table.error(f"no current flows: the largest is {largest:g} A")
    dt = np.diff(time, prepend=time[0])
    before = np.concatenate([current[:1], current[:-1]])
    # A tester writes a sample when it switches: until then the current before it flowed. A record at equal times knows
    # of no switch: taking its large steps so and its small ones not would count a road profile 2 % wrong.
    switched = (np.abs(current - before) > STEP * largest) & ~_regular(dt[1:])
    flowed = np.where(switched & (dt > SAMPLED), before, (before + current) / 2)
    on = np.abs(current) > REST_CURRENT * largest
    if "charge" in table:
        counter = table["charge"] - table["charge"][0]
        sign = 1.0 if float(np.dot(np.diff(counter), flowed[1:])) >= 0 else -1.0
        drawn = sign * counter
        long = dt > GAP
        flowed = np.where(long, np.diff(drawn, prepend=0.0) * HOUR / np.where(dt > 0, dt, 1.0), flowed)
    else:
        gap = (dt > LONGEST_GAP) & (on | np.concatenate([on[:1], on[:-1]]))
        if np.any(gap):
            row = int(np.flatnonzero(gap)[0])
            raise table.error(
                f"a gap of {dt[row]:.0f} s while a current of {before[row]:.3g} A flows: what was drawn "
                "meanwhile is not known; a column 'charge' (the tester's counter, Ah) would tell",
                row,
            )
        drawn = np.cumsum(flowed * dt) / HOUR
    _check_sign(table, current, volts, dt, drawn, largest)
    _check_clipped(table, current, volts, on)
    starts = on & ~np.concatenate([[False], on[:-1]])
    return CellTest(table, time, dt, flowed, current, volts, temperature, drawn, np.cumsum(starts), ~on)


def _regular(dt: Array) -> bool:
    """Whether samples come at equal times, but for a few that are missing."""
    return float(np.mean(np.abs(dt / np.median(dt) - 1) < EQUAL)) > REGULAR


def _check_units(table: Measurements) -> None:
    """What no cell has is a wrong unit, a pack, or a sample that was lost."""
    for name, unit, (low, high) in (("voltage", "V", VOLTAGE), ("cell_temperature", "degC", LIMITS.temperature)):
        outside = np.flatnonzero((table[name] < low) | (table[name] > high))
        if len(outside):
            row, more = int(outside[0]), f" (and at {len(outside) - 1} more samples)" if len(outside) > 1 else ""
            raise table.error(
                f"{name} is {table[name][row]:g} {unit}, not {low:g} to {high:g} {unit} as of one cell{more}", row
            )
    if (duration := float(np.ptp(table["time"]))) < SHORTEST:
        raise table.error(f"is {duration:.3g} s long; a test of a cell takes {SHORTEST:g} s or more. Is time in s?")


def _check_sign(table: Measurements, current: Array, volts: Array, dt: Array, drawn: Array, largest: float) -> None:
    """Discharging must lower the voltage: at once at the steps of the current, or by and by if those are lost in noise.

    drawn: the charge [Ah] at each sample, positive when discharging.
    """
    step, change = np.diff(current), np.diff(volts)
    steps = (np.abs(step) > EDGE_STEP * largest) & (dt[1:] < LONGEST_GAP)
    jumps = change[steps] * np.sign(step[steps])
    noise = 1.4826 * float(np.median(np.abs(change - np.median(change))))  # as an sd (Hampel 1974)
    if jumps.size and abs(float(np.median(jumps))) > 4 * noise / np.sqrt(jumps.size):
        if float(np.median(jumps)) > 0:
            row = int(np.flatnonzero(steps)[jumps > 0][0]) + 1
            way = "rises" if change[row - 1] > 0 else "falls"
            raise table.error(
                f"the voltage {way} by {abs(change[row - 1]):.3g} V as the current goes from {current[row - 1]:.3g} to "
                f"{current[row]:.3g} A, and so at most steps: discharging must be positive (scale = -1 turns it)",
                row,
            )
    elif float(np.dot(drawn - drawn.mean(), volts - volts.mean())) > 0:
        raise table.error(
            "the voltage rises as charge is drawn, and falls as it is charged: discharging must be positive "
            "(scale = -1 turns it)"
        )


def _check_clipped(table: Measurements, current: Array, volts: Array, on: NDArray[np.bool_]) -> None:
    """A voltage that stays at its own largest or least value while the current does not is the instrument's limit.

    Holding a voltage with a falling current is not: then the current moves slowly, and changes from sample to sample.
    """
    for edge, word in ((float(volts.max()), "largest"), (float(volts.min()), "least")):
        stuck = (volts == edge) & on
        steady = stuck[1:] & stuck[:-1] & (np.abs(np.diff(current)) < 1e-3 * np.max(np.abs(current)))
        if np.count_nonzero(steady) > 10:
            row = int(np.flatnonzero(steady)[0]) + 1
            raise table.error(
                f"the voltage stays at {edge:g} V, its {word}, for {np.count_nonzero(steady)} samples of constant "
                f"current ({current[row]:.3g} A): it is clipped",
                row,
            )
