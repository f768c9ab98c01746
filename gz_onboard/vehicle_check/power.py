"""What a motor gives at most: its current limit, and what the controller leaves of it, by peak power and top speed."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log

KMH = 3.6
LOWEST, HIGHEST = 0.97, 1.03  # of the top speed, from and to which the controller takes the motor's current away
STEPS = 1.3  # at most, from one point of the curve to the next, in which a constant power is taken for a line


@dataclass(frozen=True)
class RatedMotor:
    """Peak power at the shaft [W], top speed [km/h], what it moves: mass [kg], pull as it starts [m/s²].

    wheel_radius [m], gear_ratio (wheel speed over motor speed) and torque_constant [N·m/A] are those of the file.
    """

    power: float
    top_speed: float
    mass: float
    pull: float
    wheel_radius: float
    gear_ratio: float
    torque_constant: float

    @property
    def torque(self) -> float:
        """At the shaft, as it pulls off [N·m]."""
        return self.mass * self.pull * self.wheel_radius * self.gear_ratio

    @property
    def current_limit(self) -> float:
        """The motor's current at that torque [A]."""
        return self.torque / self.torque_constant

    def shares(self) -> tuple[list[float], list[float]]:
        """(motor speeds [rad/s], shares of the current limit there): torque, then power, then the top speed."""
        top = self.top_speed / KMH / self.wheel_radius / self.gear_ratio
        base, last = self.power / self.torque, LOWEST * top
        if base >= last:
            return [last, HIGHEST * top], [1.0, 0.0]
        count = max(ceil(log(last / base) / log(STEPS)), 1)
        speeds = [base * (last / base) ** (i / count) for i in range(count + 1)]
        return [*speeds, HIGHEST * top], [*(base / speed for speed in speeds), 0.0]
