"""What a log holds, as tables: estimates, explanations, signals, frames. It prints nothing."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gz_onboard.can.mapping import BusMapping
from gz_onboard.errors import InputError, nearest
from gz_onboard.log_rows import CHANGE_TOPIC, ESTIMATE_TOPIC, WHY_TOPIC
from gz_onboard.offline import write_tables
from gz_onboard.offline.decode_signals import Decoded, Decoder
from gz_onboard.offline.table import table_columns
from gz_onboard.recording import logs
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.recording.replay import log_section
from gz_onboard.vehicle import OWN, Vehicle, read_vehicle

ESTIMATES = {"estimate": ESTIMATE_TOPIC, "why": WHY_TOPIC, "range_change": CHANGE_TOPIC}
"""The topics that a folder of tables has beside the messages, by the name of the table."""
_TABLES = (".csv", ".parquet", ".jsonl")
_FORMATS = (*_TABLES, *(f"/{suffix}" for suffix in _TABLES))
_SHOWN = 20  # columns in a message: a log may have hundreds
_MESSAGE = "/can/"  # begins the topic of a message's signals


@dataclass
class ExportSource:
    """A log, and what part of it is wanted: of time, [s] since its beginning, and of the columns (None: all)."""

    log: Path
    start: float = 0.0
    end: float | None = None
    columns: Sequence[str] | None = None
    damages: list[LogDamage] = field(default_factory=list)

    def frames(self) -> tuple[tuple[int | None, int | None], FrameColumns]:
        """(the part that is wanted [ns since the epoch], its frames); InputError if there are none."""
        found = logs.read_log(self.log, on_damage=self.damages.append)
        section = log_section(self.log, found, self.start, self.end)
        if len(frames := found.between(*section)):
            return section, frames
        where = "this log" if section == (None, None) else "the chosen part"
        why = "".join(f"; damaged at {damage.place}: {damage.reason}" for damage in self.damages)
        raise InputError(f"{self.log}: no frames in {where}{why}")

    def rows(self, topic: str) -> list[tuple[int, dict[str, Any]]]:
        """(time [ns], values) of the samples of a topic, in the part that is wanted."""
        found = [sample[1:] for sample in self._samples() if sample[0] == topic]
        if not found:
            return []
        low = found[0][0] + round(self.start * 1e9)
        high = math.inf if self.end is None else found[0][0] + round(self.end * 1e9)
        return [(time_ns, values) for time_ns, values in found if low <= time_ns < high]

    def _samples(self) -> Iterator[tuple[str, int, dict[str, Any]]]:
        return logs.read_samples(self.log, on_damage=self.damages.append)


# --- columns ------------------------------------------------------------------------------------------------------


def chosen(source: ExportSource, known: Iterable[str]) -> set[str]:
    """The columns that are wanted of those `known`, by names with or without unit. InputError for one not there."""
    names = list(dict.fromkeys(known))
    if source.columns is None:
        return set(names)
    if not source.columns:
        raise InputError(f"columns: names none; there are {', '.join(names[:_SHOWN]) or 'none'}")
    plain = [*names, *(name.partition("[")[0] for name in names)]
    for name in source.columns:
        if name not in plain:
            more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
            there = f"{', '.join(names[:_SHOWN]) or 'none'}{more}"
            raise InputError(f"{source.log}: has no column {name!r}{nearest(name, plain)}; there are {there}")
    return {name for name in names if {name, name.partition("[")[0]} & set(source.columns)}


def topic_columns(log: Path, topic: str) -> dict[str, str]:
    """Of each field of a topic's samples its column, ``name[unit]``."""
    try:
        properties = json.loads(logs.json_channels(log)[topic][0])["properties"]
        return table_columns({name: str(about.get("description", "")) for name, about in properties.items()})
    except (ValueError, LookupError, AttributeError, TypeError) as error:
        raise InputError(f"{log}: the schema of {topic} is not one of ours: {error!r}") from None


# --- estimates ----------------------------------------------------------------------------------------------------


def estimate_rows(source: ExportSource) -> list[tuple[int, dict[str, Any]]]:
    """(time [ns], values) of the estimates. InputError if there are none, which says what else the log holds."""
    if rows := source.rows(ESTIMATE_TOPIC):
        return rows
    if ESTIMATE_TOPIC in logs.json_channels(source.log) and (source.start or source.end is not None):
        raise InputError(f"{source.log}: no estimates in the chosen part")
    raise InputError(f"{source.log}: holds no estimates ({ESTIMATE_TOPIC}){_other(source.log)}")


def write_estimates(source: ExportSource, files: Mapping[str, Path]) -> int:
    """Write a table, a row each, of the estimates and of each other topic in `files` that has rows and wanted columns.

    Gives how many estimates. InputError if there are none, or if no table has a column that is wanted.
    """
    estimates = estimate_rows(source)
    columns = {topic: topic_columns(source.log, topic) for topic in files}
    wanted = chosen(source, [column for of in columns.values() for column in of.values()])
    for topic, out in files.items():
        rows = estimates if topic == ESTIMATE_TOPIC else source.rows(topic)
        table = {c: [values.get(name) for _, values in rows] for name, c in columns[topic].items() if c in wanted}
        if rows and table:
            write_tables.write_table(out, table, [time_ns for time_ns, _ in rows])
    return len(estimates)


def holds_frames(log: Path) -> bool:
    """Whether a log holds a frame; of one in another format than ours it is taken for granted."""
    return logs.log_suffix(log) != ".mcap" or len(logs.read_log(log, on_damage=lambda _: None)) > 0


def _other(log: Path) -> str:
    if len(logs.read_log(log, on_damage=lambda _: None)):
        return f"; it holds frames, of which `gz-onboard estimate {log.name}` makes them"
    return ""


