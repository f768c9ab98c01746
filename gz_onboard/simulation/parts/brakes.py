"""The friction brakes (Lord 2016, eqs. 2.13-2.14).

The printed force, F_b = |ω_t|·β·C_b, vanishes as the wheel stops, so a braked scooter never quite stands: it stays
selectable as ``viscous``. The default is ``friction``: a torque proportional to the command, which at standstill holds
as much as it must, up to its limit.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass
class Brakes:
    """Both brakes. The front's share acts on the chassis (F_b of eq. 3.3), the rear's on the wheel (eq. 2.11)."""

    torque_limit: float  # N·m of both at full command
    viscous_constant: float  # N·s/rad, C_b
    radius: float  # m, of the disc
    front_share: float = 0.0
    form: str = "friction"

    def torque(self, command: float, wheel_speed: float, to_stop: float) -> float:
        """Torque [N·m] against a wheel at `wheel_speed` [rad/s]; `to_stop` is what would bring it to rest just now."""
        if self.form == "viscous":
            return wheel_speed * command * (1 - self.front_share) * self.viscous_constant * self.radius
        limit = command * (1 - self.front_share) * self.torque_limit
        return min(max(to_stop, -limit), limit)

    def front_force(self, command: float, speed: float, wheel_radius: float, to_stop: float) -> float:
        """Force [N] of the front brake against a vehicle at `speed` [m/s]; `to_stop` as in `torque`."""
        if self.form == "viscous":
            return (
                speed / wheel_radius * command * self.front_share * self.viscous_constant * self.radius / wheel_radius
            )
        limit = command * self.front_share * self.torque_limit / wheel_radius
        return min(max(to_stop, -limit), limit)
