"""The channels: each a residual with its blocks, what it needs, where it holds and what it depends on.

Each channel is an analytical redundancy relation (Gertler 1998; Krysander & Frisk 2008): a balance of one part of the
vehicle that takes its inputs from sensors, not from the model of another part. So a fault in one part shows in few
channels, and causes that look alike in the energy drawn (a heavier rider, a weaker magnet) do not in all of them.

    road_force           N      torque at the wheel, less road load; mass times the accelerometer is grade and inertia
    altitude             m      GPS altitude, less the way times the grade that the accelerometer shows
    inverter_power       W      DC power of the inverter, less air-gap power and losses
    pack_balance         A      pack current less auxiliary current, less inverter current
    auxiliary            W      what the auxiliary current sensor shows
    voltage_balance      V      pack voltage, less inverter voltage and cable drop
    cell_voltage         V      of a mean cell, less the equivalent circuit at the current measured
    voltage_timing       V      its step in 0.1 s, less that of the current
    gps_speed            m/s    less motor speed times wheel radius
    rear_speed, front_speed   m/s    wheel-speed sensors, less motor speed
    motor_temperature, inverter_temperature, cell_temperature   K   less the cooling networks at the modelled heat
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.lab.discover import residuals
from gz_onboard.lab.discover.grid import Ride
from gz_onboard.lab.discover.residuals import SLOW
from gz_onboard.lab.discover.system import System, Values
from gz_onboard.physics.effect import Port


def _always(ride: Ride) -> Mask:
    return np.ones(len(ride.time), dtype=bool)


def _rolling(ride: Ride) -> Mask:
    return np.asarray((np.abs(ride.quantities["speed"]) > 2.0) & ~ride.braking)


def _fast(ride: Ride) -> Mask:
    fix = ride.signals["gps_fix"] > 2.5 if "gps_fix" in ride.signals else np.ones(len(ride.time), dtype=bool)
    return np.asarray((np.abs(ride.quantities["speed"]) > 4.0) & fix)


def _coasting(ride: Ride) -> Mask:
    return np.asarray((np.abs(ride.quantities["speed"]) > 3.0) & ~ride.braking)


@dataclass(frozen=True)
class Channel:
    """One residual: how long its blocks are, what it needs, where it holds, and which parameters it depends on.

    ports: those whose effects act on it. correlated: whether its noise is (if not, its blocks are independent).
    """

    name: str
    unit: str
    block: float  # s
    steps: int  # grid steps to one of the function's
    roles: tuple[str, ...]
    residual: Callable[[Ride, Values, System], Array]
    holds: Callable[[Ride], Mask]
    parameters: tuple[str, ...]
    ports: tuple[Port, ...] = ()
    noise: tuple[float, float, float] = (1.0, 1.0, 60.0)  # white sd, correlated sd, s: before any healthy ride
    battery: bool = False
    correlated: bool = True
    slow: float = 0.0  # s: the shortest correlation that its noise can have; what its model lacks is slow
    rough: float = 0.0  # A of motor current within a block that double its variance; 0: none do
    shaken: float = 0.0  # m/s² of vibration that do; 0: none


_TORQUE = ("torque_constant", "torque_constant_slope", "torque_saturation")
_SPEED = ("wheel_radius", "speed_sensor_scale")
_CELL = (
    "pack_current_offset",
    "pack_current_gain",
    "cell_capacity",
    "soc_start",
    "cell_resistance_factor",
    "v1_start",
    "resistance_cold",
    "ocv_offset",
    "ocv_tilt",
    "ocv_cold",
    "pair_resistance",
    "pair_time",
    "mid_resistance",
    "drift",
    "resistance_level",
    "resistance_empty_cold",
    "resistance_empty",
    "resistance_current",
    "resistance_current_cold",
)

CHANNELS = (
    Channel(
        "road_force",
        "N",
        4.0,
        1,
        ("motor_speed", "motor_current", "accel_x"),
        residuals.road_force,
        _rolling,
        (*_TORQUE, *_SPEED, "payload_mass", "payload_error", "accel_bias", "pitch_gain", "rolling_cold"),
        (Port.WHEEL_FORCE, Port.TYRE, Port.MOTOR_LOSS),
        (5.0, 2.0, 60.0),
        rough=60.0,
        shaken=0.85,
    ),
    Channel(
        "altitude",
        "m",
        10.0,
        1,
        ("accel_x", "gps_altitude"),
        residuals.altitude,
        _always,
        ("accel_bias", "pitch_gain", "altitude_start", "wheel_radius", "speed_sensor_scale"),
        (),
        (0.5, 2.5, 120.0),
    ),
    Channel(
        "inverter_power",
        "W",
        2.0,
        1,
        ("inverter_voltage", "inverter_current", "motor_speed", "motor_current"),
        residuals.inverter_power,
        _always,
        (
            *_TORQUE,
            "speed_sensor_scale",
            "copper_speed",
            "inverter_current_gain",
            "inverter_current_offset",
            "torque_lag",
            "loss_speed",
            "loss_cross",
        ),
        (Port.MOTOR_LOSS, Port.INVERTER_LOSS),
        (6.0, 4.0, 60.0),
        rough=10.0,
    ),
    Channel(
        "pack_balance",
        "A",
        2.0,
        1,
        ("pack_current", "inverter_current", "auxiliary_current"),
        residuals.pack_balance,
        _always,
        (
            "pack_current_offset",
            "pack_current_gain",
            "inverter_current_offset",
            "inverter_current_gain",
            "idle_current",
            "pack_inverter_lag",
        ),
        (),
        (0.1, 0.03, 60.0),
        rough=30.0,
    ),
    Channel(
        "auxiliary",
        "W",
        4.0,
        1,
        ("auxiliary_current", "pack_voltage"),
        residuals.auxiliary,
        _always,
        ("brake_light",),
        (Port.DC_POWER,),
        (1.0, 1.0, 60.0),
    ),
    Channel(
        "voltage_balance",
        "V",
        2.0,
        1,
        ("pack_voltage", "inverter_voltage", "inverter_current"),
        residuals.voltage_balance,
        _always,
        ("pack_voltage_offset", "inverter_voltage_offset", "cable_resistance"),
        (),
        (0.03, 0.01, 60.0),
    ),
    Channel(
        "cell_voltage",
        "V",
        2.0,
        SLOW,
        ("pack_voltage", "pack_current"),
        residuals.cell_voltage,
        _always,
        (*_CELL, "pack_voltage_offset", "pack_series_resistance"),
        (Port.CELL_VOLTAGE,),
        (0.002, 0.008, 300.0),
        True,
        slow=60.0,
        rough=10.0,
    ),
    Channel(
        "voltage_timing",
        "V",
        0.1,
        1,
        ("pack_voltage", "pack_current"),
        residuals.voltage_timing,
        _always,
        (
            "pack_current_gain",
            "pack_voltage_latency",
            "fast_resistance",
            "fast_cold",
            "cell_resistance_factor",
            "pack_series_resistance",
        ),
        (),
        (0.002, 0.0, 10.0),
        True,
        False,
        rough=3.0,
    ),
    Channel(
        "gps_speed",
        "m/s",
        2.0,
        1,
        ("gps_speed", "motor_speed"),
        residuals.gps_speed,
        _fast,
        (*_SPEED, "slip_per_force", "lean_radius", "gps_lag"),
        (),
        (0.1, 0.05, 30.0),
    ),
    Channel(
        "rear_speed",
        "m/s",
        2.0,
        1,
        ("wheel_speed_rear", "motor_speed"),
        residuals.rear_speed,
        _coasting,
        ("speed_sensor_scale", "rear_scale", "wheel_lag"),
        (),
        (0.02, 0.01, 30.0),
    ),
    Channel(
        "front_speed",
        "m/s",
        2.0,
        1,
        ("wheel_speed_front", "motor_speed"),
        residuals.front_speed,
        _coasting,
        ("speed_sensor_scale", "front_scale", "front_lean", "slip_per_force", "wheel_lag"),
        (),
        (0.05, 0.02, 30.0),
    ),
    Channel(
        "motor_temperature",
        "K",
        10.0,
        SLOW,
        ("motor_temperature", "ambient_temperature"),
        residuals.motor_temperature,
        _always,
        (
            "motor_start",
            "rotor_start",
            "motor_stator_share",
            "motor_gap_conductance",
            "motor_stator_capacity",
            "motor_rotor_capacity",
            "motor_rotor_to_ambient",
            "motor_airflow",
            "cooling_factor",
            "copper_speed",
        ),
        (Port.MOTOR_LOSS,),
        (0.4, 0.7, 200.0),
        slow=200.0,
    ),
    Channel(
        "inverter_temperature",
        "K",
        10.0,
        SLOW,
        ("inverter_temperature", "ambient_temperature"),
        residuals.inverter_temperature,
        _always,
        (
            "inverter_start",
            "box_start",
            "inverter_board_to_box",
            "inverter_box_to_ambient",
            "inverter_board_capacity",
            "inverter_box_capacity",
            "inverter_airflow",
            "cooling_factor",
        ),
        (Port.INVERTER_LOSS,),
        (0.4, 0.7, 200.0),
        slow=200.0,
    ),
    Channel(
        "cell_temperature",
        "K",
        10.0,
        SLOW,
        ("cell_temperature", "ambient_temperature", "pack_voltage", "pack_current"),
        residuals.cell_temperature,
        _always,
        (
            "cells_start",
            "pack_heat_capacity",
            "pack_conductance",
            "pack_airflow",
            "cooling_factor",
            "cell_resistance_factor",
            "pack_current_gain",
        ),
        (Port.CELL_VOLTAGE,),
        (0.3, 0.5, 300.0),
        True,
        slow=200.0,
    ),
)
BY_NAME = {channel.name: channel for channel in CHANNELS}
