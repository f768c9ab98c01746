"""The channels: each a residual with its blocks, the sensors it needs, where it holds, and its parameters.

Each channel is an analytical redundancy relation (Gertler 1998; Krysander & Frisk 2008): a balance of one part of the
vehicle whose inputs come from sensors, not from the model of another part. A fault in one part then shows in few
channels, and causes that look alike in the energy drawn (a heavier rider, a weaker magnet) do not look alike in all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gz_onboard.arrays import Array, Mask, block_means
from gz_onboard.discovery import residuals
from gz_onboard.discovery.grid import COARSE, STEP, Ride
from gz_onboard.discovery.residuals import WARMING, System, Values
from gz_onboard.model.effect import ROAD_LOAD, Effect, Port

ROLLING = 2.0  # m/s: above it the wheel rolls freely


def always(ride: Ride) -> Mask:
    """Everywhere."""
    return np.ones(len(ride.time), dtype=bool)


def rolling(ride: Ride, threshold: float = ROLLING) -> Mask:
    """Faster than `threshold` [m/s], without a brake."""
    return np.asarray((np.abs(ride.quantities["speed"]) > threshold) & ~ride.braking)


def coasting(ride: Ride) -> Mask:
    """Fast enough that wheel speeds can be compared, without a brake."""
    return rolling(ride, 3.0)


def fast(ride: Ride) -> Mask:
    """Fast enough for a GPS speed, with a fix in three dimensions."""
    fix = ride.signals["gps_fix"] > 2.5 if "gps_fix" in ride.signals else always(ride)
    return np.asarray((np.abs(ride.quantities["speed"]) > 4.0) & fix)


def known_drive(ride: Ride) -> Mask:
    """Where the drive power is known: everywhere with a motor current, else where no brake takes a part of it."""
    return always(ride) if "motor_current" in ride.signals else np.asarray(~ride.braking | ride.standing)


class ChannelNoise(NamedTuple):
    """Standard deviations of the white and the exponentially correlated noise of a block [unit], correlation time."""

    white: float
    slow: float
    time: float  # s

    @property
    def sd(self) -> float:
        """Standard deviation of one block."""
        return float(np.hypot(self.white, self.slow))

    def scaled(self, size: float) -> ChannelNoise:
        """The noise of a vehicle of another size."""
        return ChannelNoise(self.white * size, self.slow * size, self.time)


@dataclass(frozen=True)
class Channel:
    """One residual: how long its blocks are, the roles it needs, where it holds, the parameters it depends on.

    ports: effects there act on it. correlated: False if its blocks are independent.
    """

    name: str
    unit: str
    block: float  # s
    roles: tuple[str, ...]
    residual: Callable[[Ride, Values, System], Array]
    parameters: tuple[str, ...]
    noise: ChannelNoise  # before any healthy ride, in a vehicle of size 1
    size: str = ""  # the size of `Sizes` that the noise grows with
    steps: int = 1  # grid steps to one of the residual's
    holds: Callable[[Ride], Mask] = always
    ports: tuple[Port, ...] = ()
    battery: bool = False  # whether it needs the pack's cells
    correlated: bool = True
    slow: float = 0.0  # s: the shortest correlation of its noise; model errors are slow
    rough: float = 0.0  # A of changing motor current, in a vehicle of size 1, that double the variance; 0: none do
    shaken: float = 0.0  # m/s² of vibration that do
    fast: float = 0.0  # m/s that do, in a power: force noise times speed
    fed_by: tuple[str, ...] = ()  # roles that it needs too, though not at each instant
    max_gap: float = math.inf  # s between samples of its roles, beyond which they do not show it
    unless: tuple[str, ...] = ()  # channels that together show it in parts, where the motor current was measured

    def depends(self, effects: Sequence[Effect]) -> set[str]:
        """The parameters that it depends on."""
        acting = (e for e in effects if e.port in self.ports and not e.stores_energy)
        return set(self.parameters).union(*(effect.takes for effect in acting))

    def too_slow(self, ride: Ride) -> bool:
        """Whether samples of its roles are too far apart."""
        return any(ride.periods.get(role, 0.0) > self.max_gap for role in self.roles)

    def usable(self, ride: Ride, system: System) -> bool:
        """Whether the ride has the signals that it needs."""
        if not {*self.roles, *self.fed_by} <= ride.have or (self.battery and system.battery is None):
            return False
        parts = [CHANNEL[name] for name in self.unless if "motor_current" in ride.have]
        split = bool(parts) and all(part.usable(ride, system) for part in parts)
        return not (split or self.too_slow(ride))

    def mean(self, values: Array) -> Array:
        """A quantity on the grid, averaged over the blocks."""
        return block_means(values, round(self.block / STEP))

    def support(self, ride: Ride) -> Mask:
        """The blocks in which everything was measured and the channel holds, shape (blocks,)."""
        good = self.holds(ride) & ride.mask(*self.roles)
        if self.name == "voltage_timing":  # of steps from one to the next
            good = good & np.append(good[1:], False)
        return np.asarray(self.mean(good.astype(float)) > 0.99)  # all of it, but for rounding

    def blocks(self, ride: Ride, p: Values, system: System) -> Array:
        """The residual averaged over blocks, shape (blocks,); those without support too."""
        means = block_means(self.residual(ride, p, system), round(self.block / STEP / self.steps))
        return np.asarray(means[: len(ride.time) // round(self.block / STEP)])

    def roughness(self, ride: Ride, system: System) -> Array:
        """How much more than usual a block scatters, shape (blocks,).

        Small errors of timing and dynamics weigh more where the current changes within a block; the accelerometer is
        noisier on a rough road.
        """
        shaken = np.ones(len(ride.time) // round(self.block / STEP))
        if self.shaken > 0 and "vibration" in ride.quantities:
            shaken = shaken + self.mean(ride.quantities["vibration"] ** 2) / self.shaken**2
        if self.fast > 0 and "motor_current" not in ride.have:
            shaken = shaken * (1 + self.mean(ride.quantities["speed"] ** 2) / self.fast**2)
        doubling = self.rough * system.sizes.current
        if doubling <= 0:
            return np.asarray(np.sqrt(shaken))
        amperes = ride.quantities["motor_current"]
        level = 0.2 * self.mean(np.abs(amperes))  # gain errors count as if a fifth of a steady current changed
        swing = np.sqrt(np.maximum(self.mean(amperes**2) - self.mean(amperes) ** 2, 0.0))
        return np.asarray(np.sqrt(shaken * (1 + ((swing + level) / doubling) ** 2)))


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

# Blocks: 0.1 s where a delay shows, 2 s for currents, voltages and speeds, 4 s to average the noise of accelerometer
# and lamps, 10 s for heights and temperatures. Noise is that of healthy rides of the reference scooter, until a
# baseline or the rides themselves say more. rough: the lower, the more the timing of two sensors matters.
CHANNELS = (
    Channel(
        "road_force",
        "N",
        block=4.0,
        roles=("motor_speed", "motor_current", "accel_x"),
        residual=residuals.road_force,
        holds=rolling,
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
        residual=residuals.pack_power,
        holds=known_drive,
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
        steps=COARSE,
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
        max_gap=0.15,
    ),
    Channel(
        "gps_speed",
        "m/s",
        block=2.0,
        roles=("gps_speed", "motor_speed"),
        residual=residuals.gps_speed,
        holds=fast,
        parameters=(*_SPEED, "slip_per_force", "lean_radius", "gps_lag"),
        noise=ChannelNoise(white=0.1, slow=0.05, time=30.0),
    ),
    Channel(
        "rear_speed",
        "m/s",
        block=2.0,
        roles=("wheel_speed_rear", "motor_speed"),
        residual=residuals.rear_speed,
        holds=coasting,
        parameters=("speed_sensor_scale", "rear_scale", "wheel_lag"),
        noise=ChannelNoise(white=0.02, slow=0.01, time=30.0),
    ),
    Channel(
        "front_speed",
        "m/s",
        block=2.0,
        roles=("wheel_speed_front", "motor_speed"),
        residual=residuals.front_speed,
        holds=coasting,
        parameters=("speed_sensor_scale", "front_scale", "front_lean", "slip_per_force", "wheel_lag"),
        noise=ChannelNoise(white=0.05, slow=0.02, time=30.0),
    ),
    Channel(
        "motor_temperature",
        "K",
        block=10.0,
        steps=WARMING,
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
        steps=WARMING,
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
        steps=WARMING,
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
