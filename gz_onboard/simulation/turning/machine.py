"""What the three chassis models share: the machine, the road, the rates of change, a fixed step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import ceil, sqrt

from gz_onboard.constants import GRAVITY, MILD
from gz_onboard.model.effects import aerodynamic_drag, rolling_resistance
from gz_onboard.model.model import air_density
from gz_onboard.simulation.turning.tyre import LateralTyre

MachineState = tuple[float, ...]

STABLE = 2.0
"""Step times fastest decay that is left to one step: the method is stable up to 2.78, and oscillates beyond 2."""


@dataclass(frozen=True)
class RoadConditions:
    """Where the machine rides: grade (sine of the angle, along its heading), headwind [m/s], air density [kg/m³]."""

    grade: float = 0.0
    headwind: float = 0.0
    air_density: float = air_density(MILD)


@dataclass(frozen=True)
class Rates:
    """How a state changes, where the power goes, and what else is worth seeing.

    `power` [W] by name, positive where it leaves the machine; ``drive`` is what the driven wheel puts in, negative.
    Its sum is minus the rate of the kinetic energy. `fastest` [1/s] is the greatest rate at which a part of the state
    decays by itself.
    """

    change: MachineState
    power: dict[str, float]
    seen: dict[str, float]
    fastest: float = 0.0


@dataclass(frozen=True)
class Machine:
    """A two-wheeler with its rider, in SI units; names as `VEHICLE_PARAMETERS`."""

    mass: float
    wheelbase: float
    cg_to_rear: float
    cg_height: float
    wheel_radius: float
    spin_inertia: float  # both wheels
    yaw_inertia: float
    crown: float
    caster: float
    front: LateralTyre
    rear: LateralTyre
    drag_area: float
    rolling_constant: float
    rolling_speed: float

    @classmethod
    def of(cls, parameters: Mapping[str, float]) -> Machine:
        """The machine that these parameters describe."""
        p = parameters
        front, rear = (
            LateralTyre(
                p[f"cornering_stiffness_{axle}"],
                p[f"camber_stiffness_{axle}"],
                p["side_friction"],
                p["twisting_arm"],
                p["tyre_relaxation_length"],
            )
            for axle in ("front", "rear")
        )
        return cls(
            mass=p["vehicle_mass"] + p["payload_mass"],
            wheelbase=p["wheelbase"],
            cg_to_rear=p["cg_to_rear"],
            cg_height=p["cg_height"],
            wheel_radius=p["wheel_radius"],
            spin_inertia=p["wheel_inertia_front"] + p["wheel_inertia_rear"],
            yaw_inertia=p["yaw_inertia"],
            crown=p["tyre_crown_radius"],
            caster=p["caster_angle"],
            front=front,
            rear=rear,
            drag_area=p["drag_area"],
            rolling_constant=p["rolling_resistance_constant"],
            rolling_speed=p["rolling_resistance_speed"],
        )

    def resistance(self, speed: float, road: RoadConditions) -> tuple[float, float]:
        """(aerodynamic drag, weight along the road) [N], against the motion: eqs. 3.1, 3.2."""
        drag = aerodynamic_drag.term(speed, road.headwind, road.air_density, drag_area=self.drag_area)
        return float(drag), self.mass * GRAVITY * road.grade

    def rolling(self, speed: float) -> float:
        """Rolling resistance per load: eq. 3.9 with a constant term."""
        return float(
            rolling_resistance.term(
                speed,
                1 / GRAVITY,
                1.0,
                rolling_resistance_constant=self.rolling_constant,
                rolling_resistance_speed=self.rolling_speed,
            )
        )

    def weight(self, road: RoadConditions) -> float:
        """Load on both axles [N]: eq. 3.5."""
        return self.mass * GRAVITY * sqrt(1 - road.grade * road.grade)


def step(
    rates: Callable[[MachineState], Rates], state: MachineState, dt: float
) -> tuple[MachineState, dict[str, float]]:
    """A step of the classical Runge-Kutta method: (state after `dt` [s], energy [J] by where it went).

    The energies are integrated like the state, so their balance is as exact as the step itself. Where something decays
    faster than the step can follow (slip angles, within the relaxation length of the tyre, at high speed), the step is
    made in as many equal parts as it takes.
    """
    first = rates(state)
    parts = max(ceil(first.fastest * dt / STABLE), 1)
    state, energy = _one_step(rates, first, state, dt / parts)
    for _ in range(parts - 1):
        state, more = _one_step(rates, rates(state), state, dt / parts)
        energy = {name: energy[name] + more[name] for name in energy}
    return state, energy


def _one_step(
    rates: Callable[[MachineState], Rates], first: Rates, state: MachineState, dt: float
) -> tuple[MachineState, dict[str, float]]:
    second = rates(_moved(state, first.change, dt / 2))
    third = rates(_moved(state, second.change, dt / 2))
    fourth = rates(_moved(state, third.change, dt))
    change = tuple(
        (a + 2 * (b + c) + d) / 6
        for a, b, c, d in zip(first.change, second.change, third.change, fourth.change, strict=True)
    )
    energy = {
        name: (first.power[name] + 2 * (second.power[name] + third.power[name]) + fourth.power[name]) * dt / 6
        for name in first.power
    }
    return _moved(state, change, dt), energy


def _moved(state: MachineState, change: MachineState, dt: float) -> MachineState:
    return tuple(value + rate * dt for value, rate in zip(state, change, strict=True))
