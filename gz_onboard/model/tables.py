"""Read and check the tables of a vehicle file: those of the battery, and how the controller limits the current.

Lord 2016 names the motor controller and does not give it (it is proprietary). Its limits are piecewise-linear shares
over speed, temperature, voltage and charge; a share that the vehicle file does not give is 1: a limit of one vehicle is
not another's.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.model.battery import HALF_FULL, Battery, Window
from gz_onboard.model.functions import Mesh, PiecewiseLinear
from gz_onboard.model.parameters import MOST_CELLS, Parameters

if TYPE_CHECKING:
    from gz_onboard.toml import Table

Bounds = tuple[float, float]
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

    temperature: Bounds = (-60.0, 100.0)  # degC, of a cell
    soc: Bounds = (-0.01, 1.01)
    voltage: Bounds = (0.5, 5.0)  # V, of a cell
    capacity: Bounds = (0.01, 1000.0)  # A·h, of a cell
    capacity_share: Bounds = (0.05, 2.0)  # of the capacity on the bench
    resistance: Bounds = (1e-6, 10.0)  # ohm, of a cell: from the largest to a frozen one of a watch
    capacitance: Bounds = (1e-3, 1e8)  # F, of a cell's RC pair
    entropy: Bounds = (-5e-3, 5e-3)  # V/K: of intercalation cells 1e-3 at most; more is mV/K
    rest_shift: Bounds = (-0.2, 0.2)  # V: cells rest tens of mV apart; more is a mistyped unit
    voltage_error: Bounds = (0.0, 0.2)  # V
    narrowest_window: float = 0.1  # of the charge: no vehicle carries ten times the cells that it uses
    as_new: Bounds = (0.01, 0.99)  # nothing could be learned from a certainty


LIMITS = TableLimits()
SD_KEYS = "sd", "sd_relative"


def read_curve(
    table: Table, axis: str, value: str, unit: str, x: Bounds, y: Bounds, more: Collection[str] = (), x_unit: str = ""
) -> PiecewiseLinear:
    """The numbers `value` of a table over its `axis`, within the bounds `y` and `x`.

    unit: the one that the table must give; x_unit: of the axis, for messages; more: keys that the table may have.
    """
    table.only([axis, value, "unit", "status", "source", *more])
    table.text("unit", choices=[unit])
    xs, ys = table.increasing(axis, *x, x_unit), table.numbers(value, *y)
    if len(ys) != len(xs):
        raise table.error(f"must be {len(xs)} numbers, one for each {axis}", value)
    return PiecewiseLinear(xs, ys)


# --- the battery --------------------------------------------------------------------------------------------------


def read_battery(vehicle: Table, parameters: Parameters) -> Battery:
    """The battery in the vehicle file; InputError for tables that do not make sense."""
    table = vehicle.table("battery")
    table.only(KEYS)
    ocv = _needed(table, "ocv")
    ocv_curve = read_curve(ocv, "soc", "value", "V", LIMITS.soc, LIMITS.voltage, more=["sd"])
    ocv.increasing("value", *LIMITS.voltage)  # a voltage must tell the state of charge
    empty, full = ocv_curve.x[0], ocv_curve.x[-1]
    if empty > 0.1 or full < 0.9:
        raise ocv.error(f"must reach from 0.1 or less to 0.9 or more, is {empty:g} to {full:g}", "soc")
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
        ocv_curve=ocv_curve,
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


def _curve(battery: Table, name: str, axis: str, unit: str, bounds: Bounds) -> PiecewiseLinear | None:
    """The table `name` of values in `unit` over its `axis`; None if the file does not have it."""
    if name not in battery.values:
        return None
    return read_curve(battery.table(name), axis, "value", unit, getattr(LIMITS, axis), bounds, SD_KEYS)


def _capacity_share(battery: Table) -> PiecewiseLinear:
    """The capacity over temperature [degC], as a share of that on the bench; 1 if the file does not have the table."""
    capacity = _curve(battery, "capacity", "temperature", "A·h", LIMITS.capacity)
    if capacity is None:
        return PiecewiseLinear((BENCH_TEMPERATURE,), (1.0,))
    rated = capacity.at(BENCH_TEMPERATURE)
    shares = tuple(value / rated for value in capacity.y)
    low, high = LIMITS.capacity_share
    if min(shares) < low or max(shares) > high:
        complaint = f"must be within {low:g} to {high:g} times the value at {BENCH_TEMPERATURE:g} degC"
        raise battery.table("capacity").error(complaint, "value")
    return PiecewiseLinear(capacity.x, shares)


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


def _mesh(table: Table, unit: str, low: float, high: float) -> Mesh:
    table.only(["soc", "temperature", "value", "unit", "sd_relative", "source", "status"])
    table.text("unit", choices=[unit])
    soc, temperature = table.increasing("soc", *LIMITS.soc), table.increasing("temperature", *LIMITS.temperature)
    if len(soc) < 2:
        raise table.error("must be two numbers or more", "soc")
    rows = table.rows("value", len(soc), f"in {unit}, one for each soc", low, high)
    if len(rows) != len(temperature):
        raise table.error(f"must be {len(temperature)} rows, one for each temperature", "value")
    return Mesh(soc, temperature, rows, geometric=True)


# --- the motor controller -----------------------------------------------------------------------------------------

FULL = PiecewiseLinear((0.0,), (1.0,))


@dataclass(frozen=True)
class Derating:
    """Shares of the current limit while driving (``current_``) and while braking with the motor (``regeneration_``).

    Shares that act together multiply; temperatures act on driving and braking. regeneration_gain: share of the
    regeneration for each share of the brake's command, up to all of it.
    """

    current_by_motor_speed: PiecewiseLinear = FULL
    current_by_cell_voltage: PiecewiseLinear = FULL
    current_by_soc: PiecewiseLinear = FULL
    current_by_motor_temperature: PiecewiseLinear = FULL
    current_by_inverter_temperature: PiecewiseLinear = FULL
    current_by_cell_temperature: PiecewiseLinear = FULL
    regeneration_by_motor_speed: PiecewiseLinear = FULL
    regeneration_by_soc: PiecewiseLinear = FULL
    regeneration_gain: float = 1.0

    @property
    def top_spin(self) -> float | None:
        """The motor speed [rad/s] from which there is no current; None if the file does not say."""
        curve = self.current_by_motor_speed
        return next((at for at, share in zip(curve.x, curve.y, strict=True) if not share and at > 0), None)


AXES: dict[str, tuple[str, Bounds]] = {
    "motor_speed": ("rad/s", (0.0, 5000.0)),
    "cell_voltage": ("V", (0.5, 5.0)),
    "soc": ("1", (-0.01, 1.01)),
    "motor_temperature": ("degC", (-60.0, 300.0)),
    "inverter_temperature": ("degC", (-60.0, 200.0)),
    "cell_temperature": ("degC", (-60.0, 150.0)),
}
"""The axes of shares, with unit and bounds."""


def read_derating(vehicle: Table) -> Derating:
    """The table ``[controller]`` of a vehicle file; a missing entry limits nothing. InputError for a bad one."""
    table = vehicle.table("controller")
    table.only([entry.name for entry in fields(Derating)])
    found: dict[str, PiecewiseLinear | float] = {}
    for name in table.values:
        entry = table.table(name)
        if name == "regeneration_gain":
            entry.only(["value", "unit", "status", "source"])
            entry.text("unit", choices=["1"])
            found[name] = entry.number("value", low=0.01, high=1e6)
        else:
            unit, bounds = AXES[name.partition("_by_")[2]]
            found[name] = read_curve(entry, "at", "share", unit, bounds, (0.0, 1.0), x_unit=unit)
    return Derating(**found)  # type: ignore[arg-type]
