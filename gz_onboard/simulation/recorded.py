"""Recorded rides as inputs of a simulation: throttle and brake, speed, and what to compare the simulation with.

Frames go through the codec of the bus, which drops the same ones as on board. The road is that of the estimator's road
filter (accelerometer, altitude, yaw rate), or that of a route file. Its roughness is the estimator's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import nan, pi
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
from gz_onboard.simulation.scooter import STEP, AlongRoad, Scooter
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class RecordedConfig:
    """Settings of reading a recorded ride."""

    road_piece_m: float = 5.0  # length of a piece of the road's tables
    brake_pressed_pa: float = 0.5e5  # less is noise of the pressure sensors
    brake_mean: float = 0.07835  # of full brake (90 N): mean of the repository's rides while the switch is on
    turning_m_s: float = 2.0  # slower, yaw rate over speed is not a curvature, nor the heading known
    least_headings: int = 10  # of a ride whose heading counts as known
    roller_span_s: float = 2.0  # over which a roller's force and speed are averaged
    roller_m_s: float = 1.0  # mean of a span in which the roller moves
    roller_spans: int = 10  # at least, to fit four parameters
    roller_smoothing_s: float = 0.2  # of the speed at the ends of a span


CONFIG = RecordedConfig()


@dataclass(frozen=True)
class Recorded:
    """A recorded ride, at even steps.

    signals: by role, in its SI unit, arrays of one length; only recorded ones, corrected for known errors of the
    vehicle's sensors (`model.sensors`). ``speed`` [m/s] (of the driven wheel), ``distance`` [m], ``brake`` (0..1,
    of `brake_torque_limit`) and ``soc`` (counted charge) are worked out; ``vibration`` [m/s²] too, if the vehicle's
    model reads it and the ride tells it.
    """

    name: str
    dt: float  # s
    signals: dict[str, Array]
    grade: Array  # sine, each `road_piece_m` of distance
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

    def road(self, headwind: float = 0.0) -> RoadProfile:
        """The road that was ridden."""
        starts = [CONFIG.road_piece_m * i for i in range(len(self.grade))]
        return road_table(starts, self.grade.tolist(), self.curvature.tolist(), headwind)


def read_recorded(log: Path, vehicle: Vehicle) -> Recorded:
    """The ride in `log`, of `vehicle`. InputError for a log that cannot be read, or that has no speed."""
    if vehicle.battery is None:
        raise vehicle.error("has no [battery], which a simulation needs")
    columns = true_columns(read_recording(log, vehicle).columns, vehicle.parameters)
    rows: list[tuple[float, ...]] = []
    reads_vibration = "vibration" in vehicle.model.reads and "accel_z" in columns

    def observe(estimate: Estimate) -> None:
        motion, speed = pipeline.estimator.motion, estimate.speed or 0.0
        turning = speed > CONFIG.turning_m_s
        curvature = (motion.yaw_rate or 0.0) / speed if turning else 0.0
        heading = motion.heading if turning and motion.heading is not None else nan
        rough = pipeline.estimator.load.vibration(estimate.time) if reads_vibration else nan
        rows.append((estimate.time, motion.distance, motion.grade or 0.0, curvature, heading, rough))

    mapping, frames = open_ride(log, vehicle)
    pipeline = Pipeline(replace(vehicle, mapping=mapping), observer=observe)
    pipeline.codec.longest_pause_ns = LONGEST_PAUSE_NS
    feed(pipeline, frames)
    time, way, grade, curvature, heading, rough = np.array(rows).T
    if reads_vibration:
        columns["vibration"] = time, rough
    signals = _signals(log, columns, vehicle)
    known, stood = np.isfinite(heading), way[0] == way[-1]
    recorded = Recorded(
        name=ride_name(log),
        dt=STEP,
        signals=signals,
        grade=np.zeros(1) if stood else _over_road(way, grade),
        curvature=np.zeros(1) if stood else _over_road(way, curvature),
        heading=_over_road(way[known], heading[known], 2 * pi) if known.sum() >= CONFIG.least_headings else None,
        vibration=_over_road(way, rough) if reads_vibration else None,
    )
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
        pressure = np.where(pressure > CONFIG.brake_pressed_pa, pressure, 0.0)
        if pressed is not None:
            pressure = np.where(pressed > 0.5, np.maximum(pressure, 1.0), 0.0)
        signals["brake"] = np.clip(pressure * vehicle.parameters["brake_force_per_pressure"] / limit, 0.0, 1.0)
    elif pressed is not None:
        signals["brake"] = np.where(pressed > 0.5, CONFIG.brake_mean, 0.0)
    return signals


def _over_road(distance: Array, values: Array, period: float | None = None) -> Array:
    """`values` (n,) at `distance` (n,) [m], each `road_piece_m` of the way; where the scooter stood, as it came there.

    period: of an angle, which then continues over a whole turn.
    """
    distance, keep = np.unique(distance, return_index=True)
    found = values[keep] if period is None else np.unwrap(values[keep], period=period)
    return np.interp(
        np.arange(CONFIG.road_piece_m / 2, distance[-1] + CONFIG.road_piece_m, CONFIG.road_piece_m), distance, found
    )


def along_road(table: Array) -> AlongRoad:
    """The values of `table`, each `road_piece_m`, at a distance [m]; beyond its ends the edge."""
    return lambda distance: float(table[min(max(int(distance / CONFIG.road_piece_m), 0), len(table) - 1)])


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
    scooter.motor_cooling.temperature = scooter.motor_cooling.rotor = measured("motor_temperature", air)
    scooter.inverter_cooling.temperature = scooter.inverter_cooling.box = measured("inverter_temperature", air)
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
    n = round(CONFIG.roller_span_s / recorded.dt)
    speed, force = recorded.signals["roller_speed"], recorded.signals["roller_force"]
    mean_v, mean_f, square = (block_means(x, n) for x in (speed, force, speed**2))
    spans = len(mean_v)
    smooth = running_mean(speed, 2 * round(CONFIG.roller_smoothing_s / recorded.dt / 2) + 1)
    acceleration = np.diff(smooth[np.minimum(np.arange(spans + 1) * n, len(smooth) - 1)]) / (n * recorded.dt)
    moving = mean_v > CONFIG.roller_m_s
    if moving.sum() < CONFIG.roller_spans:
        raise InputError(f"{recorded.name}: its roller hardly moves; give --dyno KG,A,B,C")
    matrix: Any = np.stack([acceleration, np.ones(spans), mean_v, square], axis=1)[moving]
    return Dynamometer(*np.linalg.lstsq(matrix, mean_f[moving], rcond=None)[0].tolist())
