"""Read a ride from a table of signals (CSV, Parquet, or columns in memory) in place of a log of frames.

time [s],pack_voltage [V],pack_current [A],speed [km/h]
0.0,52.1,3.2,0.0
0.1,,3.4,0.2
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gz_onboard.can.dbc import empty_database
from gz_onboard.can.mapping import BusMapping, Source, TimeColumn, column_sources, known_units, to_si
from gz_onboard.errors import InputError, nearest, shown, unreadable
from gz_onboard.events import ROLES, Group
from gz_onboard.recording.frames import TIME_LIMIT_NS, SignalColumns
from gz_onboard.recording.readers.contents import LogDamage, unpacked
from gz_onboard.routes.columns import separated

if TYPE_CHECKING:
    from gz_onboard.arrays import Array
    from gz_onboard.toml import Table

_COLUMN = re.compile(r"\s*(?P<name>.*?)\s*(?:[\[(]\s*(?P<unit>[^\])]*?)\s*[\])])?\s*")
_TIME = re.compile(r"\s*(?:time|timestamp|t)(?:(?:_|\s+|\s*[\[(]\s*)(?P<unit>s|ms)\s*[\])]?)?\s*", re.I)
_SECONDS = {"s": 1.0, "ms": 1e-3}
_ALSO = {"speed": "vehicle_speed"}
_WORDS = {"battery": "pack", "soc": "bms_state_of_charge", "temp": "temperature", "velocity": "speed"}
_MISSING = ("", "nan", "nat", "null", "none", "n/a", "<na>")
MAX_STEP_S = 30.0  # usual time between rows: beyond it no ride can be followed
MAX_ROUNDING_S = 1.0  # of times that several rows share: clocks give whole seconds, coarser times were rounded
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class _Column(NamedTuple):
    name: str
    unit: str
    cells: Sequence[Any]


@dataclass(frozen=True)
class SignalTable:
    """A ride as a table.

    name: of the file, or what errors call it. header: names, each with its unit. columns: the cells below. lines: of
    the file, or row numbers from 1.
    """

    name: Path
    header: list[str]
    columns: Sequence[Sequence[Any]]
    lines: Sequence[int]


# --- from files and from memory -------------------------------------------------------------------------------------


def read_table(file: Path) -> SignalTable:
    """Read the table in a CSV or Parquet file. Raises InputError."""
    with file.open("rb") as stream:
        is_parquet = stream.read(4) == b"PAR1"
    return _parquet(file) if is_parquet else _csv(file)


def table_of(data: object, name: str = "table") -> SignalTable:
    """Take a mapping of columns, or a table of pandas, polars, pyarrow and the like; errors call it `name`.

    The time is the column of that name, of pandas also the index. InputError for anything else, and for columns of
    different lengths.
    """
    columns = _columns_of(data, name)
    columns.sort(key=lambda column: not is_time(column[0]))
    return _table(columns, name)


def is_time(name: str) -> bool:
    """Return whether a column of that name is the time."""
    return _TIME.fullmatch(name) is not None


def _csv(file: Path) -> SignalTable:
    try:
        data = bytes(unpacked(file.read_bytes(), LogDamage(file)))
    except OSError as error:
        raise unreadable(file, error) from error
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252", "replace")
    (_, header), *rows = separated(text) or [(1, [])]
    for line, row in rows:
        if len(row) != len(header):
            raise InputError(f"{file}:{line}: {len(row)} cells for {len(header)} columns")
    columns: list[Sequence[Any]] = list(zip(*(row for _, row in rows), strict=True)) or [()] * len(header)
    return SignalTable(file, header, columns, [line for line, _ in rows])


def _parquet(file: Path) -> SignalTable:
    import pyarrow.parquet

    try:
        table = pyarrow.parquet.ParquetFile(file).read()  # `read_table` refuses two columns of one name
    except (OSError, pyarrow.ArrowException) as error:
        raise InputError(f"{file}: not a Parquet file: {error}") from error
    return _table(list(zip(table.column_names, table.columns, strict=True)), str(file))


def _columns_of(data: Any, name: str) -> list[tuple[str, object]]:
    if isinstance(data, Mapping):
        return [(str(header), column) for header, column in data.items()]
    if hasattr(data, "iloc") and hasattr(data, "columns"):  # pandas, which may have two columns of one name
        columns = [(str(header), data.iloc[:, i]) for i, header in enumerate(data.columns)]
        index = str(data.index.name)
        return [(index, data.index), *columns] if is_time(index) and index not in dict(columns) else columns
    if hasattr(data, "__arrow_c_stream__"):
        import pyarrow

        with suppress(pyarrow.ArrowException, TypeError, ValueError, RuntimeError):  # a column alone speaks Arrow too
            table = pyarrow.table(data)
            return list(zip(table.column_names, table.columns, strict=True))
    raise InputError(
        f"{name}: {type(data).__name__} is no table of signals; give a dict of arrays by column, or a table of "
        "pandas, polars or pyarrow"
    )


def _table(columns: Sequence[tuple[str, object]], name: str) -> SignalTable:
    cells = [_cells(column, name, header) for header, column in columns]
    header = [header for header, _ in columns]
    if len({len(column) for column in cells}) > 1:
        said = ", ".join(f"{one} {len(column)}" for one, column in zip(header, cells, strict=True))
        raise InputError(f"{name}: its columns have unlike lengths: {said}")
    return SignalTable(Path(name), header, cells, range(1, len(cells[0]) + 1 if cells else 1))


def _cells(column: object, name: str, header: str) -> list[Any]:
    """Return the cells of a column as Python objects. InputError for anything else, and for dates of no calendar."""
    kind = getattr(getattr(column, "dtype", None), "kind", "")
    array = np.array(0)
    with suppress(TypeError, ValueError):  # of rows of different lengths
        array = np.asanyarray(column, "M8[us]" if kind == "M" else None)  # or pandas gives `Timestamp`s
    if array.ndim != 1:
        raise InputError(f"{name}: column {header!r}: must be an array of one dimension, is {shown(column)}")
    if array.dtype.kind in "Mm":
        array = array.astype(f"{array.dtype.kind}8[us]")  # as `datetime`, which has no ns
    cells: list[Any] = array.tolist()
    if array.dtype.kind == "M":
        for row, cell in enumerate(cells):
            if isinstance(cell, int):  # in place of a `datetime`, which has the years 1 to 9999
                time = array[row].astype("M8[s]")
                raise InputError(f"{name}:{row + 1}: column {header!r}: {time} is not a plausible time")
    return cells


# --- as signals -----------------------------------------------------------------------------------------------------


def table_signals(table: SignalTable, mapping: BusMapping) -> tuple[BusMapping, SignalColumns]:
    """Return the mapping of a table's columns to roles, for a vehicle with `mapping`, and their values.

    The columns have the names of roles; or, for a vehicle without DBC files, those that its roles name. InputError
    naming file, line, column, value and unit for a cell that is not a time, a number or empty, for a time that
    decreases, and for a column that is no role or whose unit its role does not have.
    """
    file, header = table.name, table.header
    if len(header) < 2:
        raise InputError(f"{file}:1: a table of signals has a column of times and one for each signal")
    time_at, time = _time_column(file, header, mapping.time)
    times = _times(table, time, table.columns[time_at])
    columns = [
        _column(text, cells)
        for at, (text, cells) in enumerate(zip(header, table.columns, strict=True))
        if at != time_at and (text.strip() or not all(map(_is_missing, cells)))  # a separator at each line's end
    ]
    columns = _without_duplicates(file, columns, mapping.columns)
    if mapping.columns:
        sources = column_sources({column.name: column.unit for column in columns}, mapping.columns, file)
    else:
        sources = _by_role(file, columns)
    roles: dict[str, list[Source]] = {}
    for source in sources:
        roles.setdefault(source.signal, []).append(source)
    columns = [column for column in columns if column.name in roles]
    values = np.array([_values(table, column) for column in columns]).reshape(len(columns), len(times)).T
    row, at = np.nonzero(~np.isnan(values))
    if not len(row):
        raise InputError(f"{file}: holds no value of a role")
    place = f"{file}: {time.name}"
    periods = {c.name: _period(place, times[~np.isnan(v)], c.name) for c, v in zip(columns, values.T, strict=True)}
    groups = tuple(Group(name, tuple(s.role for s in roles[name]), period) for name, period in periods.items())
    made = replace(
        mapping,
        database=empty_database(),
        sources=sources,
        protection={},
        periods={name: period for name, period in periods.items() if period},
        j1939=False,
        instruments=(),
        requests=(),
        groups=groups,
    )
    return made, SignalColumns(times[row], at, values[row, at])


def _time_column(file: Path, header: Sequence[str], configured: TimeColumn | None) -> tuple[int, TimeColumn]:
    """Return the index of the column of times, and its name as errors call it."""
    names = [name.strip() for name in header]
    if configured:
        if configured.name not in names:
            raise InputError(
                f"{file}:1: there is no column {shown(configured.name)}, which is the time in the vehicle file"
                f"{nearest(configured.name, names)}"
            )
        if names.count(configured.name) > 1:
            raise InputError(f"{file}:1: two columns are called {configured.name!r}")
        return names.index(configured.name), configured
    for at, name in enumerate(names):
        if found := _TIME.fullmatch(name):
            return at, TimeColumn(name, (found["unit"] or "").lower())
    raise InputError(
        f"{file}:1: no column is a time, such as 'time [s]' (in s, ms or ISO 8601); rename one, or name it in the "
        f"vehicle file: [table] time = {{ column = {shown(names[0])}, unit = 's' }}"
    )


def _times(table: SignalTable, column: TimeColumn, cells: Sequence[Any]) -> NDArray[np.int64]:
    """Return the time of each row [ns], from 0 on if the first is negative."""
    name, unit, place = column.name, column.unit, f"{table.name}: {column.name}"
    times: NDArray[np.int64] | None = None
    if unit and not column.format:
        numbers = np.array([_number(cell) for cell in cells]) * _SECONDS[unit] * 1e9
        if (np.abs(numbers) < TIME_LIMIT_NS).all():
            times = np.rint(numbers).astype(np.int64)
    if times is None:
        times = np.array([_time(table, column, cell, i) for i, cell in enumerate(cells)], np.int64)
    if len(times) < 2:
        raise InputError(f"{table.name}: {len(times)} rows below the names of the columns are no ride")
    steps = np.diff(times)
    for row in np.flatnonzero(steps < 0)[:1] + 1:
        where = f"{table.name}:{table.lines[row]}: {name}"
        raise InputError(f"{where}: {shown(cells[row])} is before the time of the row above")
    if times[0] == times[-1]:
        raise InputError(f"{place}: all rows have the same time, {shown(cells[0])}, which is no ride")
    if (step := float(np.median(steps)) * 1e-9) > MAX_STEP_S + 1e-6:
        raise InputError(
            f"{place}: from row to row it is usually {step:.4g} s, and {MAX_STEP_S:g} s are the most; if "
            "the times are in ms, call the column 'time [ms]'"
        )
    begin: NDArray[np.int64] = times - min(int(times[0]), 0)
    return begin


def _time(table: SignalTable, column: TimeColumn, cell: Any, row: int) -> int:
    """Return the time of one row [ns]. Raises InputError."""
    place = f"{table.name}:{table.lines[row]}: {column.name}: {shown(cell)}"
    try:
        if column.format and not isinstance(cell, date):
            time_ns = _nanoseconds(datetime.strptime(str(cell).strip(), column.format), column.unit)
        else:
            time_ns = _nanoseconds(cell, column.unit)
    except KeyError:
        raise InputError(f"{place} has no unit; call the column 'time [s]' or 'time [ms]'") from None
    except (TypeError, ValueError, OverflowError):
        form = f"no date of the format {column.format}" if column.format else ""
        raise InputError(f"{place} is {form or 'neither a number nor a time of ISO 8601'}") from None
    if not -TIME_LIMIT_NS < time_ns < TIME_LIMIT_NS:
        unit = column.unit or "s"
        raise InputError(f"{place} {unit} is not a plausible time; if it is in ms, call the column 'time [ms]'")
    return time_ns


def _nanoseconds(cell: Any, unit: str) -> int:
    """Convert a time: a number in `unit`, a duration, or a date, which is UTC if it has no zone.

    TypeError, ValueError or OverflowError for anything else, KeyError for a number without a unit.
    """
    if _is_missing(cell):
        raise ValueError
    if isinstance(cell, str):
        text = cell.strip()
        try:
            cell = float(text)
        except ValueError:
            cell = datetime.fromisoformat(text)
    if isinstance(cell, date):
        cell = cell if isinstance(cell, datetime) else datetime(cell.year, cell.month, cell.day)
        cell = (cell if cell.tzinfo else cell.replace(tzinfo=UTC)) - _EPOCH
    if isinstance(cell, timedelta):
        return cell // timedelta(microseconds=1) * 1000
    return round(float(cell) * _SECONDS[unit] * 1e9)


def _column(text: str, cells: Sequence[Any]) -> _Column:
    header = _COLUMN.fullmatch(text)
    return _Column(header["name"], header["unit"] or "", cells) if header else _Column(text, "", cells)


def _is_missing(cell: object) -> bool:
    if isinstance(cell, int | float):
        return False
    return cell is None or str(cell).strip().lower() in _MISSING


def _number(cell: Any) -> float:
    """Return the number in a cell: nan for an empty one, inf for anything else."""
    if cell is None or (type(cell) is str and not cell):  # most cells of a table whose signals come at their own times
        return math.nan
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return math.nan if _is_missing(cell) else math.inf


def _values(table: SignalTable, column: _Column) -> Array:
    """Return the values of a column, nan for an empty cell."""
    values = np.array([_number(cell) for cell in column.cells])
    for row in np.flatnonzero(np.isinf(values))[:1]:
        unit = f" [{column.unit}]" if column.unit else ""
        where = f"{table.name}:{table.lines[row]}: column {column.name!r}{unit}"
        raise InputError(f"{where}: {shown(column.cells[row])} is not a finite number")
    return values


def _without_duplicates(file: Path, columns: list[_Column], roles: Table | None) -> list[_Column]:
    """Leave out columns of one name, unless a role asks for that name, which is an InputError."""
    names = [column.name for column in columns]
    twice = {name for name in names if names.count(name) > 1}
    asked = {v if isinstance(v, str) else v.get("signal") for v in roles.values.values()} if roles else twice
    if name := next((name for name in names if name in twice & asked), None):
        raise InputError(f"{file}:1: two columns are called {name!r}")
    return [column for column in columns if column.name not in twice]


def _by_role(file: Path, columns: Sequence[_Column]) -> tuple[Source, ...]:
    """Return the source of each role, of columns that have the names of roles."""
    sources: dict[str, Source] = {}
    for column in columns:
        role = _ALSO.get(column.name, column.name)
        if role not in ROLES:
            ours = "_".join(_WORDS.get(word, word) for word in role.lower().split("_"))
            raise InputError(
                f"{file}:1: column {column.name!r} is no role{nearest(ours, (*_ALSO, *ROLES))}; rename it, leave it "
                "out, or name it in the [roles] of a vehicle file without dbc"
            )
        if role in sources:
            raise InputError(f"{file}:1: columns {sources[role].signal!r} and {column.name!r} are both {role}")
        si = to_si(column.unit, role)
        if si is None:
            units = ", ".join(known_units(role))
            raise InputError(
                f"{file}:1: column {column.name!r} has {f'unit {column.unit!r}' if column.unit else 'no unit'}; "
                f"write one of {units} behind it, such as {column.name} [{ROLES[role]}]"
            )
        sources[role] = Source(role, column.name, column.name, *si)
    return tuple(sources.values())


def _period(place: str, times: NDArray[np.int64], name: str) -> float | None:
    """Return the usual time between a column's values [s]; None if there are too few. times: of its values [ns].

    InputError if most values share their time with the one before and the others are far apart.
    """
    steps = np.diff(times)
    forward = steps[steps > 0]
    if not len(forward):
        return None
    period = float(np.median(forward)) * 1e-9
    if 2 * len(forward) < len(steps) and period > MAX_ROUNDING_S + 1e-6:
        raise InputError(
            f"{place}: {name!r} mostly has several values at one time, then none for "
            f"{period:.4g} s: the times are rounded; give them as float64, not float32, or since the start of the ride"
        )
    return period
