"""Iron and drag loss of the motor: hysteresis and bearings with speed, eddy currents with its square."""

from __future__ import annotations

from typing import Any

from gz_onboard.physics.effect import Parameter, Port

PORT = Port.MOTOR_LOSS
HYSTERESIS = "Bertotti 1988: hysteresis loss grows with frequency"
EDDIES = "Bertotti 1988: eddy loss, its square"
PARAMETERS = (
    Parameter("motor_iron_linear", "W·s/rad", 0.5, 0.4, 0.0, 200.0, HYSTERESIS, ride_sd=0.03, bench=True),
    Parameter("motor_iron_quadratic", "W·s²/rad²", 0.01, 0.01, 0.0, 20.0, EDDIES, ride_sd=0.001, bench=True),
)


def term(motor_speed: Any, *, motor_iron_linear: float, motor_iron_quadratic: float) -> Any:
    """Heat [W]."""
    return motor_iron_linear * abs(motor_speed) + motor_iron_quadratic * motor_speed * motor_speed
