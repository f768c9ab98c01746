"""Aerodynamic drag, F = ½·ρ·C_d·A·(V + V_w)·|V + V_w| (Lord 2016, eq. 3.1, with the sign kept in a tailwind)."""

from gz_onboard.model.effect import Parameter, Port, Values

PORT = Port.WHEEL_FORCE
PARAMETERS = (
    Parameter(
        "drag_area",
        "m²",
        prior=0.55,
        prior_sd=0.15,
        low=0.05,
        high=8.0,
        source="scooter with upright rider: Cossalter 2006, table 3.1, CdA 0.5-0.7",
        ride_sd=0.01,
        required=True,
    ),
)
CAUSE = ("aero_drag_area", "F = ½·ρ·CdA·V²")
SHOWN_BY = (
    "Road load that grows with the square of speed; long stretches at 30 and at 50 km/h in both directions split it"
    " from drivetrain drag and wind."
)


def term(speed: Values, headwind: Values, air_density: Values, *, drag_area: float) -> Values:
    """Force [N] against the motion."""
    flow = speed + headwind
    return 0.5 * air_density * drag_area * flow * abs(flow)
