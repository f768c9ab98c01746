"""Motor and inverter (Lord 2016, eqs. 2.1-2.10, with the errata: power is conserved, loss is mapped in watts)."""

from __future__ import annotations

from collections.abc import MutableMapping, Sequence
from typing import Protocol

from gz_onboard.model.model import Bound
from gz_onboard.offline.series import stepper

Quantities = MutableMapping[str, float]
Ledger = MutableMapping[str, float]
"""Energy [J] by name; what is not in it yet is 0."""


class Motor(Protocol):
    """A motor, as the scooter uses it."""

    torque_constant: float  # N·m/A (eq. 2.8)
    voltage_constant: float  # V·s/rad, line to line, RMS (eq. 2.7)

    def heat(self, speed: float, current: float, temperature: float, dt: float, ledger: Ledger) -> float:
        """Heat [W] at a shaft speed [rad/s], current [A] and temperature [degC]; books each loss of `dt` [s]."""

    def idle(self, speed: float, temperature: float) -> float:
        """Loss [W] turning without current: drag, which slows the shaft."""


class EffectMotor:
    """A motor whose losses are effects of the vehicle's model: copper, iron, and others that its file lists.

    quantities: read by the effects.
    """

    def __init__(
        self,
        effects: Sequence[Bound],
        dt: float,
        torque_constant: float,
        voltage_constant: float,
        quantities: Quantities,
    ) -> None:
        self.torque_constant = torque_constant
        self.voltage_constant = voltage_constant
        self._losses, self._settled = stepper(effects, dt, booked=True), stepper(effects, None)
        self._q = quantities

    def heat(self, speed: float, current: float, temperature: float, dt: float, ledger: Ledger) -> float:
        """See `Motor`; `dt` is that of the effects."""
        q = self._q
        q["motor_speed"], q["motor_current"], q["motor_temperature"] = speed, current, temperature
        q["torque"] = self.torque_constant * current
        return float(self._losses(q, ledger))

    def idle(self, speed: float, temperature: float) -> float:
        """See `Motor`; not a step for an effect with memory."""
        q = self._q
        q["motor_speed"], q["motor_temperature"] = speed, temperature
        q["motor_current"] = q["torque"] = 0.0
        return float(sum(self._settled(q)))
