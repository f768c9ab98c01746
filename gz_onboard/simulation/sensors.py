"""Readings of the reference scooter's sensors in a simulated ride: with gain, offset, noise and delay.

`Truth` has the states of the scooter; `SENSORS` gives the sensor of each signal of the scooter's DBC files.
Figures are those of docs/reference/reference-scooter.md, or guesses where that has none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import cos, pi

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import GRAVITY
from gz_onboard.model.sensors import VIBRATION_PERIOD_S
from gz_onboard.simulation.truth import Truth

BAR = 1e5  # Pa
BMS_DELAY = 0.10  # s behind the inverter
GPS_DELAY = 0.4  # s
REPORTED_TORQUE = 0.47  # N·m/A, that the inverter makes torque of its current with, whatever the magnets are
ODOMETER_RADIUS = 0.245  # m, that the odometer assumes
LATITUDE, LONGITUDE, ALTITUDE = 45.0, 9.0, 200.0  # deg, deg, m: where a simulated road begins, to the north
_METRES_PER_DEGREE = 111_200.0


@dataclass(frozen=True)
class SimulatedSensor:
    """One signal: the true value in the unit of the DBC, as read `delay` [s] later with noise of `sd` in that unit.

    noise_time: time constant [s] of the noise; 0 is white. Quantisation is that of the DBC.
    """

    signal: str
    read: Callable[[Truth], Array]
    sd: float = 0.0
    delay: float = 0.0
    noise_time: float = 0.0


def _column(name: str, factor: float = 1.0) -> Callable[[Truth], Array]:
    return lambda t: factor * t[name]


# The thermometers that are not the ambient air's: the place, and how late [s].
THERMOMETERS: dict[str, tuple[str, float]] = {
    "INV_Temperature": ("inverter_temperature", 0.0),
    "INV_MotorTemperature": ("motor_temperature", 0.0),
    **{f"TC_Inverter{i}": ("inverter_temperature", 0.0) for i in range(1, 4)},
    **{f"BMS_CellTemp{which}": ("cell_temperature", BMS_DELAY) for which in ("Min", "Max", "Mean")},
    "BMS_BoardTemp": ("bms_temperature", BMS_DELAY),
    **{f"TC_Pack{i}": ("cell_temperature", 0.0) for i in range(1, 7)},
}


def _inverter_voltage(t: Truth) -> Array:
    return t["pack_voltage"] - t.parameters["cable_resistance"] * t["pack_current"]


def _inverter_current(t: Truth) -> Array:
    """The DC current: no auxiliary load in it, nor the inverter's constant loss, which it does not show."""
    p = t.parameters
    return t["pack_current"] - (t["auxiliary_power"] + p["inverter_loss_constant"]) / t["pack_voltage"]


def _pressure(share: Callable[[Mapping[str, float]], float]) -> Callable[[Truth], Array]:
    """Brake pressure [bar] of the wheel with this share of the force."""

    def read(t: Truth) -> Array:
        p = t.parameters
        return t["brake"] * (
            share(p) * p["brake_torque_limit"] / p["wheel_radius"] / p["brake_force_per_pressure"] / BAR
        )

    return read


def _lateral(t: Truth) -> Array:
    return GRAVITY * np.cos(t["slope"]) * np.sin(t["lean"]) + t["way"] * t["yaw_rate"] * np.cos(t["lean"])


def _vertical(t: Truth) -> Array:
    return GRAVITY * np.cos(t["slope"]) * np.cos(t["lean"]) - t["way"] * t["yaw_rate"] * np.sin(t["lean"])


def _forward(t: Truth) -> Array:
    return t["acceleration"] + GRAVITY * np.sin(t["slope"])


def _pitch(t: Truth) -> Array:
    return (t["pitch_rate"] * np.cos(t["lean"]) + t["yaw_rate"] * np.sin(t["lean"])) * (180 / pi)


def _yaw(t: Truth) -> Array:
    return (t["yaw_rate"] * np.cos(t["lean"]) - t["pitch_rate"] * np.sin(t["lean"])) * (180 / pi)


def _course(t: Truth) -> Array:
    """Clockwise from north [deg]; not known while standing."""
    return np.where(t["way"] > 0.5, t["heading"] * (180 / pi), np.nan)


def _longitude(t: Truth) -> Array:
    return LONGITUDE + t["east"] / (_METRES_PER_DEGREE * cos(LATITUDE * pi / 180))


def _inverter_state(t: Truth) -> Array:
    """Ready, Drive or Regen."""
    current = t["motor_current"]
    return np.where(current > 0.5, 2.0, np.where(current < -0.5, 3.0, 1.0))


def _motor_speed(t: Truth) -> Array:
    return t["wheel_speed"] * (_RPM * t.parameters["speed_sensor_scale"] / t.parameters["gear_ratio"])


def _front_wheel(t: Truth) -> Array:
    return t["way"] / (2 * pi * t.parameters["wheel_radius"])


