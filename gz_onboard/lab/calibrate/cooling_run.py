"""Runs that warm up and cool down, as the cooling networks take them: temperatures, and the heat that drives them.

On a bench the heat is measured; of a ride it is what the vehicle's own losses give.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gz_onboard.arrays import Array, held_integral
from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.errors import InputError
from gz_onboard.lab.calibrate.table import Measurements
from gz_onboard.offline.samples import Samples
from gz_onboard.physics.battery import dissipation
from gz_onboard.physics.cooling import PERIOD
from gz_onboard.physics.effect import Port
from gz_onboard.physics.model import total, when_met
from gz_onboard.physics.sensors import road_speed, true_columns
from gz_onboard.vehicle import Vehicle

FIRST = 5  # periods whose mean voltage and current tell the state of charge at the start
SHORTEST = 300.0  # s: less says nothing of time constants of minutes


@dataclass(frozen=True)
class CoolingRun:
    """One run at `PERIOD` spacing, every array of shape (n,); powers in W, temperatures in degC.

    still: on a bench or a roller, without the airflow of riding. iron: the part of the motor's heat that grows with
    speed. measured: the temperatures there are, by ``motor_temperature``, ``inverter_temperature``,
    ``inverter_box_temperature``, ``cell_temperature``, ``bms_temperature``.
    """

    name: str
    still: bool
    time: Array
    ambient: Array
    speed: Array  # m/s, of the wheel
    motor_heat: Array
    iron: Array
    inverter_heat: Array
    pack_heat: Array
    pack_square: Array  # A²: mean square of the pack's current
    measured: dict[str, Array]


def bench_run(table: Measurements, vehicle: Vehicle) -> CoolingRun:
    """A run of motor and inverter in a closed room with their losses measured. InputError naming what is missing."""
    time = table["time"]
    grid = _grid(time, table.file.name)

    def column(name: str) -> Array:
        return _means(time, table[name], grid)

    speed, current = column("motor_speed"), column("motor_current")
    motor_heat = column("ac_power") - _means(time, table["shaft_torque"] * table["motor_speed"], grid)
    inverter_heat = column("dc_power") - column("ac_power")
    if motor_heat.sum() <= 0 or inverter_heat.sum() <= 0:
        raise table.error(
            "ac_power less shaft_torque times motor_speed, or dc_power less ac_power, is no heat but cold"
        )
    measured = {name: np.interp(grid, time, table[name]) for name in SENSORS if name in table}
    turning = speed * (np.abs(current) > 1.0)  # the bench's own drive stops with the current
    nothing = np.zeros_like(grid)
    iron = nothing + vehicle.model.idle_loss({"motor_speed": turning, "motor_temperature": BENCH_TEMPERATURE})
    return CoolingRun(
        table.file.name,
        True,
        grid,
        np.interp(grid, time, table["ambient_temperature"]),
        road_speed(speed, vehicle.parameters),
        motor_heat,
        iron,
        inverter_heat,
        nothing,
        nothing,
        measured,
    )


def ride_run(ride: Samples, vehicle: Vehicle) -> CoolingRun:
    """A ride or dynamometer run with the heat that the vehicle's own losses give. InputError for signals it lacks."""
    for role in ("motor_speed", "motor_current", "motor_temperature", "ambient_temperature", "pack_current"):
        if role not in ride.columns:
            raise InputError(f"{ride.name}: no {role}, without which no heat is known")
    columns = true_columns(ride.columns, vehicle.parameters)
    start = max(t[0] for t, _ in columns.values())
    end = min(t[-1] for t, _ in columns.values())
    grid = _grid(np.array([start, end]), ride.name)

    def at(role: str) -> Array:
        return np.interp(grid, *columns[role])

    time, current = columns["motor_current"]
    speed = np.interp(time, *columns["motor_speed"])
    quantities = {
        "motor_current": current,
        "motor_speed": speed,
        "motor_temperature": np.interp(time, *columns["motor_temperature"]),
    }
    motor_heat, inverter_heat = (
        np.zeros_like(time) + total(vehicle.model.at(port), quantities)
        for port in (Port.MOTOR_LOSS, Port.INVERTER_LOSS)
    )
    pack_time, amperes = columns["pack_current"]
    measured = {name: at(name) for name in SENSORS if name in columns}
    inside = [at(role) for role in columns if role.startswith("pack_temperature_")]
    if inside:  # the mean of thermocouples is finer than the BMS's whole degrees
        measured["cell_temperature"] = np.mean(inside, axis=0)
    mean, square = _means(pack_time, amperes, grid), _means(pack_time, amperes**2, grid)
    pack_heat = np.zeros_like(grid)
    if vehicle.battery and "cell_temperature" in measured and "pack_voltage" in columns:
        pack_heat = _pack_heat(vehicle, mean, square, measured["cell_temperature"], at("pack_voltage"))
    return CoolingRun(
        ride.name,
        "roller_speed" in columns,
        grid,
        at("ambient_temperature"),
        road_speed(np.abs(_means(*columns["motor_speed"], grid)), vehicle.parameters),
        _means(time, motor_heat, grid),
        _means(time, np.zeros_like(time) + vehicle.model.idle_loss(quantities), grid),
        _means(time, inverter_heat, grid),
        pack_heat,
        square,
        measured,
    )


SENSORS = tuple(f"{part}_temperature" for part in ("motor", "inverter", "inverter_box", "cell", "bms"))


def _grid(time: Array, name: str) -> Array:
    if time[-1] - time[0] < SHORTEST:
        raise InputError(
            f"{name}: {time[-1] - time[0]:.0f} s are too short for a cooling network; {SHORTEST:.0f} s are needed"
        )
    return np.arange(np.ceil(time[0]), np.floor(time[-1]), PERIOD)


def _means(time: Array, value: Array, grid: Array) -> Array:
    """The mean of `value`, held from each of its times to the next, over each period of `grid`."""
    edges = np.append(grid, grid[-1] + PERIOD)
    result: Array = np.diff(np.interp(edges, time, held_integral(time, value))) / PERIOD
    if edges[-1] > time[-1]:
        result[-1] = value[-1]
    return result


def _pack_heat(vehicle: Vehicle, mean: Array, square: Array, temperature: Array, voltage: Array) -> Array:
    """What the cells turn to heat [W] by mean and mean square of the pack's current; voltage: the pack's, all (n,)."""
    battery = vehicle.pack
    lost = vehicle.model.overpotential(battery)
    n, m = battery.cells_series, battery.cells_parallel
    first = [float(column[:FIRST].mean()) for column in (voltage, mean, temperature)]
    inside = vehicle.model.at(Port.CELL_VOLTAGE)
    begun = when_met(inside, battery, first[1], first[2], FIRST * PERIOD / 2)  # the load, from rest
    soc = battery.first_soc(first[0], first[1], first[2], begun)
    heat, v1 = np.empty_like(mean), 0.0
    for k, (i, i2, t) in enumerate(
        zip((mean / m).tolist(), (square / m**2).tolist(), temperature.tolist(), strict=True)
    ):
        r0, r1, _ = battery.circuit(soc, t)
        soc, v1, _ = battery.advanced(PERIOD, soc, v1, i, t)
        heat[k] = n * m * dissipation(r0, r1, i2, v1)
        if lost and i:
            heat[k] += n * m * i * lost(i, soc, t, i2 / i**2)
    return heat
