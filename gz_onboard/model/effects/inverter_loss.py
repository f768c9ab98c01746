"""Inverter loss, P = c0 + c1·|i_m| + c2·i_m²: gate drive, switching and conduction (Lord 2016, eqs. 2.1-2.6)."""

from gz_onboard.model.effect import ELECTRONICS, MOTOR_RESISTANCE, Parameter, Port, Values

PORT = Port.INVERTER_LOSS
PARAMETERS = (
    Parameter(
        "inverter_loss_constant",
        "W",
        prior=10.0,
        prior_sd=6.0,
        low=0.0,
        high=2000.0,
        source="control and gate supply of a 48 V inverter",
        ride_sd=0.5,
        bench=True,
        grows_with=ELECTRONICS,
    ),
    Parameter(
        "inverter_loss_linear",
        "W/A",
        prior=0.3,
        prior_sd=0.2,
        low=0.0,
        high=50.0,
        source="switching loss: grows with current",
        ride_sd=0.02,
        bench=True,
        grows_with="wheel_radius^-1 gear_ratio^-1 torque_constant",
    ),
    Parameter(
        "inverter_loss_quadratic",
        "W/A²",
        prior=3e-3,
        prior_sd=2e-3,
        low=0.0,
        high=5.0,
        source="conduction: MOSFET on-resistance",
        ride_sd=1e-4,
        bench=True,
        grows_with=MOTOR_RESISTANCE,
    ),
)
CAUSE = ("inverter_loss", "P = c1·|i|")
STRENGTHS = ("inverter_loss_linear",)
SHOWN_BY = (
    "DC power over air-gap power grows with the current itself, and the inverter warms; steady riding at low and at"
    " high torque splits it from winding resistance."
)


def term(
    motor_current: Values, *, inverter_loss_constant: float, inverter_loss_linear: float, inverter_loss_quadratic: float
) -> Values:
    """Heat [W]."""
    return (
        inverter_loss_constant
        + inverter_loss_linear * abs(motor_current)
        + inverter_loss_quadratic * motor_current * motor_current
    )
