"""Inertia of the vehicle and of what rotates, F = (m + J/r²)·dV/dt (Lord 2016, eqs. 2.11, 3.3)."""

from collections.abc import Mapping

from gz_onboard.model.effect import Parameter, Port, Values

PORT = Port.WHEEL_FORCE
PARAMETERS: tuple[Parameter, ...] = ()
STORES_ENERGY = True


def term(
    acceleration: Values, mass: Values, *, wheel_inertia_front: float, wheel_inertia_rear: float, wheel_radius: float
) -> Values:
    """Force [N] against the motion."""
    return (mass + (wheel_inertia_front + wheel_inertia_rear) / wheel_radius**2) * acceleration


def rotating_mass(parameters: Mapping[str, float]) -> float:
    """What rotates, as mass at the wheel [kg]."""
    names = ("wheel_inertia_front", "wheel_inertia_rear", "wheel_radius")
    return float(term(1.0, 0.0, **{name: parameters[name] for name in names}))
