"""``gz-onboard export``: turns a log into other formats of frames, tables of signals, or an MCAP of signals.

The name of the output says what is written:
- .log .blf .asc .trc .csv .mf4: the frames, in the format of candump, Vector, PEAK, python-can or ASAM;
- .parquet, or .csv with --signals: one table of all signals, a row for each value: time, message, signal, value;
- a directory (a name without a suffix): one table for each message, a row for each frame, a column for each signal;
- .mcap: everything that is in the log, and besides one JSON channel for each message at its full rate.

With --estimates, and of a log that holds nothing else (that of ``gz-onboard estimate``), the estimates: .csv, .parquet
or a directory, a row for each estimate.

Signals have the units of the DBC files, in their names: ``BMS_PackVoltage[V]``. What was not available, or is out of
the DBC's range, is null.
"""

from __future__ import annotations

import argparse
import heapq
import json
import math
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gz_onboard.bus import logs, tables
from gz_onboard.bus.logfile import LogFile, object_schema
from gz_onboard.bus.replay import log_section
from gz_onboard.bus.signals import Decoder
from gz_onboard.bus.writers import write_blf, write_candump
from gz_onboard.errors import OK, InputError, nearest, not_an_input, writing
from gz_onboard.events import Frame
from gz_onboard.options import add_shared

if TYPE_CHECKING:
    from cantools.database.can import Database, Message

ESTIMATE_TOPIC = "/estimate"  # as in gz_onboard.log_rows, which a part of bus may not import
_TEXT_FORMATS = (".log", ".asc", ".trc", ".csv")
_FORMATS = (*_TEXT_FORMATS, ".blf", ".mf4", ".parquet", ".mcap")


# --- frames ----------------------------------------------------------------------------------------------------


def write_frames_as(out: Path, suffix: str, batches: Iterable[list[Frame]]) -> int:
    """Write the frames to `out` in the format of `suffix`; gives how many it were."""
    if suffix == ".log":
        with tables.open_text(out) as text:
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


# --- MCAP ------------------------------------------------------------------------------------------------------


def _write_mcap(log: Path, out: Path, decoder: Decoder, batches: Iterator[list[Frame]], section: Any) -> int:
    """Everything that is in the log, and the signals of each message on a topic ``/can/MESSAGE``, by time."""
    first = next(batches, None)
    if first is None:
        raise InputError(f"{log}: no frames in the chosen part")
    metadata = {**logs.read_metadata(log), "expanded_from": log.name}
    with out.open("wb") as stream:
        file = LogFile(stream, first[0][0], metadata, logs.read_attachments(log))
        recorded, topics = logs.json_channels(log), {m.name: f"/can/{m.name}" for m in decoder.messages.values()}
        for topic, (schema, of_channel) in recorded.items():
            file.channel(topic, json.loads(schema), of_channel)
        for message in decoder.messages.values():
            if topics[message.name] not in recorded:
                file.channel(topics[message.name], _message_schema(message, decoder.columns[message.name]))

        def logged() -> Iterator[list[Frame]]:
            file.frames(first)
            yield first
            for batch in batches:
                file.frames(batch)
                yield batch

        samples = ((time_ns, topic, values) for topic, time_ns, values in logs.read_samples(log, *section))
        signals = ((time_ns, topics[name], values) for time_ns, name, values in decoder.decode(logged()))
        count = 0
        for time_ns, topic, values in heapq.merge(signals, samples, key=lambda item: item[0]):
            file.sample(topic, time_ns, values)
            count += 1
        file.close()
    return count


def _message_schema(message: Message, columns: Mapping[str, str]) -> dict[str, Any]:
    pairs = zip(columns.items(), message.signals, strict=True)
    texts = {name: ", ".join(filter(None, (unit, signal.comment))) for (name, unit), signal in pairs}
    return object_schema(message.name, texts)


# --- estimates -------------------------------------------------------------------------------------------------


def _write_estimates(log: Path, out: Path, suffix: str, table_format: str, section: tuple[float, float | None]) -> int:
    """The rows of the topic of estimates, a column for each field, with its unit; gives how many. Prints damage."""
    if suffix not in (".csv", ".parquet", ""):
        raise InputError(f"{out}: estimates can be written into .csv, .parquet or a directory")
    samples = logs.read_samples(log, on_damage=lambda damage: print(f"damaged log: {damage}"))
    found = [(time_ns, values) for topic, time_ns, values in samples if topic == ESTIMATE_TOPIC]
    if not found:
        raise InputError(f"{log}: holds no estimates ({ESTIMATE_TOPIC})")
    start_s, end_s = section
    low = found[0][0] + round(start_s * 1e9)
    high = math.inf if end_s is None else found[0][0] + round(end_s * 1e9)
    rows = [(time_ns, values) for time_ns, values in found if low <= time_ns < high]
    columns = _estimate_columns(log)
    if suffix == "":
        out.mkdir(parents=True, exist_ok=True)
        out /= f"estimate.{table_format}"
    times = [time_ns for time_ns, _ in rows]
    tables.write_table(
        out, times, {column: [values.get(name) for _, values in rows] for name, column in columns.items()}
    )
    return len(rows)


