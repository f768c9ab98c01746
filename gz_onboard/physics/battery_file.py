"""Reads and checks the battery's tables of a vehicle file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.physics.battery import HALF_FULL, Battery, Window
from gz_onboard.physics.functions import Mesh, PiecewiseLinear, Row
from gz_onboard.physics.parameters import MOST_CELLS, Parameters

if TYPE_CHECKING:
    from gz_onboard.toml import Table

KEYS = (
    "cells_series",
    "cells_parallel",
    "ocv",
    "rest_shift",
    "voltage_error",
    "voltage_error_time",
    "entropy",
    "capacity",
    "window",
    "as_new",
    "r0",
    "r1",
    "c1",
)


@dataclass(frozen=True)
class TableLimits:
    """Bounds of the values in battery tables."""

    temperature: tuple[float, float] = (-60.0, 100.0)  # degC, of a cell
    soc: tuple[float, float] = (-0.01, 1.01)
    voltage: tuple[float, float] = (0.5, 5.0)  # V, of a cell
    capacity: tuple[float, float] = (0.01, 1000.0)  # A·h, of a cell
    capacity_share: tuple[float, float] = (0.05, 2.0)  # of the capacity on the bench
    resistance: tuple[float, float] = (1e-6, 10.0)  # ohm, of a cell: from the largest to a frozen one of a watch
    capacitance: tuple[float, float] = (1e-3, 1e8)  # F, of a cell's RC pair
    entropy: tuple[float, float] = (-5e-3, 5e-3)  # V/K: of intercalation cells 1e-3 at most; more is mV/K
    rest_shift: tuple[float, float] = (-0.2, 0.2)  # V: cells rest tens of mV apart; more is a mistyped unit
    voltage_error: tuple[float, float] = (0.0, 0.2)  # V
    narrowest_window: float = 0.1  # of the charge: no vehicle carries ten times the cells that it uses
    as_new: tuple[float, float] = (0.01, 0.99)  # nothing could be learned of what is certain


LIMITS = TableLimits()


def read_battery(vehicle: Table, parameters: Parameters) -> Battery:
    """The battery in the vehicle file; InputError for tables that do not make sense."""
    table = vehicle.table("battery")
    table.only(KEYS)
    ocv = _needed(table, "ocv")
    ocv.only(["soc", "value", "unit", "sd", "source", "status"])
    ocv.text("unit", choices=["V"])
    soc, volts = _axis(ocv, "soc", LIMITS.soc), _axis(ocv, "value", LIMITS.voltage)
    if soc[0] > 0.1 or soc[-1] < 0.9:
        raise ocv.error(f"must reach from 0.1 or less to 0.9 or more, is {soc[0]:g} to {soc[-1]:g}", "soc")
    if len(soc) != len(volts):
        raise ocv.error(f"has {len(volts)} numbers for {len(soc)} of soc", "value")
    error_time = parameters.declared["cell_voltage_error_time"]
    times = error_time.low, error_time.high
    rest_shift = _curve(table, "rest_shift", "temperature", "V", LIMITS.rest_shift)
    battery = Battery(
        cells_series=table.integer("cells_series", 1, MOST_CELLS),
        cells_parallel=table.integer("cells_parallel", 1, MOST_CELLS),
        capacity=parameters["cell_capacity"],
        capacity_share=_capacity_share(table),
        cutoff_voltage=parameters["cell_cutoff_voltage"],
        series_resistance=parameters["pack_series_resistance"],
        ocv_curve=PiecewiseLinear(soc, volts),
        ocv_sd=ocv.number("sd", 0.005, low=1e-4, high=0.5),
        r0=_mesh(_needed(table, "r0"), "ohm", *LIMITS.resistance),
        r1=_mesh(_needed(table, "r1"), "ohm", *LIMITS.resistance),
        c1=_mesh(_needed(table, "c1"), "F", *LIMITS.capacitance),
        rest_shift_curve=rest_shift,
        rest_shift_sd=table.table("rest_shift").number("sd", 0.005, 0.0, LIMITS.rest_shift[1]) if rest_shift else 0.0,
        window=_window(table),
        entropy=_curve(table, "entropy", "soc", "V/K", LIMITS.entropy),
        voltage_error_curve=_curve(table, "voltage_error", "temperature", "V", LIMITS.voltage_error),
        voltage_error_time_curve=_curve(table, "voltage_error_time", "temperature", "s", times),
        capacity_sd=parameters.sd("cell_capacity") / parameters["cell_capacity"],
        resistance_sd=parameters.sd("cell_resistance_factor") / parameters["cell_resistance_factor"],
        as_new=table.number("as_new", Battery.as_new, *LIMITS.as_new),
    )
    return battery.with_parameters(parameters)


def _needed(battery: Table, name: str) -> Table:
    """A table that every battery must have: otherwise the error would name the first of its keys."""
    if name not in battery.values:
        raise battery.error("is missing", name)
    return battery.table(name)


def _capacity_share(battery: Table) -> PiecewiseLinear:
    """The capacity over temperature [degC], as a share of that on the bench; 1 if the file does not have the table."""
    capacity = _curve(battery, "capacity", "temperature", "A·h", LIMITS.capacity)
    if capacity is None:
        return PiecewiseLinear((BENCH_TEMPERATURE,), (1.0,))
    rated = capacity.at(BENCH_TEMPERATURE)
    shares = tuple(value / rated for value in capacity.y)
    low, high = LIMITS.capacity_share
    if min(shares) < low or max(shares) > high:
        complaint = f"must be within {low:g} to {high:g} times what it is at {BENCH_TEMPERATURE:g} degC"
        raise battery.table("capacity").error(complaint, "value")
    return PiecewiseLinear(capacity.x, shares)


def _curve(battery: Table, name: str, axis: str, unit: str, bounds: tuple[float, float]) -> PiecewiseLinear | None:
    """The table `name` of values in `unit` over its `axis`; None if the file does not have it."""
    if name not in battery.values:
        return None
    table = battery.table(name)
    table.only([axis, "value", "unit", "sd", "sd_relative", "source", "status"])
    table.text("unit", choices=[unit])
    x, y = _axis(table, axis, getattr(LIMITS, axis), least=1), table.numbers("value", *bounds)
    if len(y) != len(x):
        raise table.error(f"must be {len(x)} numbers, one for each {axis}", "value")
    return PiecewiseLinear(x, y)


def _window(battery: Table) -> Window:
    """The share of the cells' charge that the vehicle uses; all of it if the file does not say."""
    if "window" not in battery.values:
        return Window()
    table = battery.table("window")
    table.only(["low", "high", "sd", "source", "status"])
    low, high = table.number("low", low=0.0, high=HALF_FULL), table.number("high", low=HALF_FULL, high=1.0)
    if high - low < LIMITS.narrowest_window:
        raise table.error(f"must be {LIMITS.narrowest_window:g} or more above low, is {high:g} over {low:g}", "high")
    return Window(low, high, table.number("sd", 0.01, low=0.0, high=HALF_FULL), given=True)


def _axis(table: Table, key: str, bounds: tuple[float, float], least: int = 2) -> Row:
    row = table.increasing(key, *bounds)
    if len(row) < least:
        raise table.error(f"must be two numbers or more within {bounds[0]:g} to {bounds[1]:g}", key)
    return row


def _mesh(table: Table, unit: str, low: float, high: float) -> Mesh:
    table.only(["soc", "temperature", "value", "unit", "sd_relative", "source", "status"])
    table.text("unit", choices=[unit])
    soc, temperature = _axis(table, "soc", LIMITS.soc), _axis(table, "temperature", LIMITS.temperature, least=1)
    rows = table.rows("value", len(soc), f"in {unit}, one for each soc", low, high)
    if len(rows) != len(temperature):
        raise table.error(f"must be {len(temperature)} rows, one for each temperature", "value")
    return Mesh(soc, temperature, rows, geometric=True)
