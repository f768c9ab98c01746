"""The plant's cell: particles that are emptier at their surface than inside, two electrodes, several delays.

One array element for each ride, as in `ride.py`. A pack is the mean cell, and perhaps one group that is weaker.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy.interpolate import PchipInterpolator

from gz_onboard.arrays import Array
from tests.plant.machine import OCV_POINTS

KELVIN = 273.15
EMPTIEST = -0.02  # SOC down to which the voltage falls on
GAS, FARADAY = 8.314, 96485.0


def curve() -> tuple[Array, int]:
    """The open-circuit voltage [V] at so many equal steps of SOC, and their number."""
    soc, volts = zip(*OCV_POINTS, strict=True)
    count = 4000
    return PchipInterpolator(soc, volts)(np.linspace(0, 1, count + 1)), count


class Cells:
    """One cell of each ride. `m`, `h`: what the machines are made of and what is wrong, as arrays (rides,)."""

    def __init__(self, m: SimpleNamespace, h: SimpleNamespace, soc: Array, step: float) -> None:
        n = len(soc)
        self._m, self._h, self._step = m, h, step
        self._ocv, self._count = curve()
        self._keep, self._deplete_keep = (
            np.exp(-step / np.array(taus)[:, None]) for taus in ((6.0, 45.0), (45.0, 300.0, 1800.0))
        )
        self._slow_keep = np.exp(-step / h.slow_time)
        self._layer = np.exp(-step / np.stack([m.cathode_layer, m.anode_layer]))
        self.soc = soc
        self._reaction = np.zeros((2, n))
        self._branch, self._depleted = np.zeros((2, n)), np.zeros((3, n))
        self._slow, self._memory, self._hidden_memory = np.zeros(n), m.hysteresis * 0.5, np.zeros(n)

    def source(self, core: Array) -> tuple[Array, Array]:
        """(voltage without current now [V], ohm that act at once) at `core` [degC]."""
        m, h, soc = self._m, self._h, self.soc
        self._kelvin = core + KELVIN
        self._cold = 1 / self._kelvin - 1 / 298.15
        self._ends = 1 + 0.22 * np.exp(-np.maximum(soc, 0) / 0.06) + 0.35 * (soc - 0.45) ** 2
        ohmic = m.ohmic * np.exp(1100 * self._cold) * self._ends
        film = m.film * np.exp(4300 * self._cold) * self._ends
        # the surface, which the voltage follows: on a steep curve it falls much sooner
        self._surface = soc - self._depleted.sum(axis=0)
        source_soc = np.clip(self._surface, 0, 1) * self._count
        low = np.minimum(source_soc.astype(int), self._count - 1)
        self._steepness = self._ocv[low + 1] - self._ocv[low]
        rest = self._ocv[low] + (source_soc - low) * self._steepness + m.ocv_shift
        rest = rest + m.ocv_wave * np.sin(9 * soc + m.ocv_phase) + 2.0 * np.clip(self._surface, EMPTIEST, 0)
        window = h.window_resistance * np.exp(-0.5 * ((soc - h.window_soc) / 0.03) ** 2)
        self._instant = (ohmic + film) * h.resistance_factor + window
        self._lag = self._branch.sum(axis=0) + self._reaction.sum(axis=0) + self._slow + self._memory
        self._lag = self._lag + self._hidden_memory
        return rest - self._lag, self._instant

    def flow(self, current: Array, core: Array) -> Array:
        """Let `current` [A] flow for a step, after `source`; gives the voltage [V] that becomes heat."""
        m, h, cold, step = self._m, self._h, self._cold, self._step
        thermal = np.exp(3400 * cold) * h.resistance_factor
        diffusion = np.array([m.diffusion_a, m.diffusion_b]) * thermal * current
        self._branch = self._keep * self._branch + (1 - self._keep) * diffusion
        faster = np.array([thermal, np.exp(2500 * cold), np.exp(1500 * cold)])
        settled = np.array([m.depletion_a, m.depletion_b, m.depletion_c]) * faster * current
        self._depleted = self._deplete_keep * self._depleted + (1 - self._deplete_keep) * settled
        # each electrode's own reaction (Butler and Volmer), behind its own double layer
        exchange = np.stack([m.cathode_exchange * np.exp(-5200 * cold), m.anode_exchange * np.exp(-4000 * cold)])
        wanted = (
            h.resistance_factor * 2 * GAS / FARADAY * self._kelvin * np.arcsinh(current / (2 * exchange / self._ends))
        )
        self._reaction = self._layer * self._reaction + (1 - self._layer) * wanted
        self._slow = self._slow_keep * self._slow + (1 - self._slow_keep) * h.slow_resistance * current
        capacity = m.capacity * (1 - m.capacity_temperature * np.maximum(25 - core, 0)) * h.capacity_factor
        passed = current * step / 3600 / capacity
        self._memory = self._memory + 40 * np.abs(passed) * (np.sign(passed) * m.hysteresis - self._memory)
        self._hidden_memory = self._hidden_memory + h.hysteresis_rate * np.abs(passed) * (
            np.sign(passed) * h.hysteresis - self._hidden_memory
        )
        self.soc = self.soc - passed
        diffusion = self._steepness * self._count * (self.soc - self._surface)  # V from inside to the surface
        return np.asarray(self._lag + diffusion + (self._instant * current))
