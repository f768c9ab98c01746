"""The parameters of the linear model: prior, scatter between rides, and the candidate causes that change them.

Three kinds. *Vehicle*: parameters of the vehicle file, as sure as their calibration says. *Nuisance*: what no vehicle
file has and no cause is named after, such as the bias of the accelerometer; each with a mean over the vehicle's life
and a scatter between rides. *Candidate*: parameters that a cause would change. The scatter between rides is the
discrepancy of Brynjarsdóttir & O'Hagan 2014, as a random effect.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.model.effect import BASE_EFFECTS, Effect, Parameter, Port, effects_in, load_effect, package_effects
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.model.traits import traits
from gz_onboard.priors import nearest_step, sizes_of
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class Nuisance:
    """A parameter that no vehicle file has, in a vehicle of size 1.

    sd: of its mean. ride_sd: of its scatter between rides. size, per: the `Sizes` that they grow and fall with.
    """

    name: str
    unit: str
    value: float
    sd: float
    ride_sd: float
    text: str
    size: str = ""
    per: str = ""


NUISANCES = (  # name, unit, value, sd of the mean, sd between rides, meaning
    Nuisance("payload_error", "kg", 0.0, 0.0, 2.0, "clothes and luggage on top of the mass entered"),
    Nuisance("accel_bias", "m/s²", 0.0, 0.05, 0.02, "bias of the forward accelerometer, or its mounting angle"),
    Nuisance("pitch_gain", "1", 0.0, 0.1, 0.02, "pitch of the body under acceleration, and the accelerometer's gain"),
    Nuisance("altitude_start", "m", 0.0, 0.0, 20.0, "error of the first GPS altitude"),
    Nuisance("rolling_cold", "1/(20 K)", 0.0, 0.3, 0.05, "rolling resistance below 20 degC, as a share"),
    Nuisance("torque_constant_slope", "1/K", 0.0, 7e-4, 1e-4, "magnets weaken when warm"),
    Nuisance("torque_saturation", "1/(100 A)", 0.0, 0.03, 0.005, "torque per current falls at high current"),
    Nuisance("copper_speed", "s/(50 rad)", 0.0, 0.25, 0.02, "copper loss grows with frequency", per="spin"),
    Nuisance("inverter_current_gain", "1", 1.0, 0.007, 0.002, "gain of the inverter's current measurement"),
    Nuisance("inverter_current_offset", "A", 0.0, 0.2, 0.03, "its offset", "current"),
    Nuisance("idle_current", "A", 0.0, 0.2, 0.01, "drawn past inverter and auxiliary current sensors", "current"),
    Nuisance("pack_inverter_lag", "s", 0.0, 0.1, 0.02, "pack current later than the inverter's, beyond 0.1 s"),
    Nuisance("torque_lag", "s", 0.0, 0.1, 0.02, "DC current later than the motor's"),
    Nuisance("loss_speed", "W/(50 rad/s)", 0.0, 15.0, 1.0, "further loss that grows with speed", "power"),
    Nuisance("loss_cross", "W/(2500 A·rad/s)", 0.0, 60.0, 2.0, "loss that grows with current times speed", "power"),
    Nuisance("brake_light", "W", 0.0, 6.0, 0.3, "more auxiliary power while the brake is touched", "auxiliary"),
    Nuisance("inverter_voltage_offset", "V", 0.0, 0.1, 0.01, "offset of the inverter's voltage measurement", "voltage"),
    Nuisance("soc_start", "1", 0.0, 0.0, 0.04, "state of charge at the start, against that by the first voltage"),
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

START = (
    "soc_start",
    "v1_start",
    "altitude_start",
    "motor_start",
    "rotor_start",
    "inverter_start",
    "box_start",
    "cells_start",
)
GIVEN_SCATTER = (*START, "payload_error")
"""Nuisances whose scatter healthy rides say nothing of: of the start of a ride, or of the mass entered."""
EACH_RIDES_OWN = (*START, "accel_bias", "pitch_gain", "gps_lag", "wheel_lag")
"""Nuisances of the sensors or the start, not of the vehicle: each ride has its own, whatever the model."""


@dataclass(frozen=True)
class VehicleParameter:
    """A parameter of the vehicle, not of an effect, that a channel depends on.

    ride_sd: scatter between rides [unit]. healthy_sd: spread of healthy vehicles where the file does not state it.
    size: of `Sizes`, that the scatter grows with if the prior is 0. bench: found on a bench at steady points.
    positive: known to a factor only; a step and the scatter are of its logarithm.
    """

    ride_sd: float
    healthy_sd: float | None = None
    size: str = ""
    bench: bool = False
    positive: bool = False


_COOLING = VehicleParameter(0.1, positive=True)
VEHICLE: Mapping[str, VehicleParameter] = {
    "wheel_radius": VehicleParameter(4e-4),
    "payload_mass": VehicleParameter(0.0, healthy_sd=2.0),
    "torque_constant": VehicleParameter(0.002, bench=True),
    "cell_capacity": VehicleParameter(0.01),
    "cable_resistance": VehicleParameter(2e-4, bench=True),
    "pack_current_offset": VehicleParameter(0.03, size="current"),
    "pack_current_gain": VehicleParameter(0.002),
    "pack_voltage_offset": VehicleParameter(0.01, size="voltage"),
    "cell_resistance_factor": VehicleParameter(0.01, healthy_sd=0.005),
    "cooling_factor": VehicleParameter(0.08, healthy_sd=0.01),
    "speed_sensor_scale": VehicleParameter(3e-4, healthy_sd=0.001),
    "pack_voltage_latency": VehicleParameter(0.004, healthy_sd=0.02),
    "motor_stator_capacity": _COOLING,
    "motor_rotor_capacity": _COOLING,
    "motor_gap_conductance": _COOLING,
    "motor_rotor_to_ambient": _COOLING,
    "inverter_board_capacity": _COOLING,
    "inverter_box_capacity": _COOLING,
    "inverter_board_to_box": _COOLING,
    "inverter_box_to_ambient": _COOLING,
    "pack_heat_capacity": VehicleParameter(0.05, positive=True),
    "pack_conductance": _COOLING,
}
LOG_SCALED = frozenset(name for name, known in VEHICLE.items() if known.positive)


def stepped(name: str, value: float, step: float) -> float:
    """`value` of the parameter `name` after a step, in its unit, or of the logarithm."""
    return value * exp(step) if name in LOG_SCALED else value + step


@dataclass(frozen=True)
class Prior:
    """Knowledge of one parameter: its scale [unit], and in scales the sd of the vehicle's, of a bench's, between rides.

    The scale is the scatter between rides, or a twentieth of the standard deviation if that is more.
    """

    scale: float
    sd: float
    bench_sd: float
    ride_sd: float


def prior_of(name: str, vehicle: Vehicle, declared: Mapping[str, Parameter], value: float, absent: bool) -> Prior:
    """The prior of the parameter `name`, at `value`. absent: it is of an effect that the model does not have."""
    on_bench, sizes, own = False, sizes_of(vehicle), VEHICLE.get(name)
    if name in NUISANCE:
        size = sizes.of(NUISANCE[name].size) / sizes.of(NUISANCE[name].per)
        scatter, spread = NUISANCE[name].ride_sd * size, NUISANCE[name].sd * size
    else:
        parameter, known = declared[name], vehicle.parameters
        on_bench = parameter.bench or (own is not None and own.bench)
        stated = name in known and not known.known[name].source.startswith("prior:")
        healthy = parameter.healthy_sd if own is None or own.healthy_sd is None else own.healthy_sd
        spread = known.sd(name) if name in known and not absent else parameter.prior_sd
        if healthy is not None and (absent or not stated or name == "payload_mass"):  # the mass entered is known
            spread = healthy
        ride_sd = parameter.ride_sd if own is None else own.ride_sd
        # a scatter grows with a parameter over its prior, which is known to a factor of two
        size = nearest_step(value / parameter.prior, 4.0) if parameter.prior else sizes.of(own.size if own else "")
        scatter = 0.1 * parameter.prior_sd if ride_sd is None else ride_sd * size
    if own is not None and own.positive:
        spread, scatter = min(spread / value, 0.5), own.ride_sd
    wide = spread * (3.0 if on_bench else 1.0)  # a bench's steady points hold on the road within so much
    step = max(scatter, 0.05 * wide)
    return Prior(step, max(wide / step, 1e-3), spread / step, max(scatter / step, 1e-3))


def prior_covariance(priors: Mapping[str, Prior], correlations: Mapping[frozenset[str], float]) -> Array:
    """Covariance of the vehicle's parameters before any ride, in scales, (p, p)."""
    covariance = np.diag(np.array([prior.sd for prior in priors.values()]) ** 2)
    place = {name: i for i, name in enumerate(priors)}
    for pair, r in correlations.items():
        a, b = sorted(pair)  # a set's order differs from run to run, and with it the last digits
        if a in place and b in place:
            # uncertainty of the bench is correlated; the difference of road and bench is not
            both = r * priors[a].bench_sd * priors[b].bench_sd
            covariance[place[a], place[b]] = covariance[place[b], place[a]] = both
    return covariance


