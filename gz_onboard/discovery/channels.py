"""The channels: each a residual with its blocks, what it needs, where it holds and what it depends on.

Each channel is an analytical redundancy relation (Gertler 1998; Krysander & Frisk 2008): a balance of one part of the
vehicle that takes its inputs from sensors, not from the model of another part. So a fault in one part shows in few
channels, and causes that look alike in the energy drawn (a heavier rider, a weaker magnet) do not in all of them.
`residuals` says what is measured and what is taken off.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.discovery import residuals
from gz_onboard.discovery.grid import Ride
from gz_onboard.discovery.pack_power import pack_power
from gz_onboard.discovery.residuals import SLOW
from gz_onboard.discovery.system import System, Values
from gz_onboard.model.effect import ROAD_LOAD, Port

ROLLING, COASTING, FAST = 2.0, 3.0, 4.0  # m/s: above these the wheel rolls freely, coasts, GPS shows its speed well
FIX = 2.5  # quality of a GPS fix, between that of two dimensions and of three


def _always(ride: Ride) -> Mask:
    return np.ones(len(ride.time), dtype=bool)


def _unbraked(faster: float, ride: Ride) -> Mask:
    return np.asarray((np.abs(ride.quantities["speed"]) > faster) & ~ride.braking)


def _fast(ride: Ride) -> Mask:
    fix = ride.signals["gps_fix"] > FIX if "gps_fix" in ride.signals else np.ones(len(ride.time), dtype=bool)
    return np.asarray((np.abs(ride.quantities["speed"]) > FAST) & fix)


def _known_drive(ride: Ride) -> Mask:
    """Where what drives it is known: all of the ride with a motor current, else where no brake takes a part of it."""
    return _always(ride) if "motor_current" in ride.signals else np.asarray(~ride.braking | ride.standing)


class ChannelNoise(NamedTuple):
    """Of a channel's blocks: standard deviations of the white and of the exponentially correlated part [unit]."""

    white: float
    slow: float
    time: float  # s: of the correlation

    @property
    def sd(self) -> float:
        """Of one block."""
        return float(np.hypot(self.white, self.slow))

    def scaled(self, size: float) -> ChannelNoise:
        """Of a channel whose unit weighs so much less."""
        return ChannelNoise(self.white * size, self.slow * size, self.time)


@dataclass(frozen=True)
class Channel:
    """One residual: how long its blocks are, what it needs, where it holds, and which parameters it depends on.

    ports: those whose effects act on it. correlated: whether its noise is (if not, its blocks are independent).
    """

    name: str
    unit: str
    block: float  # s
    roles: tuple[str, ...]
    residual: Callable[[Ride, Values, System], Array]
    parameters: tuple[str, ...]
    noise: ChannelNoise  # before any healthy ride, in a vehicle of size 1
    size: str = ""  # the size of `Sizes` that the noise grows with
    steps: int = 1  # grid steps to one of the function's
    holds: Callable[[Ride], Mask] = _always
    ports: tuple[Port, ...] = ()
    battery: bool = False
    correlated: bool = True
    slow: float = 0.0  # s: the shortest correlation that its noise can have; what its model lacks is slow
    rough: float = 0.0  # A of motor current, in a vehicle of size 1, that double a block's variance; 0: none do
    shaken: float = 0.0  # m/s² of vibration that do; 0: none
    fast: float = 0.0  # m/s that do, of a power: of what noise in a force makes at that speed; 0: none
    fed_by: tuple[str, ...] = ()  # roles that it needs too, though not at each instant
    apart: float = math.inf  # s between samples of its roles, beyond which they do not show it
    unless: tuple[str, ...] = ()  # channels that together show it in parts, where the motor's current was measured


