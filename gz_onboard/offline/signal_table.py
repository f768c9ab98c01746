"""A ride as a table of signals, CSV or Parquet, in place of a log of frames.

    time [s],pack_voltage [V],pack_current [A],speed [km/h]
    0.0,52.1,3.2,0.0
    0.1,,3.4,0.2

Each value travels as a frame of its own, a message of one floating-point signal, so that all that is done with frames
is done with it too: no command knows of tables.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gz_onboard.can.mapping import BusMapping, Source, TimeColumn, column_sources, known_units, to_si
from gz_onboard.errors import InputError, nearest, shown, unreadable
from gz_onboard.events import EFF_FLAG, ROLES
from gz_onboard.recording.frames import TIME_LIMIT_NS, FrameColumns
from gz_onboard.recording.readers.contents import LogDamage, unpacked
from gz_onboard.routes.columns import separated

if TYPE_CHECKING:
    from cantools.database.can import Database

    from gz_onboard.toml import Table

_FIRST_IDENTIFIER = 0x1000_0000  # of 29 bits: no range frames have it
_COLUMN = re.compile(r"\s*(?P<name>.*?)\s*(?:[\[(]\s*(?P<unit>[^\])]*?)\s*[\])])?\s*")
_TIME = re.compile(r"\s*(?:time|timestamp|t)(?:(?:_|\s+|\s*[\[(]\s*)(?P<unit>s|ms)\s*[\])]?)?\s*", re.I)
_SECONDS = {"s": 1.0, "ms": 1e-3}
_ALSO = {"speed": "vehicle_speed"}
_WORDS = {"battery": "pack", "soc": "bms_state_of_charge", "temp": "temperature", "velocity": "speed"}
_MISSING = ("", "nan", "nat", "null", "none", "n/a", "<na>")
_LAST = ("motor_speed", "inverter_voltage", "pack_voltage")  # the estimator makes its step with the last that is there
_LONGEST_STEP = 30.0  # s, the usual one from row to row: beyond it nothing can be followed
_COARSEST = 1.0  # s: times of whole seconds are clocks', coarser ones that several rows share were rounded
_1970 = datetime(1970, 1, 1, tzinfo=UTC)


class _Column(NamedTuple):
    """A column as its header says; at: its index."""

    name: str
    unit: str
    at: int


Rows = Sequence[tuple[int, Sequence[Any]]]
"""(line, or row from 1 of a table that has no lines, and its cells), one for each row."""


@dataclass(frozen=True)
class SignalTable:
    """A ride as a table: its header, with a unit behind each name, and its rows. name: what errors call it."""

    name: Path
    header: list[str]
    rows: Rows


def read_table(file: Path) -> SignalTable:
    """The table in a CSV or Parquet file; InputError if there is none."""
    return SignalTable(file, *(_parquet(file) if _is_parquet(file) else _csv(file)))


def signal_frames(table: SignalTable, mapping: BusMapping) -> tuple[BusMapping, FrameColumns]:
    """The mapping that the ride in a table is decoded by, and its frames, for a vehicle with `mapping`.

    The columns have the names of roles; or, for a vehicle without DBC files, those that its roles name. Raises
    InputError naming file, line, column, value and unit for what is neither a time nor a number nor an empty cell, for
    a time that decreases, and for a column that is no role or has a unit that is none of its role's.
    """
    file, header, rows = table.name, table.header, table.rows
    if len(header) < 2:
        raise InputError(f"{file}:1: a table of signals has a column of times and one for each signal")
    time_at, time = _time_column(file, header, mapping.time)
    times = _times(file, time, [(line, row[time_at]) for line, row in rows])
    columns = [
        _column(text, at)
        for at, text in enumerate(header)
        if at != time_at
        and (text.strip() or not all(_is_missing(row[at]) for _, row in rows))  # a separator at each line's end
    ]
    columns = _without_duplicates(file, columns, mapping.columns)
    database = _database(columns)
    sources = column_sources(database, mapping.columns, file) if mapping.columns else _by_role(file, columns)
    played = {source.signal: source.role for source in sources}
    order = {role: i for i, role in enumerate(_LAST)}
    used = sorted((c for c in columns if c.name in played), key=lambda c: order.get(played[c.name], -1))
    values = {column.name: _values(file, rows, column) for column in used}
    periods = {
        name: period
        for name, found in values.items()
        if (period := _period(f"{file}: {time.name}", times, name, found))
    }
    numbers = {m.name: m.frame_id | EFF_FLAG for m in database.messages}
    made = replace(mapping, database=database, sources=sources, protection={}, periods=periods, j1939=False)
    return made, _frames(times, [numbers[name] for name in values], list(values.values()))


def is_time(name: str) -> bool:
    """Whether a column of that name is the time."""
    return _TIME.fullmatch(name) is not None


def _is_parquet(file: Path) -> bool:
    with file.open("rb") as stream:
        return stream.read(4) == b"PAR1"


def _csv(file: Path) -> tuple[list[str], Rows]:
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
    return header, rows


def _parquet(file: Path) -> tuple[list[str], Rows]:
    try:
        import pyarrow
        import pyarrow.parquet

        from gz_onboard.offline.cells import rows_of
    except ImportError as error:
        raise InputError(
            f"{file}: Parquet needs pyarrow: pip install 'gz-onboard[lab]'; or give the table as CSV"
        ) from error
    try:
        table = pyarrow.parquet.ParquetFile(file).read()  # `read_table` chokes on two columns of one name
    except (OSError, pyarrow.ArrowException) as error:
        raise InputError(f"{file}: not a Parquet file: {error}") from error
    return rows_of(list(zip(table.column_names, table.columns, strict=True)), str(file))


def _time_column(file: Path, header: Sequence[str], configured: TimeColumn | None) -> tuple[int, TimeColumn]:
    """The index of the column of times, and its name as errors call it."""
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


def _without_duplicates(file: Path, columns: list[_Column], roles: Table | None) -> list[_Column]:
    """`columns` without those of one name that no role asks for; InputError if one does."""
    names = [column.name for column in columns]
    twice = {name for name in names if names.count(name) > 1}
    asked = {v if isinstance(v, str) else v.get("signal") for v in roles.values.values()} if roles else twice
    if name := next((name for name in names if name in twice & asked), None):
        raise InputError(f"{file}:1: two columns are called {name!r}")
    return [column for column in columns if column.name not in twice]


def _times(file: Path, column: TimeColumn, rows: Sequence[tuple[int, Any]]) -> list[int]:
    """The time of each row [ns]; rows: (line, cell)."""
    name, unit = column.name, column.unit
    times: list[int] = []
    for line, cell in rows:
        try:
            times.append(_nanoseconds(_parsed_date(cell, column.format), unit))
        except KeyError:
            raise InputError(
                f"{file}:{line}: {name}: {shown(cell)} has no unit; call the column 'time [s]' or 'time [ms]'"
            ) from None
        except (TypeError, ValueError, OverflowError):
            what = "neither a number nor a time of ISO 8601"
            what = f"no date of the format {column.format}" if column.format else what
            raise InputError(f"{file}:{line}: {name}: {shown(cell)} is {what}") from None
        if not -TIME_LIMIT_NS < times[-1] < TIME_LIMIT_NS:
            raise InputError(
                f"{file}:{line}: {name}: {shown(cell)} {unit or 's'} is not a plausible time; if it is in "
                "ms, call the column 'time [ms]'"
            )
        if len(times) > 1 and times[-1] < times[-2]:
            raise InputError(f"{file}:{line}: {name}: {shown(cell)} is before the time of the row above")
    if len(times) < 2:
        raise InputError(f"{file}: {len(times)} rows below the names of the columns are no ride")
    if times[0] == times[-1]:
        raise InputError(f"{file}: {name}: all rows have the same time, {shown(rows[0][1])}, which is no ride")
    if (step := median(after - before for before, after in pairwise(times)) * 1e-9) > _LONGEST_STEP + 1e-6:
        raise InputError(
            f"{file}: {name}: from row to row it is usually {step:.4g} s, and {_LONGEST_STEP:g} s are the most; if "
            "the times are in ms, call the column 'time [ms]'"
        )
    return [time - times[0] for time in times] if times[0] < 0 else times


def _parsed_date(cell: object, form: str) -> object:
    """A text of this `form` as its date; what is a date already, or without a form, as it is."""
    return datetime.strptime(str(cell).strip(), form) if form and not isinstance(cell, date) else cell


def _nanoseconds(cell: object, unit: str) -> int:
    """A time [ns]: a number in `unit`, a duration, or since 1970 that of a date, which is UTC if it has no zone.

    TypeError, ValueError or OverflowError for what is none, KeyError for a number without a unit.
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
        moment = cell if cell.tzinfo else cell.replace(tzinfo=UTC)
        cell = moment - _1970
    if isinstance(cell, timedelta):
        return cell // timedelta(microseconds=1) * 1000
    number = float(cell)  # type: ignore[arg-type]  # of Decimal too
    return round(number * _SECONDS[unit] * 1e9)


