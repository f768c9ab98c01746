"""The battery as a first-order equivalent circuit (Lord 2016, eqs. 2.20-2.24), one representative cell.

    dSOC/dt = -I/(3600·Ah)      dV1/dt = -V1/(R1·C1) + I/C1      V = V_oc(SOC) - R0·I - V1

with I the cell's current, positive when discharging. R0, R1 and C1 are tables over SOC and temperature, linear in
between; outside them the nearest edge counts, except that V_oc goes on along its last slope, so that an estimate
that strays beyond full or empty is still told its way back. A cold cell rests lower: with `rest_shift`
V_oc(SOC, T) = V_oc(SOC) + shift(T), linear in T, constant beyond its ends.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import sqrt
from typing import TYPE_CHECKING

from gz_onboard.physics.parameters import Parameters
from gz_onboard.physics.relaxation import decay_over, relaxed

if TYPE_CHECKING:
    from gz_onboard.toml import Table

Row = tuple[float, ...]
Lacks = Callable[[float, float, float], float]
"""What a cell's voltage lacks [V] beside R0 and the RC pair, at a cell's current [A], SOC and temperature [degC]."""
TEMPERATURE = (-60.0, 100.0)  # degC, of a cell
RESISTANCE = (1e-6, 10.0)  # ohm, of a cell: from the largest to a frozen one of a watch
CAPACITANCE = (1e-3, 1e8)  # F, of a cell's RC pair
BENCH_TEMPERATURE = 25.0  # degC, at which capacities are given
HALF_FULL = 0.5  # SOC that is taken where it is not known
SMALLEST_STEP = 1e-6  # of SOC, V or degC, from point to point: a slope must stay a number
LARGEST_SHIFT = 0.2  # V: real cells rest tens of mV apart from -20 to 25 degC; more is a mistyped unit


def _linear(xs: Row, ys: Row, x: float) -> float:
    """Linear interpolation, constant beyond the ends."""
    if x <= xs[0]:
        return ys[0]
    if x >= xs[-1]:
        return ys[-1]
    i = bisect_right(xs, x) - 1
    return ys[i] + (x - xs[i]) * (ys[i + 1] - ys[i]) / (xs[i + 1] - xs[i])


@dataclass(frozen=True, eq=False)
class Mesh:
    """Values over SOC (columns) and temperature [degC] (rows)."""

    soc: Row
    temperature: Row
    value: tuple[Row, ...]
    _rows: dict[float, Row] = field(default_factory=dict, init=False, repr=False)  # by temperature, the last few

    def at(self, soc: float, temperature: float) -> tuple[float, float]:
        """(value, its slope over SOC); beyond the mesh its edge, with slope zero."""
        xs = self.soc
        row = self._rows.get(temperature) or self._row(temperature)
        i = bisect_right(xs, soc) - 1
        if i < 0:
            return row[0], 0.0
        if i >= len(xs) - 1:
            return row[-1], 0.0
        slope = (row[i + 1] - row[i]) / (xs[i + 1] - xs[i])
        return row[i] + slope * (soc - xs[i]), slope

    def scaled(self, factor: float) -> Mesh:
        """The same mesh times `factor`."""
        return Mesh(self.soc, self.temperature, tuple(tuple(factor * v for v in row) for row in self.value))

    def _row(self, temperature: float) -> Row:
        """The values over SOC at `temperature`, kept: it changes far more slowly than SOC."""
        ts = self.temperature
        row = self.value[0]
        if len(ts) > 1:
            j = min(max(bisect_right(ts, temperature) - 1, 0), len(ts) - 2)
            w = min(max((temperature - ts[j]) / (ts[j + 1] - ts[j]), 0.0), 1.0)
            row = tuple(cold + w * (warm - cold) for cold, warm in zip(self.value[j], self.value[j + 1], strict=True))
        if len(self._rows) >= 8:
            self._rows.clear()
        self._rows[temperature] = row
        return row


@dataclass(frozen=True)
class Battery:
    """A pack of `cells_series` by `cells_parallel` cells."""

    cells_series: int
    cells_parallel: int
    capacity: float  # A·h of a cell at 25 degC
    capacity_temperature: Row  # degC
    capacity_share: Row  # of the capacity at 25 degC
    cutoff_voltage: float  # V of a cell
    series_resistance: float  # ohm, of the pack beside its cells
    ocv_soc: Row
    ocv_value: Row  # V
    ocv_sd: float  # V
    r0: Mesh  # ohm
    r1: Mesh  # ohm
    c1: Mesh  # F
    resistance_factor: float = 1.0  # that is in r0, r1 and c1
    rest_shift_temperature: Row = ()  # degC; none: V_oc does not depend on temperature
    rest_shift_value: Row = ()  # V of a cell
    rest_shift_sd: float = 0.0  # V

    def cell_capacity(self, temperature: float) -> float:
        """Capacity of a cell [A·h] at `temperature` [degC]: the charge between SOC 0 and 1."""
        return self.capacity * _linear(self.capacity_temperature, self.capacity_share, temperature)

    def pack_capacity(self, temperature: float) -> float:
        """Capacity of the pack [A·h] at `temperature` [degC]."""
        return self.cell_capacity(temperature) * self.cells_parallel

    def rest_shift(self, temperature: float) -> float:
        """How much higher [V] a cell rests at `temperature` [degC] than `ocv_value` says."""
        if not self.rest_shift_value:
            return 0.0
        return _linear(self.rest_shift_temperature, self.rest_shift_value, temperature)

    def ocv(self, soc: float, temperature: float | None = None) -> tuple[float, float]:
        """(open-circuit voltage of a cell [V], its slope [V]) at `temperature` [degC]; None: as tabulated over SOC."""
        xs, ys = self.ocv_soc, self.ocv_value
        i = bisect_right(xs, soc, 1, len(xs) - 1) - 1
        slope = (ys[i + 1] - ys[i]) / (xs[i + 1] - xs[i])
        volts = ys[i] + slope * (soc - xs[i])
        if temperature is not None and self.rest_shift_value:
            volts += _linear(self.rest_shift_temperature, self.rest_shift_value, temperature)
        return volts, slope

    def soc_at(self, ocv: float, temperature: float | None = None) -> float:
        """The SOC at which the open-circuit voltage of a cell is `ocv` [V]; `temperature` as for `ocv`."""
        if temperature is not None and self.rest_shift_value:
            ocv -= _linear(self.rest_shift_temperature, self.rest_shift_value, temperature)
        xs, ys = self.ocv_soc, self.ocv_value
        i = min(max(bisect_right(ys, ocv) - 1, 0), len(xs) - 2)
        return xs[i] + (ocv - ys[i]) * (xs[i + 1] - xs[i]) / (ys[i + 1] - ys[i])

    def cell_voltage(self, pack_voltage: float, pack_current: float) -> float:
        """Voltage of the mean cell [V] out of pack voltage [V] and current [A]."""
        return (pack_voltage + self.series_resistance * pack_current) / self.cells_series

    def relax(self, dt: float, v1: float, current: float, r1: float, c1: float) -> tuple[float, float]:
        """(V1 after `dt` [s] of constant cell current [A], the factor that V1 decayed by): eq. 2.22, exact."""
        decay = decay_over(dt, r1 * c1)
        return relaxed(v1, r1 * current, decay), decay

    def advanced(
        self, dt: float, soc: float, v1: float, current: float, temperature: float
    ) -> tuple[float, float, float]:
        """(SOC, V1 [V], the factor that V1 decayed by) of a cell after `dt` [s] at a constant `current` [A]."""
        r1, c1 = self.r1.at(soc, temperature)[0], self.c1.at(soc, temperature)[0]
        v1, decay = self.relax(dt, v1, current, r1, c1)
        return soc - current * dt / (3600 * self.cell_capacity(temperature)), v1, decay

    def terminal_voltage(self, soc: float, v1: float, current: float, temperature: float) -> tuple[float, float]:
        """(voltage of a cell [V] at `current` [A] and `temperature` [degC], its derivative over SOC): eq. 2.23."""
        ocv, slope = self.ocv(soc, temperature)
        r0, r0_slope = self.r0.at(soc, temperature)
        return ocv - r0 * current - v1, slope - current * r0_slope

    def with_parameters(self, parameters: Mapping[str, float]) -> Battery:
        """The same battery with what a vehicle's `parameters` say of capacity, cut-off and resistances."""
        factor = parameters["cell_resistance_factor"]
        battery = replace(
            self,
            capacity=parameters["cell_capacity"],
            cutoff_voltage=parameters["cell_cutoff_voltage"],
            series_resistance=parameters["pack_series_resistance"],
        )
        if factor == self.resistance_factor:
            return battery
        more = factor / self.resistance_factor
        return replace(
            battery,
            r0=self.r0.scaled(more),
            r1=self.r1.scaled(more),
            c1=self.c1.scaled(1 / more),  # the time constant stays
            resistance_factor=factor,
        )

    def settled_current(
        self, power: float, soc: float, temperature: float, form: float = 1.0, lacks: Lacks | None = None
    ) -> float | None:
        """Mean pack current [A] that delivers a mean `power` [W] once the RC pair has settled; None if none can.

        `form` is the mean square of the current over the square of its mean: in traffic the current comes in
        bursts, which heat R0 more than a steady one; the RC pair smooths them. `lacks`: what a cell's voltage lacks
        beside R0 and the RC pair.
        """
        n, m = self.cells_series, self.cells_parallel
        source = n * self.ocv(soc, temperature)[0]
        cell = form * self.r0.at(soc, temperature)[0] + self.r1.at(soc, temperature)[0]
        resistance = n * cell / m + form * self.series_resistance
        root = source * source - 4 * resistance * power
        if root < 0:
            return None
        current = 2 * power / (source + sqrt(root))
        if lacks is None:
            return current
        for _ in range(2):  # the lack moves the current by a percent, and that the lack by a percent of itself
            lower = source - n * lacks(current / m, soc, temperature)
            root = lower * lower - 4 * resistance * power
            if root < 0:
                return None
            current = 2 * power / (lower + sqrt(root))
        return current


