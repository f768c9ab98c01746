"""The rider: PI control of speed by throttle and brake (Lord 2016, eqs. 3.13-3.16), with anti-windup."""

from __future__ import annotations

from dataclasses import dataclass

ROLLS_BACK = -1.0  # m/s: more than a start uphill rolls back until the throttle is open


@dataclass
class Rider:
    """Follows a commanded speed. Gains in 1/(m/s) and 1/m.

    Who rolls back pulls the brake; on a hill that full throttle does not climb he stays, throttle open and brake on.
    """

    proportional: float = 1.5
    integral: float = 0.3
    sum: float = 0.0
    holds: bool = False  # has rolled back where he wants to stand
    beaten: bool = False  # has rolled back with the throttle open

    def step(self, wanted: float, speed: float, dt: float) -> tuple[float, float]:
        """(throttle, brake), each 0..1. The integral stops where the command is at its end (Åström 2006, sec. 3.5)."""
        error = wanted - speed
        command = self.proportional * error + self.sum
        if -1 < command < 1 or error * command < 0:
            total = self.sum + self.integral * error * dt
            self.sum = -1.0 if total < -1.0 else 1.0 if total > 1.0 else total
        if wanted <= 0 and speed < 0.3:  # stands: holds the brake
            self.sum = min(self.sum, 0.0)
            self.holds, self.beaten = self.holds or speed < -0.05, False
            return 0.0, 1.0 if self.holds else min(max(-command, 0.3), 1.0)
        self.holds = False
        if self.beaten or (speed < ROLLS_BACK and command >= 1.0):
            self.beaten = True
            return 1.0, 1.0
        if command >= 0:
            return (command if command < 1.0 else 1.0), 0.0
        return 0.0, (-command if command > -1.0 else 1.0)
