"""Signals that follow from others: accelerations, turning, currents, powers, throttle.

Each row of `PREDICTIONS` names a measured signal and the one that predicts it; one rule, `Prediction.judge`, reads the
sign and the size off their correlation and the ratio of their spreads. `derived` computes the predicting signals.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.estimator.plausibility.residual import CONFIG
from gz_onboard.model.battery import Battery
from gz_onboard.model.model import air_density
from gz_onboard.model.series import all_quantities
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.finding import Finding, Roles, right, unknown, wrong
from gz_onboard.vehicle_check.seconds import change, rate, relation, unit_of

VOLTAGE, CURRENT = "pack_voltage", "pack_current"
LOAD = "power against speed and acceleration"
ROUGH = 0.2  # relative tolerance of a unit told by accelerations, powers or a resistance
BRAKES_M_S2 = -0.4  # slower than by the road load alone


@dataclass(frozen=True)
class Prediction:
    """How one signal should follow another, both by name among the signals of a ride and those of `derived`."""

    check: str
    roles: Roles  # blamed for a wrong sign or size
    measured: str
    predicted: str
    reference: str  # the prediction in words
    close: float = 0.4  # correlation from which on they go together
    usual: tuple[float, float] = (0.0, inf)  # ratios that look right
    possible: tuple[float, float] = (0.0, 0.0)  # that can be explained
    unsure: str = ""  # explanations of these
    unit: str = ""  # role whose units may explain another ratio
    size: str = ""  # hint for a ratio that no unit explains
    sign: str = "its sign, scale = -1"  # hint for a wrong sign
    hidden: str = "they hardly move together"

    def judge(self, signals: Mapping[str, Array]) -> tuple[Finding, float]:
        """Return the finding, and the factor that corrects a measured signal of which sign or unit is wrong."""
        ratio, correlation = relation(signals[self.predicted], signals[self.measured]) or (0.0, 0.0)
        if abs(correlation) < self.close:
            return unknown(self.check, self.roles, self.hidden), 1.0
        low, high = self.usual
        times = f"is {abs(ratio):.3g} times" if high < inf else "follows"
        text = f"{self.measured} {times} {self.reference}, correlation {correlation:.2f}"
        if correlation < 0:
            return wrong(self.check, self.roles, f"{text}: {self.sign}"), -1.0
        if low < ratio < high:
            return right(self.check, self.roles, text), 1.0
        if self.possible[0] < ratio < self.possible[1]:
            return unknown(self.check, self.roles, f"{text}: {self.unsure}"), 1.0
        unit = unit_of(self.unit, ratio, ROUGH)
        return wrong(self.check, self.roles, text + (unit or self.size)), 1 / ratio if unit else 1.0


SAG = Prediction(
    "current against the voltage's drop",
    (CURRENT,),
    measured="change of current",
    predicted="change of current by the voltage",
    reference="that by the voltage's drop and the file's resistance",
    close=0.5,
    usual=(0.6, 1.7),
    possible=(0.3, 3.5),
    unsure="aged or cold cells, r0, or the cells' number",
    unit=CURRENT,
    size=": scale of the current, r0, or the cells' number",
    hidden="the current hardly changes, or the voltage does not follow it",
)
FORWARD = Prediction(
    "acceleration against speed",
    ("accel_x",),
    measured="accel_x",
    predicted="change of speed",
    reference="the change of speed",
    usual=(0.6, 1.7),
    unit="accel_x",
    hidden="the speed hardly changes, or hills and shaking hide it",
)
PREDICTIONS = (
    FORWARD,
    Prediction(
        "turning against course",
        ("rate_z", "gps_course"),
        measured="rate_z",
        predicted="turning by course",
        reference="the change of course",
        usual=(0.6, 1.6),
        unit="rate_z",
        sign="the sign of one; rate_z is positive to the left, the course to the right",
        hidden="too few bends with a GPS course, or too noisy",
    ),
    Prediction(
        LOAD,
        (CURRENT,),
        measured="power",
        predicted="power by the model",
        reference="the model's",
        usual=(0.75, 1.5),  # 20 recorded rides have 0.97 to 1.26
        possible=(0.5, 2.0),
        unsure="hills, wind and payload, or mass, drag area or losses of the file",
        unit=CURRENT,
        size=": a scale of current or speed, mass, or drag area",
        hidden="hills hide it, or they hardly change",
    ),
    Prediction(
        "current while braking",
        (CURRENT,),
        measured="change of current while braking",
        predicted="change of current by the voltage",
        reference="the voltage's drop",
        close=0.3,  # 9 recorded rides have 0.97 to 1.0, and without the sign -0.85 to 0.53
        sign="the voltage rises with it there, so the current comes without its sign",
        hidden="too little braking, or nothing is recovered, or that part is cut off",
    ),
    Prediction(
        "currents against each other",
        (CURRENT, "inverter_current"),
        measured="current of inverter and auxiliaries",
        predicted="current of the pack",
        reference="the pack's",
        usual=(1 - 2 * CONFIG.current_sd_relative, 1 + 2 * CONFIG.current_sd_relative),
        unit="inverter_current",
        size=": the scale of one",
        sign="the sign of one",
    ),
    *(
        Prediction(
            f"{role.replace('_', ' ')} against the pack's power",
            (role,),
            measured=f"work of {role}",
            predicted="power",
            reference="the pack's power",
            usual=usual,
            unit=role,
            sign="the sign of one, positive when driving",
        )
        for role, usual in (("motor_torque", (0.4, 1.6)), ("motor_current", (0.0, inf)))
    ),
    Prediction(
        "throttle",
        ("throttle",),
        measured="throttle",
        predicted="current",
        reference="the current",
        close=0.3,
        sign="the current falls where it opens: the other way round, or the current's sign",
        hidden="it does not move, or the current does not follow it",
    ),
    Prediction(
        "brake switch",
        ("brake_switch",),
        measured="brake_switch",
        predicted="slowing",
        reference="the speed's fall",
        close=0.2,
        sign="the vehicle slows where it is not pressed: the other way round",
        hidden="it does not change while riding",
    ),
)


@dataclass(frozen=True)
class PackRide:
    """The pack in a ride: voltage [V] and current [A] (n,), temperature of the cells [degC]."""

    voltage: Array
    current: Array | None
    battery: Battery
    temperature: float


def pack_of(ride: Mapping[str, Array], vehicle: Vehicle) -> PackRide | None:
    """Return voltage and current by the pack or the inverter; None without a voltage or a battery."""
    voltages = [ride[role] for role in (VOLTAGE, "inverter_voltage") if role in ride]
    if not voltages or vehicle.battery is None:
        return None
    currents = [ride[role] for role in (CURRENT, "inverter_current") if role in ride]
    degrees = [float(np.nanmean(ride[role])) for role in ("cell_temperature", "ambient_temperature") if role in ride]
    temperature = min(max(degrees[0], -30.0), 60.0) if degrees else BENCH_TEMPERATURE
    return PackRide(voltages[0], currents[0] if currents else None, vehicle.battery, temperature)


def derived(
    ride: Mapping[str, Array], vehicle: Vehicle, speed: Array | None, payload: float | None, pack: PackRide | None
) -> dict[str, Array]:
    """Return the signals that measurements of a `ride` are compared with, (n,), by the names in `PREDICTIONS`.

    speed [m/s] (n,): None if its size is not known. payload [kg], if known. pack: with a current of the right sign.
    """
    found: dict[str, Array] = {}
    moving = None
    if speed is not None:
        moving = np.abs(speed) > CONFIG.moving_m_s
        found["change of speed"] = rate(speed)
        found["slowing"] = np.where(moving, -rate(np.abs(speed)), np.nan)
        if "gps_course" in ride:
            turning = -rate(ride["gps_course"])
            bends = (np.abs(turning) < 1.0) & (np.abs(speed) > 2 * CONFIG.moving_m_s)
            found["turning by course"] = np.where(bends, turning, np.nan)
    if pack is None or pack.current is None:
        return found
    battery = pack.battery
    resistance = battery.circuit(0.5, pack.temperature)[0] * battery.cells_series / battery.cells_parallel
    power = pack.voltage * pack.current
    found["current"], found["power"], found["change of current"] = pack.current, power, change(pack.current)
    found["change of current by the voltage"] = -change(pack.voltage) / (resistance + battery.series_resistance)
    if moving is not None and speed is not None:
        found["power by the model"] = np.where(moving, _model_power(ride, vehicle, speed, payload), np.nan)
        braking = moving & (rate(np.abs(speed)) < BRAKES_M_S2)
        braking[1:] &= braking[:-1]  # the change from driving to braking has the same sign without one
        found["change of current while braking"] = np.where(braking, found["change of current"], np.nan)
    if CURRENT in ride and "inverter_current" in ride:
        auxiliary = np.nan_to_num(ride["auxiliary_current"]) if "auxiliary_current" in ride else 0.0
        found["current of the pack"] = pack.current
        found["current of inverter and auxiliaries"] = ride["inverter_current"] + auxiliary
    for role in ("motor_torque", "motor_current"):
        if role in ride and "motor_speed" in ride:
            found[f"work of {role}"] = ride[role] * np.abs(ride["motor_speed"])
    return found


def _model_power(ride: Mapping[str, Array], vehicle: Vehicle, speed: Array, payload: float | None) -> Array:
    """The power [W] (n,) that the model takes on the level."""
    p = vehicle.parameters
    ambient = float(np.nanmean(ride["ambient_temperature"])) if "ambient_temperature" in ride else BENCH_TEMPERATURE
    ambient = min(max(ambient, -40.0), 60.0)
    quantities = all_quantities(
        speed=speed,
        acceleration=rate(speed),
        grade=np.zeros_like(speed),
        mass=p["vehicle_mass"] + (p["payload_mass"] if payload is None else payload),
        air_density=air_density(ambient),
        ambient_temperature=ambient,
        motor_temperature=ambient,
    )
    return np.asarray(sum(vehicle.model.power(quantities).values()))


def check_predictions(
    ride: Mapping[str, Array], vehicle: Vehicle, speed: Array | None, payload: float | None
) -> tuple[list[Finding], PackRide | None]:
    """Judge every prediction of a ride without the roles that look wrong already; speed, payload: see `derived`.

    Returns the findings, and the pack with its current corrected: its sign and unit come first, by the voltage's drop.
    """
    findings, pack = [], pack_of(ride, vehicle)
    if pack and pack.current is not None:
        finding, factor = SAG.judge(derived(ride, vehicle, None, None, pack))
        findings.append(finding)
        pack = replace(pack, current=factor * pack.current)
    signals = {**ride, **derived(ride, vehicle, speed, payload, pack)}
    for prediction in PREDICTIONS:
        if prediction.measured in signals and prediction.predicted in signals:
            findings.append(prediction.judge(signals)[0])
    if {"accel_x", "accel_y", "change of speed"} <= signals.keys():
        axes = (relation(signals["change of speed"], signals[role]) for role in ("accel_x", "accel_y"))
        forward, sideways = (abs(axis[1]) if axis else 0.0 for axis in axes)
        if sideways > max(FORWARD.close, forward + 0.3):
            text = "accel_y follows the change of speed, and accel_x does not: swapped"
            findings.append(wrong(FORWARD.check, ("accel_x", "accel_y"), text))
    return findings, pack
