"""The motor controller: current by throttle, limited by speed, temperature, voltage and state of charge.

The thesis names it and does not give it (it is proprietary): piecewise-linear derating tables stand in. Those over
speed and cell voltage are what eight road rides of the reference scooter show of current over throttle: constant up to
35 rad/s, then falling as one over speed (constant power) to the speed limit; the rest are guesses.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field

Table = Sequence[tuple[float, float]]


def interpolate(table: Table, x: float) -> float:
    """Linear between the points of `table`, constant beyond its ends."""
    if x <= table[0][0]:
        return table[0][1]
    if x >= table[-1][0]:
        return table[-1][1]
    i = bisect_right([point[0] for point in table], x) - 1
    (x0, y0), (x1, y1) = table[i], table[i + 1]
    return y0 + (y1 - y0) * (x - x0) / (x1 - x0)


@dataclass
class Controller:
    """Current limit [A] and what lessens it; each table gives a share over its quantity."""

    current_limit: float
    regeneration_limit: float  # A
    by_speed: Table = (
        (0.0, 1.0), (35.3, 1.0), (38.0, 0.929), (41.0, 0.861), (44.0, 0.802), (47.5, 0.743), (53.0, 0.666), (55.4, 0.0),
    )  # rad/s of the motor  # fmt: skip
    by_motor: Table = ((0.0, 1.0), (120.0, 1.0), (150.0, 0.2))  # degC
    by_inverter: Table = ((0.0, 1.0), (80.0, 1.0), (100.0, 0.2))  # degC
    by_cell: Table = ((-20.0, 0.3), (-5.0, 1.0), (50.0, 1.0), (62.0, 0.1))  # degC
    by_cell_voltage: Table = ((2.75, 0.1), (2.89, 0.46), (3.04, 0.77), (3.16, 1.0))  # V of a cell
    by_soc: Table = ((0.0, 0.1), (0.08, 1.0))
    regeneration_by_soc: Table = ((0.95, 1.0), (1.0, 0.0))
    regeneration_by_speed: Table = ((7.0, 0.0), (14.5, 1.0))  # rad/s
    regeneration_gain: float = 50.0  # of the brake's command: all of it as soon as the lever is touched
    _slow: float = field(default=1.0, init=False)
    _slow_regeneration: float = field(default=1.0, init=False)

    def watch(self, motor: float, inverter: float, cell: float, soc: float) -> None:
        """Take the temperatures [degC] and the SOC; once a second is enough."""
        temperatures = interpolate(self.by_motor, motor) * interpolate(self.by_inverter, inverter)
        self._slow = temperatures * interpolate(self.by_cell, cell) * interpolate(self.by_soc, soc)
        self._slow_regeneration = temperatures * interpolate(self.regeneration_by_soc, soc)

    def current(self, throttle: float, brake: float, motor_speed: float, cell_voltage: float) -> float:
        """Motor current [A]: driving by the throttle; regenerating while braking or with the throttle closed."""
        if throttle > 0 and brake <= 0:
            limit = self.current_limit * self._slow
            if motor_speed > self.by_speed[1][0]:
                limit *= interpolate(self.by_speed, motor_speed)
            if cell_voltage < self.by_cell_voltage[-1][0]:
                limit *= interpolate(self.by_cell_voltage, cell_voltage)
            return throttle * limit
        if brake > 0 and motor_speed > self.regeneration_by_speed[0][0]:
            limit = self.regeneration_limit * self._slow_regeneration
            if motor_speed < self.regeneration_by_speed[-1][0]:
                limit *= interpolate(self.regeneration_by_speed, motor_speed)
            return -min(brake * self.regeneration_gain, 1.0) * limit
        return 0.0
