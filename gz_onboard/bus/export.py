"""``gz-onboard export``: turns a log into other formats of frames, tables of signals, or an MCAP of signals.

What is written is told by the name of the output:
- .log .blf .asc .trc .csv .mf4: the frames, in the format of candump, Vector, PEAK, python-can or ASAM;
- .parquet, or .csv with --signals: one table of all signals, a row for each value: time, message, signal, value;
- a directory (a name without a suffix): one table for each message, a row for each frame, a column for each signal;
- .mcap: everything that is in the log, and besides one JSON channel for each message at its full rate.

With --estimates, and of a log that holds nothing else (that of ``gz-onboard estimate``), the estimates: .csv, .parquet
or a directory, a row for each estimate.

Signals have the units of the DBC files, in their names: ``BMS_PackVoltage[V]``. What was not available is null.
"""

from __future__ import annotations

import argparse
import csv
import gzip
import heapq
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Protocol, cast

from gz_onboard.bus.logs import (
    LogDamage,
    json_channels,
    log_suffix,
    read_attachments,
    read_frames,
    read_metadata,
    read_samples,
)
from gz_onboard.bus.recorder import LogFile
from gz_onboard.bus.replay import log_section
from gz_onboard.bus.writers import write_blf, write_candump
from gz_onboard.errors import InputError, nearest
from gz_onboard.events import EFF_FLAG, Frame
from gz_onboard.options import add_shared

if TYPE_CHECKING:
    from cantools.database.can import Database, Message
    from cantools.database.can.signal import Signal

Values = dict[str, "float | int | None"]
Decoded = tuple[int, str, Values]
"""(time [ns], message, value by column): one frame's signals."""

ESTIMATE_TOPIC = "/estimate"  # as in gz_onboard.pipeline, which a part of bus may not import
_ROWS = 20_000
_TEXT_FORMATS = (".log", ".asc", ".trc", ".csv")
_FORMATS = (*_TEXT_FORMATS, ".blf", ".mf4", ".parquet", ".mcap")


# --- frames ----------------------------------------------------------------------------------------------------


def _open_text(out: Path) -> IO[str]:
    if out.suffix.lower() == ".gz":
        return cast("IO[str]", gzip.open(out, "wt", newline=""))
    return out.open("w", newline="")


def write_frames_as(out: Path, suffix: str, batches: Iterable[list[Frame]]) -> int:
    """Write the frames to `out` in the format of `suffix`; gives how many it were."""
    if suffix == ".log":
        with _open_text(out) as text:
            return write_candump(text, batches)
    if suffix == ".blf":
        with out.open("wb") as binary:
            return write_blf(binary, batches)
    from gz_onboard.bus._can import can
    from gz_onboard.bus.readers.pycan import message_of, with_asammdf

    if suffix == ".mf4":
        with_asammdf(out)
        writer: Any = can.io.mf4.MF4Writer(out)
    else:
        writer = can.Logger(out)
    count = 0
    with writer:
        for batch in batches:
            for frame in batch:
                writer.on_message_received(message_of(frame))
            count += len(batch)
    return count


# --- signals ---------------------------------------------------------------------------------------------------


