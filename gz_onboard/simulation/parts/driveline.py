"""Wheel, tyre and vehicle together, implicit in the slip (Lord 2016, eqs. 2.11, 3.3, 3.8, 3.10-3.12).

The tyre's slip is stiff, so the three are solved at once; with the mean speeds of the step each force times its speed
is exactly the change of kinetic energy.
"""

from __future__ import annotations

from typing import NamedTuple

from gz_onboard.simulation.parts.brakes import Brakes
from gz_onboard.simulation.parts.tyre import Tyre

BRAKE_PASSES = 4  # of front and rear brake in turn, where both hold; each leaves a twentieth of what they disagree by
FREELY = 0.5  # m/s: above it the front brake does all it can, for it stops nothing within a step


class Acting(NamedTuple):
    """What acts on wheel and vehicle in a step."""

    torque: float  # N·m, that drives the wheel
    resistance: float  # N, against the vehicle
    rolling: float  # N, against the driven wheel
    load: float  # N, on the driven tyre
    radius: float  # m, of the wheel


class Moved(NamedTuple):
    """How wheel and vehicle moved in a step."""

    speed_change: float  # m/s
    wheel_change: float  # rad/s
    force: float  # N, of the driven tyre
    braking: float  # N·m, of the rear brake
    front_braking: float  # N


class Driveline:
    """The inertias [kg, kg·m²] that the driven tyre connects."""

    def __init__(self, moving_mass: float, wheel_inertia: float, front_wheel: bool) -> None:
        self.moving_mass, self.wheel_inertia, self.front_wheel = moving_mass, wheel_inertia, front_wheel

    def kinetic_energy(self, speed: float, wheel_speed: float) -> float:
        """Of vehicle and wheels [J] at these speeds [m/s, rad/s]."""
        return 0.5 * (self.moving_mass * speed**2 + self.wheel_inertia * wheel_speed**2)

    def step(self, tyre: Tyre, brakes: Brakes, acting: Acting, v: float, w: float, brake: float, dt: float) -> Moved:
        """One step of `dt` [s] from vehicle and wheel speeds `v` [m/s], `w` [rad/s]; brake: 0..1. Moves the slip on."""
        drive, against, rolling, load, r = acting
        base, gain = tyre.linear(r * w, v, dt)
        mu, slope = tyre.friction(base + gain * (r * w - v))
        grip, stiffness = load * mu, load * (slope if slope > 0.0 else 0.0) * gain
        m, j = self.moving_mass / dt, self.wheel_inertia / dt
        det = m * j + stiffness * (m * r * r + j)
        f1 = grip - against
        f2 = drive - r * (grip + rolling)
        braking = front_braking = 0.0
        if brake > 0.0:
            # How much each slows what it is on and what is on the other side of the tyre.
            by_torque, by_force, across = (m + stiffness) / det, (j + r * r * stiffness) / det, r * stiffness / det
            for _ in range(BRAKE_PASSES):
                if self.front_wheel:
                    to_stop = (v + by_force * f1 + across * (f2 - braking)) / by_force
                    front_braking = brakes.front_force(brake, v, r, to_stop)
                to_stop = (w + by_torque * f2 + across * (f1 - front_braking)) / by_torque
                braking = brakes.torque(brake, w, to_stop)
                if v > FREELY:
                    break
            f1 -= front_braking
            f2 -= braking
        dw = ((m + stiffness) * f2 + r * stiffness * f1) / det
        dv = ((j + r * r * stiffness) * f1 + r * stiffness * f2) / det
        tyre.slip = base + gain * (r * (w + dw) - v - dv)
        return Moved(dv, dw, grip + stiffness * (r * dw - dv), braking, front_braking)
