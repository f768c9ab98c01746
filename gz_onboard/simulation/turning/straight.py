"""The straight chassis with pitch (Lord 2016, eqs. 3.1-3.7): it knows no turn, whatever the steering does."""

from __future__ import annotations

from dataclasses import dataclass

from gz_onboard.simulation.turning.machine import Machine, MachineState, Rates, RoadConditions

_NONE = "lateral_acceleration yaw_rate lean steer slip_front slip_rear side_front side_rear"


@dataclass(frozen=True)
class Straight:
    """MachineState: speed [m/s], distance [m]."""

    machine: Machine

    def start(self, speed: float) -> MachineState:
        """The state at `speed` [m/s]."""
        return speed, 0.0

    def energy(self, state: MachineState) -> float:
        """Kinetic energy [J], of the turning wheels too."""
        m = self.machine
        return (m.mass + m.spin_inertia / m.wheel_radius**2) * state[0] ** 2 / 2

    def rates(self, state: MachineState, steer: float, drive: float | None, road: RoadConditions) -> Rates:
        """With a force `drive` [N] of the driven wheel (None: the one that holds the speed); `steer` does nothing."""
        m = self.machine
        speed = state[0]
        drag, slope = m.resistance(speed, road)
        weight = m.weight(road)
        rolling = m.rolling(speed) * weight
        against = drag + slope + rolling
        if drive is None:
            drive = against
        acceleration = (drive - against) / (m.mass + m.spin_inertia / m.wheel_radius**2)
        ground = m.mass * acceleration + drag + slope  # what the tyres push the machine with
        front = min(max((weight * m.cg_to_rear - ground * m.cg_height) / m.wheelbase, 0.0), weight)
        power = {"aerodynamic drag": drag * speed, "rolling": rolling * speed, "sideslip": 0.0, "twisting": 0.0}
        power |= {"grade": slope * speed, "drive": -drive * speed}
        seen = {"speed": speed, "acceleration": acceleration, "drive": drive, "rolling_radius": m.wheel_radius}
        for load in ("load", "plane_load"):
            seen |= {f"{load}_front": front, f"{load}_rear": weight - front}
        return Rates((acceleration, speed), power, seen | dict.fromkeys(_NONE.split(), 0.0))

    def handlebar(self, steer: float, lean: float) -> float:
        """Handlebar angle [rad] for a steer angle at the ground: there is no steering."""
        return steer
