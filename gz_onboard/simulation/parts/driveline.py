"""Wheel, tyre and vehicle together, implicit in the slip (Lord 2016, eqs. 2.11, 3.3, 3.8, 3.10-3.12).

The tyre's slip is stiff, so the three are solved at once; with the mean speeds of the step each force times its speed
is exactly the change of kinetic energy.
"""

from __future__ import annotations

from dataclasses import dataclass

from gz_onboard.simulation.parts.brakes import Brakes
from gz_onboard.simulation.parts.tyre import Tyre

BRAKE_PASSES = 4  # of front and rear brake in turn, where both hold; each leaves a twentieth of what they disagree by
FREELY = 0.5  # m/s: above it the front brake does all it can, for it stops nothing within a step


@dataclass
class Driveline:
    """Vehicle and driven wheel, connected by the tyre."""

    tyre: Tyre
    brakes: Brakes
    moving_mass: float  # kg
    wheel_inertia: float  # kg·m²
    has_front_wheel: bool

    def kinetic_energy(self, speed: float, wheel_speed: float) -> float:
        """Kinetic energy of vehicle and wheels [J] at these speeds [m/s, rad/s]."""
        return 0.5 * (self.moving_mass * speed**2 + self.wheel_inertia * wheel_speed**2)

    def step(
        self,
        v: float,
        w: float,
        torque: float,
        against: float,
        rolling: float,
        load: float,
        r: float,
        brake: float,
        dt: float,
    ) -> tuple[float, float, float, float, float]:
        """Advance by `dt` [s] and update the tyre's slip.

        v: speed of the vehicle [m/s]. w: of the driven wheel [rad/s]. torque: drives the wheel [N·m]. against, rolling:
        forces [N] against the vehicle and against the driven wheel. load: on the driven tyre [N]. r: radius of the
        wheel [m]. brake: command, 0..1. Returns the change of both speeds, the force of the driven tyre [N], the
        torque of the rear brake [N·m] and the force of the front brake [N].
        """
        tyre = self.tyre
        base, gain, mu, slope = tyre.grip(r * w, v, dt)
        grip, stiffness = load * mu, load * (slope if slope > 0.0 else 0.0) * gain
        m, j = self.moving_mass / dt, self.wheel_inertia / dt
        det = m * j + stiffness * (m * r * r + j)
        f1 = grip - against
        f2 = torque - r * (grip + rolling)
        braking = front_braking = 0.0
        if brake > 0.0:
            # How much each slows its own side and the other side of the tyre.
            by_torque, by_force, across = (m + stiffness) / det, (j + r * r * stiffness) / det, r * stiffness / det
            front_least, front_most, rear_least, rear_most = self.brakes.bounds(brake, v, w, r)
            for _ in range(BRAKE_PASSES):
                if self.has_front_wheel:
                    to_stop = (v + by_force * f1 + across * (f2 - braking)) / by_force
                    limited = front_most if to_stop > front_most else to_stop
                    front_braking = front_least if limited < front_least else limited
                to_stop = (w + by_torque * f2 + across * (f1 - front_braking)) / by_torque
                limited = rear_most if to_stop > rear_most else to_stop
                braking = rear_least if limited < rear_least else limited
                if v > FREELY:
                    break
            f1 -= front_braking
            f2 -= braking
        dw = ((m + stiffness) * f2 + r * stiffness * f1) / det
        dv = ((j + r * r * stiffness) * f1 + r * stiffness * f2) / det
        tyre.slip = base + gain * (r * (w + dw) - v - dv)
        return dv, dw, grip + stiffness * (r * dw - dv), braking, front_braking
