"""The battery pack: first-order equivalent circuit of one representative cell (Lord 2016, eqs. 2.20-2.24)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from math import exp
from typing import Protocol

from gz_onboard.constants import HOUR
from gz_onboard.model.battery import Battery, current_of

TABLE_PERIOD = 1.0  # s: R0, R1 and C1 follow SOC and temperature this often; both move slowly


class PackModel(Protocol):
    """A battery pack, as the scooter uses it."""

    soc: float

    def draw(self, power: float, dt: float, temperature: float) -> tuple[float, float, float, float]:
        """Deliver `power` [W] for `dt` [s] at a cell temperature [degC].

        Gives (pack current [A], terminal voltage [V], heat [W], power really delivered [W]).
        """

    def chemical_energy_drawn(self) -> float:
        """Energy [J] that has left the cells' chemistry since the start: what became terminal energy and heat."""


class FirstOrderPack:
    """R0 and one RC pair over SOC and temperature, and the effects of the vehicle's model in the cells.

    effects: a function that gives their voltages [V] after one step, see `offline.series.stepper`; its step is the
    `dt` of `draw`. They act in the next step. quantities: read by the effects; the pack keeps those of the cells up to
    date. The voltage lost to effects is heat of the pack. So is the energy that the RC pair's capacitor stores for a
    minute: heat = S·P·(V_oc - V_cell)·I_cell. Eq. 2.24 as printed mixes cell and pack voltage.
    """

    def __init__(
        self,
        battery: Battery,
        soc: float = 1.0,
        v1: float = 0.0,
        effects: Callable[[Mapping[str, float]], tuple[float, ...]] | None = None,
        quantities: dict[str, float] | None = None,
    ) -> None:
        self.battery = battery
        self._effects, self._q = effects, {} if quantities is None else quantities
        self.effect_voltages: tuple[float, ...] = ()  # V of a cell, in the order of the effects
        self.soc = soc
        self.v1 = v1  # V of a cell
        self._age = TABLE_PERIOD
        self._r0 = self._r1 = 0.0
        self._c1 = 1.0
        self._decay = 0.0
        self._decay_dt = 0.0
        self._capacity = 1.0  # A·h of the pack
        self._shift = 0.0  # V of a cell
        self._drawn = 0.0  # J, up to the last look-up
        self._soc_before = soc  # at the last look-up

    def _look_up(self, temperature: float, dt: float) -> None:
        battery, soc = self.battery, self.soc
        self._drawn += self._between(self._soc_before, soc)
        self._soc_before = soc
        self._r0, self._r1, self._c1 = battery.circuit(soc, temperature)
        self._q["cell_temperature"], self._q["cell_capacity"] = temperature, battery.cell_capacity(temperature)
        self._decay, self._decay_dt = exp(-dt / (self._r1 * self._c1)), dt
        self._capacity = battery.pack_capacity(temperature)
        self._shift = battery.rest_shift(temperature)
        self._age = 0.0

    def draw(self, power: float, dt: float, temperature: float) -> tuple[float, float, float, float]:
        """See `PackModel`. The current is the root of V·I = P; where there is none, the current of greatest power."""
        if self._age >= TABLE_PERIOD - 1e-9 or dt != self._decay_dt:
            self._look_up(temperature, dt)
        self._age += dt
        battery = self.battery
        n, m = battery.cells_series, battery.cells_parallel
        ocv, slope = battery.ocv_curve.extended(self.soc)
        ocv += self._shift
        resistance = n * self._r0 / m + battery.series_resistance
        relaxing = n * (self.v1 + sum(self.effect_voltages))
        source = n * ocv - relaxing
        current = current_of(power, source, resistance)
        if current is None:
            current = source / (2 * resistance)
        # Eqs. 2.21 to 2.24, written out: this runs a hundred times for each second ridden.
        step = current * dt / (HOUR * self._capacity)
        # V_oc at the middle of the step, so that charge times voltage is the energy between the two SOCs.
        middle = n * (ocv - slope * step / 2)
        voltage = middle - resistance * current - relaxing
        self.soc -= step
        cell = current / m
        self.v1 = self._decay * self.v1 + (1 - self._decay) * self._r1 * cell
        if self._effects:
            q = self._q
            q["cell_current"], q["soc"] = cell, self.soc
            self.effect_voltages = self._effects(q)
        return current, voltage, (middle - voltage) * current, voltage * current

    def chemical_energy_drawn(self) -> float:
        """See `PackModel`: the integral of V_oc over the charge between the SOC at the start and now.

        It follows from the SOC alone, not from the energy delivered: the check of the energy balance relies on it.
        """
        return self._drawn + self._between(self._soc_before, self.soc)

    def _between(self, high: float, low: float) -> float:
        """The integral of V_oc over charge from SOC `low` to `high` [J], exact for its straight pieces."""
        ocv = self.battery.ocv
        sign = 1.0 if high >= low else -1.0
        a, b = (low, high) if high >= low else (high, low)
        knots = [a, *(x for x in self.battery.ocv_curve.x[1:-1] if a < x < b), b]
        total = sum((y - x) * (ocv(x)[0] + ocv(y)[0]) / 2 for x, y in pairwise(knots))
        total += (b - a) * self._shift
        return sign * total * self.battery.cells_series * HOUR * self._capacity
