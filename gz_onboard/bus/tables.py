"""Tables of signals or estimates, as CSV and Parquet: a row for each frame, or for each value."""

from __future__ import annotations

import csv
import gzip
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Protocol, cast

from gz_onboard.bus.signals import Decoded, Values

ROWS = 20_000  # of a message, which are written at once


class Sink(Protocol):
    """Where rows of signals go, message by message."""

    def write(self, message: str, times: list[int], rows: list[Values]) -> None:
        """Write the rows of one message."""


def write_signals(decoded: Iterable[Decoded], sink: Sink) -> int:
    """Hand the rows to the sink in portions of one message; returns the number of frames."""
    pending: dict[str, tuple[list[int], list[Values]]] = {}
    count = 0
    for time_ns, message, values in decoded:
        times, rows = pending.setdefault(message, ([], []))
        times.append(time_ns)
        rows.append(values)
        count += 1
        if len(times) >= ROWS:
            sink.write(message, *pending.pop(message))
    for message, (times, rows) in pending.items():
        sink.write(message, times, rows)
    return count


@dataclass
class _Tables:
    """A table for each message in a directory, open until `stack` is left. columns: units by column, by message."""

    directory: Path
    columns: Mapping[str, Mapping[str, str]]
    stack: ExitStack
    writers: dict[str, Any] = field(default_factory=dict)


class CsvTables(_Tables):
    """``MESSAGE.csv``."""

    def write(self, message: str, times: list[int], rows: list[Values]) -> None:
        """As of `Sink`."""
        names = list(self.columns[message])
        writer = self.writers.get(message)
        if writer is None:
            stream = self.stack.enter_context((self.directory / f"{message}.csv").open("w", newline=""))
            writer = self.writers[message] = csv.writer(stream)
            writer.writerow(["time[s]", *names])
        writer.writerows(
            [_seconds(t), *(_decimal(row[name]) for name in names)] for t, row in zip(times, rows, strict=True)
        )


class ParquetTables(_Tables):
    """``MESSAGE.parquet``."""

    def write(self, message: str, times: list[int], rows: list[Values]) -> None:
        """As of `Sink`."""
        import pyarrow.parquet as pq

        table = _arrow_table(times, {name: [row[name] for row in rows] for name in self.columns[message]})
        if message not in self.writers:
            path = self.directory / f"{message}.parquet"
            self.writers[message] = self.stack.enter_context(pq.ParquetWriter(path, table.schema))
        self.writers[message].write_table(table)


class CsvLong:
    """One table, a row for each value."""

    def __init__(self, stream: IO[str]) -> None:
        self._writer = csv.writer(stream)
        self._writer.writerow(["time[s]", "message", "signal", "value"])

    def write(self, message: str, times: list[int], rows: list[Values]) -> None:
        """As of `Sink`."""
        for time_ns, row in zip(times, rows, strict=True):
            seconds = _seconds(time_ns)
            self._writer.writerows((seconds, message, name, _decimal(value)) for name, value in row.items())


class ParquetLong:
    """As `CsvLong`."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        name = pa.dictionary(pa.int32(), pa.string())
        fields = [("time", pa.timestamp("ns", "UTC")), ("message", name), ("signal", name), ("value", pa.float64())]
        self._schema = pa.schema(fields)
        self._writer = stack.enter_context(pq.ParquetWriter(path, self._schema))

    def write(self, message: str, times: list[int], rows: list[Values]) -> None:
        """As of `Sink`."""
        import pyarrow as pa

        names = list(rows[0])
        repeated = [t for t in times for _ in names]
        arrays = [
            pa.array(repeated, self._schema.field("time").type),
            pa.array([message] * len(repeated)).dictionary_encode(),
            pa.array(names * len(rows)).dictionary_encode(),
            pa.array([None if v is None else float(v) for row in rows for v in row.values()], pa.float64()),
        ]
        self._writer.write_table(pa.table(arrays, schema=self._schema))


def write_table(out: Path, times: Sequence[int], columns: Mapping[str, Sequence[object]]) -> None:
    """Write one row for each of `times` [ns] to a .csv or .parquet file."""
    if out.suffix.lower() != ".parquet":
        with open_text(out) as stream:
            writer = csv.writer(stream)
            writer.writerow(["time[s]", *columns])
            writer.writerows([_seconds(t), *row] for t, *row in zip(times, *columns.values(), strict=True))
        return
    import pyarrow.parquet as pq

    pq.write_table(_arrow_table(times, columns), out)


def open_text(out: Path) -> IO[str]:
    """`out` to be written as text, packed if its name ends in .gz."""
    if out.suffix.lower() == ".gz":
        return cast("IO[str]", gzip.open(out, "wt", newline=""))
    return out.open("w", newline="")


def _arrow_table(times: Sequence[int], columns: Mapping[str, Sequence[object]]) -> Any:
    """A pyarrow table of `columns` over ``time``: text where any value is, else floating point; None stays null."""
    import pyarrow as pa

    arrays = {"time": pa.array(times, pa.timestamp("ns", "UTC"))}
    for name, values in columns.items():
        if any(isinstance(value, str) for value in values):
            arrays[name] = pa.array([None if value is None else str(value) for value in values], pa.string())
        else:
            numbers = [float(value) if isinstance(value, int | float) else None for value in values]
            arrays[name] = pa.array(numbers, pa.float64())
    return pa.table(arrays)


def _decimal(value: float | None) -> float | None:
    """`value` to the 15 digits that a float has for sure: 28 times 0.1 is 2.8, not 2.8000000000000003."""
    return float(f"{value:.15g}") if isinstance(value, float) else value


def _seconds(time_ns: int) -> str:
    seconds, rest = divmod(time_ns, 1_000_000_000)
    return f"{seconds}.{rest:09d}"
