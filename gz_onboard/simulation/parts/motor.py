"""Motor and inverter (Lord 2016, eqs. 2.1-2.10, with the errata: power is conserved, loss is mapped in watts)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping, Sequence
from typing import Protocol

from gz_onboard.physics.model import Bound

Quantities = MutableMapping[str, float]
Ledger = MutableMapping[str, float]
"""Energy [J] by name; what is not in it yet is 0."""


Call = tuple[str, Callable[[Mapping[str, float]], float]]
"""An effect's name and its value as a function of the quantities, called once each step."""


class Losses:
    """The effects at one port, summed and booked a step of `dt` [s] at a time."""

    def __init__(self, calls: Sequence[Call], dt: float) -> None:
        self._calls, self._dt = calls, dt

    def total(self, quantities: Mapping[str, float], ledger: Ledger) -> float:
        """Their sum [W]; adds each [J] to `ledger` by its name."""
        total = 0.0
        for name, call in self._calls:
            watts = call(quantities)
            ledger[name] += watts * self._dt
            total += watts
        return total


class Motor(Protocol):
    """What the scooter needs of a motor."""

    torque_constant: float  # N·m/A (eq. 2.8)
    voltage_constant: float  # V·s/rad, line to line, RMS (eq. 2.7)

    def heat(self, speed: float, current: float, temperature: float, dt: float, ledger: Ledger) -> float:
        """Heat [W] at a shaft speed [rad/s], current [A] and temperature [degC]; books each loss of `dt` [s]."""

    def idle(self, speed: float, temperature: float) -> float:
        """What it loses [W] turning without current: it is drag, which slows the shaft."""


class EffectMotor:
    """A motor whose losses are effects of the vehicle's model: copper, iron, and what else its file lists.

    booked: their sum a step at a time; settled: what they settle at.
    quantities: what the effects read.
    """

    def __init__(
        self,
        booked: Losses,
        settled: Sequence[Bound],
        torque_constant: float,
        voltage_constant: float,
        quantities: Quantities,
    ) -> None:
        self.torque_constant = torque_constant
        self.voltage_constant = voltage_constant
        self._booked, self._settled = booked, [effect.term for effect in settled]
        self._q = quantities

    def heat(self, speed: float, current: float, temperature: float, dt: float, ledger: Ledger) -> float:
        """See `Motor`; `dt` is that of the effects."""
        q = self._q
        q["motor_speed"], q["motor_current"], q["motor_temperature"] = speed, current, temperature
        q["torque"] = self.torque_constant * current
        return self._booked.total(q, ledger)

    def idle(self, speed: float, temperature: float) -> float:
        """See `Motor`; not a step for an effect with memory."""
        q = self._q
        q["motor_speed"], q["motor_temperature"] = speed, temperature
        q["motor_current"] = q["torque"] = 0.0
        total = 0.0
        for term in self._settled:
            total += term(q)
        return total
