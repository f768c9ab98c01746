"""The parameters of the linear model of all channels: what is known of each before, and how it changes by ride.

Three kinds. *Base*: the vehicle file's parameters, as sure as their calibration says. *Nuisance*: what no vehicle
file has and no cause is named after, such as the bias of the accelerometer or a wind; each with a mean over the
vehicle's life and a scatter between rides. *Candidate*: what a cause would move. `RIDE_SD` is how much a parameter
is taken to scatter from ride to ride before any healthy ride (the discrepancy of Brynjarsdóttir & O'Hagan
2014, as a random effect).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.sizes import nearest_step, sizes_of
from gz_onboard.model.effect import Parameter
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class Nuisance:
    """A parameter that no vehicle file has: sd is of its mean, ride_sd of its scatter from ride to ride, both in a
    vehicle of size 1; size, per: those of `Sizes` that they grow with, and fall with.
    """

    name: str
    unit: str
    value: float
    sd: float
    ride_sd: float
    text: str
    size: str = ""
    per: str = ""


NUISANCES = (
    Nuisance("payload_error", "kg", 0.0, 0.0, 2.0, "clothes and luggage beside the mass entered"),
    Nuisance("accel_bias", "m/s²", 0.0, 0.05, 0.02, "bias of the forward accelerometer, or its mounting angle"),
    Nuisance("pitch_gain", "1", 0.0, 0.1, 0.02, "pitch of the body under acceleration, and the accelerometer's gain"),
    Nuisance("altitude_start", "m", 0.0, 0.0, 20.0, "error of the first GPS altitude"),
    Nuisance("rolling_cold", "1/(20 K)", 0.0, 0.3, 0.05, "rolling resistance below 20 degC, as a share"),
    Nuisance("torque_constant_slope", "1/K", 0.0, 7e-4, 1e-4, "magnets weaken when warm"),
    Nuisance("torque_saturation", "1/(100 A)", 0.0, 0.03, 0.005, "torque per current falls at high current"),
    Nuisance("copper_speed", "s/(50 rad)", 0.0, 0.25, 0.02, "copper loss grows with frequency", per="spin"),
    Nuisance("inverter_current_gain", "1", 1.0, 0.007, 0.002, "gain of the inverter's current measurement"),
    Nuisance("inverter_current_offset", "A", 0.0, 0.2, 0.03, "its offset", "current"),
    Nuisance("idle_current", "A", 0.0, 0.2, 0.01, "drawn beside inverter and auxiliary current sensors", "current"),
    Nuisance("pack_inverter_lag", "s", 0.0, 0.1, 0.02, "pack current later than the inverter's, beyond 0.1 s"),
    Nuisance("torque_lag", "s", 0.0, 0.1, 0.02, "DC current later than the motor's"),
    Nuisance("loss_speed", "W/(50 rad/s)", 0.0, 15.0, 1.0, "loss that grows with speed, beside the model's", "power"),
    Nuisance("loss_cross", "W/(2500 A·rad/s)", 0.0, 60.0, 2.0, "loss that grows with current times speed", "power"),
    Nuisance("brake_light", "W", 0.0, 6.0, 0.3, "more auxiliary power while the brake is touched", "auxiliary"),
    Nuisance("inverter_voltage_offset", "V", 0.0, 0.1, 0.01, "offset of the inverter's voltage measurement", "voltage"),
    Nuisance("soc_start", "1", 0.0, 0.0, 0.04, "state of charge at the start, beyond what the first voltage says"),
    Nuisance("v1_start", "V", 0.0, 0.0, 0.01, "relaxation left over from before the ride"),
    Nuisance("ocv_offset", "V", 0.0, 0.006, 0.004, "rest voltage against the table: hysteresis, relaxation"),
    Nuisance("ocv_tilt", "V", 0.0, 0.03, 0.005, "slope of the rest voltage over SOC against the table"),
    Nuisance("ocv_cold", "V/(20 K)", 0.0, 0.02, 0.001, "rest voltage at 0 degC less that at 20 degC"),
    Nuisance("resistance_level", "1", 0.0, 0.1, 0.03, "cell resistance against the tables"),
    Nuisance("drift", "V/(600 s)", 0.0, 0.001, 0.004, "what no circuit of the model follows over a ride"),
    Nuisance("pair_resistance", "1", 0.0, 0.3, 0.02, "R1 of one pair where a second one has the slow part"),
    Nuisance("pair_time", "1", 0.0, 0.4, 0.03, "its time constant, logarithm of the share"),
    Nuisance("mid_resistance", "ohm", 0.0, 0.02, 0.001, "a pair between it and the slow one", "resistance"),
    Nuisance("resistance_empty", "1", 0.0, 0.3, 0.05, "cell resistance at SOC 0.6 less that at 1.0, as a share"),
    Nuisance("resistance_current", "1/(5 A)", 0.0, 0.1, 0.01, "cell resistance falls with current"),
    Nuisance("resistance_current_cold", "1/(5 A·20 K)", 0.0, 0.1, 0.01, "the more so below 20 degC"),
    Nuisance("resistance_cold", "1/(20 K)", 0.0, 0.15, 0.03, "cell resistance below 20 degC beyond the tables"),
    Nuisance("resistance_empty_cold", "1", 0.0, 0.3, 0.03, "at SOC 0.6 and 0 degC more than either alone"),
    Nuisance("fast_resistance", "1", 0.0, 0.2, 0.05, "resistance at 0.1 s over that of the tables"),
    Nuisance("fast_cold", "1/(20 K)", 0.0, 0.2, 0.05, "the same, below 20 degC"),
    Nuisance("slip_per_force", "1/(100 N)", 0.0, 0.02, 0.003, "slip of the driven wheel"),
    Nuisance("lean_radius", "1", 0.0, 0.3, 0.05, "rolling radius falls with lean"),
    Nuisance("front_lean", "1", 0.0, 0.3, 0.05, "the same, front against rear"),
    Nuisance("gps_lag", "s", 0.0, 0.2, 0.05, "GPS speed later than 0.4 s"),
    Nuisance("rear_scale", "1", 0.0, 0.003, 3e-4, "rear wheel-speed sensor over motor speed"),
    Nuisance("front_scale", "1", 0.0, 0.02, 1e-3, "front wheel turns faster: its radius is smaller"),
    Nuisance("wheel_lag", "s", 0.0, 0.05, 0.01, "wheel-speed sensors later than motor speed"),
    Nuisance("motor_start", "K", 0.0, 0.3, 0.5, "first motor temperature: quantised"),
    Nuisance("rotor_start", "1/10", 0.0, 0.5, 1.0, "rotor colder than stator at the start, per 10 K above ambient"),
    Nuisance("motor_airflow", "1/(10 m/s)", 0.0, 1.0, 0.1, "rim cools better in moving air"),
    Nuisance("inverter_start", "K", 0.0, 0.3, 0.5, "first inverter temperature: quantised"),
    Nuisance("box_start", "K", 0.0, 1.0, 1.0, "box against board at the start"),
    Nuisance("inverter_airflow", "1/(10 m/s)", 0.0, 1.0, 0.1, "box cools better in moving air"),
    Nuisance("cells_start", "K", 0.0, 0.3, 0.5, "first cell temperature: quantised"),
    Nuisance("pack_airflow", "1/(10 m/s)", 0.0, 1.0, 0.1, "pack cools better in moving air"),
)
NUISANCE = {nuisance.name: nuisance for nuisance in NUISANCES}

COOLING = (
    "motor_stator_capacity",
    "motor_rotor_capacity",
    "motor_gap_conductance",
    "motor_rotor_to_ambient",
    "inverter_board_capacity",
    "inverter_box_capacity",
    "inverter_board_to_box",
    "inverter_box_to_ambient",
    "pack_heat_capacity",
    "pack_conductance",
)
LOG_SCALED = frozenset(COOLING)
"""Those that are positive and known to a factor only: a step is one of their logarithm."""
LOG_RIDE_SD, LOG_RIDE_SD_ELSE = {"pack_heat_capacity": 0.05}, 0.1
"""By how much their logarithm scatters from ride to ride."""


def stepped(name: str, value: float, step: float) -> float:
    """`value` of the parameter `name` after a step, in its unit, or of the logarithm."""
    return value * exp(step) if name in LOG_SCALED else value + step


GIVEN_SCATTER = (
    "soc_start",
    "v1_start",
    "altitude_start",
    "payload_error",
    "motor_start",
    "rotor_start",
    "inverter_start",
    "box_start",
    "cells_start",
)
"""Those whose scatter is of the ride's start or of what was entered: healthy rides say no more of it."""

