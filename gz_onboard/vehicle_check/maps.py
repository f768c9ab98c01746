"""Efficiency of motor, inverter and both over speed and torque, by the loss models of a vehicle file, and as measured.

As figures 2.14 and 2.15 of Lord 2016, but made of losses in watts: an efficiency has no value at no torque. Torque is
the shaft's, speed the motor's. Driving, efficiency is mechanical over electric power, regenerating the reverse. Of a
dynamometer with a power analyser all three are measured; of a ride only both together, as its torque is that of the
current by the vehicle file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.calibration.motor import read_bench
from gz_onboard.calibration.table import read_table
from gz_onboard.errors import InputError
from gz_onboard.lab.validate_components import losses
from gz_onboard.model.model import drag_torque
from gz_onboard.offline.arrays import block_means
from gz_onboard.offline.samples import read_samples
from gz_onboard.offline.sensors import road_speed, true_columns
from gz_onboard.offline.series import curve_over
from gz_onboard.recording.logs import log_suffix
from gz_onboard.vehicle import Vehicle

MOTOR, INVERTER, BOTH = "motor", "inverter", "motor and inverter"
WARM = 40.0  # degC: of the motor, as on a dynamometer and in the middle of a ride
GRID = 181  # points each way
LEAST_POWER = 0.02  # of the greatest: below, measured efficiencies are noise over nothing
STEP, BLOCK = 0.1, 1.0  # s: of a ride, and over which it is a mean
STEADY_CURRENT, STEADY_SPEED = 0.05, 0.02  # of the limit and of the greatest speed: sd within a block
CELLS = 24  # each way, into which the blocks of rides are gathered
LEAST_BLOCKS = 3  # of such a cell
_TABLES = (".csv", ".parquet", ".pq")


@dataclass(frozen=True)
class Efficiency:
    """Shares of power that arrive, arrays of one shape; not a number where nothing arrives, or nothing is known."""

    motor: Array
    inverter: Array
    both: Array

    def of(self, part: str) -> Array:
        """Of `MOTOR`, `INVERTER` or `BOTH`."""
        return {MOTOR: self.motor, INVERTER: self.inverter, BOTH: self.both}[part]


@dataclass(frozen=True)
class Points:
    """Measured points of `source`, arrays of shape (n,): speed [rad/s], shaft torque [N·m]."""

    source: str
    on_bench: bool
    speed: Array
    torque: Array
    temperature: Array  # degC, of the motor
    efficiency: Efficiency


@dataclass(frozen=True)
class Maps:
    """Over the grid of speed (m,) [rad/s] and shaft torque (n,) [N·m]: efficiencies of shape (n, m), within the limits.

    most, least: shaft torque [N·m] that the controller gives at each speed, shape (m,).
    """

    vehicle: str
    temperature: float  # degC, of the motor
    speed: Array
    torque: Array
    efficiency: Efficiency
    most: Array
    least: Array
    measured: Sequence[Points]


def shares(mechanical: Array, alternating: Array, direct: Array) -> Efficiency:
    """Of powers [W] at shaft, between inverter and motor, and at the inverter's input; positive driving."""

    def share(out: Array, inside: Array) -> Array:
        """out: nearer to the wheel."""
        driving, recovering = (out > 0) & (inside > 0), (out < 0) & (inside < 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(driving, out / inside, np.where(recovering, inside / out, np.nan))

    return Efficiency(share(mechanical, alternating), share(alternating, direct), share(mechanical, direct))


def modelled(vehicle: Vehicle, speed: Array, torque: Array, temperature: Array) -> Efficiency:
    """At shaft torques [N·m], speeds [rad/s] and motor temperatures [degC], all of one shape."""
    _, idle, _ = losses(vehicle, 0 * speed, speed, temperature)
    current = (torque + drag_torque(idle, speed)) / vehicle.parameters["torque_constant"]
    copper, idle, inverter = losses(vehicle, current, speed, temperature)
    alternating = torque * speed + copper + idle
    return shares(torque * speed, alternating, alternating + inverter)


def efficiency_maps(
    vehicle: Vehicle, data: Sequence[Path], temperature: float = WARM, top_speed: float | None = None
) -> Maps:
    """The maps of `vehicle`, its motor at `temperature` [degC], with what was measured in `data`.

    data: tables of a dynamometer, or logs of rides. top_speed: of the vehicle [m/s]; None: that of the controller, or
    what was measured. Raises InputError, also where nothing says how fast the motor turns.
    """
    measured = [_measured(vehicle, file) for file in data]
    fastest = top_speed / road_speed(1.0, vehicle.parameters) if top_speed else _fastest(vehicle, measured)
    speed = np.linspace(0.0, fastest, GRID)[1:]
    p, derating = vehicle.parameters, vehicle.derating
    _, idle, _ = losses(vehicle, 0 * speed, speed, np.full(len(speed), temperature))
    drag = drag_torque(idle, speed)
    limits = p["torque_constant"] * p["motor_current_limit"], p["regeneration_torque_limit"]
    curves = derating.current_by_motor_speed, derating.regeneration_by_motor_speed
    driving, braking = (limit * curve_over(curve, speed) for limit, curve in zip(limits, curves, strict=True))
    most, least = driving - drag, -braking - drag
    torque = np.linspace(min(float(least.min()), 0.0), float(most.max()), GRID)
    x, y = np.meshgrid(speed, torque)
    inside = (y <= most) & (y >= least) & (least < 0)
    found = modelled(vehicle, x, y, np.full(x.shape, temperature))
    shown = Efficiency(*(np.where(inside, part, np.nan) for part in (found.motor, found.inverter, found.both)))
    return Maps(vehicle.name, temperature, speed, torque, shown, most, least, measured)


def _fastest(vehicle: Vehicle, measured: Sequence[Points]) -> float:
    """Up to which speed of the motor [rad/s] the map goes: the controller's limit, else what was measured."""
    curve = vehicle.derating.current_by_motor_speed
    if curve.y[-1] <= 0:
        return curve.x[-1]
    if measured:
        return max(float(points.speed.max()) for points in measured)
    raise vehicle.error(
        "says nothing of how fast the motor turns: current_by_motor_speed in [controller] has no end; "
        "give --top-speed, or a ride"
    )


def fit_of(vehicle: Vehicle, maps: Maps) -> list[tuple[str, str, int, float, float | None]]:
    """Of each part and source: points, RMS of measured less modelled efficiency, its R² on a bench."""
    rows = []
    for points in maps.measured:
        model = modelled(vehicle, points.speed, points.torque, points.temperature)
        for part in (MOTOR, INVERTER, BOTH):
            share, said = points.efficiency.of(part), model.of(part)
            use = np.isfinite(share) & np.isfinite(said)
            if use.sum() > 1:
                square = float(np.mean((share - said)[use] ** 2))
                r2 = 1 - square / float(share[use].var()) if points.on_bench else None  # rides are at few places
                rows.append((part, points.source, int(use.sum()), square**0.5, r2))
    return rows


def _measured(vehicle: Vehicle, file: Path) -> Points:
    if log_suffix(file) in _TABLES:
        table = read_table(file)
        if "shaft_torque" in table:
            bench = read_bench(table)
            mechanical = bench.torque * bench.speed
            found = shares(mechanical, table["ac_power"], table["dc_power"])
            use = _enough(mechanical) & _enough(table["ac_power"]) & _enough(table["dc_power"])
            return Points(file.name, True, bench.speed[use], bench.torque[use], bench.temperature[use], _at(found, use))
    return _ridden(vehicle, file)


def _enough(mechanical: Array) -> Mask:
    """Where power is so much that its losses could be measured."""
    size = np.abs(mechanical)
    return np.asarray(size > LEAST_POWER * size.max())


def _at(found: Efficiency, use: Mask) -> Efficiency:
    return Efficiency(found.motor[use], found.inverter[use], found.both[use])


def _ridden(vehicle: Vehicle, log: Path) -> Points:
    """Steady riding, as ratios of energies in cells of speed and torque."""
    columns = true_columns(read_samples(log, vehicle).columns, vehicle.parameters)
    roles = ("motor_current", "motor_speed", "inverter_voltage", "inverter_current")
    if missing := [role for role in roles if role not in columns]:
        raise InputError(f"{log}: has no {missing[0]}; for a map there must be {', '.join(roles)}")
    begin, end = (f(columns[role][0][i] for role in roles) for f, i in ((max, 0), (min, -1)))
    grid = np.arange(begin, end, STEP)
    current, speed, volts, amperes = (np.interp(grid, *columns[role]) for role in roles)
    celsius = np.interp(grid, *columns["motor_temperature"]) if "motor_temperature" in columns else 0 * grid + WARM
    _, idle, _ = losses(vehicle, current, speed, celsius)
    torque = vehicle.parameters["torque_constant"] * current - drag_torque(idle, speed)
    n = round(BLOCK / STEP)
    blocks = {name: block_means(x, n) for name, x in (("speed", speed), ("torque", torque), ("celsius", celsius))}
    blocks |= {"mechanical": block_means(torque * speed, n), "direct": block_means(volts * amperes, n)}
    spread = [np.sqrt(np.maximum(block_means(x**2, n) - block_means(x, n) ** 2, 0)) for x in (current, speed)]
    limit = vehicle.parameters["motor_current_limit"]
    steady = (spread[0] < STEADY_CURRENT * limit) & (spread[1] < STEADY_SPEED * float(speed.max()))
    use = steady & _enough(blocks["mechanical"]) & (blocks["speed"] > 0)
    return _gathered(log.name, {name: x[use] for name, x in blocks.items()})


def _gathered(name: str, blocks: dict[str, Array]) -> Points:
    """The blocks of a ride in cells of a grid, each a point where there are enough."""
    cells = np.stack([_cell(blocks["speed"]), _cell(blocks["torque"])])
    _, cell, count = np.unique(cells, axis=1, return_inverse=True, return_counts=True)
    if not (count >= LEAST_BLOCKS).any():
        raise InputError(
            f"{name}: has too little steady riding: {LEAST_BLOCKS} times {BLOCK:g} s at one speed and current"
        )
    means = {k: np.bincount(cell.ravel(), x) / count for k, x in blocks.items()}
    means = {k: x[count >= LEAST_BLOCKS] for k, x in means.items()}
    none = np.full(len(means["speed"]), np.nan)
    both = shares(means["mechanical"], means["direct"], means["direct"]).both
    return Points(name, False, means["speed"], means["torque"], means["celsius"], Efficiency(none, none.copy(), both))


def _cell(values: Array) -> Array:
    if not len(values):
        return values
    low, high = float(values.min()), float(values.max())
    return np.floor((values - low) / max((high - low) / CELLS, 1e-9))
