"""The rider: PI control of speed by throttle and brake (Lord 2016, eqs. 3.13-3.16), with anti-windup."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Rider:
    """Follows a commanded speed. Gains in 1/(m/s) and 1/m."""

    proportional: float = 1.5
    integral: float = 0.3
    sum: float = 0.0

    def step(self, wanted: float, speed: float, dt: float) -> tuple[float, float]:
        """(throttle, brake), each 0..1. The integral stops where the command is at its end (Åström 2006, sec. 3.5)."""
        error = wanted - speed
        command = self.proportional * error + self.sum
        if -1 < command < 1 or error * command < 0:
            total = self.sum + self.integral * error * dt
            self.sum = -1.0 if total < -1.0 else 1.0 if total > 1.0 else total
        if wanted <= 0 and speed < 0.3:  # stands: holds the brake
            self.sum = min(self.sum, 0.0)
            return 0.0, max(-command, 0.3)
        if command >= 0:
            return (command if command < 1.0 else 1.0), 0.0
        return 0.0, (-command if command > -1.0 else 1.0)
