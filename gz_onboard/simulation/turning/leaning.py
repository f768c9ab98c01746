"""The planar bicycle with lean (Lord 2016, ch. 4, extended model): the lean follows from speed and corner radius.

    tan φ_ideal = -u·r/g,  φ = φ_ideal + asin(t·sin φ_ideal/(h - t))     (lean positive right, yaw rate positive left)

What lean changes: camber thrust carries most of the side force, so the tyres slip less; the load in a tyre's plane
grows as m·sqrt(g² + a_y²) and with it the rolling resistance; the wheel rolls on the side of its crown, r_t - t·(1 -
cos φ), so it turns faster; the steering turns at the ground by more than at the handlebar; the centre of gravity comes
down. And a cambered tyre is a piece of a cone that is made to run straight: the moment that twists it, times the rate
at which it is twisted on the road, (V/r)·sin γ - dψ/dt, is lost as heat. This is the rolling resistance that grows with
camber; models that take a tyre's side force only do not have it.

Sources: Cossalter 2006, ch. 1, 2 and 4; Pacejka 2012, ch. 11.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import atan, cos, sin

from gz_onboard.constants import GRAVITY
from gz_onboard.simulation.turning.machine import MachineState, Rates, RoadConditions
from gz_onboard.simulation.turning.planar import Planar, Posture
from gz_onboard.simulation.turning.tyre import front_camber, ground_steer, handlebar_of, lean_of, rolling_radius

LEAN_TIME = 0.2  # s: the machine has no roll dynamics; its lean follows balance as fast as a rider makes it


@dataclass(frozen=True)
class Leaning(Planar):
    """MachineState: that of `Planar`, and the lean [rad, positive right]. `steer` is the handlebar's angle."""

    def start(self, speed: float) -> MachineState:
        """Straight ahead, upright, at `speed` [m/s]."""
        return *super().start(speed), 0.0

    def settled(self, u: float, v: float, r: float, steer: float) -> MachineState:
        """The state at speed, lateral speed [m/s] and yaw rate [rad/s] in which lean and slip have settled."""
        return self._slipped((u, v, r, 0.0, 0.0, 0.0, 0.0, 0.0, self._balance(u, r)), steer)

    def posture(self, state: MachineState, steer: float) -> Posture:
        """Leaning as the state says."""
        m = self.machine
        lean = state[8]
        return Posture(
            steer=ground_steer(steer, lean, m.caster),
            camber_front=front_camber(steer, lean, m.caster),
            camber_rear=-lean,
            radius=rolling_radius(m.wheel_radius, m.crown, lean),
            radius_rate=-m.crown * sin(lean) * self._lean_rate(state),
            cg_height=m.crown + (m.cg_height - m.crown) * cos(lean),
            lean=lean,
        )

    def handlebar(self, steer: float, lean: float) -> float:
        """Handlebar angle [rad] for a steer angle at the ground."""
        return handlebar_of(steer, lean, self.machine.caster)

    def rates(self, state: MachineState, steer: float, drive: float | None, road: RoadConditions) -> Rates:
        """With the handlebar at `steer` [rad] and a force `drive` [N] (None: what holds the speed)."""
        rates = super().rates(state, steer, drive, road)
        return replace(rates, change=(*rates.change, self._lean_rate(state)))

    def _lean_rate(self, state: MachineState) -> float:
        return (self._balance(state[0], state[2]) - state[8]) / LEAN_TIME

    def _balance(self, u: float, r: float) -> float:
        return lean_of(-atan(u * r / GRAVITY), self.machine.crown, self.machine.cg_height)
