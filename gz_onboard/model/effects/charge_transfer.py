"""Charge transfer of a cell: overpotential of the reaction, U·asinh(R_ct·I/U) with U = n·2RT/F, settling in seconds.

Butler's and Volmer's equation of two equal coefficients, solved for the overpotential (Plett 2015, Battery Management
Systems, vol. 1, sec. 3.11); it settles as the double layer is charged. It grows less than the current, so that a cold
cell's resistance falls with the current. R_ct, its slope at no current, falls with temperature (Arrhenius). n is 1
where one electrode is by far the slower and 2 where both are alike: the more, the less it bends.
"""

from gz_onboard.constants import BENCH_TEMPERATURE, KELVIN, THERMAL_VOLTAGE
from gz_onboard.model.effect import Parameter, Port, Values
from gz_onboard.model.functions import asinh, exp

PORT = Port.CELL_VOLTAGE
PARAMETERS = (  # of the kind of cell: from ride to ride they stay, but for how well its temperature is known
    Parameter(
        "charge_transfer_resistance",
        "ohm",
        prior=0.01,
        prior_sd=0.01,
        low=0.0,
        high=10.0,
        source="18650 cells: a third of R0 at 25 degC",
        ride_sd=1e-4,
        bench=True,
        grows_with="cell_capacity^-1",
    ),
    Parameter(
        "charge_transfer_activation",
        "K",
        prior=6000.0,
        prior_sd=2500.0,
        low=0.0,
        high=15000.0,
        source="50 kJ/mol; Li-ion cells: 35 to 110",
        ride_sd=20.0,
        bench=True,
    ),
    Parameter(
        "charge_transfer_time",
        "s",
        prior=1.0,
        prior_sd=1.0,
        low=0.01,
        high=60.0,
        source="double layer: tenths of a second to seconds",
        ride_sd=0.02,
        bench=True,
    ),
    Parameter(
        "charge_transfer_reactions",
        "1",
        prior=1.0,
        prior_sd=0.5,
        low=0.5,
        high=4.0,
        source="2 where both electrodes are alike slow, 1 where one is",
        ride_sd=0.02,
        bench=True,
    ),
)
STRENGTHS = ()  # pulses of several currents show it; a ride shows it as resistance only


def term(
    cell_current: Values,
    cell_temperature: Values,
    *,
    charge_transfer_resistance: float,
    charge_transfer_activation: float,
    charge_transfer_reactions: float,
) -> Values:
    """Voltage lost [V] once settled."""
    kelvin = cell_temperature + KELVIN
    thermal = charge_transfer_reactions * 2 * THERMAL_VOLTAGE * kelvin
    arrhenius = exp(charge_transfer_activation * (1 / kelvin - 1 / (BENCH_TEMPERATURE + KELVIN)))
    return thermal * asinh(charge_transfer_resistance * arrhenius * cell_current / thermal)


def decay(dt: Values, *, charge_transfer_time: float) -> Values:
    """The share that is left after `dt` [s]."""
    return exp(-dt / charge_transfer_time)
