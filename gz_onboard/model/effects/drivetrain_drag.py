"""Drag of what turns with the wheel, F = b·V/r²: grease, seals and gear oil, a torque that grows with wheel speed.

The viscous part of a bearing's friction torque grows with its speed (Harris & Kotzalas 2006, Rolling Bearing Analysis,
sec. 10.3); unlike the tyres' it does not grow with the load.
"""

from gz_onboard.model.effect import ROTATION, Parameter, Port, Values

PORT = Port.WHEEL_FORCE
PARAMETERS = (
    Parameter(
        "drivetrain_drag_torque",
        "N·m·s/rad",
        prior=0.02,
        prior_sd=0.02,
        low=0.0,
        high=50.0,
        source="seals and bearings: 1 N·m at 50 rad/s",
        ride_sd=0.005,
        healthy_sd=0.01,
        grows_with=ROTATION,
    ),
)
SHOWN_BY = (
    "Road load in proportion to speed, the same at all payloads; rides over all speeds split it from drag area, which "
    "goes with the square, and coasting with the wheel lifted splits it from the rolling resistance's rise with speed."
)


def term(speed: Values, *, drivetrain_drag_torque: float, wheel_radius: float) -> Values:
    """Force [N] against the motion."""
    return drivetrain_drag_torque * speed / (wheel_radius * wheel_radius)