class Decoder:
    """All signals of frames by a cantools database; what cannot be decoded is counted, never guessed."""

    def __init__(self, database: Database) -> None:
        from gz_onboard.bus.codec import raw_range

        self.unknown = 0
        self.undecodable = 0
        self.messages: dict[int, Message] = {
            message.frame_id | (EFF_FLAG if message.is_extended_frame else 0): message for message in database.messages
        }
        self.columns: dict[str, dict[str, str]] = {}
        self._signals: dict[str, list[tuple[str, Signal, float, float]]] = {}
        for message in database.messages:
            signals = [(column_name(s), s, *raw_range(s, not_available=True)) for s in message.signals]
            self._signals[message.name] = signals
            self.columns[message.name] = {name: s.unit or "" for name, s, _, _ in signals}

    def decode(self, batches: Iterable[list[Frame]]) -> Iterator[Decoded]:
        """One item for each frame that the database knows."""
        for batch in batches:
            for time_ns, identifier, data, _ in batch:
                message = self.messages.get(identifier)
                if message is None:
                    self.unknown += 1
                    continue
                values = self._values(message, data)
                if values is None:
                    self.undecodable += 1
                    continue
                yield time_ns, message.name, values

    def _values(self, message: Message, data: bytes) -> Values | None:
        if len(data) != message.length:
            return None
        try:
            raw = message.decode_simple(data, decode_choices=False, scaling=False)
        except Exception:  # cantools has several types of its own for data that do not fit
            return None
        values: Values = {}
        for name, signal, low, high in self._signals[message.name]:
            value = raw.get(signal.name)  # absent: another branch of the multiplexer
            if not isinstance(value, int | float) or _is_absent(signal, value, low, high):
                values[name] = None
            else:
                values[name] = signal.conversion.raw_to_scaled(value, decode_choices=False)  # type: ignore[assignment]
        return values


def column_name(signal: Signal) -> str:
    """``name[unit]``, or the name alone for a signal without a unit."""
    return f"{signal.name}[{signal.unit}]" if signal.unit else signal.name


def _is_absent(signal: Signal, raw: float, low: float, high: float) -> bool:
    """Whether a raw value is the code for not available (all ones, or the least of a signed signal), or NaN."""
    if signal.conversion.is_float:
        return math.isnan(raw)
    code = -(1 << (signal.length - 1)) if signal.is_signed else (1 << signal.length) - 1
    return signal.length >= 8 and raw == code and not low <= raw <= high


class _Sink(Protocol):
    """Where rows of signals go, message by message."""

    def write(self, message: str, times: list[int], rows: list[Values]) -> None: ...


def _write_signals(decoded: Iterable[Decoded], sink: _Sink) -> int:
    """Hand the rows to the sink in portions of one message; returns the number of frames."""
    pending: dict[str, tuple[list[int], list[Values]]] = {}
    count = 0
    for time_ns, message, values in decoded:
        times, rows = pending.setdefault(message, ([], []))
        times.append(time_ns)
        rows.append(values)
        count += 1
        if len(times) >= _ROWS:
            sink.write(message, *pending.pop(message))
    for message, (times, rows) in pending.items():
        sink.write(message, times, rows)
    return count


class _CsvTables:
    def __init__(self, directory: Path, columns: Mapping[str, Mapping[str, str]], stack: ExitStack) -> None:
        self._directory = directory
        self._columns = columns
        self._stack = stack
        self._writers: dict[str, Any] = {}

    def write(self, message: str, times: list[int], rows: list[Values]) -> None:
        names = list(self._columns[message])
        writer = self._writers.get(message)
        if writer is None:
            stream = self._stack.enter_context((self._directory / f"{message}.csv").open("w", newline=""))
            writer = self._writers[message] = csv.writer(stream)
            writer.writerow(["time[s]", *names])
        writer.writerows(
            [_seconds(t), *(_decimal(row[name]) for name in names)] for t, row in zip(times, rows, strict=True)
        )


class _CsvLong:
    def __init__(self, stream: IO[str]) -> None:
        self._writer = csv.writer(stream)
        self._writer.writerow(["time[s]", "message", "signal", "value"])

    def write(self, message: str, times: list[int], rows: list[Values]) -> None:
        for time_ns, row in zip(times, rows, strict=True):
            seconds = _seconds(time_ns)
            self._writer.writerows((seconds, message, name, _decimal(value)) for name, value in row.items())


