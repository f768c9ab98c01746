"""A simulated cell on a simulated tester: other code than the calibration's, one or more RC pairs, its own curve."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from gz_onboard.calibration.cell import open_circuit
from gz_onboard.calibration.table import Measurements


@dataclass
class Plant:
    """V = ocv(soc) - r0·I - Σ v, each v' = (r·I - v)/tau; resistances grow by `cold` and ocv falls by `rest` per K
    below 25 degC.

    What a tester and a cell do that no model says: the current is measured wrong by `gain`, and the resistances of each
    pulse with its rest differ by `scatter` from those of the next, and so, by themselves, do its times, all relative.
    """

    capacity: float = 2.5
    r0: float = 0.05
    pairs: tuple[tuple[float, float], ...] = ((0.03, 30.0),)  # ohm, s
    cold: float = 0.04
    rest: float = 0.0  # V/K
    hysteresis: float = 0.0  # V: half the gap of the curves
    noise: float = 0.0005
    gain: float = 0.0
    scatter: float = 0.0
    seed: int = 0
    soc: float = 1.0
    state: list[float] = field(default_factory=list)
    reaction: float = 0.0  # ohm at 25 degC and no current: of charge transfer beside a double layer,
    activation: float = 4500.0  # K, of it
    layer: float = 3.0  # s: resistance times the double layer's capacity; 0: none
    eta: float = 0.0  # V

    def charged(self, current, dt, temperature):
        """The double layer's voltage [V] after `dt` [s]: τ·η' = R·I - U·sinh(η/U), U = 2RT/F."""
        u = 1.7234e-4 * (temperature + 273.15)
        r = self.reaction * np.exp(self.activation * (1 / (temperature + 273.15) - 1 / 298.15))
        if dt > 30 or not self.layer:
            self.eta = u * np.arcsinh(r * current / u)
            return self.eta
        n = int(np.ceil(dt / 0.05))
        for _ in range(n):
            self.eta += dt / n / self.layer * (r * current - u * np.sinh(self.eta / u))
        return self.eta

    def ocv(self, soc):
        return 3.35 + 0.75 * soc + 0.1 * np.exp(-(((soc - 0.95) / 0.08) ** 2)) - 0.5 * np.exp(-soc / 0.03)

    def run(self, pieces, temperature=25.0, name="cell.csv"):
        """pieces: (current, seconds, step); a sample 0.1 s after each change, then each `step`."""
        rng, times = np.random.default_rng(self.seed), np.random.default_rng((self.seed, 1))
        slower = 1.0
        factor = usual = np.exp(self.cold * (25 - temperature))
        self.state = [0.0] * len(self.pairs)
        lower = self.rest * (25 - temperature)
        now, rows, side = 0.0, [(0.0, 0.0, float(self.ocv(self.soc)) - lower)], -1.0
        for current, seconds, step in pieces:
            for dt in [0.1, *[step] * round(seconds / step)]:
                now += dt
                self.soc -= current * dt / 3600 / self.capacity
                if current and dt == 0.1:
                    factor = usual * (1 + self.scatter * rng.normal())
                    slower = 1 + self.scatter * times.normal()
                if current:
                    side = np.sign(current)
                for k, (r, tau) in enumerate(self.pairs):
                    a = np.exp(-dt / tau / slower)
                    self.state[k] = a * self.state[k] + (1 - a) * r * factor * current
                volts = (-self.charged(current, dt, temperature) if self.reaction else 0.0) + (
                    self.ocv(self.soc) - lower - self.r0 * factor * current - sum(self.state) - side * self.hysteresis
                )
                rows.append((now, current, volts))
        time, current, volts = (np.array(c) for c in zip(*rows, strict=True))
        size = len(time)
        volts = volts + rng.normal(0, self.noise, size)
        columns = {
            "time": time,
            "current": current * (1 + self.gain),
            "voltage": volts,
            "cell_temperature": np.full(size, float(temperature)) + rng.normal(0, 0.05, size),
        }
        return Measurements(Path(name), columns)


def slow_test(charge=1.0, hours=20, **plant):
    """Full, rest, discharge in `hours`, rest, and `charge` times of it back."""
    cell = Plant(**plant)
    current, seconds = cell.capacity / hours, hours * 3600
    pieces: list[tuple[float, float, float]] = [(0.0, 600, 60), (current, seconds, 60), (0.0, 3600, 60)]
    if charge:
        pieces += [(-current, seconds * charge, 60), (0.0, 600, 60)]
    return cell.run(pieces, name="ocv.csv"), cell


@cache
def slow_curve():
    """Open-circuit voltage and capacity that the slow test of a `Plant` gives."""
    result = open_circuit(slow_test()[0])
    return result.curves["battery.ocv"], result.parameters["cell_capacity"]


def changed(table, **columns):
    """`table` with columns changed by functions of themselves."""
    new = {name: change(table.columns[name].copy()) for name, change in columns.items()}
    return replace(table, columns={**table.columns, **new})


def pulse_pieces(capacity=2.5, levels=10, sizes=(1.0, 2.5, 5.0)):
    """At each of `levels` states: pulses of both signs, 0.5 s samples after a step, then a step of SOC and a rest."""
    pieces: list[tuple[float, float, float]] = [(0.0, 1500, 10)]
    for k in range(levels):
        for size in sizes:
            for sign in (1, -1) if k else (1,):
                pieces += [(sign * size, 30, 0.5), (0.0, 10, 0.5), (0.0, 110, 5)]
        down = capacity / levels * 3600 * 0.95 / 1.25 - (0 if k else 30 * sum(sizes) / 1.25)
        pieces += [(1.25, 5 * round(down / 5), 5), (0.0, 1500, 10)]
    return pieces


def pulse_test(temperature=25.0, levels=10, **plant):
    cell = Plant(**plant)
    return cell.run(pulse_pieces(cell.capacity, levels), temperature, f"pulse_{temperature:g}C.csv"), cell


# As the pulse test of the bench cell shows at 25 degC; no time is one of those that the calibration uses.
MANY = ((0.007, 2.4), (0.008, 24.0), (0.010, 70.0), (0.014, 1200.0))
# A strong slow pair: the one nearest to all, of some 106 s, is none of them.
SLOW = ((0.008, 0.6), (0.012, 9.0), (0.012, 90.0), (0.030, 900.0))


def nearest_pair(pairs, r0, loads, beside=()):
    """(R0, R1 [ohm], C1 [F]) of the one pair nearest, in least squares under `loads` of one value a second, to what a
    cell of `r0` and `pairs` answers: each time constant tried, the rest solved for. beside: pairs that are given."""
    current = np.concatenate(loads)

    def relaxed(tau):
        a = np.exp(-1 / tau)
        return np.concatenate([lfilter([1 - a], [1, -a], load) for load in loads])

    volts = r0 * current + sum(r * relaxed(tau) for r, tau in pairs) - sum(r * relaxed(tau) for r, tau in beside)

    def solved(tau):
        columns = np.column_stack([current, relaxed(tau)])
        found, left, *_ = np.linalg.lstsq(columns, volts, rcond=None)
        return float(left[0]), found[0], found[1], tau / found[1]

    return min(solved(tau) for tau in np.geomspace(3, 300, 600))[1:]
