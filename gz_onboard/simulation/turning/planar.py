"""The planar bicycle (Lord 2016, ch. 4, first model): upright, with lateral tyre forces and its place in the plane.

Equations (Cossalter 2006, ch. 7; Pacejka 2012, sec. 1.3; Sharp 1971 without roll), a and b from the centre of gravity
to the front and the rear axle, δ steer at the ground, X the rolling resistance of each tyre in its own plane:

    m·(du/dt - v·r) = X_r + X_f·cos δ - F_yf·sin δ - F_d - m·g·sin θ
    m·(dv/dt + u·r) = F_yr + F_yf·cos δ + X_f·sin δ
    I_z·dr/dt       = a·(F_yf·cos δ + X_f·sin δ) - b·F_yr
    α_f = δ - atan((v + a·r)/u),  α_r = -atan((v - b·r)/u),  F_y = F_y(α, γ, F_n)
    dX/dt = u·cos ψ - v·sin ψ,  dY/dt = u·sin ψ + v·cos ψ,  dψ/dt = r

The slip angles follow these over the relaxation length of the tyres, and the turning wheels add to the mass in the
first. The axle loads are eqs. 3.6 and 3.7 with the force of the tyres along the machine; everything is proportional to
load, so that they are solved for in closed form.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin, sqrt

from gz_onboard.simulation.turning.machine import Machine, MachineState, Rates, RoadConditions
from gz_onboard.simulation.turning.tyre import LateralTyre

STANDSTILL = 0.1  # m/s: below it what camber does fades, as rolling resistance does


@dataclass(frozen=True)
class Posture:
    """How the machine stands on its wheels: angles [rad], camber positive to the left; lengths [m]."""

    steer: float  # at the ground
    camber_front: float
    camber_rear: float
    radius: float
    radius_rate: float  # m/s
    cg_height: float
    lean: float


@dataclass(frozen=True)
class Planar:
    """MachineState: u, v [m/s], r [rad/s], x, y [m], heading [rad], slip angles front and rear [rad]."""

    machine: Machine

    def start(self, speed: float) -> MachineState:
        """Straight ahead at `speed` [m/s]."""
        return speed, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0

    def settled(self, u: float, v: float, r: float, steer: float) -> MachineState:
        """The state at speed, lateral speed [m/s] and yaw rate [rad/s] in which slip has settled."""
        return self._slipped((u, v, r, 0.0, 0.0, 0.0, 0.0, 0.0), steer)

    def _slipped(self, state: MachineState, steer: float) -> MachineState:
        m = self.machine
        u, v, r, x, y, heading, _, _, *rest = state
        delta = self.posture(state, steer).steer
        across = v + (m.wheelbase - m.cg_to_rear) * r
        along_f, across_f = u * cos(delta) + across * sin(delta), across * cos(delta) - u * sin(delta)
        front = m.front.settled_slip(along_f, across_f)
        return u, v, r, x, y, heading, front, m.rear.settled_slip(u, v - m.cg_to_rear * r), *rest

    def posture(self, state: MachineState, steer: float) -> Posture:
        """Upright, whatever the turn."""
        m = self.machine
        return Posture(steer, 0.0, 0.0, m.wheel_radius, 0.0, m.cg_height, 0.0)

    def handlebar(self, steer: float, lean: float) -> float:
        """Steer input [rad] for a steer angle at the ground: the same."""
        return steer

    def energy(self, state: MachineState) -> float:
        """Kinetic energy [J], of the turning wheels too."""
        m = self.machine
        u, v, r = state[:3]
        radius = self.posture(state, 0.0).radius
        return (m.mass * (u * u + v * v) + m.yaw_inertia * r * r + m.spin_inertia * (u / radius) ** 2) / 2

    def rates(self, state: MachineState, steer: float, drive: float | None, road: RoadConditions) -> Rates:
        """With `steer` [rad] at the ground and a force `drive` [N] of the rear wheel (None: what holds the speed)."""
        m = self.machine
        u, v, r, _, _, heading, slip_f, slip_r = state[:8]
        a, b = m.wheelbase - m.cg_to_rear, m.cg_to_rear
        p = self.posture(state, steer)
        c, s = cos(p.steer), sin(p.steer)
        # Contact speeds in the axes of each wheel.
        across = v + a * r
        along_f, across_f = u * c + across * s, across * c - u * s
        along_r, across_r = u, v - b * r
        # All forces of a wheel per its load: side, rolling (in the wheel's plane), twist about the vertical and its
        # drag; last the load in the wheel's plane.
        side_f, rolling_f, twist_f, drag_f, plane_f = self._wheel(m.front, slip_f, p.camber_front, along_f, p.radius)
        side_r, rolling_r, twist_r, drag_r, plane_r = self._wheel(m.rear, slip_r, p.camber_rear, along_r, p.radius)
        x_f = -(rolling_f + drag_f) * c - side_f * s
        y_f = side_f * c - (rolling_f + drag_f) * s
        x_r, y_r = -(rolling_r + drag_r), side_r

        drag, slope = m.resistance(u, road)
        weight = m.weight(road)
        spin = m.spin_inertia / p.radius**2
        spun = spin * u * p.radius_rate / p.radius  # force of wheels that turn faster on a smaller radius
        # Loads: h·X = b·W - p·N_f with X, the force of the ground along the machine, linear in N_f.
        if drive is None:
            ground = drag + slope - m.mass * v * r
            load_f = (weight * b - p.cg_height * ground) / m.wheelbase
        else:
            share = m.mass / (m.mass + spin)
            rest = -(1 - share) * (m.mass * v * r - drag - slope + spun) + spun
            tilt = p.cg_height * share
            load_f = weight * b - tilt * (drive + weight * x_r) - p.cg_height * rest
            load_f /= m.wheelbase + tilt * (x_f - x_r)
        load_f = min(max(load_f, 0.0), weight)
        load_r = weight - load_f
        tyres = load_f * x_f + load_r * x_r
        if drive is None:
            drive = drag + slope - m.mass * v * r - spun - tyres
        du = (drive + tyres + spun - drag - slope + m.mass * v * r) / (m.mass + spin)
        dv = (load_f * y_f + load_r * y_r) / m.mass - u * r
        dr = (load_f * (a * y_f + twist_f) + load_r * (twist_r - b * y_r)) / m.yaw_inertia
        ch, sh = cos(heading), sin(heading)
        slips = m.front.slip_rate(slip_f, along_f, across_f), m.rear.slip_rate(slip_r, along_r, across_r)
        change = (du, dv, dr, u * ch - v * sh, u * sh + v * ch, r, *slips)
        power = {
            "aerodynamic drag": drag * u,
            "rolling": load_f * rolling_f * along_f + load_r * rolling_r * along_r,
            "sideslip": -load_f * side_f * across_f - load_r * side_r * across_r,
            "twisting": load_f * (drag_f * along_f - twist_f * r) + load_r * (drag_r * along_r - twist_r * r),
            "grade": slope * u,
            "drive": -drive * u,
        }
        seen = {"speed": u, "acceleration": du, "drive": drive, "lateral_acceleration": u * r, "yaw_rate": r}
        seen |= {"lean": p.lean, "steer": p.steer, "load_front": load_f, "load_rear": load_r}
        seen |= {"plane_load_front": load_f * plane_f, "plane_load_rear": load_r * plane_r, "rolling_radius": p.radius}
        seen |= {"slip_front": slip_f, "slip_rear": slip_r, "side_front": load_f * side_f, "side_rear": load_r * side_r}
        fastest = max(m.front.slip_decay(along_f), m.rear.slip_decay(along_r))
        return Rates(change, power, seen, fastest)

    def _wheel(
        self, tyre: LateralTyre, slip: float, camber: float, along: float, radius: float
    ) -> tuple[float, float, float, float, float]:
        rolls = along / sqrt(along * along + STANDSTILL * STANDSTILL)  # a wheel that stands has no camber thrust
        side = tyre.side_force(slip, camber * abs(rolls))
        # The load in the wheel's plane, W·sqrt(1 + (a_y/g)²) where the wheel leans as a thin disc would.
        in_plane = cos(camber) + side * sin(camber)
        twist = tyre.twist(camber) * rolls
        return side, self.machine.rolling(along) * in_plane, twist, twist * sin(camber) / radius, in_plane
