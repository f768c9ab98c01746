"""A brake that drags, F = F_b while the vehicle moves: pads rub with the same force at any load.

Coulomb friction of pads that do not come free (Limpert 2011, Brake Design and Safety). Smooth around standstill.
"""

from gz_onboard.model.effect import MASS, Parameter, Port, Values
from gz_onboard.model.functions import direction

PORT = Port.WHEEL_FORCE
PARAMETERS = (
    Parameter(
        "brake_drag_force",
        "N",
        prior=5.0,
        prior_sd=5.0,
        low=0.0,
        high=5000.0,
        source="a guess: a free disc takes 1 to 3 N at the tyre",
        ride_sd=1.0,
        healthy_sd=1.5,
        grows_with=MASS,
    ),
)
SHOWN_BY = (
    "Road load that is the same at all speeds and loads; rides with another payload split it from rolling resistance, "
    "which grows with weight."
)


def term(speed: Values, *, brake_drag_force: float) -> Values:
    """Force [N] against the motion."""
    return brake_drag_force * direction(speed)
