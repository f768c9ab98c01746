"""Weight along the road, F = m·g·sin θ (Lord 2016, eq. 3.2). Returns downhill the energy taken uphill."""

from gz_onboard.constants import GRAVITY
from gz_onboard.model.effect import Parameter, Port, Values

PORT = Port.WHEEL_FORCE
PARAMETERS: tuple[Parameter, ...] = ()
STORES_ENERGY = True


def term(mass: Values, grade: Values) -> Values:
    """Force [N] against the motion."""
    return mass * GRAVITY * grade
