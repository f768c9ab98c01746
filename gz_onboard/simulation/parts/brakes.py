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

    def bounds(
        self, command: float, speed: float, wheel_speed: float, wheel_radius: float
    ) -> tuple[float, float, float, float]:
        """Least and greatest force [N] of the front brake, then least and greatest torque [N·m] of the rear brake.

        speed: of the vehicle [m/s]. wheel_speed: of the rear wheel [rad/s]. Both act against the motion.
        """
        front, rear = command * self.front_share, command * (1 - self.front_share)
        if self.form == "viscous":
            arm = self.viscous_constant * self.radius
            force, torque = speed / wheel_radius * front * arm / wheel_radius, wheel_speed * rear * arm
            return force, force, torque, torque
        force, torque = front * self.torque_limit / wheel_radius, rear * self.torque_limit
        return -force, force, -torque, torque
