"""Motor and inverter (Lord 2016, eqs. 2.1-2.10, with the errata: power is conserved, loss is mapped in watts)."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

Loss = Callable[[Mapping[str, float]], float]
"""Heat [W] at motor_speed, motor_current and motor_temperature."""


class Motor(Protocol):
    """What the scooter needs of a motor."""

    torque_constant: float  # N·m/A (eq. 2.8)
    voltage_constant: float  # V·s/rad, line to line, RMS (eq. 2.7)

    def losses(self, speed: float, current: float, temperature: float) -> list[tuple[str, float]]:
        """(name, heat [W]) of each loss at a shaft speed [rad/s], current [A] and temperature [degC].

        What it loses without current is drag: it slows the shaft.
        """


class EffectMotor:
    """A motor whose losses are effects of the vehicle's model: copper, iron, and what else its file lists."""

    def __init__(
        self,
        effects: Sequence[tuple[str, Loss]],
        torque_constant: float,
        voltage_constant: float,
        quantities: dict[str, float] | None = None,
    ) -> None:
        self.torque_constant = torque_constant
        self.voltage_constant = voltage_constant
        self._effects = list(effects)
        self._q = {} if quantities is None else quantities  # what else the effects read

    def losses(self, speed: float, current: float, temperature: float) -> list[tuple[str, float]]:
        """See `Motor`."""
        q = self._q
        q["motor_speed"], q["motor_current"], q["motor_temperature"] = speed, current, temperature
        q["torque"] = self.torque_constant * current
        return [(name, effect(q)) for name, effect in self._effects]


class MapMotor:
    """A motor with a measured loss map [W] over speed [rad/s] (rows) and current [A] (columns), bilinear, clamped."""

    def __init__(self, speed: Sequence[float], current: Sequence[float], loss: Sequence[Sequence[float]],
                 torque_constant: float, voltage_constant: float) -> None:  # fmt: skip
        self.torque_constant = torque_constant
        self.voltage_constant = voltage_constant
        self._speed, self._current = list(speed), list(current)
        self._loss = [list(row) for row in loss]

    def losses(self, speed: float, current: float, temperature: float) -> list[tuple[str, float]]:
        """See `Motor`; the map was measured at one temperature."""
        xs, ys = self._speed, self._current
        i = min(max(bisect_right(xs, abs(speed)) - 1, 0), len(xs) - 2)
        j = min(max(bisect_right(ys, current) - 1, 0), len(ys) - 2)
        a = min(max((abs(speed) - xs[i]) / (xs[i + 1] - xs[i]), 0.0), 1.0)
        b = min(max((current - ys[j]) / (ys[j + 1] - ys[j]), 0.0), 1.0)
        low, high = self._loss[i], self._loss[i + 1]
        one, two = low[j] + b * (low[j + 1] - low[j]), high[j] + b * (high[j + 1] - high[j])
        return [("motor_map_loss", one + a * (two - one))]
