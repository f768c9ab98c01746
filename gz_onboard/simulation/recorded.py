"""Recorded rides as inputs of a simulation: throttle and brake, speed, and what to compare the simulation with.

Frames go through the codec of the bus, which drops the same ones as on board. The road is that of the estimator's road
filter (accelerometer, altitude, yaw rate), or that of a route file. Its roughness is the estimator's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np

from gz_onboard.arrays import Array, block_means, held_at, running_mean
from gz_onboard.can.codec import LONGEST_PAUSE_NS
from gz_onboard.constants import MILD
from gz_onboard.errors import InputError
from gz_onboard.events import Estimate
from gz_onboard.model.battery import discharged
from gz_onboard.model.effect import Port
from gz_onboard.model.model import standing_load
from gz_onboard.model.series import first_soc
from gz_onboard.pipeline import Pipeline
from gz_onboard.recording.decode import feed
from gz_onboard.recording.recording import open_ride, read_recording, ride_name
from gz_onboard.recording.sensors import speed_role, true_columns
from gz_onboard.simulation.parts import Dynamometer, RoadProfile, road_table
from gz_onboard.simulation.scooter import STEP, Scooter
from gz_onboard.vehicle import Vehicle

BRAKE_PRESSED = 0.5e5  # Pa: below this the sensors show noise
BRAKE_MEAN = 0.07835  # of full brake, 90 N: the mean of these rides while the switch is on, where no pressures are
ROAD_PIECE = 5.0  # m
SPAN, ROLLING, LEAST_SPANS = 2.0, 1.0, 10  # s, m/s and count: of spans of a roller's run that moves
SMOOTHED = 0.2  # s: over which the roller's speed at the ends of a span is a mean
LEAST_HEADINGS = 10  # of a ride whose heading counts as known
_MOVING = 2.0  # m/s: slower than this, yaw rate over speed is no curvature


@dataclass(frozen=True)
class Recorded:
    """A recorded ride, at even steps.

    signals: by role, in its SI unit, arrays of one length; only recorded ones, corrected for known errors of the
    vehicle's sensors (`physics.sensors`). ``speed`` [m/s] (of the driven wheel), ``distance`` [m], ``brake`` (0..1,
    of `brake_torque_limit`) and ``soc`` (counted charge) are worked out; ``vibration`` [m/s²] too, if the vehicle's
    model reads it and the ride tells it.
    """

    name: str
    dt: float  # s
    signals: dict[str, Array]
    grade: Array  # sine, each `ROAD_PIECE` of distance
    curvature: Array  # 1/m, positive to the left, likewise
    heading: Array | None = None  # rad clockwise from north, likewise; None without GPS
    vibration: Array | None = None  # m/s², likewise; None where ``vibration`` is not known

    @property
    def duration(self) -> float:
        """[s]."""
        return (len(self.signals["speed"]) - 1) * self.dt

    @property
    def distance(self) -> float:
        """[m]."""
        return float(self.signals["distance"][-1])

    @property
    def on_dynamometer(self) -> bool:
        """Whether there was a roller under the wheel."""
        return "roller_force" in self.signals

    def first(self, role: str, default: float) -> float:
        """What `role` was in the first second; `default` if it was not recorded."""
        values = self.signals.get(role)
        return default if values is None else float(values[: max(round(1 / self.dt), 1)].mean())

    def energy(self) -> float | None:
        """Energy out of the pack [J] as measured, or None."""
        if "pack_voltage" not in self.signals or "pack_current" not in self.signals:
            return None
        return float((self.signals["pack_voltage"] * self.signals["pack_current"]).sum() * self.dt)

    def heading_at(self, distance: float) -> float:
        """The heading [rad] at `distance` [m]; north where none is known."""
        return 0.0 if self.heading is None else _at(self.heading, distance)

    def vibration_at(self, distance: float) -> float:
        """How rough the road is [m/s²] at `distance` [m]; only if `vibration` is known."""
        assert self.vibration is not None
        return _at(self.vibration, distance)

    def road(self, headwind: float = 0.0) -> RoadProfile:
        """The road that was ridden."""
        starts = [ROAD_PIECE * i for i in range(len(self.grade))]
        return road_table(starts, self.grade.tolist(), self.curvature.tolist(), headwind)


def read_recorded(log: Path, vehicle: Vehicle, progress: Callable[[int], None] | None = None) -> Recorded:
    """The ride in `log`, of `vehicle`. progress: called with the number of frames read.

    Raises InputError for a log that cannot be read, or that has no speed.
    """
    if vehicle.battery is None:
        raise vehicle.error("has no [battery], which a simulation needs")
    columns = true_columns(read_recording(log, vehicle, progress).columns, vehicle.parameters)
    rows: list[tuple[float, float, float]] = []  # distance, grade, yaw rate over speed
    headings: list[tuple[float, float]] = []
    rough: list[tuple[float, float, float]] = []  # time, distance, vibration
    reads_vibration = "vibration" in vehicle.model.reads

    def observe(estimate: Estimate) -> None:
        motion, speed = pipeline.estimator.motion, estimate.speed or 0.0
        turning = (motion.yaw_rate or 0.0) / speed if speed > _MOVING else 0.0
        rows.append((motion.distance, motion.grade or 0.0, turning))
        if motion.heading is not None and speed > _MOVING:
            headings.append((motion.distance, motion.heading))
        if reads_vibration:
            rough.append((estimate.time, motion.distance, pipeline.estimator.load.vibration(estimate.time)))

    mapping, frames = open_ride(log, vehicle)
    pipeline = Pipeline(replace(vehicle, mapping=mapping), observer=observe)
    pipeline.codec.longest_pause_ns = LONGEST_PAUSE_NS
    feed(pipeline, frames)
    felt = np.array(rough) if rough and "accel_z" in columns else None
    if felt is not None:
        columns["vibration"] = felt[:, 0], felt[:, 2]
    signals = _signals(log, columns, vehicle)
    way, grade, curvature = (np.array(column) for column in zip(*rows, strict=True))
    vibration = None if felt is None else _over_road(felt[:, 1], felt[:, 2])
    heading = None
    if len(headings) >= LEAST_HEADINGS:
        course = np.array(headings)
        heading = _over_road(course[:, 0], course[:, 1], period=2 * pi)
    stood = way[0] == way[-1]
    slope, bend = (np.zeros(1) if stood else _over_road(way, values) for values in (grade, curvature))
    recorded = Recorded(ride_name(log), STEP, signals, slope, bend, heading, vibration)
    if "pack_voltage" in signals and "pack_current" in signals:
        signals["soc"] = _counted_soc(recorded, vehicle)
    return recorded


def _signals(log: Path, columns: dict[str, tuple[Array, Array]], vehicle: Vehicle) -> dict[str, Array]:
    """All on one grid of steps: speeds interpolated, signals that come in steps held."""
    pace, factor = speed_role(str(log), columns, vehicle.parameters)
    time = columns[pace][0]
    grid = np.arange(time[0], time[-1], STEP)
    signals = {role: np.interp(grid, t, v) for role, (t, v) in columns.items()}
    if "brake_switch" in columns:
        signals["brake_switch"] = held_at(grid, *columns["brake_switch"])
    signals["speed"] = np.maximum(signals[pace] * factor, 0.0)
    signals["distance"] = np.concatenate(([0.0], np.cumsum(signals["speed"][1:] * STEP)))
    limit = vehicle.parameters["brake_torque_limit"] / vehicle.parameters["wheel_radius"]
    pressed = signals.get("brake_switch")
    if "brake_pressure_front" in signals and "brake_pressure_rear" in signals:
        pressure = signals["brake_pressure_front"] + signals["brake_pressure_rear"]
        pressure = np.where(pressure > BRAKE_PRESSED, pressure, 0.0)
        if pressed is not None:
            pressure = np.where(pressed > 0.5, np.maximum(pressure, 1.0), 0.0)
        signals["brake"] = np.clip(pressure * vehicle.parameters["brake_force_per_pressure"] / limit, 0.0, 1.0)
    elif pressed is not None:
        signals["brake"] = np.where(pressed > 0.5, BRAKE_MEAN, 0.0)
    return signals


def _over_road(distance: Array, values: Array, period: float | None = None) -> Array:
    """`values` (n,) at `distance` (n,) [m], each `ROAD_PIECE` of the way; where the scooter stood, as it came there.

    period: of an angle, which then continues over a whole turn.
    """
    distance, keep = np.unique(distance, return_index=True)
    found = values[keep] if period is None else np.unwrap(values[keep], period=period)
    return np.interp(np.arange(ROAD_PIECE / 2, distance[-1] + ROAD_PIECE, ROAD_PIECE), distance, found)


def _at(table: Array, distance: float) -> float:
    """What `table`, each `ROAD_PIECE`, has at `distance` [m]; beyond its ends the edge."""
    return float(table[min(max(int(distance / ROAD_PIECE), 0), len(table) - 1)])


def scooter_at_start(
    recorded: Recorded | None,
    vehicle: Vehicle,
    road: RoadProfile | Dynamometer,
    ambient: float | None = None,
    **options: Any,
) -> Scooter:
    """The scooter as it was when a recorded ride began; parts without a measurement are at `ambient`.

    ambient: air [degC]; None: as measured, or 20 degC. options: of `Scooter`.
    """
    measured = recorded.first if recorded else lambda _, default: default
    air = measured("ambient_temperature", MILD) if ambient is None else ambient
    cell, speed = measured("cell_temperature", air), measured("speed", 0.0)
    scooter = Scooter(vehicle, road, ambient=air, cell_temperature=cell, speed=speed, **options)
    scooter.motor_cooling.stator = scooter.motor_cooling.rotor = measured("motor_temperature", air)
    scooter.inverter_cooling.board = scooter.inverter_cooling.box = measured("inverter_temperature", air)
    return scooter


def rest_soc(recorded: Recorded, vehicle: Vehicle) -> float | None:
    """SOC in the first second, from voltage and current, see `first_soc`; None if not measured."""
    battery = vehicle.battery
    if battery is None or "pack_voltage" not in recorded.signals:
        return None
    voltage, current = recorded.first("pack_voltage", 0.0), recorded.first("pack_current", 0.0)
    load = standing_load(current, voltage, vehicle.parameters["auxiliary_power"])
    cells, celsius = vehicle.model.at(Port.CELL_VOLTAGE), recorded.first("cell_temperature", MILD)
    return min(max(first_soc(cells, battery, (voltage, current), celsius, load), 0.0), 1.0)


def _counted_soc(recorded: Recorded, vehicle: Vehicle) -> Array:
    """SOC by counting the measured charge from that at the start."""
    signals, start = recorded.signals, rest_soc(recorded, vehicle)
    assert start is not None
    temperature = float(signals["cell_temperature"][0]) if "cell_temperature" in signals else MILD
    soc: Array = start - discharged(np.cumsum(signals["pack_current"]), STEP, vehicle.pack.pack_capacity(temperature))
    return soc


def fit_dynamometer(recorded: Recorded) -> Dynamometer:
    """The roller of a recorded dynamometer run: F = M·dV/dt + A + B·V + C·V², by least squares over spans of 2 s.

    Raises InputError if there was no roller, or it did not move.
    """
    if not recorded.on_dynamometer:
        raise InputError(f"{recorded.name}: no roller of a dynamometer was recorded")
    n = round(SPAN / recorded.dt)
    speed, force = recorded.signals["roller_speed"], recorded.signals["roller_force"]
    mean_v, mean_f, square = (block_means(x, n) for x in (speed, force, speed**2))
    spans = len(mean_v)
    smooth = running_mean(speed, 2 * round(SMOOTHED / recorded.dt / 2) + 1)
    acceleration = np.diff(smooth[np.minimum(np.arange(spans + 1) * n, len(smooth) - 1)]) / (n * recorded.dt)
    moving = mean_v > ROLLING
    if moving.sum() < LEAST_SPANS:
        raise InputError(f"{recorded.name}: its roller hardly moves; give --dyno KG,A,B,C")
    matrix: Any = np.stack([acceleration, np.ones(spans), mean_v, square], axis=1)[moving]
    return Dynamometer(*np.linalg.lstsq(matrix, mean_f[moving], rcond=None)[0].tolist())