@dataclass(frozen=True)
class Drawable:
    """What a pack still delivers until its cells reach the cut-off voltage."""

    energy: float  # J, at the pack's terminals
    soc_left: float
    slope: float  # J: how much more energy there would be for more SOC


# Gauss-Legendre nodes and weights on [0, 1], of order 8
_NODES = (0.019855072, 0.101666761, 0.237233795, 0.408282679, 0.591717321, 0.762766205, 0.898333239, 0.980144928)
_WEIGHTS = (0.050614268, 0.111190517, 0.156853323, 0.181341892, 0.181341892, 0.156853323, 0.111190517, 0.050614268)


def drawable(
    battery: Battery, soc: float, temperature: float, power: float, form: float = 1.0, lacks: Lacks | None = None
) -> Drawable:
    """What a pack at `soc` and `temperature` [degC] delivers at a mean `power` [W] until the cut-off.

    At constant power P the charge Q·dSOC passes in dt = Q·dSOC/I, so the energy is P·Q·∫ dSOC/I(SOC), from the
    SOC at which the terminal voltage at the mean load meets the cut-off: bursts are held back by the vehicle before.
    `form`, `lacks`: see `Battery.settled_current`. The RC pair is taken as settled (V1 = R1·I): discharging
    takes an hour, its time constant is a minute.
    """
    low, high = -0.05, soc
    charge = battery.pack_capacity(temperature) * 3600
    cutoff = battery.cutoff_voltage * battery.cells_series
    current = battery.settled_current(power, soc, temperature, lacks=lacks)
    if current is None or power < cutoff * current:
        return Drawable(0.0, soc, charge * cutoff)
    slope = charge * power / current
    for _ in range(14):  # to 6e-5 of SOC
        middle = (low + high) / 2
        current = battery.settled_current(power, middle, temperature, lacks=lacks)
        if current is None or power < cutoff * current:
            low = middle
        else:
            high = middle
    width = soc - high
    total = 0.0
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        current = battery.settled_current(power, high + width * node, temperature, form, lacks)
        total += weight / current if current else 0.0
    return Drawable(power * charge * width * total, high, slope)


