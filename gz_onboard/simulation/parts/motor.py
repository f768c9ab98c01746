"""Motor and inverter (Lord 2016, eqs. 2.1-2.10, with the errata: power is conserved, loss is mapped in watts)."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

Losses = Callable[[Mapping[str, float]], tuple[float, ...]]
"""Heat [W] of each effect at motor_speed, motor_current, motor_temperature and what else it reads."""


class Motor(Protocol):
    """What the scooter needs of a motor."""

    torque_constant: float  # N·m/A (eq. 2.8)
    voltage_constant: float  # V·s/rad, line to line, RMS (eq. 2.7)

    def losses(self, speed: float, current: float, temperature: float) -> list[tuple[str, float]]:
        """(name, heat [W]) of each loss at a shaft speed [rad/s], current [A] and temperature [degC]."""

    def idle(self, speed: float, temperature: float) -> float:
        """What it loses [W] turning without current: it is drag, which slows the shaft."""


class EffectMotor:
    """A motor whose losses are effects of the vehicle's model: copper, iron, and what else its file lists.

    names, losses: of the effects, and their values [W] together; settled: the same of those with memory at their end.
    quantities: what else the effects read.
    """

    def __init__(
        self,
        names: Sequence[str],
        losses: Losses,
        settled: Losses,
        torque_constant: float,
        voltage_constant: float,
        quantities: dict[str, float],
    ) -> None:
        self.torque_constant = torque_constant
        self.voltage_constant = voltage_constant
        self._names = tuple(names)
        self._losses, self._settled = losses, settled
        self._q = quantities

    def losses(self, speed: float, current: float, temperature: float) -> list[tuple[str, float]]:
        """See `Motor`."""
        q = self._q
        q["motor_speed"], q["motor_current"], q["motor_temperature"] = speed, current, temperature
        q["torque"] = self.torque_constant * current
        return list(zip(self._names, self._losses(q), strict=True))

    def idle(self, speed: float, temperature: float) -> float:
        """See `Motor`; not a step for an effect with memory."""
        q = self._q
        q["motor_speed"], q["motor_temperature"] = speed, temperature
        q["motor_current"] = q["torque"] = 0.0
        return sum(self._settled(q))


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

    def idle(self, speed: float, temperature: float) -> float:
        """See `Motor`."""
        return self.losses(speed, 0.0, temperature)[0][1]
