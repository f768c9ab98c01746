"""Loss of recovered power, P = s·max(-τ·ω, 0): braking gives back less than losses in both directions say.

A share of the mechanical power that the motor takes while it brakes; Lord 2016, eqs. 2.1-2.6, has one loss for both
directions. Its maps do not include losses of a controller at braking alone, such as braking against its own field.
"""

from gz_onboard.model.effect import Parameter, Port, Values

PORT = Port.INVERTER_LOSS
PARAMETERS = (
    Parameter(
        "regeneration_loss_share",
        "1",
        prior=0.1,
        prior_sd=0.1,
        low=0.0,
        high=1.0,
        source="a guess: a tenth of the motor's power",
        ride_sd=0.02,
        healthy_sd=0.03,
    ),
)
SHOWN_BY = (
    "DC power short of the model's while the motor brakes and right while it drives; stops from speed by the motor "
    "alone split it from the friction brakes."
)


def term(torque: Values, motor_speed: Values, *, regeneration_loss_share: float) -> Values:
    """Heat [W]."""
    power = torque * motor_speed
    return regeneration_loss_share * (abs(power) - power) / 2
