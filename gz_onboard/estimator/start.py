"""The first state of charge: from a voltage that may not be at rest, and from what was saved before.

Each has its variance: a loaded voltage carries the polarisation of an unknown past, and a saved state of charge
lacks the charge that flowed uncounted.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, hypot, sqrt
from typing import Any

from gz_onboard.constants import HOUR
from gz_onboard.estimator.ekf import Covariance, SocFilter
from gz_onboard.estimator.saved_fields import Each, Number
from gz_onboard.physics.battery import HALF_FULL, Battery

SOC_UNKNOWN_SD = 0.5  # whatever has flowed
SOC_BOUNDS = -0.05, 1.05  # what a linear update, over a curve that is not, may make of it
BEYOND = 0.5  # of the span of the rest voltage: no cell at work is further beyond full or empty than this
BRIDGE = 60.0  # s: over so short a gap the currents before and after give the charge
RIDING_RATE = 0.5  # 1/h: sd of the mean current over capacity in a gap that may have been ridden or charged
BURST_RATE = 1.0  # 1/h: the same in addition, over `BRIDGE`: full power does not last longer
CHARGING_FROM = 120.0  # s: a shorter gap is too short to plug in, charge and leave
CONSUMPTION_SD = 0.3  # relative: of a distance that was not seen
ODOMETER_STEP = 100.0  # m: odometers on the bus count in steps of up to this
FASTEST = 70.0  # m/s
UNKNOWN_AGE = 86_400.0  # s
STUCK_SHARE = 0.3  # of what may have flowed: remains though the vehicle's own state of charge shows no change
OWN_SOC_SD = 0.015  # of a change of the vehicle's own state of charge: its steps
OWN_SOC_GAIN_SD = 0.2  # relative, of the same: its window and its errors
CONTRADICTS = 3.0  # sd: two that are further apart are not both right
CURVE = -0.02, 1.02  # SOC to which a first voltage is read off the rest voltage
ROUNDS = 5  # of the search for a SOC: R0 depends on it
SLOW_TIME = 1000.0  # s: time constant of slow diffusion in lithium-ion cells, a quarter of an hour or so


@dataclass(frozen=True)
class Saved:
    """What is kept of the battery over a restart; None where the vehicle has no such signal."""

    soc: float
    v1: float  # V
    covariance: Covariance
    current: float | None = None  # A of the pack
    odometer: float | None = None  # m
    own_soc: float | None = None  # the vehicle's own state of charge, 0..1
    consumption: float | None = None  # J/m that was expected


FIELDS = {
    "soc": Number(0.0, 1.0),
    "v1": Number(-1.0, 1.0),  # V of a cell
    "covariance": Each(Number(-1.0, 1.0), 3),
    "current": Number(-1e4, 1e4, optional=True),  # A
    "odometer": Number(-1e3, 1e10, optional=True),  # m
    "own_soc": Number(-0.1, 1.1, optional=True),
    "consumption": Number(-1e5, 1e5, optional=True),  # J/m
}
"""Of the saved state: those of `Saved`."""


def read_saved(fields: Mapping[str, Any]) -> Saved:
    """The saved `fields` of `FIELDS`, which were checked. ValueError for a covariance that no filter has."""
    p00, p01, p11 = fields["covariance"]
    if not (0 < p00 <= SOC_UNKNOWN_SD**2 and p11 > 0 and p01 * p01 <= p00 * p11):
        raise ValueError("is damaged: state.covariance is impossible")
    return Saved(**{name: fields[name] for name in FIELDS} | {"covariance": (p00, p01, p11)})


def bounded(soc: float) -> float:
    """`soc`, within `SOC_BOUNDS`."""
    return min(max(soc, SOC_BOUNDS[0]), SOC_BOUNDS[1])


def limit_soc_variance(covariance: Covariance) -> Covariance:
    """`covariance`, of a SOC that is no less known than not at all."""
    p00, p01, p11 = covariance
    share = min(SOC_UNKNOWN_SD / sqrt(p00), 1.0)
    return (p00, p01, p11) if share == 1 else (SOC_UNKNOWN_SD**2, p01 * share, p11)


def plausible(battery: Battery, emf: float) -> bool:
    """Whether a cell can have this voltage [V] without load: an inverter that is not yet charged shows a few volts."""
    empty, full = battery.ocv(0.0)[0], battery.ocv(1.0)[0]
    margin = BEYOND * (full - empty)
    return empty - margin < emf < full + margin


def from_voltage(
    battery: Battery, voltage: float, current: float, temperature: float, v1: float, v1_sd: float, voltage_sd: float
) -> tuple[float, Covariance]:
    """(SOC, covariance of SOC and V1) of a cell with this voltage [V] at this current [A], `temperature` in degC.

    v1, v1_sd: polarisation that is expected, and its sd [V]; voltage_sd: of everything else [V]. The sd of SOC is the
    chord of the rest voltage over its uncertainty: near empty a tangent would promise far too much.
    """
    soc = HALF_FULL
    for _ in range(ROUNDS):
        emf = voltage + battery.r0.at(soc, temperature)[0] * current + v1
        soc = min(max(battery.soc_at(emf, temperature), CURVE[0]), CURVE[1])
    sd = hypot(v1_sd, voltage_sd)
    soc_sd = min(soc_width(battery, emf, sd, temperature) / 2, SOC_UNKNOWN_SD)
    return soc, (soc_sd**2, v1_sd**2 * soc_sd / sd, v1_sd**2)


def soc_width(battery: Battery, emf: float, sd: float, temperature: float) -> float:
    """How far apart the states of charge at a rest voltage `emf` ± `sd` [V] are."""
    return battery.soc_at(emf + sd, temperature) - battery.soc_at(emf - sd, temperature)


def update_soc(filter_: SocFilter, soc: float, variance: float) -> None:
    """A state of charge that is known from elsewhere, as a measurement of the first state."""
    p00, p01, p11 = filter_.covariance
    total = p00 + variance
    difference = soc - filter_.soc
    filter_.soc += p00 / total * difference
    filter_.error += p01 / total * difference
    share = variance / total
    filter_.covariance = p00 * share, p01 * share, p11 - p01 * p01 / total


def parked(saved: Saved, age: float | None, odometer: float | None, own_soc: float | None) -> float:
    """The share of a polarisation that is gone by the clock: 0 if the vehicle may have been used or charged."""
    if age is None or odometer is None or saved.odometer is None or odometer != saved.odometer:
        return 0.0
    if own_soc is None or saved.own_soc is None or abs(own_soc - saved.own_soc) > OWN_SOC_SD:
        return 0.0
    return 1 - exp(-age / SLOW_TIME)


def uncounted_sd(gap: float) -> float:
    """Sd of the SOC that flowed uncounted in `gap` [s], ridden or charged."""
    return min((RIDING_RATE * gap + BURST_RATE * min(gap, BRIDGE)) / HOUR, SOC_UNKNOWN_SD)


def uncounted(
    saved: Saved,
    age: float | None,
    charge: float,
    voltage: float,
    current: float,
    odometer: float | None,
    own_soc: float | None,
) -> tuple[float, float]:
    """(SOC that was drawn uncounted, its sd).

    age: of what was saved [s], None if not known; charge: of the pack [A·h]; voltage, current: of the pack now
    [V], [A]; odometer [m] and own_soc: as the vehicle shows them now, None if it does not.
    """
    gap = UNKNOWN_AGE if age is None else age
    distance = None if odometer is None or saved.odometer is None else odometer - saved.odometer
    if distance is not None and distance > FASTEST * gap + ODOMETER_STEP:
        gap = UNKNOWN_AGE  # it is so much longer than the clock says, or the odometer was reset
    mean, sd = 0.0, uncounted_sd(gap)
    if distance is not None and saved.consumption is not None:
        price = saved.consumption / (HOUR * charge * voltage)  # SOC per metre
        if -ODOMETER_STEP <= distance <= FASTEST * gap + ODOMETER_STEP and distance * price < 1:  # else charged, too
            mean = max(distance, 0.0) * price
            charged = RIDING_RATE * max(gap - CHARGING_FROM, 0.0) / HOUR
            step = min(ODOMETER_STEP, FASTEST * gap) * price
            sd = min(hypot(CONSUMPTION_SD * mean, hypot(charged, step)), sd)
    elif gap <= BRIDGE and saved.current is not None:
        mean = (saved.current + current) / 2 * gap / (HOUR * charge)
    if own_soc is not None and saved.own_soc is not None:
        own = saved.own_soc - own_soc
        own_sd = OWN_SOC_SD + OWN_SOC_GAIN_SD * abs(own)
        apart = abs(own - mean)
        if apart > CONTRADICTS * hypot(sd, own_sd):  # one of the two is wrong
            sd = hypot(sd, apart)
        elif apart <= own_sd:  # confirmed, to no better than its steps; but it may be stuck
            sd = min(sd, hypot(own_sd, STUCK_SHARE * sd))
        else:
            share = sd * sd / (sd * sd + own_sd * own_sd)
            mean, sd = mean + share * (own - mean), sd * sqrt(1 - share)
    return mean, min(sd, SOC_UNKNOWN_SD)
