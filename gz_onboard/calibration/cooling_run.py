"""Runs that warm up and cool down, as the cooling networks take them: temperatures, and the heat that drives them.

On a bench the heat is measured; of a ride it is what the vehicle's own losses give.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gz_onboard.arrays import Array, held_integral
from gz_onboard.calibration.manifest import AIRFLOWS
from gz_onboard.calibration.table import Measurements
from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.errors import InputError
from gz_onboard.model.cooling import PERIOD
from gz_onboard.model.effect import Port
from gz_onboard.model.model import STOOD, stepping
from gz_onboard.model.series import advanced, all_quantities, first_soc, idle_loss, total
from gz_onboard.recording.recording import Recording
from gz_onboard.recording.sensors import road_speed, true_columns
from gz_onboard.vehicle import Vehicle

FIRST = 1.0  # s: whose mean voltage and current tell the state of charge at the start, before the load has grown
SHORTEST = 300.0  # s: less says nothing of time constants of minutes


@dataclass(frozen=True)
class CoolingRun:
    """One run at `PERIOD` spacing, every array of shape (n,); powers in W, temperatures in degC.

    bench: a table with measured heat. air: past the vehicle. iron: the part of the motor's
    heat that comes without current. pack_heat: without the reversible part, for which series_current is the pack's
    current times its cells in series. measured: the temperatures there are, by ``motor_temperature``,
    ``inverter_temperature``, ``inverter_box_temperature``, ``cell_temperature``, ``bms_temperature``.
    """

    name: str
    bench: bool
    time: Array
    ambient: Array
    air: Array  # m/s
    motor_heat: Array
    iron: Array
    inverter_heat: Array
    pack_heat: Array
    pack_square: Array  # A²: mean square of the pack's current
    series_current: Array  # A
    soc: Array
    measured: dict[str, Array]


def _air(airflow: float | str, motor_speed: Array, vehicle: Vehicle) -> Array:
    """The speed of the air [m/s] past a vehicle whose motor turns by `motor_speed` (n,) [rad/s], shape (n,).

    airflow: of the whole run [m/s], or one of `AIRFLOWS`.
    """
    if isinstance(airflow, str):
        return np.asarray(AIRFLOWS[airflow] * road_speed(np.abs(motor_speed), vehicle.parameters))
    return np.full_like(motor_speed, airflow)


def bench_run(table: Measurements, vehicle: Vehicle, airflow: float | str = "none") -> CoolingRun:
    """A run of motor and inverter with their losses measured, in a closed room if `airflow` does not say otherwise.

    InputError naming what is missing.
    """
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
    iron = nothing + idle_loss(vehicle.model, {"motor_speed": turning, "motor_temperature": BENCH_TEMPERATURE})
    return CoolingRun(
        table.file.name,
        True,
        grid,
        np.interp(grid, time, table["ambient_temperature"]),
        _air(airflow, turning, vehicle),
        motor_heat,
        iron,
        inverter_heat,
        nothing,
        nothing,
        nothing,
        nothing,
        measured,
    )


def ride_run(ride: Recording, vehicle: Vehicle, airflow: float | str = "wheel") -> CoolingRun:
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
    pack_heat = soc = np.zeros_like(grid)
    if vehicle.battery and "cell_temperature" in measured and "pack_voltage" in columns:
        begin = [float(v[t < t[0] + FIRST].mean()) for t, v in (columns["pack_voltage"], columns["pack_current"])]
        pack_heat, soc = _pack_heat(vehicle, mean, square, measured["cell_temperature"], (begin[0], begin[1]))
    return CoolingRun(
        ride.name,
        False,
        grid,
        at("ambient_temperature"),
        _air(airflow, _means(*columns["motor_speed"], grid), vehicle),
        _means(time, motor_heat, grid),
        _means(time, np.zeros_like(time) + idle_loss(vehicle.model, quantities), grid),
        _means(time, inverter_heat, grid),
        pack_heat,
        square,
        (vehicle.battery.cells_series if vehicle.battery else 0) * mean,
        soc,
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


def dissipation(r0: Any, r1: Any, current_squared: Any, v1: Any) -> Any:
    """Heat [W] of a cell's resistors alone; current_squared: mean square of its current [A²].

    It is `battery.heat` without the energy that the RC pair's capacitor takes in and gives back; over a ride both have
    the same sum. The mean square includes bursts faster than the steps.
    """
    return r0 * current_squared + v1 * v1 / r1


def _pack_heat(
    vehicle: Vehicle, mean: Array, square: Array, temperature: Array, first: tuple[float, float]
) -> tuple[Array, Array]:
    """(what the pack turns to heat [W], its SOC) by mean and mean square of its current, all (n,).

    first: mean voltage and current of the pack in its first moments. These runs begin under way, so the whole current
    is taken to have flowed for a while, not only what lamps and control draw.
    """
    battery = vehicle.pack
    cells = vehicle.model.at(Port.CELL_VOLTAGE)
    n, m = battery.cells_series, battery.cells_parallel
    volts, amperes, celsius = *first, float(temperature[0])
    soc = first_soc(cells, battery, (volts, amperes), celsius, amperes)
    states: dict[str, float] = {}
    q = all_quantities(cell_current=amperes / m, soc=soc, cell_temperature=celsius)
    q["cell_capacity"] = battery.cell_capacity(celsius)
    total(cells, q, stepping(states, STOOD))  # as the first state of charge has it
    heat, socs, v1 = battery.series_resistance * square, np.empty_like(mean), 0.0
    for k, (i, i2, t) in enumerate(
        zip((mean / m).tolist(), (square / m**2).tolist(), temperature.tolist(), strict=True)
    ):
        r0, r1, _ = battery.circuit(soc, t)
        soc, v1 = advanced(battery, PERIOD, soc, v1, i, t)
        socs[k] = soc
        heat[k] += n * m * dissipation(r0, r1, i2, v1)
        q |= {"cell_current": i, "soc": soc, "cell_temperature": t, "cell_capacity": battery.cell_capacity(t)}
        heat[k] += n * m * i * total(cells, q, stepping(states, PERIOD))
    return heat, socs
