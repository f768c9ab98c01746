"""Tables of frames, signals or estimates, as CSV, Parquet and JSON lines: a row for each frame, or for each value."""

from __future__ import annotations

import csv
import gzip
import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Protocol, cast

from gz_onboard.bus.signals import Decoded, Values
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, TRANSMITTED, Frame

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

        table = _arrow_table(times, {name: [row[name] for row in rows] for name in self.columns[message]}, {})
        if message not in self.writers:
            path = self.directory / f"{message}.parquet"
            self.writers[message] = self.stack.enter_context(pq.ParquetWriter(path, table.schema))
        self.writers[message].write_table(table)


class JsonTables(_Tables):
    """``MESSAGE.jsonl``."""

    def write(self, message: str, times: list[int], rows: list[Values]) -> None:
        """As of `Sink`."""
        if message not in self.writers:
            self.writers[message] = self.stack.enter_context((self.directory / f"{message}.jsonl").open("w"))
        self.writers[message].writelines(_json_line(t, row) for t, row in zip(times, rows, strict=True))


class JsonLong:
    """One file, a line for each frame: ``{"time[s]": ..., "message": ..., SIGNAL: ..., ...}``."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def write(self, message: str, times: list[int], rows: list[Values]) -> None:
        """As of `Sink`."""
        lines = (_json_line(t, {"message": message, **row}) for t, row in zip(times, rows, strict=True))
        self._stream.writelines(lines)


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
            pa.array([_number(v) for row in rows for v in row.values()], pa.float64()),
        ]
        self._writer.write_table(pa.table(arrays, schema=self._schema))


FRAME = ("channel", "identifier", "extended", "remote", "error", "sent", "data")
"""What a table of frames has beside the time."""


def write_frame_table(out: Path, batches: Iterable[list[Frame]]) -> int:
    """Write a row for each frame to a .parquet or .jsonl file; gives how many it were.

    identifier: without its flags, which are columns. sent: by ourselves. data: hexadecimal.
    """
    count = 0
    with ExitStack() as stack:
        writer = None
        stream = None if out.suffix.lower() == ".parquet" else stack.enter_context(open_text(out))
        for batch in batches:
            count += len(batch)
            if stream:
                stream.writelines(
                    _json_line(frame[0], dict(zip(FRAME, _frame_row(frame), strict=True))) for frame in batch
                )
                continue
            import pyarrow as pa
            import pyarrow.parquet as pq

            columns = frame_columns(batch)
            times = pa.array([frame[0] for frame in batch], pa.timestamp("ns", "UTC"))
            table = pa.table({"time": times, **{name: pa.array(column) for name, column in columns.items()}})
            writer = writer or stack.enter_context(pq.ParquetWriter(out, table.schema))
            writer.write_table(table)
    return count


def frame_columns(frames: Sequence[Frame]) -> dict[str, Sequence[Any]]:
    """By the names of `FRAME`; of no frame each is empty."""
    rows = list(map(_frame_row, frames))
    return {name: [row[i] for row in rows] for i, name in enumerate(FRAME)}


def _frame_row(frame: Frame) -> tuple[object, ...]:
    """The values of `FRAME`."""
    _, identifier, data, channel = frame
    flags = (bool(identifier & flag) for flag in (EFF_FLAG, RTR_FLAG, ERR_FLAG))
    plain = identifier & ~(EFF_FLAG | RTR_FLAG | ERR_FLAG)
    return channel & ~TRANSMITTED, plain, *flags, bool(channel & TRANSMITTED), data.hex()


def write_table(
    out: Path,
    columns: Mapping[str, Sequence[object]],
    times: Sequence[int] | None = None,
    kinds: Mapping[str, type] | None = None,
) -> None:
    """Write a table to a .csv, .parquet or .jsonl file, its first column the `times` [ns], if there are any.

    kinds: str, int or float of a column in Parquet; of others str if it has a text, else float.
    """
    suffix = out.with_suffix("").suffix if out.suffix.lower() == ".gz" else out.suffix
    if suffix.lower() == ".parquet":
        import pyarrow.parquet as pq

        pq.write_table(_arrow_table(times, columns, kinds or {}), out)
        return
    rows = zip(*columns.values(), strict=True)
    with open_text(out) as stream:
        if suffix.lower() == ".jsonl":
            named = (dict(zip(columns, row, strict=True)) for row in rows)
            if times is None:
                stream.writelines(json.dumps(row, ensure_ascii=False) + "\n" for row in named)
            else:
                stream.writelines(_json_line(t, row) for t, row in zip(times, named, strict=True))
            return
        writer = csv.writer(stream)
        if times is None:
            writer.writerow(columns)
            writer.writerows(rows)
        else:
            writer.writerow(["time[s]", *columns])
            writer.writerows([_seconds(t), *row] for t, row in zip(times, rows, strict=True))


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
    for name, values in columns.items():
        kind = kinds.get(name) or (str if any(isinstance(value, str) for value in values) else float)
        if kind is int:
            arrays[name] = pa.array(values, pa.int64())
        elif kind is str:
            arrays[name] = pa.array([None if value is None else str(value) for value in values], pa.string())
        else:
            arrays[name] = pa.array([_number(value) for value in values], pa.float64())
    return pa.table(arrays)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _json_line(time_ns: int, row: Mapping[str, object]) -> str:
    """A line of JSON, the time in seconds to the nanosecond, which no float has."""
    rest = {name: _decimal(value) if isinstance(value, float) else value for name, value in row.items()}
    text = json.dumps(rest, ensure_ascii=False)
    return f'{{"time[s]": {_seconds(time_ns)}{", " if rest else ""}{text[1:]}\n'


def _decimal(value: float | None) -> float | None:
    """`value` to the 15 digits that a float has for sure: 28 times 0.1 is 2.8, not 2.8000000000000003."""
    return float(f"{value:.15g}") if isinstance(value, float) else value


def _seconds(time_ns: int) -> str:
    seconds, rest = divmod(time_ns, 1_000_000_000)
    return f"{seconds}.{rest:09d}"
