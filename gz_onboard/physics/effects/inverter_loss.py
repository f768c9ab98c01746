"""Inverter loss, P = c0 + c1·|i_m| + c2·i_m²: gate drive, switching and conduction (Lord 2016, eqs. 2.1-2.6)."""

from __future__ import annotations

from typing import Any

from gz_onboard.physics.effect import Parameter, Port

PORT = Port.INVERTER_LOSS
SUPPLY = "control and gate supply of a 48 V inverter"
SWITCHING = "switching loss: grows with current"
CONDUCTION = "conduction: MOSFET on-resistance"
PARAMETERS = (
    Parameter("inverter_loss_constant", "W", 10.0, 6.0, 0.0, 2000.0, SUPPLY, ride_sd=0.5, bench=True),
    Parameter("inverter_loss_linear", "W/A", 0.3, 0.2, 0.0, 50.0, SWITCHING, ride_sd=0.02, bench=True),
    Parameter("inverter_loss_quadratic", "W/A²", 3e-3, 2e-3, 0.0, 5.0, CONDUCTION, ride_sd=1e-4, bench=True),
)
CAUSE = ("inverter_loss", "P = c1·|i|")
STRENGTHS = ("inverter_loss_linear",)
SHOWN_BY = (
    "DC power over air-gap power grows with the current itself, and the inverter warms; steady riding at low and at"
    " high torque splits it from winding resistance."
)


def term(
    motor_current: Any, *, inverter_loss_constant: float, inverter_loss_linear: float, inverter_loss_quadratic: float
) -> Any:
    """Heat [W]."""
    return (
        inverter_loss_constant
        + inverter_loss_linear * abs(motor_current)
        + inverter_loss_quadratic * motor_current * motor_current
    )
