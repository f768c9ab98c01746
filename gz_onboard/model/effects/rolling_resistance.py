"""Rolling resistance, F = m·g·cos θ·(c0 + c1·V): Lord 2016, eq. 3.9, has c1 alone; road load is A + B·V + C·V².

Smooth around standstill: the constant term fades below 0.1 m/s, where a scooter that stands is held, not driven.
"""

from gz_onboard.constants import GRAVITY, MILD
from gz_onboard.model.effect import Parameter, Port, Values
from gz_onboard.model.functions import direction

PORT = Port.TYRE
PARAMETERS = (
    Parameter(
        "rolling_resistance_constant",
        "1",
        prior=0.015,
        prior_sd=0.005,
        low=0.0,
        high=0.06,
        source="scooter tyres: Cossalter 2006, sec. 2.3",
        ride_sd=7e-4,
    ),
    Parameter(
        "rolling_resistance_speed",
        "s/m",
        prior=2e-4,
        prior_sd=2e-4,
        low=0.0,
        high=3e-3,
        source="SAE J2452: rises by a few percent per m/s",
        ride_sd=2e-5,
    ),
)
CAUSE = ("rolling_resistance", "F = m·g·cos θ·c0")
SHOWN_BY = (
    "Road load that is the same at all speeds and grows with weight; rides with another payload split it from a "
    "dragging brake."
)


def term(
    speed: Values,
    mass: Values,
    grade_cosine: Values,
    *,
    rolling_resistance_constant: float,
    rolling_resistance_speed: float,
) -> Values:
    """Force [N] against the motion."""
    return (
        mass
        * GRAVITY
        * grade_cosine
        * (rolling_resistance_constant * direction(speed) + rolling_resistance_speed * speed)
    )


def variation(ambient_temperature: Values, *, rolling_cold: float) -> Values:
    """Cold rubber rolls worse; rolling_cold: by how much more at 0 than at 20 degC."""
    return 1 + rolling_cold * (MILD - ambient_temperature) / MILD
