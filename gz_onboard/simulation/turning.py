"""Chassis models: straight, or turning as an upright (planar) or leaning two-wheeler (Lord 2016, ch. 4).

A turn lasts much longer than the 0.2 s in which lean and tyres settle, so the turning models are tables of steady
turns over speed and lateral acceleration. x is forward, y left, z up (ISO 8855). Steer, yaw rate, lateral speed, side
force, slip angle and camber are positive to the left, lean to the right. Forces of a tyre are per load [N/N].

Steady turn at speed u, lateral speed v and yaw rate r, with a and b from the centre of gravity to the front and rear
axle and δ the steer at the ground (Cossalter 2006, ch. 7; Pacejka 2012, sec. 1.3):

    m·u·r = F_yr + F_yf·cos δ + X_f·sin δ,  a·(F_yf·cos δ + X_f·sin δ) + twist = b·F_yr
    α_f = δ - atan((v + a·r)/u),  α_r = -atan((v - b·r)/u),  F_y = F_y(α, γ)

A leaning machine leans by φ = φ_ideal + asin(t·sin φ_ideal/(h - t)) on tyres with a crown of radius t (Cossalter 2006,
sec. 4.1). Its camber carries most of the side force, so the tyres slip less; but a cambered tyre is a cone made to run
straight: the moment that twists it, times (V/r)·sin γ - dψ/dt, is lost as heat.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass
from math import asin, atan, cos, sin, sqrt, tan
from typing import NamedTuple

from gz_onboard.constants import GRAVITY, MILD
from gz_onboard.errors import InputError, nearest
from gz_onboard.model.effects import aerodynamic_drag, rolling_resistance
from gz_onboard.model.functions import STANDSTILL
from gz_onboard.model.model import air_density

STRAIGHT = "straight"  # loses nothing in turns (Lord 2016, eqs. 3.1-3.7)
MODELS = (STRAIGHT, "planar", "leaning")
LEAN_TIME = 0.2  # s: lag of the lean behind the road
TIGHTEST_M = 2.0  # radius of a scooter's smallest circle
HARDEST = 8.0  # m/s²: 39 degrees on thin wheels, more than a scooter's stand clears
SPEEDS = (0.5, 1.0, 2.0, 3.0, 4.5, 6.0, 8.0, 10.0, 12.5, 16.0, 20.0, 27.0, 35.0)  # m/s, of the table
SHARES = 40  # steps of the table over lateral acceleration
SLIP_SPEED = 0.5  # m/s: below, slip is relative to this speed
SHAPE = 1.6  # C of the magic formula for side force (Pacejka 2012, ch. 11)


class Turn(NamedTuple):
    """Changes by a turn, compared with riding straight on."""

    resistance: float  # force against the motion over weight, beyond drag and upright rolling resistance
    front_load: float  # load moved to the front axle, over weight
    height: float  # of the centre of gravity over the road, upright 1
    radius: float  # of the wheels, upright 1
    lean: float  # rad, positive right


STRAIGHT_ON = Turn(0.0, 0.0, 1.0, 1.0, 0.0)


class Chassis:
    """A chassis that turns, as a table of steady turns. Lateral acceleration follows the road within `LEAN_TIME`."""

    def __init__(self, name: str, parameters: Mapping[str, float]) -> None:
        self.name = name
        self.leans = name == "leaning"
        machine = TwoWheeler(parameters, self.leans)
        self.beyond = 0.0  # s in which the road turned harder than the table goes
        self.lateral = 0.0  # m/s², positive left
        grip = 0.8 * machine.side_friction * GRAVITY
        self._limits = [min(HARDEST, grip, speed * speed / TIGHTEST_M) for speed in SPEEDS]
        self._table = [
            [machine.changes(speed, limit * k / SHARES) for k in range(SHARES + 1)]
            for speed, limit in zip(SPEEDS, self._limits, strict=True)
        ]

    def turn(self, speed: float, curvature: float, dt: float) -> Turn:
        """Return the turn after `dt` [s] on a road of `curvature` [1/m, positive left] at `speed` [m/s].

        Bilinear between the four nearest steady turns.
        """
        wanted = speed * abs(speed) * curvature
        self.lateral += (wanted - self.lateral) * min(dt / LEAN_TIME, 1.0)
        hard = abs(self.lateral)
        if hard < 1e-6:
            return STRAIGHT_ON
        speed = min(max(abs(speed), SPEEDS[0]), SPEEDS[-1])
        i = max(bisect_left(SPEEDS, speed), 1) - 1
        part = (speed - SPEEDS[i]) / (SPEEDS[i + 1] - SPEEDS[i])
        slow, fast = hard / self._limits[i], hard / self._limits[i + 1]
        if slow > 1.0:
            part = 1.0  # the slower of the two cannot turn as tightly
            if fast > 1.0:
                self.beyond += dt
        slow, fast = SHARES * min(slow, 1.0), SHARES * min(fast, 1.0)
        k, m = min(int(slow), SHARES - 1), min(int(fast), SHARES - 1)
        b, d = (1.0 - part) * (slow - k), part * (fast - m)
        a, c = 1.0 - part - b, part - d
        one, two = self._table[i], self._table[i + 1]
        corners = zip(one[k], one[k + 1], two[m], two[m + 1], strict=True)
        turn = Turn(*(a * w + b * x + c * y + d * z for w, x, y, z in corners))
        return turn._replace(lean=-turn.lean) if self.lateral > 0 else turn


def chassis(name: str, parameters: Mapping[str, float]) -> Chassis | None:
    """Return the chassis of that name for a vehicle with these parameters; None if it loses nothing in turns.

    InputError for an unknown name.
    """
    if name not in MODELS:
        raise InputError(f"no chassis is called {name!r}; there are {', '.join(MODELS)}{nearest(name, MODELS)}")
    return None if name == STRAIGHT else Chassis(name, parameters)


@dataclass(frozen=True)
class SteadyTurn:
    """A steady turn: angles [rad], forces [N], powers lost [W]; `front` and `rear` are axles."""

    lateral_speed: float  # m/s
    steer: float  # of the handlebar
    lean: float
    slip: tuple[float, float]
    side: tuple[float, float]
    load: tuple[float, float]
    drive: float  # that holds the speed
    sideslip: float
    twisting: float
    imbalance: tuple[float, float]  # of side force [N] and yaw moment [N·m]; 0 in equilibrium


class TwoWheeler:
    """A two-wheeler with its rider that turns upright, or leans."""

    def __init__(self, parameters: Mapping[str, float], leans: bool) -> None:
        self.p = p = parameters
        self.leans = leans
        self.mass = p["vehicle_mass"] + p["payload_mass"]
        self.weight = self.mass * GRAVITY
        self.side_friction = p["side_friction"]

    def changes(self, speed: float, lateral: float) -> Turn:
        """Return the changes by a steady turn to the left at `speed` [m/s] and `lateral` acceleration [m/s²]."""
        if not lateral:
            return STRAIGHT_ON
        turn, p = self.steady(speed, lateral / speed), self.p
        drag, rolling, height = self._drag(speed), self._rolling(speed), self._height(turn.lean)
        level = (self.weight * p["cg_to_rear"] - height * drag) / p["wheelbase"]
        return Turn(
            resistance=(turn.drive - drag) / self.weight - rolling,
            front_load=(turn.load[0] - level) / self.weight,
            height=height / p["cg_height"],
            radius=self._radius(turn.lean) / p["wheel_radius"],
            lean=abs(turn.lean),
        )

    def steady(self, speed: float, rate: float) -> SteadyTurn:
        """Return the steady turn at `speed` [m/s] and yaw `rate` [rad/s], by Newton's method.

        It starts from the turn of wheels that do not slip. ArithmeticError beyond the tyres' grip.
        """
        p = self.p
        x, y = p["cg_to_rear"] * rate, self.handlebar(atan(p["wheelbase"] * rate / speed), self.lean(speed, rate))
        for _ in range(60):
            turn = self.forces(speed, x, rate, y)
            off = turn.imbalance
            if abs(off[0]) < 1e-9 * self.mass and abs(off[1]) < 1e-9 * self.mass:
                return turn
            h = 1e-6
            a, b = self.forces(speed, x + h, rate, y).imbalance, self.forces(speed, x, rate, y + h).imbalance
            xx, xy, yx, yy = (a[0] - off[0]) / h, (b[0] - off[0]) / h, (a[1] - off[1]) / h, (b[1] - off[1]) / h
            det = xx * yy - xy * yx
            dx, dy = (off[1] * xy - off[0] * yy) / det, (off[0] * yx - off[1] * xx) / det
            scale = min(1.0, 0.2 / max(abs(dy), 1e-12), 0.3 * speed / max(abs(dx), 1e-12))
            x, y = x + scale * dx, y + scale * dy
        raise ArithmeticError(f"no steady turn at {speed:g} m/s and {rate:g} rad/s")

    def forces(self, u: float, v: float, r: float, handlebar: float) -> SteadyTurn:
        """Return the forces at forward and lateral speed [m/s] and yaw rate [rad/s], held at that speed."""
        p, lean = self.p, self.lean(u, r)
        a, b = p["wheelbase"] - p["cg_to_rear"], p["cg_to_rear"]
        steer, camber_front = handlebar, 0.0
        if self.leans:
            steer = ground_steer(handlebar, lean, p["caster_angle"])
            camber_front = front_camber(handlebar, lean, p["caster_angle"])
        c, s = cos(steer), sin(steer)
        across = v + a * r
        along_f, across_f = u * c + across * s, across * c - u * s  # of the contact, in the axes of the wheel
        across_r = v - b * r
        slip_f, slip_r = slip_angle(along_f, across_f), slip_angle(u, across_r)
        side_f, rolling_f, twist_f, dragged_f = self._wheel("front", slip_f, camber_front, along_f, lean)
        side_r, rolling_r, twist_r, dragged_r = self._wheel("rear", slip_r, -lean, u, lean)
        x_f = -(rolling_f + dragged_f) * c - side_f * s
        y_f = side_f * c - (rolling_f + dragged_f) * s
        x_r = -(rolling_r + dragged_r)
        ground = self._drag(u) - self.mass * v * r  # force of the ground along the machine
        load_f = (self.weight * b - self._height(lean) * ground) / p["wheelbase"]
        load_f = min(max(load_f, 0.0), self.weight)
        load_r = self.weight - load_f
        twisting = load_f * (dragged_f * along_f - twist_f * r) + load_r * (dragged_r * u - twist_r * r)
        return SteadyTurn(
            lateral_speed=v,
            steer=handlebar,
            lean=lean,
            slip=(slip_f, slip_r),
            side=(load_f * side_f, load_r * side_r),
            load=(load_f, load_r),
            drive=ground - load_f * x_f - load_r * x_r,
            sideslip=-load_f * side_f * across_f - load_r * side_r * across_r,
            twisting=twisting,
            imbalance=(
                load_f * y_f + load_r * side_r - self.mass * u * r,
                load_f * (a * y_f + twist_f) + load_r * (twist_r - b * side_r),
            ),
        )

    def lean(self, u: float, r: float) -> float:
        """Return the lean [rad] in balance at speed [m/s] and yaw rate [rad/s]; 0 of an upright machine."""
        if not self.leans:
            return 0.0
        return lean_of(-atan(u * r / GRAVITY), self.p["tyre_crown_radius"], self.p["cg_height"])

    def handlebar(self, steer: float, lean: float) -> float:
        """Return the handlebar angle [rad] for a steer angle at the ground, the inverse of `ground_steer`."""
        if not self.leans:
            return steer
        caster, wanted = self.p["caster_angle"], tan(steer)
        return atan(wanted * cos(lean) / (cos(caster) - sin(lean) * sin(caster) * wanted))

    def _height(self, lean: float) -> float:
        crown = self.p["tyre_crown_radius"] if self.leans else 0.0
        return crown + (self.p["cg_height"] - crown) * cos(lean)

    def _radius(self, lean: float) -> float:
        """From the axle to the contact on the side of the crown [m]."""
        return self.p["wheel_radius"] - self.p["tyre_crown_radius"] * (1 - cos(lean))

    def _drag(self, speed: float) -> float:
        return float(aerodynamic_drag.term(speed, 0.0, air_density(MILD), drag_area=self.p["drag_area"]))

    def _rolling(self, speed: float) -> float:
        """Rolling resistance per load: eq. 3.9 with a constant term."""
        names = ("rolling_resistance_constant", "rolling_resistance_speed")
        return float(rolling_resistance.term(speed, 1 / GRAVITY, 1.0, **{name: self.p[name] for name in names}))

    def _wheel(
        self, axle: str, slip: float, camber: float, along: float, lean: float
    ) -> tuple[float, float, float, float]:
        """Side force, rolling resistance, twisting moment [m] and its drag, all per load."""
        p = self.p
        rolls = along / sqrt(along * along + STANDSTILL * STANDSTILL)  # a wheel that stands has no camber thrust
        stiffness = p[f"cornering_stiffness_{axle}"], p[f"camber_stiffness_{axle}"]
        side = side_force(slip, camber * abs(rolls), *stiffness, self.side_friction)
        in_plane = cos(camber) + side * sin(camber)  # load in the plane of the wheel
        twist = p["twisting_arm"] * camber * rolls  # Cossalter 2006, sec. 2.6
        return side, self._rolling(along) * in_plane, twist, twist * sin(camber) / self._radius(lean)


def side_force(slip: float, camber: float, cornering: float, camber_stiffness: float, friction: float) -> float:
    """Return the side force per load at slip and camber angles [rad]; stiffnesses in 1/rad.

    The magic formula over the equivalent slip α + γ·C_γ/C_α, so that camber and slip share the grip (Lord 2016,
    eq. 3.12, E = 0; Pacejka 2012, ch. 11).
    """
    linear = cornering * slip + camber_stiffness * camber
    return friction * sin(SHAPE * atan(linear / (SHAPE * friction)))


def slip_angle(forward: float, sideways: float) -> float:
    """Return the slip angle [rad] of a contact that moves at these speeds [m/s] in the axes of its wheel."""
    return -atan(sideways / max(abs(forward), SLIP_SPEED))


def lean_of(ideal: float, crown: float, height: float) -> float:
    """Return the lean [rad] on round tyres where thin wheels lean by `ideal` (Cossalter 2006, sec. 4.1)."""
    return ideal + asin(max(-1.0, min(1.0, crown * sin(ideal) / (height - crown))))


def ground_steer(handlebar: float, lean: float, caster: float) -> float:
    """Return the steer angle [rad] of the front wheel on the ground (Cossalter 2006, sec. 1.4)."""
    turned = tan(handlebar)
    return atan(turned * cos(caster) / (cos(lean) + sin(lean) * sin(caster) * turned))


def front_camber(handlebar: float, lean: float, caster: float) -> float:
    """Return the camber [rad] of the front wheel: steered inwards it leans more (Cossalter 2006, sec. 1.4)."""
    return asin(cos(lean) * sin(handlebar) * sin(caster) - cos(handlebar) * sin(lean))
