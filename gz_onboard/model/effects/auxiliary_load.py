"""Auxiliary load behind the DC-DC converter: lamps, dashboard, control (Lord 2016, eq. 2.19)."""

from gz_onboard.model.effect import ELECTRONICS, Parameter, Port, Values

PORT = Port.DC_POWER
PARAMETERS = (
    Parameter(
        "auxiliary_power",
        "W",
        prior=45.0,
        prior_sd=15.0,
        low=0.0,
        high=10000.0,
        source="LED lamps, dashboard and control of a scooter",
        ride_sd=0.7,
        grows_with=ELECTRONICS,
    ),
)
CAUSE = ("auxiliary_load", "P = P_aux")
SHOWN_BY = "The auxiliary current sensor, at standstill too; switching lamps one by one splits it from the sensor."


def term(*, auxiliary_power: float) -> Values:
    """Power [W] drawn from the pack."""
    return auxiliary_power
