"""A charge: its power, and how long it will take.

A charger holds its current until the cells are at the voltage of full ones, and then that voltage, at which the current
falls (CC-CV). Full is where the vehicle shows 100 %, or where the current has fallen to `CUT_OFF`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

from gz_onboard.constants import HOUR
from gz_onboard.estimator.motion import MOTION
from gz_onboard.physics.battery import Battery

CUT_OFF = 0.05  # 1/h: current over capacity at which chargers of lithium-ion cells end
SLICE = 0.01  # of SOC, over which the current is taken to be the same
SETTLING = 20.0  # s over which current and voltage are averaged: chargers ripple, and taper off in steps


def time_to_full(battery: Battery, soc: float, current: float, temperature: float) -> float | None:
    """How long [s] a charge takes from the cells' `soc` on, at the pack's charging `current` [A] now, positive into it.

    None if that current never fills it. temperature: of the cells [degC].
    """
    if current <= 0:
        return None
    full, capacity = battery.window.high, battery.pack_capacity(temperature)
    at_full, seconds = battery.ocv(1.0, temperature)[0], 0.0
    for k in range(int(soc / SLICE), ceil(full / SLICE)):  # the same slices from any soc on: no steps at the end
        low, high = max(soc, k * SLICE), min((k + 1) * SLICE, full)
        middle = (low + high) / 2
        r0, r1, _ = battery.circuit(middle, temperature)
        most = (at_full - battery.ocv(middle, temperature)[0]) / (r0 + r1) * battery.cells_parallel
        if most < CUT_OFF * capacity:
            break
        seconds += max(high - low, 0.0) * capacity * HOUR / min(current, most)
    return seconds


@dataclass(slots=True)
class Charging:
    """Follows one charge after the other; None while nothing is charged."""

    power: float | None = None  # W into the pack
    to_full: float | None = None  # s
    _current: float = 0.0  # A into the pack

    def step(self, dt: float, battery: Battery, measured: tuple[float, float], soc: float, temperature: float) -> None:
        """Go `dt` [s] on; measured: voltage [V] and current [A, positive discharging] of the pack."""
        voltage, current = measured
        share = 1.0 if self.power is None else dt / (dt + SETTLING)
        self._current += share * (-current - self._current)
        self.power = max(voltage * self._current, 0.0)
        # While less flows, as in a pause, it is not known when it is full.
        flows = -current > MOTION.charging_rate * battery.pack_capacity(temperature)
        self.to_full = time_to_full(battery, soc, self._current, temperature) if flows else None

    def end(self) -> None:
        """Nothing is charged, or nothing is known of it."""
        self.power = self.to_full = None
