"""Slow relaxation of a cell, a second RC pair: τ·dV2/dt = R2·I - V2; missing in Lord 2016 (sec. 3.3).

Diffusion in the particles lasts for the better part of an hour after the current has changed (Plett 2015, Battery
Management Systems, vol. 1, sec. 2.4; Hu, Li & Peng 2012 compare circuits of one and two pairs).
"""

from gz_onboard.model.effect import Parameter, Port, Values
from gz_onboard.model.functions import exp

PORT = Port.CELL_VOLTAGE
PARAMETERS = (
    Parameter(
        "slow_resistance",
        "ohm",
        prior=0.008,
        prior_sd=0.006,
        low=0.0,
        high=10.0,
        source="18650 NMC at 25 degC: a fifth to half of R0",
        ride_sd=0.001,
        healthy_sd=0.01,
        grows_with="cell_capacity^-1",
    ),
    Parameter("slow_time", "s", 1200.0, 400.0, 120.0, 7200.0, "diffusion in 5-10 µm particles: 10 to 40 min"),
)
SHOWN_BY = (
    "Pack voltage that sinks over tens of minutes of riding and comes back over tens of minutes of rest; a rest of "
    "half an hour in the middle of a ride splits it from capacity and OCV."
)


def term(cell_current: Values, *, slow_resistance: float) -> Values:
    """Voltage lost [V] once settled."""
    return slow_resistance * cell_current


def decay(dt: Values, *, slow_time: float) -> Values:
    """The share that is left after `dt` [s]."""
    return exp(-dt / slow_time)
