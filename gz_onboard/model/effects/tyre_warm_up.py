"""Cold tyres, F = m·g·cos θ·c0·s·exp(-t/τ): so much more rolling resistance, fading with the time t ridden.

Rubber loses less as it warms: ISO 28580 has a tyre run for half an hour before its rolling resistance is measured.
"""

from gz_onboard.model.effect import Parameter, Port, Values
from gz_onboard.model.effects.rolling_resistance import term as rolling
from gz_onboard.model.functions import exp

PORT = Port.TYRE
PARAMETERS = (
    Parameter(
        "warm_up_share",
        "1",
        prior=0.3,
        prior_sd=0.2,
        low=0.0,
        high=2.0,
        source="a guess: as cold days over warm ones, 20 to 40 %",
        ride_sd=0.05,
        healthy_sd=0.2,
    ),
    Parameter(
        "warm_up_time",
        "s",
        prior=600.0,
        prior_sd=200.0,
        low=60.0,
        high=3600.0,
        source="ISO 28580: warm after 30 min of running: three times this",
    ),
)
SHOWN_BY = (
    "Road load that falls within the first 10-20 min ridden, at all speeds, and does not when riding on straight "
    "after; a ride that starts with a warm motor and cold tyres splits it from effects of the motor's temperature."
)


def term(
    speed: Values,
    mass: Values,
    grade_cosine: Values,
    time_moving: Values,
    *,
    rolling_resistance_constant: float,
    warm_up_share: float,
    warm_up_time: float,
) -> Values:
    """Force [N] against the motion."""
    more = rolling_resistance_constant * warm_up_share * exp(-time_moving / warm_up_time)
    return rolling(speed, mass, grade_cosine, rolling_resistance_constant=more, rolling_resistance_speed=0.0)