_RPM = 60 / (2 * pi)
SENSORS: tuple[SimulatedSensor, ...] = (
    # inverter
    SimulatedSensor("INV_MotorSpeed", _motor_speed, sd=0.3),
    SimulatedSensor("INV_MotorCurrent", _column("motor_current"), sd=0.3),
    SimulatedSensor("INV_MotorTorque", _column("motor_current", REPORTED_TORQUE), sd=0.1),
    SimulatedSensor("INV_State", _inverter_state),
    SimulatedSensor("INV_DcVoltage", _inverter_voltage, sd=0.042),
    SimulatedSensor("INV_DcCurrent", _inverter_current, sd=0.35),
    # battery; gain, offset and noise are the vehicle's, see `spread`
    SimulatedSensor(
        "BMS_PackVoltage", lambda t: t["pack_voltage"] + t.parameters["pack_voltage_offset"], delay=BMS_DELAY
    ),
    SimulatedSensor(
        "BMS_PackCurrent",
        lambda t: t["pack_current"] * t.parameters["pack_current_gain"] + t.parameters["pack_current_offset"],
        delay=BMS_DELAY,
    ),
    SimulatedSensor("BMS_StateOfCharge", _column("soc", 100.0), delay=BMS_DELAY),
    SimulatedSensor("BMS_State", lambda t: t.constant(2.0)),
    SimulatedSensor("BMS_Contactor", lambda t: t.constant(1.0)),
    # rider
    SimulatedSensor("VCU_Throttle", _column("throttle", 100.0)),
    SimulatedSensor("VCU_BrakeSwitch", lambda t: (t["brake"] > 0.0).astype(float)),
    SimulatedSensor("VCU_RideMode", lambda t: t.constant(1.0)),
    SimulatedSensor("VCU_SideStand", lambda t: t.constant(0.0)),
    SimulatedSensor("VCU_ChargePlug", lambda t: t.constant(0.0)),
    SimulatedSensor("VCU_HeadLamp", lambda t: t.constant(1.0)),
    SimulatedSensor("VCU_Odometer", lambda t: t["distance"] * (1e-3 * ODOMETER_RADIUS / t.parameters["wheel_radius"])),
    SimulatedSensor("VCU_Trip", lambda t: t["distance"] * (1e-3 * ODOMETER_RADIUS / t.parameters["wheel_radius"])),
    # measuring system
    SimulatedSensor("IMU_AccelX", _forward, sd=0.05),
    SimulatedSensor("IMU_AccelY", _lateral, sd=0.05),
    SimulatedSensor("IMU_AccelZ", _vertical, sd=0.05),
    SimulatedSensor("IMU_RateX", _column("lean_rate", 180 / pi), sd=0.1),
    SimulatedSensor("IMU_RateY", _pitch, sd=0.1),
    SimulatedSensor("IMU_RateZ", _yaw, sd=0.1),
    SimulatedSensor("HBM_WheelSpeedFront", _front_wheel, sd=0.002),
    SimulatedSensor("HBM_WheelSpeedRear", _column("wheel_speed", 1 / (2 * pi)), sd=0.002),
    SimulatedSensor("HBM_BrakePressureFront", _pressure(lambda p: p["front_brake_share"]), sd=0.05),
    SimulatedSensor("HBM_BrakePressureRear", _pressure(lambda p: 1 - p["front_brake_share"]), sd=0.05),
    SimulatedSensor("HBM_AuxCurrent", _column("auxiliary_current"), sd=0.01),
    SimulatedSensor("GPS_Latitude", lambda t: LATITUDE + t["north"] / _METRES_PER_DEGREE, 1e-5, GPS_DELAY, 30.0),
    SimulatedSensor("GPS_Longitude", _longitude, 1.4e-5, GPS_DELAY, 30.0),
    SimulatedSensor("GPS_Speed", _column("way"), 0.1, GPS_DELAY),
    SimulatedSensor("GPS_Course", _course, 1.0, GPS_DELAY),
    SimulatedSensor("GPS_Altitude", lambda t: ALTITUDE + t["climb"], 1.5, GPS_DELAY, 30.0),
    SimulatedSensor("GPS_Satellites", lambda t: t.constant(9.0)),
    SimulatedSensor("GPS_Fix", lambda t: t.constant(3.0)),
    *(SimulatedSensor(signal, _column(place), delay=late) for signal, (place, late) in THERMOMETERS.items()),
    *(SimulatedSensor(signal, lambda t: t.constant(t.ambient)) for signal in ("TC_Ambient", "TC_Chassis")),
)
"""Cell voltages, limits, steering and suspension are in the DBC files but not here: the simulation has none."""

ROLLER: tuple[SimulatedSensor, ...] = (
    SimulatedSensor("DYNO_RollerSpeed", _column("speed"), sd=0.002),
    SimulatedSensor("DYNO_RollerForce", _column("tyre_force"), sd=1.0),
)
"""On the chassis dynamometer only."""


def shaken(sensor: SimulatedSensor, truth: Truth, period: float) -> Array | None:
    """Standard deviation of the vibration of the road at the sensor [its unit] at each step; None without any.

    White, sampled each `period` [s], whose filtered size (`model.sensors`) is the truth's vibration.
    """
    if sensor.signal != "IMU_AccelZ" or not truth["vibration"].any():
        return None
    keep = np.exp(
        -period / VIBRATION_PERIOD_S
    )  # of the slow mean; the faster part has a variance of keep²·(1 + (1-keep)/(1+keep))
    shown: Array = truth["vibration"] / (keep * np.sqrt(2 / (1 + keep)))
    return shown


def spread(sensor: SimulatedSensor, parameters: Mapping[str, float]) -> float:
    """The standard deviation of the sensor's noise, in the unit of its signal; of the pack's that of the vehicle."""
    name = {"BMS_PackVoltage": "pack_voltage_noise", "BMS_PackCurrent": "pack_current_noise"}.get(sensor.signal)
    return parameters[name] if name else sensor.sd


def latency(sensor: SimulatedSensor, parameters: Mapping[str, float]) -> float:
    """How late the sensor is [s]: the pack's voltage as much later than its current as the vehicle's file says."""
    return sensor.delay + (parameters["pack_voltage_latency"] if sensor.signal == "BMS_PackVoltage" else 0.0)


TURNS = {"GPS_Course": 360.0}
"""Signals that go round, and their turn."""
GPS_MESSAGES = ("GPS_Position", "GPS_Motion")
