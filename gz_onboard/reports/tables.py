"""Tables of results: in memory, and as CSV, Parquet and JSON lines."""

from __future__ import annotations

import csv
import gzip
import json
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from itertools import repeat
from pathlib import Path
from typing import IO, Any, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Arrays of one length by the name of the column, with its unit: ``range[m]``."""


class Tabular(ABC):
    """A result that has a table."""

    @abstractmethod
    def to_table(self) -> Columns:
        """The table as numpy arrays of one length, by column: numbers with nan for what is not known, texts, times."""

    def to_arrow(self) -> Any:
        """The same as a `pyarrow.Table`; what is not known is null."""
        import pyarrow

        return pyarrow.table({name: pyarrow.array(a, from_pandas=True) for name, a in self.to_table().items()})

    def to_pandas(self) -> Any:
        """The same as a `pandas.DataFrame`."""
        import pandas

        return pandas.DataFrame(self.to_table())


def columns_of(rows: Sequence[Mapping[str, object]], names: Mapping[str, str]) -> Columns:
    """The columns of `rows`; names: of each key that becomes a column the column's."""
    return {column: array_of([row.get(key) for row in rows]) for key, column in names.items()}


def array_of(values: Sequence[object]) -> NDArray[Any]:
    """Texts, truth values, or numbers with nan for None."""
    if any(isinstance(value, str) for value in values):
        return np.array(["" if value is None else str(value) for value in values], dtype=object)
    if values and all(isinstance(value, bool) for value in values):
        return np.array(values, dtype=bool)
    numbers = [float(value) if isinstance(value, int | float) else np.nan for value in values]
    return np.array(numbers, dtype=float)


def time_array(times: Sequence[int]) -> NDArray[np.datetime64]:
    """Times [ns since the epoch] as dates."""
    return np.array(times, dtype="datetime64[ns]")


def table_columns(descriptions: Mapping[str, str]) -> dict[str, str]:
    """Return the column of each field of a row, ``name[unit]``: the unit is the first word of its description.

    The field ``time``, since the first frame, is ``elapsed``: a table's first column is the time of the log.
    """
    columns = {}
    for name, text in descriptions.items():
        unit = re.split(r"[ ,]", text)[0]
        columns[name] = ("elapsed" if name == "time" else name) + (f"[{unit}]" if unit not in ("", "1") else "")
    return columns


def beside_time(name: str) -> str:
    """Return the name of a column next to ``time``, that of the log: a signal may be called ``time`` as well."""
    return "time_signal" if name == "time" else name


def write_table(
    out: Path,
    columns: Mapping[str, Sequence[object]],
    times: Sequence[int] | None = None,
    kinds: Mapping[str, type] | None = None,
) -> None:
    """Write a table to a .csv, .parquet or .jsonl file, its first column the `times` [ns], if there are any.

    With times, numbers have the 15 digits that a float has for sure: 28 times 0.1 is 2.8, not 2.8000000000000003.
    kinds: str, int, bool or float of a column in Parquet; of others str if it has a text, else float.
    """
    if table_suffix(out) == ".parquet":
        import pyarrow.parquet as pq

        pq.write_table(_arrow_table(times, columns, kinds or {}), out)
        return
    rows = zip(*columns.values(), strict=True)
    with open_text(out) as stream:
        if table_suffix(out) == ".jsonl":
            named = (dict(zip(columns, row, strict=True)) for row in rows)
            stamps = repeat(None) if times is None else times
            stream.writelines(map(json_line, stamps, named))
            return
        writer = csv.writer(stream)
        writer.writerow(columns if times is None else ["time[s]", *columns])
        if times is None:
            writer.writerows(rows)
        else:
            writer.writerows([_seconds(t), *map(_decimal, row)] for t, row in zip(times, rows, strict=True))


def table_suffix(out: Path) -> str:
    """The suffix that says the format, without the .gz of a packed file."""
    return (out.with_suffix("") if out.suffix.lower() == ".gz" else out).suffix.lower()


def open_text(out: Path) -> IO[str]:
    """`out` to be written as text, packed if its name ends in .gz."""
    if out.suffix.lower() == ".gz":
        return cast("IO[str]", gzip.open(out, "wt", newline=""))
    return out.open("w", newline="")


def _arrow_table(
    times: Sequence[int] | None, columns: Mapping[str, Sequence[object]], kinds: Mapping[str, type]
) -> Any:
    """A pyarrow table of `columns` over ``time``; None stays null. kinds: as of `write_table`."""
    import pyarrow as pa

    arrays = {} if times is None else {"time": pa.array(times, pa.timestamp("ns", "UTC"))}
    for column, values in columns.items():
        name = column if times is None else beside_time(column)
        kind = kinds.get(name) or (str if any(isinstance(value, str) for value in values) else float)
        if kind in (int, bool):
            arrays[name] = pa.array(values, pa.int64() if kind is int else pa.bool_())
        elif kind is str:
            arrays[name] = pa.array([None if value is None else str(value) for value in values], pa.string())
        else:
            arrays[name] = pa.array([_number(value) for value in values], pa.float64())
    return pa.table(arrays)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def json_line(time_ns: int | None, row: Mapping[str, object]) -> str:
    """A line of JSON, the time in seconds to the nanosecond, which no float has."""
    if time_ns is None:
        return json.dumps(row, ensure_ascii=False) + "\n"
    text = json.dumps({name: _decimal(value) for name, value in row.items()}, ensure_ascii=False)
    return f'{{"time[s]": {_seconds(time_ns)}{", " if row else ""}{text[1:]}\n'


def _decimal(value: object) -> object:
    """`value`, a float to the 15 digits that it has for sure."""
    return float(f"{value:.15g}") if isinstance(value, float) else value


def _seconds(time_ns: int) -> str:
    seconds, rest = divmod(time_ns, 1_000_000_000)
    return f"{seconds}.{rest:09d}"