def _column(text: str, at: int) -> _Column:
    header = _COLUMN.fullmatch(text)
    return _Column(header["name"], header["unit"] or "", at) if header else _Column(text, "", at)


def _is_missing(cell: object) -> bool:
    if isinstance(cell, int | float):
        return False
    return cell is None or str(cell).strip().lower() in _MISSING


def _values(file: Path, rows: Rows, column: _Column) -> list[float | None]:
    """The values of a column, None for an empty cell."""
    values: list[float | None] = []
    for line, row in rows:
        cell = row[column.at]
        if _is_missing(cell):
            values.append(None)
            continue
        try:
            value = float(cell)
        except (TypeError, ValueError, OverflowError):
            value = math.inf
        if math.isinf(value):
            unit = f" [{column.unit}]" if column.unit else ""
            raise InputError(f"{file}:{line}: column {column.name!r}{unit}: {shown(cell)} is not a finite number")
        values.append(None if math.isnan(value) else value)
    return values


def _database(columns: Sequence[_Column]) -> Database:
    """A message for each column, with one signal of the same name."""
    from cantools.database.can import Message, Signal
    from cantools.database.conversion import BaseConversion

    from gz_onboard.can.dbc import empty_database  # before cantools

    database = empty_database()
    for column in columns:
        conversion = BaseConversion.factory(is_float=True)
        signal = Signal(column.name, 0, 64, conversion=conversion, unit=column.unit or None)
        database.messages.append(
            Message(_FIRST_IDENTIFIER + column.at, column.name, 8, [signal], is_extended_frame=True)
        )
    database.refresh()
    return database


