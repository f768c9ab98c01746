"""The plant's packs alone, on a steady way: many discharges at once, in steps long enough for a test.

The cells are those of the rides (`cells.py`); the power is that of a speed that rises and falls, with stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from types import SimpleNamespace

import numpy as np

from gz_onboard.arrays import Array
from tests.plant.cells import Cells
from tests.plant.machine import PARALLEL, SERIES, Machine
from tests.plant.ride import Hidden

STEP = 1.0  # s
GIVES_UP = 2.8  # V of the weakest group, in the mean over `FELT`: the controller takes the bursts away before
FELT = 20.0  # s
AUXILIARY = 45.0  # W
CUT = 500.0  # W that regeneration gives back at most


@dataclass(frozen=True)
class Discharge:
    """What happened to one pack, (steps,); of the groups one for each of SERIES, (SERIES, steps)."""

    time: Array  # s
    speed: Array  # m/s
    way: Array  # m
    voltage: Array  # V, current [A]: of the pack
    current: Array
    soc: Array  # of the mean cell
    groups: Array  # V
    temperature: float  # degC


def speeds(steps: int, seed: int) -> Array:
    """A speed [m/s] for each step: between 6 and 13 m/s, with a stop every few minutes."""
    rng, wish, v = np.random.default_rng([seed, 101]), 10.0, 0.0
    found, until, stands = np.zeros(steps), 0.0, True
    for i in range(steps):
        if i * STEP >= until:
            stands = not stands and rng.random() < 0.25
            wish = 0.0 if stands else rng.uniform(6.0, 13.0)
            until = i * STEP + (rng.uniform(8, 25) if stands else rng.uniform(15, 70))
        v += STEP * float(np.clip(0.5 * (wish - v), -1.2, 1.0))
        found[i] = v
    return found


def discharge(packs: Sequence[Hidden], seed: int, soc: float = 1.0, temperature: float = 18.0) -> list[Discharge]:
    """Each of `packs` on the same way from `soc` until its weakest group gives up, after a rest of a minute."""
    machine = Machine()
    n, steps = len(packs), 20_000
    m = SimpleNamespace(**{f.name: np.full(n, getattr(machine, f.name)) for f in fields(Machine)})
    h = SimpleNamespace(**{f.name: np.array([float(getattr(x, f.name)) for x in packs]) for f in fields(Hidden)})
    more = {"capacity_factor": h.weak_capacity, "resistance_factor": h.weak_resistance}
    weak_h = SimpleNamespace(**{**vars(h), **{name: getattr(h, name) * x for name, x in more.items()}})
    weak_soc = 1 - h.weak_charge - (1 - soc) / h.weak_capacity  # full together, but for its charge
    cells, weak = Cells(m, h, np.full(n, soc), STEP), Cells(m, weak_h, weak_soc, STEP)
    speed = np.concatenate((np.zeros(round(60 / STEP)), speeds(steps, seed)))[:steps]
    acceleration = np.gradient(speed, STEP)
    power = speed * (200 * acceleration + 27 + 0.36 * speed**2) * np.where(acceleration > -0.2, 1.15, 0.4)
    power = np.maximum(power, -CUT) + AUXILIARY
    core, felt, ends = np.full(n, temperature), np.full(n, 4.0), np.full(n, steps)
    rows = np.zeros((steps, 4, n))
    for i in range(steps):
        (one, instant), (other, other_instant) = cells.source(core), weak.source(core)
        emf = (SERIES - 1) * one + other
        inside = ((SERIES - 1) * instant + other_instant) / PARALLEL + machine.series_resistance
        current = 2 * power[i] / (emf + np.sqrt(np.maximum(emf**2 - 4 * inside * power[i], 1.0)))
        cell = current / PARALLEL
        rows[i] = emf - inside * current, current, cells.soc, other - other_instant * cell
        cells.flow(cell, core)
        weak.flow(cell, core)
        felt = felt + STEP / FELT * (np.minimum(rows[i, 3], one - instant * cell) - felt)
        ends = np.where((felt < GIVES_UP) & (ends == steps), i, ends)
        if (ends < steps).all():
            break
    way = np.cumsum(speed) * STEP
    found = []
    for k, end in enumerate(ends):
        voltage, current, mean, group = rows[:end, :, k].T
        others = (voltage + machine.series_resistance * current - group) / (SERIES - 1)
        groups = np.vstack((group, np.repeat(others[None], SERIES - 1, axis=0)))
        time = STEP * np.arange(end)
        found.append(Discharge(time, speed[:end], way[:end], voltage, current, mean, groups, temperature))
    return found