_TORQUE = ("torque_constant", "torque_constant_slope", "torque_saturation")
_SPEED = ("wheel_radius", "speed_sensor_scale")
_PACK_CURRENT = ("pack_current_offset", "pack_current_gain")
_PACK = (*_PACK_CURRENT, "pack_voltage_offset")
_ROAD = ("payload_mass", "payload_error", "accel_bias", "pitch_gain", "rolling_cold")
_INVERTER_CURRENT = ("inverter_current_offset", "inverter_current_gain")
_LOSSES = ("copper_speed", "loss_speed", "loss_cross", "torque_lag")
_CELL = (
    *_PACK_CURRENT,
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

# A block is as long as what the residual is of stays the same: 0.1 s where a delay shows, 2 s for currents, voltages
# and speeds, 4 s where noise is to average out (of the accelerometer, of lamps), 10 s for heights and temperatures.
# Noise is as on healthy rides of the reference scooter, until a baseline, or the rides themselves, say more.
# rough: some of what a rider changes the current by; the less, the more two sensors' timing matters to the residual.
CHANNELS = (
    Channel(
        "road_force",
        "N",
        block=4.0,
        roles=("motor_speed", "motor_current", "accel_x"),
        residual=residuals.road_force,
        holds=partial(_unbraked, ROLLING),
        parameters=(*_TORQUE, *_SPEED, *_ROAD),
        ports=(Port.WHEEL_FORCE, Port.TYRE, Port.MOTOR_LOSS),
        noise=ChannelNoise(white=5.0, slow=2.0, time=60.0),
        size="power",
        rough=60.0,
        shaken=0.85,
    ),
    Channel(
        "altitude",
        "m",
        block=10.0,
        roles=("accel_x", "gps_altitude"),
        residual=residuals.altitude,
        parameters=("accel_bias", "pitch_gain", "altitude_start", "wheel_radius", "speed_sensor_scale"),
        noise=ChannelNoise(white=0.5, slow=2.5, time=120.0),
    ),
    Channel(
        "inverter_power",
        "W",
        block=2.0,
        roles=("inverter_voltage", "inverter_current", "motor_speed", "motor_current"),
        residual=residuals.inverter_power,
        parameters=(*_TORQUE, "speed_sensor_scale", *_LOSSES, *_INVERTER_CURRENT),
        ports=(Port.MOTOR_LOSS, Port.INVERTER_LOSS),
        noise=ChannelNoise(white=6.0, slow=4.0, time=60.0),
        size="power",
        rough=10.0,
    ),
    Channel(
        "pack_balance",
        "A",
        block=2.0,
        roles=("pack_current", "inverter_current", "auxiliary_current"),
        residual=residuals.pack_balance,
        parameters=(*_PACK_CURRENT, *_INVERTER_CURRENT, "idle_current", "pack_inverter_lag"),
        noise=ChannelNoise(white=0.1, slow=0.03, time=60.0),
        size="current",
        rough=30.0,
    ),
    Channel(
        "pack_power",
        "W",
        block=4.0,
        roles=("pack_voltage", "pack_current"),
        residual=pack_power,
        holds=_known_drive,
        parameters=(*_TORQUE, *_SPEED, *_LOSSES, *_PACK, *_INVERTER_CURRENT, *_ROAD, "idle_current", "brake_light"),
        ports=(*ROAD_LOAD, Port.MOTOR_LOSS, Port.INVERTER_LOSS, Port.DC_POWER),
        noise=ChannelNoise(white=4.0, slow=2.0, time=60.0),
        size="power",
        rough=7.0,
        shaken=0.85,
        fast=0.8,
        slow=60.0,
        unless=("inverter_power", "pack_balance"),
    ),
    Channel(
        "auxiliary",
        "W",
        block=4.0,
        roles=("auxiliary_current", "pack_voltage"),
        residual=residuals.auxiliary,
        parameters=("brake_light",),
        ports=(Port.DC_POWER,),
        noise=ChannelNoise(white=1.0, slow=1.0, time=60.0),
        size="auxiliary",
    ),
    Channel(
        "voltage_balance",
        "V",
        block=2.0,
        roles=("pack_voltage", "inverter_voltage", "inverter_current"),
        residual=residuals.voltage_balance,
        parameters=("pack_voltage_offset", "inverter_voltage_offset", "cable_resistance"),
        noise=ChannelNoise(white=0.03, slow=0.01, time=60.0),
        size="voltage",
    ),
    Channel(
        "cell_voltage",
        "V",
        block=2.0,
        steps=SLOW,
        roles=("pack_voltage", "pack_current"),
        residual=residuals.cell_voltage,
        parameters=(*_CELL, "pack_voltage_offset", "pack_series_resistance"),
        ports=(Port.CELL_VOLTAGE,),
        noise=ChannelNoise(white=0.002, slow=0.008, time=300.0),
        battery=True,
        slow=60.0,
        rough=10.0,
    ),
    Channel(
        "voltage_timing",
        "V",
        block=0.1,
        roles=("pack_voltage", "pack_current"),
        residual=residuals.voltage_timing,
        parameters=(
            "pack_current_gain",
            "pack_voltage_latency",
            "fast_resistance",
            "fast_cold",
            "cell_resistance_factor",
            "pack_series_resistance",
        ),
        noise=ChannelNoise(white=0.002, slow=0.0, time=10.0),
        battery=True,
        correlated=False,
        rough=3.0,
        apart=0.15,
    ),
    Channel(
        "gps_speed",
        "m/s",
        block=2.0,
        roles=("gps_speed", "motor_speed"),
        residual=residuals.gps_speed,
        holds=_fast,
        parameters=(*_SPEED, "slip_per_force", "lean_radius", "gps_lag"),
        noise=ChannelNoise(white=0.1, slow=0.05, time=30.0),
    ),
    Channel(
        "rear_speed",
        "m/s",
        block=2.0,
        roles=("wheel_speed_rear", "motor_speed"),
        residual=residuals.rear_speed,
        holds=partial(_unbraked, COASTING),
        parameters=("speed_sensor_scale", "rear_scale", "wheel_lag"),
        noise=ChannelNoise(white=0.02, slow=0.01, time=30.0),
    ),
    Channel(
        "front_speed",
        "m/s",
        block=2.0,
        roles=("wheel_speed_front", "motor_speed"),
        residual=residuals.front_speed,
        holds=partial(_unbraked, COASTING),
        parameters=("speed_sensor_scale", "front_scale", "front_lean", "slip_per_force", "wheel_lag"),
        noise=ChannelNoise(white=0.05, slow=0.02, time=30.0),
    ),
    Channel(
        "motor_temperature",
        "K",
        block=10.0,
        steps=SLOW,
        roles=("motor_temperature", "ambient_temperature"),
        fed_by=("motor_current",),
        residual=residuals.motor_temperature,
        parameters=(
            "motor_start",
            "rotor_start",
            "motor_iron_share",
            "motor_gap_conductance",
            "motor_stator_capacity",
            "motor_rotor_capacity",
            "motor_rotor_to_ambient",
            "motor_airflow",
            "cooling_factor",
            "copper_speed",
        ),
        ports=(Port.MOTOR_LOSS,),
        noise=ChannelNoise(white=0.4, slow=0.7, time=200.0),
        slow=200.0,
    ),
    Channel(
        "inverter_temperature",
        "K",
        block=10.0,
        steps=SLOW,
        roles=("inverter_temperature", "ambient_temperature"),
        fed_by=("motor_current",),
        residual=residuals.inverter_temperature,
        parameters=(
            "inverter_start",
            "box_start",
            "inverter_board_to_box",
            "inverter_box_to_ambient",
            "inverter_board_capacity",
            "inverter_box_capacity",
            "inverter_airflow",
            "cooling_factor",
        ),
        ports=(Port.INVERTER_LOSS,),
        noise=ChannelNoise(white=0.4, slow=0.7, time=200.0),
        slow=200.0,
    ),
    Channel(
        "cell_temperature",
        "K",
        block=10.0,
        steps=SLOW,
        roles=("cell_temperature", "ambient_temperature", "pack_voltage", "pack_current"),
        residual=residuals.cell_temperature,
        parameters=(
            "cells_start",
            "pack_heat_capacity",
            "pack_conductance",
            "pack_airflow",
            "cooling_factor",
            "cell_resistance_factor",
            "pack_current_gain",
        ),
        ports=(Port.CELL_VOLTAGE,),
        noise=ChannelNoise(white=0.3, slow=0.5, time=300.0),
        battery=True,
        slow=200.0,
    ),
)
CHANNEL = {channel.name: channel for channel in CHANNELS}