class _ParquetTables:
    def __init__(self, directory: Path, columns: Mapping[str, Mapping[str, str]], stack: ExitStack) -> None:
        self._directory = directory
        self._columns = columns
        self._stack = stack
        self._writers: dict[str, Any] = {}

    def write(self, message: str, times: list[int], rows: list[Values]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        arrays = {"time": pa.array(times, pa.timestamp("ns", "UTC"))}
        for name in self._columns[message]:
            arrays[name] = pa.array([_number(row[name]) for row in rows], pa.float64())
        table = pa.table(arrays)
        if message not in self._writers:
            path = self._directory / f"{message}.parquet"
            self._writers[message] = self._stack.enter_context(pq.ParquetWriter(path, table.schema))
        self._writers[message].write_table(table)


class _ParquetLong:
    def __init__(self, path: Path, stack: ExitStack) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        name = pa.dictionary(pa.int32(), pa.string())
        fields = [("time", pa.timestamp("ns", "UTC")), ("message", name), ("signal", name), ("value", pa.float64())]
        self._schema = pa.schema(fields)
        self._writer = stack.enter_context(pq.ParquetWriter(path, self._schema))

    def write(self, message: str, times: list[int], rows: list[Values]) -> None:
        import pyarrow as pa

        names = list(rows[0])
        repeated = [t for t in times for _ in names]
        arrays = [
            pa.array(repeated, self._schema.field("time").type),
            pa.array([message] * len(repeated)).dictionary_encode(),
            pa.array(names * len(rows)).dictionary_encode(),
            pa.array([_number(value) for row in rows for value in row.values()], pa.float64()),
        ]
        self._writer.write_table(pa.table(arrays, schema=self._schema))


def _number(value: float | None) -> float | None:
    return None if value is None else float(value)


def _decimal(value: float | None) -> float | None:
    """`value` to the 15 digits that a float has for sure: 28 times 0.1 is 2.8, not 2.8000000000000003."""
    return float(f"{value:.15g}") if isinstance(value, float) else value


def _seconds(time_ns: int) -> str:
    seconds, rest = divmod(time_ns, 1_000_000_000)
    return f"{seconds}.{rest:09d}"


# --- MCAP ------------------------------------------------------------------------------------------------------


def _write_mcap(log: Path, out: Path, decoder: Decoder, batches: Iterator[list[Frame]], section: Any) -> int:
    """Everything that is in the log, and the signals of each message on a topic ``/can/MESSAGE``, by time."""
    first = next(batches, None)
    if first is None:
        raise InputError(f"{log}: no frames in the chosen part")
    metadata = {**read_metadata(log), "expanded_from": log.name}
    with out.open("wb") as stream:
        file = LogFile(stream, first[0][0], metadata, read_attachments(log))
        recorded = json_channels(log)
        for topic, (schema, of_channel) in recorded.items():
            file.channel(topic, json.loads(schema), of_channel)
        by_identifier = {message.name: f"/can/{message.name}" for message in decoder.messages.values()}
        for message in decoder.messages.values():
            if by_identifier[message.name] not in recorded:
                file.channel(by_identifier[message.name], _message_schema(message, decoder.columns[message.name]))

        def logged() -> Iterator[list[Frame]]:
            file.frames(first)
            yield first
            for batch in batches:
                file.frames(batch)
                yield batch

        samples = ((time_ns, topic, values) for topic, time_ns, values in read_samples(log, *section))
        signals = ((time_ns, by_identifier[name], values) for time_ns, name, values in decoder.decode(logged()))
        count = 0
        for time_ns, topic, values in heapq.merge(signals, samples, key=lambda item: item[0]):
            file.sample(topic, time_ns, values)
            count += 1
        file.close()
    return count


def _message_schema(message: Message, columns: Mapping[str, str]) -> dict[str, Any]:
    properties = {}
    for (name, unit), signal in zip(columns.items(), message.signals, strict=True):
        text = ", ".join(part for part in (unit, signal.comment or "") if part)
        properties[name] = {"type": ["number", "null"], "description": text}
    return {"title": message.name, "type": "object", "properties": properties}


# --- estimates -------------------------------------------------------------------------------------------------


def _write_estimates(log: Path, out: Path, suffix: str, table_format: str, section: tuple[float, float | None]) -> int:
    """The rows of the topic of estimates, a column for each field, with its unit; gives how many."""
    if suffix not in (".csv", ".parquet", ""):
        raise InputError(f"{out}: estimates can be written into .csv, .parquet or a directory")
    found = [(time_ns, values) for topic, time_ns, values in read_samples(log) if topic == ESTIMATE_TOPIC]
    if not found:
        raise InputError(f"{log}: holds no estimates ({ESTIMATE_TOPIC})")
    start_s, end_s = section
    low = found[0][0] + round(start_s * 1e9)
    high = math.inf if end_s is None else found[0][0] + round(end_s * 1e9)
    rows = [(time_ns, values) for time_ns, values in found if low <= time_ns < high]
    columns = _estimate_columns(log)
    if suffix == "":
        out.mkdir(parents=True, exist_ok=True)
        suffix = f".{table_format}"
        out /= f"estimate{suffix}"
    if suffix == ".csv":
        with _open_text(out) as stream:
            writer = csv.writer(stream)
            writer.writerow(["time[s]", *columns.values()])
            writer.writerows([_seconds(t), *(values.get(name) for name in columns)] for t, values in rows)
        return len(rows)
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = {"time": pa.array([t for t, _ in rows], pa.timestamp("ns", "UTC"))}
    for name, column in columns.items():
        values = [row.get(name) for _, row in rows]
        if any(isinstance(value, str) for value in values):
            arrays[column] = pa.array([None if value is None else str(value) for value in values], pa.string())
        else:
            numbers = [float(v) if isinstance(v, int | float) else None for v in values]
            arrays[column] = pa.array(numbers, pa.float64())
    pq.write_table(pa.table(arrays), out)
    return len(rows)


def _estimate_columns(log: Path) -> dict[str, str]:
    """Field -> column of the table, ``name[unit]``: the unit is the first word of the schema's description.

    The field ``time``, since the first frame, is ``elapsed``: the table's first column is the time of the log.
    """
    try:
        properties = json.loads(json_channels(log)[ESTIMATE_TOPIC][0])["properties"]
        units = {name: str(about.get("description", "")) for name, about in properties.items()}
    except (ValueError, LookupError, AttributeError, TypeError) as error:
        raise InputError(f"{log}: the schema of {ESTIMATE_TOPIC} is not one of ours: {error!r}") from None
    words = {name: re.split(r"[ ,]", unit)[0] for name, unit in units.items()}
    columns = {name: "elapsed" if name == "time" else name for name in words}
    return {
        name: f"{columns[name]}[{unit}]" if unit not in ("", "1") else columns[name] for name, unit in words.items()
    }


# --- the command -----------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``gz-onboard export``."""
    add_shared(parser, "log")
    out = (
        "frames: .log .blf .asc .trc .csv .mf4; signals: .parquet (one long table), .mcap (for Foxglove), or a name "
        "without suffix (a folder with one table per message)"
    )
    parser.add_argument("out", type=Path, metavar="OUT", help=out)
    parser.add_argument("--estimates", action="store_true", help="write the estimates, one row each")
    parser.add_argument("--signals", action="store_true", help="write signals, not frames, to .csv")
    tables = "format of the tables in a folder (default: %(default)s)"
    parser.add_argument("--table-format", choices=["parquet", "csv"], default="parquet", help=tables)
    dbc = "DBC files to decode the signals (default: those attached to the log)"
    parser.add_argument("--dbc", type=Path, nargs="+", metavar="FILE", help=dbc)
    add_shared(parser, "--from", "--to")


def run(args: argparse.Namespace) -> int:
    """Run ``gz-onboard export``; raises InputError for what cannot be used."""
    log, out = args.log, args.out
    suffix = out_suffix(out)
    if out.exists() and out.resolve() == log.resolve():
        raise InputError(f"{out}: is the log itself")
    if args.estimates or _holds_only_estimates(log):
        count = _written(out, lambda: _write_estimates(log, out, suffix, args.table_format, (args.start, args.end)))
        print(f"wrote {out}: {count} estimates")
        return 0
    section = log_section(log, args.start, args.end)
    damages: list[LogDamage] = []
    rest = read_frames(log, *section, damages.append)
    first = next(rest, None)
    if first is None:
        where = "this log" if section == (None, None) else "the chosen part"
        why = "".join(f"; damaged at {damage.place}: {damage.reason}" for damage in damages)
        raise InputError(f"{log}: no frames in {where}{why}")
    batches = chain([first], rest)
    if suffix in (".parquet", ".mcap", "") or args.signals:
        decoder = Decoder(_database(log, args.dbc))
        count = _written(out, lambda: _export_signals(log, out, suffix, args.table_format, decoder, batches, section))
        left = f"; {decoder.unknown} frames are in no DBC file, {decoder.undecodable} do not fit theirs"
    else:
        count = _written(out, lambda: write_frames_as(out, suffix, batches))
        left = ""
    for damage in damages:
        print(f"damaged log: {damage}")
    print(f"wrote {out}: {count} {'samples' if suffix == '.mcap' else 'frames'}{left}")
    return 0


def _written(out: Path, write: Callable[[], int]) -> int:
    """What `write` gives; InputError for what the operating system refuses."""
    try:
        return write()
    except OSError as error:
        raise InputError(f"{out}: cannot be written: {error.strerror or error}") from None


def _holds_only_estimates(log: Path) -> bool:
    """Whether it is a log of ours that holds estimates and not a single frame."""
    if log_suffix(log) != ".mcap" or ESTIMATE_TOPIC not in json_channels(log):
        return False
    return next(read_frames(log, on_damage=lambda _: None), None) is None


def _export_signals(
    log: Path, out: Path, suffix: str, table_format: str, decoder: Decoder, batches: Iterator[list[Frame]], section: Any
) -> int:
    if suffix == ".mcap":
        return _write_mcap(log, out, decoder, batches, section)
    with ExitStack() as stack:
        sink: _Sink
        if suffix == ".parquet":
            sink = _ParquetLong(out, stack)
        elif suffix == ".csv":
            sink = _CsvLong(stack.enter_context(_open_text(out)))
        elif suffix == "":
            out.mkdir(parents=True, exist_ok=True)
            tables = _ParquetTables if table_format == "parquet" else _CsvTables
            sink = tables(out, decoder.columns, stack)
        else:
            raise InputError(f"{out}: signals can be written into .csv, .parquet, .mcap or a directory")
        return _write_signals(decoder.decode(batches), sink)


def out_suffix(out: Path) -> str:
    """The suffix of `out` that says its format, lower case, without the .gz of a packed file."""
    suffixes = [suffix.lower() for suffix in out.suffixes]
    packed = suffixes[-1:] == [".gz"]
    suffix = "".join(suffixes[-2:-1] if packed else suffixes[-1:])
    if packed and suffix not in _TEXT_FORMATS:
        raise InputError(f"{out}: only {' '.join(_TEXT_FORMATS)} can be written with .gz")
    if suffix and suffix not in _FORMATS:
        raise InputError(
            f"{out}: unknown format {suffix!r}{nearest(suffix, _FORMATS)}; known are {' '.join(_FORMATS)},"
            " and a name without a suffix for a directory of tables"
        )
    return suffix


def _database(log: Path, files: list[Path] | None) -> Database:
    from gz_onboard.bus.mapping import load_database

    if files:
        return load_database(files)
    import cantools.database

    attached = {name: data for name, data in read_attachments(log).items() if name.lower().endswith(".dbc")}
    if not attached:
        raise InputError(f"{log}: no DBC file is attached to this log; say which to decode by, with --dbc FILE")
    database = cantools.database.can.Database()
    for name, data in attached.items():
        try:
            database.add_dbc_string(data.decode("utf-8", "replace"))
        except Exception as error:  # cantools has several types of its own
            raise InputError(f"{log}, attached {name}: {error}; give the right one with --dbc FILE") from None
    return database
