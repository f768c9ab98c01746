"""A ride on a grid of one second, and how two signals of it compare."""

from __future__ import annotations

from math import copysign

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.can.mapping import UNITS, known_units, to_si
from gz_onboard.discovery.grid import averaged, delays, measured
from gz_onboard.recording.recording import Recording
from gz_onboard.recording.sensors import true_columns
from gz_onboard.vehicle import Vehicle

SECOND = 1.0  # s, spacing of the grid, and span of the mean at each point
FEWEST = 30  # points that two signals must have together before they say anything of each other
ALIKE = 0.06  # relative: a ratio that is so near that of two units is theirs
RARER = 0.02  # relative: so much nearer it must be to a power of ten, or to two units that are both not of SI


def seconds_of(samples: Recording, vehicle: Vehicle) -> dict[str, Array]:
    """The signals of a ride by role, each (n,) on the grid, nan where it was not measured.

    Delays and errors of the sensors that the file knows are taken off; roles without a value are left out.
    """
    columns = true_columns(samples.columns, vehicle.parameters)
    late = delays(vehicle)
    start = min(times[0] for times, _ in columns.values())
    end = max(times[-1] for times, _ in columns.values())
    grid = np.arange(start + SECOND, end - SECOND, SECOND)
    found = {}
    for role, (times, values) in columns.items():
        at = grid + late.get(role, 0.0)
        turned = np.unwrap(values) if role == "gps_course" else values
        on_grid = np.where(measured(times, at), averaged(times, turned, at, SECOND), np.nan)
        if np.isfinite(on_grid).any():
            found[role] = on_grid
    return found


def rate(values: Array) -> Array:
    """Return the change of `values` (n,) each second; 0 of a single one."""
    return np.gradient(values, SECOND) if len(values) > 1 else np.zeros_like(values)


def change(values: Array) -> Array:
    """Return the difference (n,) of `values` (n,) to the second before; nan in the first."""
    return np.diff(values, prepend=np.nan)


def relation(x: Array, y: Array, where: Mask | None = None) -> tuple[float, float] | None:
    """How `y` goes with `x`, both (n,), `where` (n,) if given: (ratio of their spreads, correlation).

    The ratio has the sign of the correlation. None if there are too few points, or one never moves.
    """
    known = np.isfinite(x) & np.isfinite(y)
    known = known & where if where is not None else known
    if known.sum() < FEWEST:
        return None
    a, b = x[known] - x[known].mean(), y[known] - y[known].mean()
    width, height = float(np.sqrt(np.mean(a * a))), float(np.sqrt(np.mean(b * b)))
    if width < 1e-9 or height < 1e-9:
        return None
    correlation = float(np.mean(a * b)) / (width * height)
    return copysign(height / width, correlation), correlation


def unit_of(role: str, ratio: float, alike: float = ALIKE) -> str:
    """Name the units that were mistaken if a signal is `ratio` times its right size; empty if none fits.

    A signal in km/h that is taken for m/s is 3.6 times too large. alike: tolerance of the ratio, relative. Units that
    are both not of SI, and powers of ten, must fit better by `RARER`.
    """
    scales = {unit: (to_si(unit, role) or (1.0, 0.0))[0] for unit in known_units(role)}
    off = {
        f": that is {meant} taken for {read}": abs(ratio * scales[meant] / scales[read] - 1)
        + (RARER if UNITS[role] not in (read, meant) else 0.0)
        for read in scales
        for meant in scales
        if scales[read] != scales[meant]
    }
    for power in (1000.0, 100.0, 10.0):
        text = f": a factor of {power:g}, as of a wrong scale in the DBC file"
        off[text] = min(abs(ratio / power - 1), abs(ratio * power - 1)) + RARER
    nearest = min(off, key=lambda text: off[text])
    return nearest if off[nearest] < alike else ""