@dataclass(frozen=True)
class Candidate:
    """A cause: the parameters that give its strength, the first of which is reported.

    effect: the file that it comes with, None for a parameter that every vehicle file has. sign: of the change that it
    can make, 0 for either.
    """

    name: str
    parameters: tuple[Parameter, ...]
    equation: str
    shown_by: str
    effect: Effect | None = None
    sign: int = 0

    @property
    def names(self) -> tuple[str, ...]:
        """The names of its parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def reads(self) -> tuple[str, ...]:
        """The other parameters of its effect."""
        return tuple(name for name in self.effect.term.parameters if name not in self.names) if self.effect else ()

    @property
    def varies(self) -> bool:
        """Whether it differs from ride to ride by itself."""
        return self.effect is not None and traits(self.effect).varies


# name: (port, None for a sensor or the cooling; parameter; equation; signs by which it shows)
VEHICLE_CAUSES: Mapping[str, tuple[Port | None, str, str, str]] = {
    "payload_mass": (
        Port.WHEEL_FORCE,
        "payload_mass",
        "F = m·(dV/dt + g·sin θ + g·c0·cos θ)",
        "Force short in acceleration and uphill, too large downhill; hills and firm starts split it from rolling "
        "resistance.",
    ),
    "tyre_radius": (
        Port.WHEEL_FORCE,
        "wheel_radius",
        "V = ω·r",
        "All wheel-speed sensors and the motor against GPS alike; a straight kilometre at steady speed.",
    ),
    "torque_constant_loss": (
        Port.MOTOR_LOSS,
        "torque_constant",
        "τ = k·i",
        "Force and DC power both short per motor current reported, acceleration most; steady climbing splits it "
        "from the payload.",
    ),
    "capacity_fade": (
        Port.CELL_VOLTAGE,
        "cell_capacity",
        "dSOC/dt = −I/(3600·Q)",
        "Rest voltage falls faster than the charge drawn says; a ride from full to nearly empty splits it from the"
        " gain of the current sensor, as the inverter's own does.",
    ),
    "resistance_growth": (
        Port.CELL_VOLTAGE,
        "cell_resistance_factor",
        "V = OCV − f·(R0·I + V1)",
        "Voltage sinks more with every load at all temperatures; starts from rest at high and at low SOC.",
    ),
    "cooling_blocked": (
        None,
        "cooling_factor",
        "Q = f·G·(T − T_ambient)",
        "Motor, inverter and cells warm more than their losses say, and cool slower at rest; a hard ride, then rest.",
    ),
    "current_sensor_offset": (
        None,
        "pack_current_offset",
        "I_shown = g·I + I0",
        "Pack current less inverter and auxiliary current is not zero at standstill.",
    ),
    "current_sensor_gain": (
        None,
        "pack_current_gain",
        "I_shown = g·I + I0",
        "Pack current less inverter and auxiliary current grows with the current; charge against rest voltages.",
    ),
    "voltage_sensor_offset": (
        None,
        "pack_voltage_offset",
        "U_shown = U + U0",
        "Pack and inverter voltage differ at no current; the rest voltage of the full pack splits which one errs.",
    ),
    "speed_scale": (
        None,
        "speed_sensor_scale",
        "ω_shown = s·ω",
        "Motor speed against both wheel-speed sensors and GPS; coasting.",
    ),
    "sensor_latency": (
        None,
        "pack_voltage_latency",
        "U_shown(t) = U(t − T)",
        "Voltage answers steps of the current late or early; switching the throttle on and off.",
    ),
}
PLACES = (Port.TYRE, Port.WHEEL_FORCE, Port.DC_POWER, Port.MOTOR_LOSS, Port.INVERTER_LOSS, Port.CELL_VOLTAGE, None)
"""The order of the causes that every vehicle can have: from the road to the cells, sensors last."""


def candidates(folder: Path | None = None) -> tuple[Candidate, ...]:
    """All candidates: parameters of every vehicle, the package's effects beyond `BASE_EFFECTS`, those in `folder`.

    Raises InputError for a file in `folder` that is no effect.
    """
    declared = declared_parameters()
    changes: list[tuple[Port | None, Candidate]] = []
    for effect in map(load_effect, package_effects()):
        known = traits(effect)
        if known.cause:
            changes.append((effect.port, Candidate(known.cause[0], _strengths(effect), known.cause[1], known.shown_by)))
    for name, (place, parameter, equation, shown_by) in VEHICLE_CAUSES.items():
        changes.append((place, Candidate(name, (declared[parameter],), equation, shown_by)))
    found = [cause for _, cause in sorted(changes, key=lambda row: PLACES.index(row[0]))]
    packaged = [name for name in package_effects() if name not in BASE_EFFECTS]
    theirs = [name for name in effects_in(folder) if name not in packaged] if folder else []
    for effect in (load_effect(name, folder) for name in (*packaged, *theirs)):
        if strengths := _strengths(effect):
            known = traits(effect)
            equation = known.doc.splitlines()[0] if known.doc else effect.name
            sign = 1 if strengths[0].low >= 0 else 0
            found.append(Candidate(effect.name, strengths, equation, known.shown_by, effect, sign))
    return tuple(found)


def _strengths(effect: Effect) -> tuple[Parameter, ...]:
    return tuple(p for name in traits(effect).strengths for p in effect.parameters if p.name == name)