EACH_RIDES_OWN = (
    *(name for name in GIVEN_SCATTER if name != "payload_error"),
    "accel_bias",
    "pitch_gain",
    "gps_lag",
    "wheel_lag",
)
"""Those of the sensors or of the start, not of the vehicle: each ride has its own, whatever the model."""

VEHICLE_PARAMETERS = (
    "wheel_radius",
    "payload_mass",
    "torque_constant",
    "cell_capacity",
    "cable_resistance",
    "pack_current_offset",
    "pack_current_gain",
    "pack_voltage_offset",
    *COOLING,
)
"""Of the vehicle's own parameters those that a channel depends on; those of the model's effects come on top."""

RIDE_SD = {
    "wheel_radius": 4e-4,
    "payload_mass": 0.0,
    "torque_constant": 0.002,
    "cell_capacity": 0.01,
    "pack_series_resistance": 3e-4,
    "cable_resistance": 2e-4,
    "pack_current_offset": 0.03,
    "pack_current_gain": 0.002,
    "pack_voltage_offset": 0.01,
    "cell_resistance_factor": 0.01,
    "cooling_factor": 0.08,
    "speed_sensor_scale": 3e-4,
    "pack_voltage_latency": 0.004,
}
SIZES = {"pack_current_offset": "current", "pack_voltage_offset": "voltage"}
"""What those grow with whose prior is 0."""
RIDE_SD_STEP = 4.0  # in which a scatter grows with a parameter over its prior: known to a factor of two
RIDE_SD_SHARE = 0.1
"""What a parameter scatters by of which nothing is declared, as a share of its prior's standard deviation."""
HEALTHY_SD = {
    "cell_resistance_factor": 0.005,
    "cooling_factor": 0.01,
    "speed_sensor_scale": 0.001,
    "pack_voltage_latency": 0.02,
    "payload_mass": 2.0,
}
"""Within what a healthy vehicle may show of it: standard deviation, where the vehicle file says nothing; of the payload
always, for what was entered is known."""
BENCH = ("torque_constant", "cable_resistance")
"""Found on a bench at steady points, as those of effects that say so."""

