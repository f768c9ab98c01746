"""Cornering drag: tyres that push sideways also hold back, F = c·m·a_y²/g.

A tyre's side force needs a slip angle, α = F_y/C_α, and along the path it then pulls back with F_y·α; summed over both
axles this is (m·a_y)²·(s_f²/C_αf + s_r²/C_αr), s the share of the mass on each (Cossalter 2006, sec. 4.2; Pacejka 2012,
sec. 1.3). Stiffness grows with load, so one number is left: c = s_f/c_f + s_r/c_r with c_f, c_r the stiffness per load
[1/rad]. A leaning machine slips less, but its tyres twist on the road, which grows with the square of the lean, hence
at small angles with a_y² too: c then is what both take together.
"""

from gz_onboard.constants import GRAVITY
from gz_onboard.model.effect import Parameter, Port, Values
from gz_onboard.model.functions import direction

PORT = Port.WHEEL_FORCE
PARAMETERS = (
    Parameter(
        "cornering_compliance",
        "rad",
        prior=0.1,
        prior_sd=0.05,
        low=0.0,
        high=0.5,
        source="Pacejka 2012, ch. 11: slip alone 0.06, lean up to 0.3",
        ride_sd=0.015,
        healthy_sd=0.1,
    ),
)
TURNING_LOSS = True
SHOWN_BY = (
    "Road load that grows with the square of speed times yaw rate and is absent on the straight; bends at one speed, "
    "left and right, split it from drag area and rolling resistance."
)


def term(speed: Values, mass: Values, lateral_acceleration: Values, *, cornering_compliance: float) -> Values:
    """Force [N] against the motion."""
    return cornering_compliance * mass * lateral_acceleration * lateral_acceleration / GRAVITY * direction(speed)