def _estimate_columns(log: Path) -> dict[str, str]:
    """Field -> column of the table, ``name[unit]``: the unit is the first word of the schema's description.

    The field ``time``, since the first frame, is ``elapsed``: the table's first column is the time of the log.
    """
    try:
        properties = json.loads(logs.json_channels(log)[ESTIMATE_TOPIC][0])["properties"]
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
    tables = "format of the tables in a folder (default: parquet)"
    parser.add_argument("--table-format", choices=["parquet", "csv"], help=tables)
    dbc = "DBC files to decode the signals (default: those attached to the log)"
    parser.add_argument("--dbc", type=Path, nargs="+", metavar="FILE", help=dbc)
    add_shared(parser, "--from", "--to")


def run(arguments: argparse.Namespace) -> int:
    """Run ``gz-onboard export``; raises InputError for what cannot be used."""
    log, out = arguments.log, arguments.out
    suffix = out_suffix(out)
    if suffix and arguments.table_format:
        raise InputError(f"--table-format {arguments.table_format}: is for a folder of tables, and {out} is a file")
    table_format = arguments.table_format or "parquet"
    not_an_input([out], [log, *(arguments.dbc or [])])
    if arguments.estimates or _holds_only_estimates(log):
        with _whole(out, suffix) as part:
            count = _write_estimates(log, part, suffix, table_format, (arguments.start, arguments.end))
        print(f"wrote {out}: {count} estimates")
        return OK
    section = log_section(log, arguments.start, arguments.end)
    damages: list[logs.LogDamage] = []
    rest = logs.read_frames(log, *section, damages.append)
    first = next(rest, None)
    if first is None:
        where = "this log" if section == (None, None) else "the chosen part"
        why = "".join(f"; damaged at {damage.place}: {damage.reason}" for damage in damages)
        raise InputError(f"{log}: no frames in {where}{why}")
    batches = chain([first], rest)
    if suffix in (".parquet", ".mcap", "") or arguments.signals:
        decoder = Decoder(_database(log, arguments.dbc))
        with _whole(out, suffix) as part:
            count = _export_signals(log, part, suffix, table_format, decoder, batches, section)
        left = f"; {decoder.unknown} frames are in no DBC file, {decoder.undecodable} do not fit theirs"
    else:
        with _whole(out, suffix) as part:
            count = write_frames_as(part, suffix, batches)
        left = ""
    for damage in damages:
        print(f"damaged log: {damage}")
    print(f"wrote {out}: {count} {'samples' if suffix == '.mcap' else 'frames'}{left}")
    return OK


@contextmanager
def _whole(out: Path, suffix: str) -> Iterator[Path]:
    """Where to write `out` within, which has its name once it is complete; but a folder of tables at once.

    Errors are as of `writing`.
    """
    part = out.with_name(f".part.{out.name}") if suffix else out
    with writing(out):
        try:
            yield part
            if suffix:
                part.replace(out)
        except OSError as error:
            error.filename = None  # `out` is what the user knows
            raise
        finally:
            if suffix:
                with suppress(OSError):  # there is none
                    part.unlink()


def _holds_only_estimates(log: Path) -> bool:
    """Whether it is a log of ours that holds estimates and not a single frame."""
    if logs.log_suffix(log) != ".mcap" or ESTIMATE_TOPIC not in logs.json_channels(log):
        return False
    return next(logs.read_frames(log, on_damage=lambda _: None), None) is None


def _export_signals(
    log: Path, out: Path, suffix: str, table_format: str, decoder: Decoder, batches: Iterator[list[Frame]], section: Any
) -> int:
    if suffix == ".mcap":
        return _write_mcap(log, out, decoder, batches, section)
    with ExitStack() as stack:
        sink: tables.Sink
        if suffix == ".parquet":
            sink = tables.ParquetLong(out, stack)
        elif suffix == ".csv":
            sink = tables.CsvLong(stack.enter_context(tables.open_text(out)))
        elif suffix == "":
            out.mkdir(parents=True, exist_ok=True)
            kind = tables.ParquetTables if table_format == "parquet" else tables.CsvTables
            sink = kind(out, decoder.columns, stack)
        else:
            raise InputError(f"{out}: signals can be written into .csv, .parquet, .mcap or a directory")
        return tables.write_signals(decoder.decode(batches), sink)


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
    from gz_onboard.bus.dbc import database_of, load_database

    if files:
        return load_database(files, {})
    attached = {name: data for name, data in logs.read_attachments(log).items() if name.lower().endswith(".dbc")}
    if not attached:
        raise InputError(f"{log}: no DBC file is attached to this log; say which to decode by, with --dbc FILE")
    texts = [(Path(f"{log}, attached {name}"), data.decode("utf-8", "replace")) for name, data in attached.items()]
    try:
        return database_of(texts, {})
    except InputError as error:
        raise InputError(f"{error}; give the right one with --dbc FILE") from error
