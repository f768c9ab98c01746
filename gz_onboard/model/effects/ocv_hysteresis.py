"""Hysteresis of the open-circuit voltage, dh = γ·|dSOC|·(M·sign(I) - h): Plett 2004, part 2, eq. 7.

At rest the voltage depends on whether the cell was charged or discharged before: h goes to ±M with the charge passed,
and stays where it is at rest. Positive when discharging. The sign is smooth below 10 mA of a cell.
"""

from gz_onboard.model.battery import discharged
from gz_onboard.model.effect import Parameter, Port, Values
from gz_onboard.model.functions import exp

PORT = Port.CELL_VOLTAGE
PARAMETERS = (
    Parameter(
        "hysteresis_voltage",
        "V",
        prior=0.01,
        prior_sd=0.008,
        low=0.0,
        high=0.1,
        source="NMC: Barai et al. 2015, 5 to 20 mV",
        ride_sd=0.001,
        healthy_sd=0.005,
    ),
    Parameter("hysteresis_rate", "1", 30.0, 15.0, 1.0, 1000.0, "Plett 2004, part 2: settles within 5 % of SOC"),
)
SHOWN_BY = (
    "Voltage that stays low at rest after riding and high after charging or long braking, without coming back; rests "
    "at the same SOC reached from above and from below split it from slow relaxation, which fades."
)
SMALL = 0.01  # A


def term(cell_current: Values, *, hysteresis_voltage: float) -> Values:
    """Voltage lost [V] once settled."""
    return hysteresis_voltage * cell_current / (cell_current * cell_current + SMALL * SMALL) ** 0.5


def decay(dt: Values, cell_current: Values, cell_capacity: Values, *, hysteresis_rate: float) -> Values:
    """The share that is left after `dt` [s] of `cell_current` [A]."""
    return exp(-hysteresis_rate * discharged(abs(cell_current), dt, cell_capacity))
