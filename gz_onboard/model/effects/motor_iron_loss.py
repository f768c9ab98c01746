"""Iron and drag loss of the motor: hysteresis and bearings with speed, eddy currents with its square."""

from gz_onboard.model.effect import TORQUE, Parameter, Port, Values

PORT = Port.MOTOR_LOSS
PARAMETERS = (
    Parameter(
        "motor_iron_linear",
        "W·s/rad",
        prior=0.5,
        prior_sd=0.4,
        low=0.0,
        high=200.0,
        source="Bertotti 1988: hysteresis loss grows with frequency",
        ride_sd=0.03,
        bench=True,
        grows_with=TORQUE,
    ),
    Parameter(
        "motor_iron_quadratic",
        "W·s²/rad²",
        prior=0.01,
        prior_sd=0.01,
        low=0.0,
        high=20.0,
        source="Bertotti 1988: eddy loss, its square",
        ride_sd=0.001,
        bench=True,
        grows_with="mass wheel_radius^2 gear_ratio^2",
    ),
)


def term(motor_speed: Values, *, motor_iron_linear: float, motor_iron_quadratic: float) -> Values:
    """Heat [W]."""
    return motor_iron_linear * abs(motor_speed) + motor_iron_quadratic * motor_speed * motor_speed