def read_battery(vehicle: Table, parameters: Parameters) -> Battery:
    """The battery in the vehicle file; InputError for tables that do not make sense."""
    table = vehicle.table("battery")
    table.only(["cells_series", "cells_parallel", "ocv", "rest_shift", "capacity", "r0", "r1", "c1"])
    ocv = table.table("ocv")
    ocv.only(["soc", "value", "unit", "sd", "source", "status"])
    ocv.text("unit", choices=["V"])
    soc, volts = _axis(ocv, "soc", -0.01, 1.01), _axis(ocv, "value", 0.5, 5.0)
    if soc[0] > 0.1 or soc[-1] < 0.9:
        raise ocv.error(f"must reach from 0.1 or less to 0.9 or more, is {soc[0]:g} to {soc[-1]:g}", "soc")
    if len(soc) != len(volts):
        raise ocv.error(f"has {len(volts)} numbers for {len(soc)} of soc", "value")
    temperatures: Row
    capacities: Row
    temperatures, capacities = (25.0,), (1.0,)
    if "capacity" in table.values:
        capacity = table.table("capacity")
        capacity.only(["temperature", "value", "unit", "sd_relative", "source", "status"])
        capacity.text("unit", choices=["A·h"])
        temperatures, capacities = _axis(capacity, "temperature", *TEMPERATURE), capacity.numbers("value", 0.01, 1000)
        if len(temperatures) != len(capacities):
            raise capacity.error(f"must be {len(temperatures)} positive numbers, one for each temperature", "value")
        at_25 = _linear(temperatures, capacities, 25.0)
        capacities = tuple(value / at_25 for value in capacities)
        if min(capacities) < 0.05 or max(capacities) > 2:
            raise capacity.error("must be within 0.05 to 2 times what it is at 25 degC", "value")
    shift_temperatures, shifts, shift_sd = _rest_shift(table)
    battery = Battery(
        cells_series=table.integer("cells_series", 1, 1000),
        cells_parallel=table.integer("cells_parallel", 1, 1000),
        capacity=parameters["cell_capacity"],
        capacity_temperature=temperatures,
        capacity_share=capacities,
        cutoff_voltage=parameters["cell_cutoff_voltage"],
        series_resistance=parameters["pack_series_resistance"],
        ocv_soc=soc,
        ocv_value=volts,
        ocv_sd=ocv.number("sd", 0.005, low=1e-4, high=0.5),
        r0=_mesh(table.table("r0"), "ohm", *RESISTANCE),
        r1=_mesh(table.table("r1"), "ohm", *RESISTANCE),
        c1=_mesh(table.table("c1"), "F", *CAPACITANCE),
        rest_shift_temperature=shift_temperatures,
        rest_shift_value=shifts,
        rest_shift_sd=shift_sd,
    )
    return battery.with_parameters(parameters)


def _rest_shift(battery: Table) -> tuple[Row, Row, float]:
    """(temperatures [degC], shifts [V], their sd [V]); nothing if the file does not have the table."""
    if "rest_shift" not in battery.values:
        return (), (), 0.0
    table = battery.table("rest_shift")
    table.only(["temperature", "value", "unit", "sd", "source", "status"])
    table.text("unit", choices=["V"])
    temperatures, shifts = _axis(table, "temperature", *TEMPERATURE), table.numbers("value")
    if len(shifts) != len(temperatures) or max(map(abs, shifts)) > LARGEST_SHIFT:
        wanted = f"must be {len(temperatures)} numbers within {-LARGEST_SHIFT:g} to {LARGEST_SHIFT:g} V"
        raise table.error(f"{wanted}, one for each temperature", "value")
    return temperatures, shifts, table.number("sd", 0.005, low=0.0, high=LARGEST_SHIFT)


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
    return Mesh(soc, temperature, rows)