TRANSFERRED = 3.0
"""What was found on a bench at steady points holds on the road within so many times its standard deviation."""
MOST_LOG = 0.5  # sd of a logarithm, beyond which a parameter is known to its sign only
LEAST_STEP = 0.05  # of a standard deviation: the finest scale
LEAST_SD = 1e-3  # scales: what is certain


@dataclass(frozen=True)
class Prior:
    """Of one parameter: its scale [unit], and in scales the spread of the vehicle's, of a bench's, between rides."""

    scale: float
    sd: float
    bench_sd: float
    ride_sd: float


def prior_of(name: str, vehicle: Vehicle, declared: Mapping[str, Parameter], value: float, absent: bool) -> Prior:
    """Of the parameter `name`, at `value`. absent: it is of an effect that the model lacks."""
    on_bench, sizes = False, sizes_of(vehicle)
    if name in NUISANCE:
        size = sizes.of(NUISANCE[name].size) / sizes.of(NUISANCE[name].per)
        scatter, spread = NUISANCE[name].ride_sd * size, NUISANCE[name].sd * size
    else:
        parameter, known = declared[name], vehicle.parameters
        on_bench = parameter.bench or name in BENCH
        stated = name in known and not known.known[name].source.startswith("prior:")
        healthy = HEALTHY_SD.get(name, parameter.healthy_sd)
        spread = known.sd(name) if name in known and not absent else parameter.prior_sd
        if healthy is not None and (absent or not stated or name == "payload_mass"):
            spread = healthy
        own = RIDE_SD.get(name, parameter.ride_sd)
        size = nearest_step(value / parameter.prior, RIDE_SD_STEP) if parameter.prior else sizes.of(SIZES.get(name, ""))
        scatter = RIDE_SD_SHARE * parameter.prior_sd if own is None else own * size
    if name in LOG_SCALED:
        spread, scatter = min(spread / value, MOST_LOG), LOG_RIDE_SD.get(name, LOG_RIDE_SD_ELSE)
    wide = spread * (TRANSFERRED if on_bench else 1.0)
    step = max(scatter, LEAST_STEP * wide)
    return Prior(step, max(wide / step, LEAST_SD), spread / step, max(scatter / step, LEAST_SD))


def prior_covariance(priors: Mapping[str, Prior], correlations: Mapping[frozenset[str], float]) -> Array:
    """Of the vehicle's parameters before any ride, in scales, (p, p)."""
    covariance = np.diag(np.array([prior.sd for prior in priors.values()]) ** 2)
    place = {name: i for i, name in enumerate(priors)}
    for pair, r in correlations.items():
        a, b = sorted(pair)  # of a set, whose order differs from run to run, and with it the last digits
        if a in place and b in place:
            # what the bench leaves open goes together; by how much the road differs from the bench does not
            both = r * priors[a].bench_sd * priors[b].bench_sd
            covariance[place[a], place[b]] = covariance[place[b], place[a]] = both
    return covariance
