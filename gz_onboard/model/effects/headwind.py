"""Headwind, F = ½·ρ·C_d·A·((V_r + w)·|V_r + w| - V_r·|V_r|), w = w_N·cos ψ + w_E·sin ψ; of a steady wind over the land.

The wind (w_N, w_E) is named after where it blows from; ψ is the heading, V_r the speed and any headwind known
otherwise, so this is the part of the aerodynamic drag (Lord 2016, eq. 3.1) that the wind adds. Side wind, which adds a
little to the flow's speed and changes C_d, is left out: Cossalter 2006, sec. 3.2, knows the drag area head on only.
"""

from gz_onboard.model.effect import Parameter, Port, Values
from gz_onboard.model.effects.aerodynamic_drag import term as drag
from gz_onboard.model.functions import cos, sin

PORT = Port.WHEEL_FORCE
PARAMETERS = (
    Parameter(
        "wind_north",
        "m/s",
        prior=0.0,
        prior_sd=2.0,
        low=-15.0,
        high=15.0,
        source="at 1 m over ground half of the 3-5 m/s that weather tells",
        ride_sd=1.2,
        healthy_sd=0.4,
    ),
    Parameter(
        "wind_east",
        "m/s",
        prior=0.0,
        prior_sd=2.0,
        low=-15.0,
        high=15.0,
        source="at 1 m over ground half of the 3-5 m/s that weather tells",
        ride_sd=1.2,
        healthy_sd=0.4,
    ),
)
STRENGTHS = ("wind_north", "wind_east")
VARIES = True
SHOWN_BY = (
    "Road load above 5 m/s that goes with the heading once round, as 2·V·w; the same road in both directions splits it "
    "from drag area and grade."
)


def term(
    speed: Values,
    headwind: Values,
    heading: Values,
    air_density: Values,
    *,
    drag_area: float,
    wind_north: float,
    wind_east: float,
) -> Values:
    """Force [N] against the motion."""
    wind = wind_north * cos(heading) + wind_east * sin(heading)
    still = drag(speed, headwind, air_density, drag_area=drag_area)
    return drag(speed, headwind + wind, air_density, drag_area=drag_area) - still