def _in_our_words(name: str) -> str:
    """A name with the words of our roles for those of others."""
    return "_".join(_WORDS.get(word, word) for word in name.lower().split("_"))


def _by_role(file: Path, columns: Sequence[_Column]) -> tuple[Source, ...]:
    """The source of each role, from columns that have the roles' names."""
    sources: dict[str, Source] = {}
    for column in columns:
        role = _ALSO.get(column.name, column.name)
        if role not in ROLES:
            meant = nearest(_in_our_words(role), (*_ALSO, *ROLES))
            raise InputError(
                f"{file}:1: column {column.name!r} is no role{meant}; rename it, leave it out, or name it in the "
                "[roles] of a vehicle file without dbc"
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


def _period(where: str, times: Sequence[int], name: str, values: Sequence[float | None]) -> float | None:
    """The usual time from one of a column's values to the next [s]; None if there are too few.

    InputError, which begins with `where`, if most share their time with the one before, and the others are far apart.
    """
    known = [time for time, value in zip(times, values, strict=True) if value is not None]
    steps = [after - before for before, after in pairwise(known)]
    forward = [step for step in steps if step]
    if not forward:
        return None
    period = median(forward) * 1e-9
    if 2 * len(forward) < len(steps) and period > _COARSEST + 1e-6:
        raise InputError(
            f"{where}: {name!r} mostly has several values at one time, then none for "
            f"{period:.4g} s: the times are rounded; give them as float64, not float32, or since the start of the ride"
        )
    return period


def _frames(
    times: Sequence[int], identifiers: Sequence[int], columns: Sequence[Sequence[float | None]]
) -> FrameColumns:
    """A frame for each value, row by row."""
    values = np.array(columns, float).reshape(len(columns), len(times)).T  # None becomes nan
    row, column = np.nonzero(~np.isnan(values))
    frames = FrameColumns.empty(len(row), 8)
    frames.time_ns[:], frames.identifier[:] = np.array(times, np.int64)[row], np.array(identifiers, np.uint32)[column]
    frames.length[:], frames.data[:] = 8, values[row, column].astype("<f8").view(np.uint8).reshape(-1, 8)
    return frames
