"""Copper loss of the motor, P = r(T)·(1 + f·ω²)·i_m², r(T) = r_25·(1 + 0.00393·(T − 25)), i_m on the inverter's scale.

The share f·ω² is that of eddy currents in the winding, which grow with the square of the frequency (skin and proximity
effect while the wire is thinner than the skin: Sullivan 2001).
"""

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.model.effect import MOTOR_RESISTANCE, Parameter, Port, Values

PORT = Port.MOTOR_LOSS
PARAMETERS = (
    Parameter(
        "motor_copper_resistance",
        "ohm",
        prior=0.03,
        prior_sd=0.015,
        low=1e-5,
        high=10.0,
        source="hub motors of 1.5-3 kW at 52 V; at 25 degC",
        ride_sd=3e-4,
        bench=True,
        grows_with=MOTOR_RESISTANCE,
    ),
    Parameter("motor_copper_temperature_coefficient", "1/K", 0.00393, 1e-4, 0.0, 0.01, "IEC 60034-1"),
    Parameter(
        "motor_copper_frequency",
        "s²/rad²",
        prior=0.0,
        prior_sd=5e-5,
        low=0.0,
        high=0.01,
        source="windings of thin wire: none; of bars: tens of percent at full speed",
        ride_sd=1e-6,
        bench=True,
        grows_with="wheel_radius^2 gear_ratio^2",
    ),
)
CAUSE = ("winding_resistance", "P = r·(1 + a·(T − 25))·i²")
SCALE = 50.0  # rad/s, at which copper_speed is the share
SHOWN_BY = (
    "DC power over air-gap power grows with the square of the current, and the motor warms; full-throttle starts "
    "split it from inverter loss."
)


def term(
    motor_current: Values,
    motor_temperature: Values,
    motor_speed: Values,
    *,
    motor_copper_resistance: float,
    motor_copper_temperature_coefficient: float,
    motor_copper_frequency: float,
) -> Values:
    """Heat [W]."""
    return (
        motor_copper_resistance
        * (1 + motor_copper_frequency * motor_speed * motor_speed)
        * (1 + motor_copper_temperature_coefficient * (motor_temperature - BENCH_TEMPERATURE))
        * motor_current
        * motor_current
    )


def variation(
    motor_speed: Values, *, copper_speed: float, motor_copper_resistance: float, healthy_motor_copper_resistance: float
) -> Values:
    """Eddy currents grow with frequency in the healthy winding, not in a fault; copper_speed: share at `SCALE`."""
    own = healthy_motor_copper_resistance / motor_copper_resistance
    return 1 + own * copper_speed * abs(motor_speed) / SCALE
