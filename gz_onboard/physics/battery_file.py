"""The battery's tables out of a vehicle file: checked, so that what reads them need not."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.physics.battery import HALF_FULL, Battery, Window
from gz_onboard.physics.functions import Mesh, Row, linear
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
TEMPERATURE = (-60.0, 100.0)  # degC, of a cell
RESISTANCE = (1e-6, 10.0)  # ohm, of a cell: from the largest to a frozen one of a watch
CAPACITANCE = (1e-3, 1e8)  # F, of a cell's RC pair
SMALLEST_STEP = 1e-6  # of SOC, V or degC, from point to point: a slope must stay a number
LARGEST_ENTROPY = 5e-3  # V/K: of intercalation cells 1e-3 at most; more is mV/K
NARROWEST_WINDOW = 0.1  # of the cells' charge: no vehicle carries ten times the cells that it uses
LEAST_AS_NEW = 0.01  # and so much is the least chance that it is not: nothing could be learned
LARGEST_SHIFT = 0.2  # V: real cells rest tens of mV apart from -20 to 25 degC; more is a mistyped unit


def read_battery(vehicle: Table, parameters: Parameters) -> Battery:
    """The battery in the vehicle file; InputError for tables that do not make sense."""
    table = vehicle.table("battery")
    table.only(KEYS)
    ocv = _needed(table, "ocv")
    ocv.only(["soc", "value", "unit", "sd", "source", "status"])
    ocv.text("unit", choices=["V"])
    soc, volts = _axis(ocv, "soc", -0.01, 1.01), _axis(ocv, "value", 0.5, 5.0)
    if soc[0] > 0.1 or soc[-1] < 0.9:
        raise ocv.error(f"must reach from 0.1 or less to 0.9 or more, is {soc[0]:g} to {soc[-1]:g}", "soc")
    if len(soc) != len(volts):
        raise ocv.error(f"has {len(volts)} numbers for {len(soc)} of soc", "value")
    temperatures, capacities = _capacity(table)
    entropy_soc, entropy = _entropy(table)
    shift_temperatures, shifts, shift_sd = _over_temperature(table, "rest_shift", "V", -LARGEST_SHIFT, LARGEST_SHIFT)
    error_temperatures, errors, _ = _over_temperature(table, "voltage_error", "V", 0.0, LARGEST_SHIFT)
    usual = parameters.declared["cell_voltage_error_time"]
    time_temperatures, times, _ = _over_temperature(table, "voltage_error_time", "s", usual.low, usual.high)
    battery = Battery(
        cells_series=table.integer("cells_series", 1, MOST_CELLS),
        cells_parallel=table.integer("cells_parallel", 1, MOST_CELLS),
        capacity=parameters["cell_capacity"],
        capacity_temperature=temperatures,
        capacity_share=capacities,
        cutoff_voltage=parameters["cell_cutoff_voltage"],
        series_resistance=parameters["pack_series_resistance"],
        ocv_soc=soc,
        ocv_value=volts,
        ocv_sd=ocv.number("sd", 0.005, low=1e-4, high=0.5),
        r0=_mesh(_needed(table, "r0"), "ohm", *RESISTANCE),
        r1=_mesh(_needed(table, "r1"), "ohm", *RESISTANCE),
        c1=_mesh(_needed(table, "c1"), "F", *CAPACITANCE),
        rest_shift_temperature=shift_temperatures,
        rest_shift_value=shifts,
        rest_shift_sd=shift_sd,
        window=_window(table),
        entropy_soc=entropy_soc,
        entropy_value=entropy,
        voltage_error_temperature=error_temperatures,
        voltage_error_value=errors,
        voltage_error_time_temperature=time_temperatures,
        voltage_error_time_value=times,
        capacity_sd=parameters.sd("cell_capacity") / parameters["cell_capacity"],
        resistance_sd=parameters.sd("cell_resistance_factor") / parameters["cell_resistance_factor"],
        as_new=table.number("as_new", Battery.as_new, low=LEAST_AS_NEW, high=1 - LEAST_AS_NEW),
    )
    return battery.with_parameters(parameters)


def _needed(battery: Table, name: str) -> Table:
    """A table that every battery must have: without it, the table is what is missing, not the first of its keys."""
    if name not in battery.values:
        raise battery.error("is missing", name)
    return battery.table(name)


def _capacity(battery: Table) -> tuple[Row, Row]:
    """(temperatures [degC], capacity over that at the bench's); one and 1 if the file does not have the table."""
    if "capacity" not in battery.values:
        return (BENCH_TEMPERATURE,), (1.0,)
    table = battery.table("capacity")
    table.only(["temperature", "value", "unit", "sd_relative", "source", "status"])
    table.text("unit", choices=["A·h"])
    temperatures = _axis(table, "temperature", *TEMPERATURE, least=1)
    capacities = table.numbers("value", 0.01, 1000)
    if len(temperatures) != len(capacities):
        raise table.error(f"must be {len(temperatures)} positive numbers, one for each temperature", "value")
    rated = linear(temperatures, capacities, BENCH_TEMPERATURE)
    shares = tuple(value / rated for value in capacities)
    if min(shares) < 0.05 or max(shares) > 2:
        raise table.error(f"must be within 0.05 to 2 times what it is at {BENCH_TEMPERATURE:g} degC", "value")
    return temperatures, shares


def _over_temperature(battery: Table, name: str, unit: str, least: float, most: float) -> tuple[Row, Row, float]:
    """(temperatures [degC], values in `unit`, their sd) of a table; nothing if the file does not have it."""
    if name not in battery.values:
        return (), (), 0.0
    table = battery.table(name)
    table.only(["temperature", "value", "unit", "sd", "sd_relative", "source", "status"])
    table.text("unit", choices=[unit])
    temperatures, values = _axis(table, "temperature", *TEMPERATURE, least=1), table.numbers("value")
    if len(values) != len(temperatures) or min(values) < least or max(values) > most:
        wanted = f"must be {len(temperatures)} numbers within {least:g} to {most:g} {unit}"
        raise table.error(f"{wanted}, one for each temperature", "value")
    return temperatures, values, table.number("sd", 0.005, low=0.0, high=most)


def _window(battery: Table) -> Window:
    """The share of the cells' charge that the vehicle uses; all of it if the file does not say."""
    if "window" not in battery.values:
        return Window()
    table = battery.table("window")
    table.only(["low", "high", "sd", "source", "status"])
    low, high = table.number("low", low=0.0, high=HALF_FULL), table.number("high", low=HALF_FULL, high=1.0)
    if high - low < NARROWEST_WINDOW:
        raise table.error(f"must be {NARROWEST_WINDOW:g} or more above low, is {high:g} over {low:g}", "high")
    return Window(low, high, table.number("sd", 0.01, low=0.0, high=HALF_FULL), given=True)


def _entropy(battery: Table) -> tuple[Row, Row]:
    """(SOC, dU/dT [V/K]); nothing if the file does not have the table."""
    if "entropy" not in battery.values:
        return (), ()
    table = battery.table("entropy")
    table.only(["soc", "value", "unit", "sd", "source", "status"])
    table.text("unit", choices=["V/K"])
    soc = _axis(table, "soc", -0.01, 1.01, least=1)
    value = table.numbers("value", -LARGEST_ENTROPY, LARGEST_ENTROPY)
    if len(value) != len(soc):
        raise table.error(f"must be {len(soc)} numbers, one for each soc", "value")
    return soc, value


def _axis(table: Table, key: str, low: float, high: float, least: int = 2) -> Row:
    row = table.numbers(key, low, high)
    for a, b in pairwise(row):
        if not a < b:
            raise table.error(f"must increase, but {b:g} follows {a:g}", key)
        if b - a < SMALLEST_STEP:
            raise table.error(f"must increase by {SMALLEST_STEP:g} or more, but {b!r} follows {a!r}", key)
    if len(row) < least:
        raise table.error(f"must be two numbers or more within {low:g} to {high:g}", key)
    return row


def _mesh(table: Table, unit: str, low: float, high: float) -> Mesh:
    table.only(["soc", "temperature", "value", "unit", "sd_relative", "source", "status"])
    table.text("unit", choices=[unit])
    soc = _axis(table, "soc", -0.01, 1.01)
    temperature = _axis(table, "temperature", *TEMPERATURE, least=1)
    rows = table.rows("value", len(soc), f"in {unit}, one for each soc", low, high)
    if len(rows) != len(temperature):
        raise table.error(f"must be {len(temperature)} rows, one for each temperature", "value")
    return Mesh(soc, temperature, rows, geometric=True)
