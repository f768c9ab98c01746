"""A tyre's side force over slip and camber, and what its round crown does to a leaning wheel.

All forces are per load [N/N]: on the loads of a scooter, stiffness and grip are taken to grow with load.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, atan, atan2, cos, sin, tan

SHAPE = 1.6  # shape factor C of side force: Pacejka 2012, ch. 11
SLIP_SPEED = 0.5  # m/s: below it slip is relative to this speed, as ε does in Lord 2016, eq. 3.10


@dataclass(frozen=True)
class LateralTyre:
    """The side of a tyre; stiffness [1/rad], friction [1], twisting arm [m/rad], relaxation length [m]."""

    cornering_stiffness: float
    camber_stiffness: float
    friction: float
    twisting_arm: float
    relaxation_length: float

    def side_force(self, slip: float, camber: float) -> float:
        """Side force per load at a slip angle and a camber angle [rad].

        The magic formula (Lord 2016, eq. 3.12, E = 0) over the equivalent slip angle α + γ·C_γ/C_α, so that camber
        thrust and slip share the same grip (Pacejka 2012, ch. 11); at small angles C_α·α + C_γ·γ.
        """
        linear = self.cornering_stiffness * slip + self.camber_stiffness * camber
        return self.friction * sin(SHAPE * atan(linear / (SHAPE * self.friction)))

    def twist(self, camber: float) -> float:
        """Twisting moment per load [m] of a rolling, cambered tyre, about the vertical (Cossalter 2006, sec. 2.6).

        The side of the contact that is on the inside of the lean has the smaller radius and is dragged, the other is
        pushed; with C_κ the longitudinal stiffness per load and w half the width of the contact, brushes give
        C_κ·w²/(3·r)·γ.
        """
        return self.twisting_arm * camber

    def slip_rate(self, slip: float, forward: float, sideways: float) -> float:
        """How fast the slip angle [rad] changes [rad/s] with the contact moving at these speeds [m/s] in wheel axes.

        The printed α = -atan(sideways/forward), reached over the relaxation length (Pacejka 2012, eq. 7.12).
        That lag is what keeps the lateral motion from becoming stiff when the speed falls to zero.
        """
        return (self.settled_slip(forward, sideways) - slip) * self.slip_decay(forward)

    def settled_slip(self, forward: float, sideways: float) -> float:
        """The slip angle [rad] that a contact moving at these speeds [m/s] comes to."""
        return -atan(sideways / max(abs(forward), SLIP_SPEED))

    def slip_decay(self, forward: float) -> float:
        """How fast the slip angle settles [1/s] with the contact moving at `forward` [m/s]."""
        return max(abs(forward), SLIP_SPEED) / self.relaxation_length


def rolling_radius(radius: float, crown: float, lean: float) -> float:
    """Radius [m] from the axle to the contact of a wheel with a round crown, r_t - t·(1 - cos φ)."""
    return radius - crown * (1 - cos(lean))


def lean_of(ideal: float, crown: float, height: float) -> float:
    """Lean [rad] at which a machine on round tyres is in balance where a thin disc leans by `ideal`.

    φ = φ_ideal + asin(t·sin φ_ideal/(h - t)) (Cossalter 2006, sec. 4.1): the contact moves to the inside of the turn.
    """
    return ideal + asin(max(-1.0, min(1.0, crown * sin(ideal) / (height - crown))))


def ideal_of(lean: float, crown: float, height: float) -> float:
    """The inverse of `lean_of`: direction [rad] from the contact to the centre of gravity."""
    arm = height - crown
    return atan2(arm * sin(lean), arm * cos(lean) + crown)


def ground_steer(handlebar: float, lean: float, caster: float) -> float:
    """Steer angle [rad] that the front wheel draws on the ground (Cossalter 2006, sec. 1.4).

    tan δ = tan δ_bar·cos ε/(cos φ - sin φ·sin ε·tan δ_bar) with lean to the same side positive; here lean is positive
    to the right, steer to the left, which turns the sign around.
    """
    turned = tan(handlebar)
    return atan(turned * cos(caster) / (cos(lean) + sin(lean) * sin(caster) * turned))


def handlebar_of(steer: float, lean: float, caster: float) -> float:
    """The inverse of `ground_steer` [rad]."""
    wanted = tan(steer)
    return atan(wanted * cos(lean) / (cos(caster) - sin(lean) * sin(caster) * wanted))


def front_camber(handlebar: float, lean: float, caster: float) -> float:
    """Camber [rad] of the front wheel, positive to the left: steered inwards it leans more (Cossalter 2006, 1.4)."""
    return asin(cos(lean) * sin(handlebar) * sin(caster) - cos(handlebar) * sin(lean))
