"""Measurements in a table: CSV (also .csv.gz) or Parquet, one column a quantity, its unit in the name of the column.

    time_s,current_A,voltage_mV,cell_temperature_degC

A column is called quantity_unit; ``quantity[unit]`` and ``quantity (unit)`` are read too. Columns come out by
quantity, in SI units and degC. For tables of other people a mapping says which column is what:

    columns = { time = "t_s", voltage = "v_V", current = { column = "i_A", scale = -1 } }

A quantity that is the same in all rows needs no column: ``cell_temperature = { value = 25, unit =
"degC" }``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import KELVIN
from gz_onboard.errors import InputError, nearest
from gz_onboard.routes.columns import csv_rows

if TYPE_CHECKING:
    from gz_onboard.toml import Table

_TURN = 2 * math.pi  # rad
_FACTORS: dict[str, dict[str, float]] = {  # by SI unit (or degC), the units as written
    "s": {"s": 1, "ms": 1e-3, "us": 1e-6, "min": 60, "h": 3600},
    "A": {"A": 1, "mA": 1e-3, "Arms": 1},
    "V": {"V": 1, "mV": 1e-3, "kV": 1e3, "Vrms": 1},
    "degC": {"degC": 1, "C": 1, "K": 1, "degF": 5 / 9},
    "rad/s": {"radps": 1, "rpm": _TURN / 60, "revps": _TURN, "degps": math.pi / 180},
    "m/s": {"mps": 1, "kmph": 1 / 3.6, "mph": 0.44704},
    "m/s^2": {"mps2": 1},
    "N·m": {"Nm": 1, "mNm": 1e-3},
    "W": {"W": 1, "kW": 1e3, "mW": 1e-3},
    "N": {"N": 1, "kN": 1e3},
    "ohm": {"ohm": 1, "mohm": 1e-3},
    "A·h": {"Ah": 1, "mAh": 1e-3},
    "J": {"Wh": 3600, "J": 1},
    "m": {"m": 1, "km": 1e3, "mm": 1e-3},
    "kg": {"kg": 1},
    "Pa": {"Pa": 1, "bar": 1e5},
    "rad": {"rad": 1, "deg": math.pi / 180},
    "1": {"pct": 0.01, "1": 1},
}
_OFFSETS = {"K": -KELVIN, "degF": -160 / 9}
# Unit as written -> (unit it is turned into, factor, offset)
UNITS: dict[str, tuple[str, float, float]] = {
    unit: (si, factor, _OFFSETS.get(unit, 0)) for si, units in _FACTORS.items() for unit, factor in units.items()
}
_ALIASES = (
    "rad/s=radps r/min=rpm 1/min=rpm rev/s=revps deg/s=degps m/s=mps km/h=kmph kmh=kmph kph=kmph m/s2=mps2 m/s^2=mps2 "
    "m/s²=mps2 N·m=Nm N.m=Nm °C=degC Ω=ohm A·h=Ah %=pct °=deg sec=s Amps=A Volts=V celsius=degC hr=h µs=us mΩ=mohm"
)
_SPELLINGS = {"": "1", "-": "1"} | dict(alias.split("=") for alias in _ALIASES.split())
# The last word of a quantity, and in what such a quantity must be.
_QUANTITIES = (
    "time s, current A, voltage V, line V, temperature degC, speed rad/s m/s, torque N·m, power W, force N, mass kg, "
    "charge A·h, energy J, acceleration m/s^2, distance m, altitude m"
)
_KINDS = {word: tuple(units) for word, *units in map(str.split, _QUANTITIES.split(", "))}
_SPEED_OF = {"motor_speed": "rad/s", "wheel_speed": "rad/s", "vehicle_speed": "m/s", "speed": "m/s"}

_BRACKETS = re.compile(r"^\s*(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$")


class Named(NamedTuple):
    """Which column of a file holds a quantity; unit: where its name does not say; scale: such as -1 for the sign.

    value: in place of a column, the same in every row.
    """

    column: str
    unit: str | None = None
    scale: float = 1.0
    value: float | None = None


@dataclass(frozen=True)
class Measurements:
    """Columns of measurements.

    columns: by quantity (``current``, ``cell_temperature``, ...), all of one length, in SI units and degC; ``time``
    never decreases; two rows at one time are the two sides of a step. lines: line of each row in the file, from 1 (for
    Parquet: its row). trouble: by quantity, why a column of the file cannot be used; raised when it is asked for.
    """

    file: Path
    columns: dict[str, Array]
    lines: Sequence[int] = ()
    trouble: dict[str, InputError] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __getitem__(self, name: str) -> Array:
        """The column `name`; InputError if it is not there or of no use."""
        if name in self.columns:
            return self.columns[name]
        if name in self.trouble:
            raise self.trouble[name]
        known = [*self.columns, *self.trouble]
        kinds = _kinds(name)
        wanted = f", in {' or '.join(kinds)}" if kinds else ""
        columns = ", ".join(known) or "none"
        raise InputError(f"{self.file}: no column for {name!r}{wanted}{nearest(name, known)}; there are {columns}")

    def line(self, row: int) -> int:
        """The line of row `row` in the file."""
        return int(self.lines[row]) if len(self.lines) else row + 1

    def error(self, message: str, row: int | None = None) -> InputError:
        """The error to raise about this file, or about one row of it."""
        return InputError(f"{self.file}{'' if row is None else f':{self.line(row)}'}: {message}")


def read_table(file: Path, columns: Mapping[str, Named] | None = None) -> Measurements:
    """The table in `file`.

    columns: for a file with other names, the column of each quantity; all others are left out. Raises InputError
    naming file, line, column and value for a file that cannot be read, for a missing column or unit, for a value that
    is no finite number, and for a time that goes back.
    """
    names, raw, lines = _read_parquet(file) if file.suffix in (".parquet", ".pq") else _read_csv(file)
    found: dict[str, Array] = {}
    trouble: dict[str, InputError] = {}
    for quantity, named in _asked(file, names, columns, trouble).items():
        values = raw[names.index(named.column)] if named.value is None else [named.value] * len(lines)
        try:
            found[quantity] = _converted(quantity, named, values, lines, file)
        except InputError as error:
            trouble[quantity] = error
            if columns:  # what somebody has named must be of use
                raise
    if "time" in trouble:
        raise trouble["time"]
    table = Measurements(file, found, lines, trouble)
    for row in np.flatnonzero(np.diff(found.get("time", np.empty(0))) < 0)[:1] + 1:
        before, after = found["time"][row - 1 : row + 1]
        raise table.error(f"time must not go back, but {after:g} s follows {before:g} s", int(row))
    return table


def read_columns(table: Table) -> dict[str, Named]:
    """The table ``columns`` of a manifest: quantity = "column", { column, unit, scale }, or { value, unit }."""
    found = {}
    for quantity, entry in table.values.items():
        if isinstance(entry, str):
            found[quantity] = Named(entry)
            continue
        inner = table.table(quantity)
        inner.only(["column", "unit", "scale", "value"])
        unit = inner.text("unit") if "unit" in inner.values else None
        if unit is not None and _unit(unit) is None:
            raise inner.error(f"unknown unit {unit!r}{nearest(unit, UNITS)}; known are {', '.join(UNITS)}", "unit")
        value = inner.number("value") if "value" in inner.values else None
        column = inner.text("column") if value is None else quantity
        found[quantity] = Named(column, unit, inner.number("scale", 1.0), value)
    return found


def _asked(
    file: Path, names: Sequence[str], columns: Mapping[str, Named] | None, trouble: dict[str, InputError]
) -> dict[str, Named]:
    """For each quantity its column: as the mapping says, or all by their own names; two for one go to `trouble`."""
    if columns:
        for quantity, (column, *_, value) in columns.items():
            if value is None and (count := names.count(column)) != 1:
                what = f"{count} columns are called" if count else "no column"
                there = "" if count else f"{nearest(column, names)}; there are {', '.join(names)}"
                raise InputError(f"{file}: {what} {column!r} for {quantity}{there}")
        return dict(columns)
    asked: dict[str, Named] = {}
    for name in names:
        quantity = _split(name)[0]
        if quantity in asked:
            both = f"columns {asked[quantity].column!r} and {name!r} are both {quantity!r}"
            trouble[quantity] = InputError(f"{file}: {both}")
        asked.setdefault(quantity, Named(name))
    return {quantity: named for quantity, named in asked.items() if quantity not in trouble}


def _split(name: str) -> tuple[str, str | None]:
    """(quantity, unit as written or None) out of the name of a column."""
    if match := _BRACKETS.match(name):
        return match[1], match[2]
    quantity, _, unit = name.strip().rpartition("_")
    if quantity and (_unit(unit) is not None or not _kinds(name)):
        return quantity, unit
    return name.strip(), None


def _unit(unit: str) -> tuple[str, float, float] | None:
    return UNITS.get(_SPELLINGS.get(unit, unit))


def _kinds(quantity: str) -> tuple[str, ...]:
    """The units in which `quantity` may come out; empty if its name says nothing."""
    for end, si in _SPEED_OF.items():
        if quantity.startswith(end):
            return (si,)
    return _KINDS.get(quantity.rpartition("_")[2], ())


def _converted(quantity: str, named: Named, values: Sequence[object], lines: Sequence[int], file: Path) -> Array:
    """The column of a quantity in SI units. InputError for no or a wrong unit, and values that are not finite."""
    place, written = f"{file}: column {named.column!r}", named.unit
    if written is None:
        written = _split(named.column)[1]
    kinds = _kinds(quantity)
    fitting = [name for name, (si, *_) in UNITS.items() if si in kinds or not kinds]
    if written is None:
        raise InputError(f"{place} has no unit in its name, such as {named.column}_{fitting[0]}")
    conversion, known = _unit(written), f"known are {', '.join(fitting)}"
    if conversion is None:
        raise InputError(f"{place}: unknown unit {written!r}{nearest(written, UNITS)}; {known}")
    si, factor, offset = conversion
    if kinds and si not in kinds:
        raise InputError(f"{place}: {quantity} cannot be in {written}; {known}")
    array = np.array([_number(value) for value in values])
    wrong = np.flatnonzero(~np.isfinite(array))
    if len(wrong):
        row, more = int(wrong[0]), f", and {len(wrong) - 1} more" if len(wrong) > 1 else ""
        raise InputError(
            f"{file}: line {lines[row]}, column {named.column!r}: {values[row]!r} is not a finite number{more}"
        )
    return np.asarray(named.scale * (array * factor + offset))


def _number(value: object) -> float:
    try:
        return float(value)  # type: ignore[arg-type]
    except (ValueError, TypeError):
        return math.nan


def _read_csv(file: Path) -> tuple[list[str], list[list[object]], list[int]]:
    """(names, columns as text, line of each row)."""
    (_, header), *rows = csv_rows(file) or [(1, [])]
    names = [name.strip() for name in header]
    if not any(names):
        raise InputError(f"{file}: is empty; the first line must name the columns, such as time_s,current_A")
    for line, row in rows:
        if len(row) != len(names):
            raise InputError(f"{file}:{line}: {len(row)} values for {len(names)} columns")
    if all(_number(name) == _number(name) for name in names):
        raise InputError(f"{file}:1: {', '.join(names[:3])} ... are numbers, not names of columns such as time_s")
    if not rows:
        raise InputError(f"{file}: has no rows")
    return names, [list(column) for column in zip(*(row for _, row in rows), strict=True)], [line for line, _ in rows]


def _read_parquet(file: Path) -> tuple[list[str], list[list[object]], list[int]]:
    import pyarrow
    import pyarrow.parquet

    try:
        table = pyarrow.parquet.read_table(file)
    except (OSError, pyarrow.ArrowException) as error:
        raise InputError(f"{file}: {getattr(error, 'strerror', None) or f'not a Parquet file: {error}'}") from error
    if table.num_rows == 0:
        raise InputError(f"{file}: has no rows")
    return list(table.column_names), [c.to_pylist() for c in table.columns], list(range(1, table.num_rows + 1))
