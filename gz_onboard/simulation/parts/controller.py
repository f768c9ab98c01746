"""The motor controller: current by throttle, limited by speed, temperature, voltage and state of charge.

The thesis names it and does not give it (it is proprietary). The derating tables of the vehicle file replace it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from gz_onboard.model.tables import Derating


@dataclass
class Controller:
    """Current limits [A] and what lessens them."""

    current_limit: float
    regeneration_limit: float  # A
    derating: Derating = field(default_factory=Derating)
    _slow: float = field(default=1.0, init=False)
    _slow_regeneration: float = field(default=1.0, init=False)

    def watch(self, motor: float, inverter: float, cell: float, soc: float) -> None:
        """Take the temperatures [degC] and the SOC; once a second is enough."""
        d = self.derating
        temperatures = d.current_by_motor_temperature.at(motor) * d.current_by_inverter_temperature.at(inverter)
        self._slow = temperatures * d.current_by_cell_temperature.at(cell) * d.current_by_soc.at(soc)
        self._slow_regeneration = temperatures * d.regeneration_by_soc.at(soc)

    def current(self, throttle: float, brake: float, motor_speed: float, cell_voltage: float) -> float:
        """Motor current [A]: driving by the throttle; regenerating while braking. Backwards it does neither brake."""
        d = self.derating
        if throttle > 0 and brake <= 0:
            limit = self.current_limit * self._slow
            return (
                throttle * limit * d.current_by_motor_speed.at(motor_speed) * d.current_by_cell_voltage.at(cell_voltage)
            )
        if brake > 0 and motor_speed > 0:
            share = self._slow_regeneration * d.regeneration_by_motor_speed.at(motor_speed)
            return -min(brake * d.regeneration_gain, 1.0) * self.regeneration_limit * share
        return 0.0