# --- signals ------------------------------------------------------------------------------------------------------


def recorded_messages(log: Path) -> list[str]:
    """The messages whose signals are in a log as they were decoded, once a second."""
    return [topic.removeprefix(_MESSAGE) for topic in logs.json_channels(log) if topic.startswith(_MESSAGE)]


def recorded_signals(source: ExportSource) -> tuple[dict[str, dict[str, str]], Iterator[Decoded]]:
    """(column -> unit of each message, the signals), as they stand in a log that has no frames."""
    named = {name: _signal_columns(source.log, name) for name in recorded_messages(source.log)}
    first = min((rows[0][0] for name in named if (rows := source.rows(_MESSAGE + name))), default=0)
    low = first + round(source.start * 1e9)
    high = math.inf if source.end is None else first + round(source.end * 1e9)

    def decoded() -> Iterator[Decoded]:
        for topic, time_ns, values in logs.read_samples(source.log):
            columns = named.get(topic.removeprefix(_MESSAGE)) if topic.startswith(_MESSAGE) else None
            if columns is not None and low <= time_ns < high:
                yield time_ns, topic.removeprefix(_MESSAGE), {c: values.get(n) for n, c in columns.items()}

    return {name: dict.fromkeys(columns.values(), "") for name, columns in named.items()}, decoded()


def _signal_columns(log: Path, message: str) -> dict[str, str]:
    """Signal -> column; one that has its unit in its name keeps it."""
    columns = topic_columns(log, _MESSAGE + message)
    return {name: name if name.endswith("]") else column for name, column in columns.items()}


@dataclass(frozen=True)
class LogSignals:
    """The signals of a log, those that are wanted. columns: the units by column, by message; decoded: as they come;
    decoder: that counts what it cannot decode, None if they stand decoded in the log, once a second.
    """

    columns: Mapping[str, Mapping[str, str]]
    decoded: Iterable[Decoded]
    decoder: Decoder | None


def signals_of(source: ExportSource, files: list[Path] | None, vehicle: Vehicle | None) -> LogSignals:
    """The signals of `source`, decoded as of `decoder_of` where it has frames. InputError if there are none."""
    decoded: Iterable[Decoded]
    columns: Mapping[str, Mapping[str, str]]
    if not holds_frames(source.log) and recorded_messages(source.log):
        decoder, (columns, decoded) = None, recorded_signals(source)
    else:
        _, frames = source.frames()
        decoder = decoder_of(source.log, files, vehicle)
        columns, decoded = decoder.columns, decoder.decode(frames.batches())
    wanted = chosen(source, (column for of in columns.values() for column in of))
    kept = {message: {c: unit for c, unit in of.items() if c in wanted} for message, of in columns.items()}
    if source.columns is not None:
        decoded = ((t, m, {c: v for c, v in values.items() if c in wanted}) for t, m, values in decoded if kept[m])
    return LogSignals(kept, decoded, decoder)


def write_signals(source: ExportSource, out: Path, suffix: str, signals: LogSignals) -> int:
    """Write signals as one long table, or a table for each message in the folder `out`; gives the number of frames.

    suffix: of `out`; of a folder, that of its tables with a slash before.
    """
    if suffix not in _FORMATS:
        raise InputError(f"{source.log}: its signals can be written to .csv, .parquet, .jsonl, .mcap or a directory")
    messages = write_tables.by_message(signals.decoded)
    if suffix.startswith("/"):
        out.mkdir(parents=True, exist_ok=True)
        for message, rows in messages.items():
            write_tables.write_table(out / f"{message}{suffix[1:]}", rows.columns, rows.times)
    else:
        write_tables.write_long(out, messages)
    return sum(len(rows.times) for rows in messages.values())


class DecoderError(InputError):
    """A log that does not say what decodes it."""


def decoder_of(log: Path, files: list[Path] | None, vehicle: Vehicle | None) -> Decoder:
    """What decodes the frames of `log`: DBC files; else those of a vehicle; else those attached to the log; else those
    of the vehicle that the log names, if it is one of the package's own. `DecoderError` if none is known.
    """
    return Decoder(_mapping(log, files, vehicle))


def _mapping(log: Path, files: list[Path] | None, vehicle: Vehicle | None) -> BusMapping:
    from gz_onboard.can.dbc import database_of, load_database

    if files:
        return BusMapping(load_database(files, {}), tuple(files), (), {}, {})
    if vehicle:
        return _mapping_of(vehicle)
    attached = {name: data for name, data in logs.read_attachments(log).items() if name.lower().endswith(".dbc")}
    named = logs.read_metadata(log).get("vehicle", "")
    for own in () if attached else sorted(file.stem for file in OWN.glob("*.toml")):
        if named in (own, read_vehicle(own).name):
            return _mapping_of(read_vehicle(own))
    if not attached:
        raise DecoderError(f"{log}: no DBC file is attached to this log; give a vehicle or DBC files")
    texts = [(Path(f"{log}, attached {name}"), data.decode("utf-8", "replace")) for name, data in attached.items()]
    try:
        return BusMapping(database_of(texts, {}), (), (), {}, {})
    except InputError as error:
        raise DecoderError(f"{error}; give a vehicle or DBC files") from error


def _mapping_of(vehicle: Vehicle) -> BusMapping:
    """The vehicle's bus with its own range frames."""
    from gz_onboard.can.dbc import load_database

    if not vehicle.mapping.reads_frames:
        raise vehicle.error("dbc is missing: without it no frame can be decoded")
    return replace(vehicle.mapping, database=load_database([*vehicle.mapping.dbc_files, vehicle.range_dbc], {}))
