"""The contents of a log as tables: frames, signals, estimates, explanations."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from itertools import chain, repeat
from pathlib import Path
from typing import Any

import numpy as np

from gz_onboard.can.codec import BACK_NS
from gz_onboard.errors import InputError, brief, nearest
from gz_onboard.events import EFF_FLAG, ERR_FLAG, MOST_EXTENDED, RTR_FLAG, TRANSMITTED
from gz_onboard.export.decoder import decoder_of
from gz_onboard.log_rows import CHANGE_TOPIC, ESTIMATE_TOPIC, WHY_TOPIC
from gz_onboard.recording import logs
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.recording.replay import log_section
from gz_onboard.reports.results import clock, text_rows
from gz_onboard.reports.tables import (
    Columns,
    Tabular,
    array_of,
    beside_time,
    json_line,
    open_text,
    table_columns,
    table_suffix,
    time_array,
    write_table,
)
from gz_onboard.vehicle import Vehicle

ESTIMATES = {"estimate": ESTIMATE_TOPIC, "why": WHY_TOPIC, "range_change": CHANGE_TOPIC}
"""The topics that a folder of tables has in addition to the messages, by the name of the table."""
FRAME = {"channel": int, "identifier": int, "extended": bool, "remote": bool, "error": bool, "sent": bool, "data": str}
"""The columns of a table of frames, after the time. identifier: without its flags, which are columns; sent: by us;
data: hexadecimal.
"""
_SHOWN_COLUMNS = 20  # in an error: a log may have hundreds
_MESSAGE = "/can/"  # begins the topic of a message's signals

Row = tuple[int, dict[str, Any]]
"""Time [ns since the epoch] and values."""


@dataclass(frozen=True)
class LoggedMessage(Tabular):
    """The signals of one message. times: [ns since the epoch]; columns: as long, by name and unit, None if unknown."""

    times: list[int] = field(default_factory=list)
    columns: dict[str, list[Any]] = field(default_factory=dict)

    __repr__ = brief

    def to_table(self) -> Columns:
        """Return a row for each frame, as in a folder of tables that ``gz-onboard export`` writes."""
        columns = {beside_time(name): array_of(column) for name, column in self.columns.items()}
        return {"time": time_array(self.times), **columns}


@dataclass(frozen=True)
class LoggedSignals(Tabular):
    """The signals in a log, by message. damages: what of the log could not be read.

    is_decoded: whether frames were decoded, or the log held the signals, once a second. unknown: frames that are in no
    DBC file; undecodable: that do not fit theirs; conflicts: messages that come from two channels or senders with
    different data, of which the first is here.
    """

    messages: Mapping[str, LoggedMessage]
    damages: Sequence[LogDamage]
    is_decoded: bool = False
    unknown: int = 0
    undecodable: int = 0
    conflicts: Sequence[str] = ()

    __repr__ = brief

    def to_table(self) -> Columns:
        """Return a row for each value: time, message, signal, value; message by message. Texts are nan."""
        tables: list[Columns] = []
        for name, message in self.messages.items():
            times, count = time_array(message.times), len(message.columns)
            columns = map(array_of, message.columns.values())
            numbers = [c if c.dtype.kind in "bf" else np.full(len(c), np.nan) for c in columns]
            tables.append(
                {
                    "time": np.repeat(times, count),
                    "message": np.full(count * len(times), name, dtype=object),
                    "signal": np.tile(np.array(list(message.columns), dtype=object), len(times)),
                    "value": np.column_stack(numbers).astype(float).ravel(),
                }
            )
        empty = {"time": time_array([]), "message": np.empty(0, object), "signal": np.empty(0, object)}
        return {
            name: np.concatenate([none, *(table[name] for table in tables)])
            for name, none in (empty | {"value": np.empty(0)}).items()
        }


@dataclass
class ExportSource:
    """A part of a log: from `start` to `end` [s since its beginning], and some columns, None for all."""

    log: Path
    start: float = 0.0
    end: float | None = None
    columns: Sequence[str] | None = None
    damages: list[LogDamage] = field(default_factory=list)

    @cached_property
    def section(self) -> tuple[int | None, int | None]:
        """The part of the frames that is wanted [ns since the epoch]."""
        return log_section(self.log, self.all_frames, self.start, self.end)

    @cached_property
    def has_frames(self) -> bool:
        """Whether the log holds a frame; taken for granted of formats other than ours."""
        return logs.log_suffix(self.log) != ".mcap" or len(self.all_frames) > 0

    @cached_property
    def topics(self) -> Mapping[str, tuple[bytes, dict[str, str]]]:
        """Schema and metadata of the topics in the log."""
        return logs.json_channels(self.log)

    @property
    def messages(self) -> list[str]:
        """Messages whose signals are in the log decoded, once a second."""
        return [topic.removeprefix(_MESSAGE) for topic in self.topics if topic.startswith(_MESSAGE)]

    def frames(self) -> FrameColumns:
        """Return the frames in the part. InputError if there are none."""
        if len(frames := self.all_frames.between(*self.section)):
            return frames
        where = "this log" if self.section == (None, None) else "the chosen part"
        why = "".join(f"; damaged at {damage.place}: {damage.reason}" for damage in self.damages)
        raise InputError(f"{self.log}: no frames in {where}{why}")

    def rows(self, topic: str, begin_ns: int | None = None) -> list[Row]:
        """Return the samples of a topic in the part, which begins with the first of them or at `begin_ns`."""
        found = self.samples.get(topic, [])
        if not found:
            return []
        begin_ns = found[0][0] if begin_ns is None else begin_ns
        low = begin_ns + round(self.start * 1e9)
        high = math.inf if self.end is None else begin_ns + round(self.end * 1e9)
        return [(time_ns, values) for time_ns, values in found if low <= time_ns < high]

    def estimates(self) -> list[Row]:
        """Return the estimates in the part. InputError, with a hint at the log's contents, if there are none."""
        if rows := self.rows(ESTIMATE_TOPIC):
            return rows
        if ESTIMATE_TOPIC in self.topics and (self.start or self.end is not None):
            raise InputError(f"{self.log}: no estimates in the chosen part")
        has_frames = len(self.all_frames) > 0
        hint = f"; it holds frames, of which `gz-onboard estimate {self.log.name}` makes them" if has_frames else ""
        raise InputError(f"{self.log}: holds no estimates ({ESTIMATE_TOPIC}){hint}")

    def columns_of(self, topic: str) -> dict[str, str]:
        """Return the column ``name[unit]`` of each field of a topic."""
        try:
            properties = json.loads(self.topics[topic][0])["properties"]
            return table_columns({name: str(about.get("description", "")) for name, about in properties.items()})
        except (ValueError, LookupError, AttributeError, TypeError) as error:
            raise InputError(f"{self.log}: the schema of {topic} is not one of ours: {error!r}") from None

    def chosen(self, known: Iterable[str]) -> set[str]:
        """Choose from the `known` columns those wanted, named with or without unit. InputError for an unknown one."""
        names = list(dict.fromkeys(known))
        if self.columns is None:
            return set(names)
        there = ", ".join(names[:_SHOWN_COLUMNS]) or "none"
        if not self.columns:
            raise InputError(f"columns: names none; there are {there}")
        plain = [*names, *(name.partition("[")[0] for name in names)]
        for name in self.columns:
            if name not in plain:
                more = f" and {len(names) - _SHOWN_COLUMNS} more" if len(names) > _SHOWN_COLUMNS else ""
                raise InputError(f"{self.log}: has no column {name!r}{nearest(name, plain)}; there are {there}{more}")
        return {name for name in names if {name, name.partition("[")[0]} & set(self.columns)}

    def signals(self, files: Sequence[Path], vehicle: Vehicle | None) -> LoggedSignals:
        """Return the signals in the part, decoded as `decoder_of` says. InputError if there are none."""
        found: dict[str, LoggedMessage] = {}
        decoder = None
        if not self.has_frames and self.messages:
            known = self._logged_signals(found)
        else:
            frames, decoder = self.frames(), decoder_of(self.log, files, vehicle)
            known = decoder.columns
            for time_ns, message, values in decoder.decode(frames.batches()):
                if (rows := found.get(message)) is None:
                    rows = found[message] = LoggedMessage(columns={name: [] for name in values})
                rows.times.append(time_ns)
                for column, value in zip(rows.columns.values(), values.values(), strict=True):
                    column.append(value)
        wanted = self.chosen(chain.from_iterable(known.values()))
        if self.columns is not None:
            kept = {m: {name: c for name, c in rows.columns.items() if name in wanted} for m, rows in found.items()}
            found = {m: LoggedMessage(found[m].times, columns) for m, columns in kept.items() if columns}
        if decoder is None:
            return LoggedSignals(found, self.damages)
        return LoggedSignals(found, self.damages, True, decoder.unknown, decoder.undecodable, decoder.conflicts)

    def _logged_signals(self, found: dict[str, LoggedMessage]) -> dict[str, list[str]]:
        """Add the signals that a log without frames holds to `found`; return the columns of each message."""
        topics = {message: _MESSAGE + message for message in self.messages}
        columns = {
            m: {n: n if n.endswith("]") else c for n, c in self.columns_of(t).items()} for m, t in topics.items()
        }
        first = min((rows[0][0] for t in topics.values() if (rows := self.samples.get(t))), default=0)
        for message, topic in topics.items():
            if rows := self.rows(topic, first):
                values = {c: [v.get(n) for _, v in rows] for n, c in columns[message].items()}
                found[message] = LoggedMessage([time_ns for time_ns, _ in rows], values)
        return {message: list(of.values()) for message, of in columns.items()}

    def _add_damage(self, damage: LogDamage) -> None:
        """Note damage once, though frames and samples are read one after the other."""
        if damage not in self.damages:
            self.damages.append(damage)

    @cached_property
    def all_frames(self) -> FrameColumns:
        """The frames of the whole log."""
        return logs.read_log(self.log, on_damage=self._add_damage)

    @cached_property
    def samples(self) -> dict[str, list[Row]]:
        """The samples of the whole log, by topic."""
        found: dict[str, list[Row]] = {}
        for topic, time_ns, values in logs.read_samples(self.log, on_damage=self._add_damage):
            found.setdefault(topic, []).append((time_ns, values))
        return found


# --- tables ---------------------------------------------------------------------------------------------------------


def write_estimates(source: ExportSource, files: Mapping[str, Path]) -> int:
    """Write a table of the estimates, and of each other topic in `files` that has rows; return how many estimates.

    InputError if there are none, or if no table has a column that is wanted.
    """
    estimates = source.estimates()
    columns = {topic: source.columns_of(topic) for topic in files}
    wanted = source.chosen(column for of in columns.values() for column in of.values())
    for topic, out in files.items():
        rows = estimates if topic == ESTIMATE_TOPIC else source.rows(topic)
        table = {c: [values.get(name) for _, values in rows] for name, c in columns[topic].items() if c in wanted}
        if rows and table:
            write_table(out, table, [time_ns for time_ns, _ in rows])
    return len(estimates)


def write_signals(signals: LoggedSignals, out: Path, suffix: str) -> int:
    """Write signals as one long table, or a table for each message in the folder `out`; return how many frames.

    suffix: of `out`; of a folder, that of its tables with a slash before.
    """
    if suffix.startswith("/"):
        out.mkdir(parents=True, exist_ok=True)
        for message, rows in signals.messages.items():
            write_table(out / f"{message}{suffix[1:]}", rows.columns, rows.times)
    else:
        _write_long(out, signals.messages)
    return sum(len(rows.times) for rows in signals.messages.values())


def _write_long(out: Path, messages: Mapping[str, LoggedMessage]) -> None:
    """Write one table, message by message: a row for each value, in .jsonl one for each frame."""
    if table_suffix(out) == ".jsonl":
        with open_text(out) as stream:
            for message, rows in messages.items():
                for time_ns, *values in zip(rows.times, *rows.columns.values(), strict=True):
                    named = dict(zip(rows.columns, values, strict=True))
                    stream.write(json_line(time_ns, {"message": message, **named}))
        return
    columns: dict[str, list[Any]] = {"message": [], "signal": [], "value": []}
    times: list[int] = []
    for message, rows in messages.items():
        names, count = list(rows.columns), len(rows.times)
        times += chain.from_iterable(repeat(time_ns, len(names)) for time_ns in rows.times)
        columns["message"] += [message] * (count * len(names))
        columns["signal"] += names * count
        columns["value"] += chain.from_iterable(zip(*rows.columns.values(), strict=True))
    write_table(out, columns, times, {"message": str, "signal": str, "value": float})


def frame_columns(frames: FrameColumns) -> dict[str, list[Any]]:
    """Return the columns of `FRAME`."""
    columns = (
        frames.bus,
        frames.identifier & MOST_EXTENDED,
        *(frames.identifier & flag != 0 for flag in (EFF_FLAG, RTR_FLAG, ERR_FLAG)),
        frames.channel & TRANSMITTED != 0,
    )
    data = [data.hex() for _, _, data, _ in frames.tuples()]
    return dict(zip(FRAME, [*(column.tolist() for column in columns), data], strict=True))


# --- what a log holds, for a person ---------------------------------------------------------------------------------


def contents_text(log: Path) -> str:
    """Say what `log` holds, by reading all of it. InputError if it cannot be read."""
    source = ExportSource(log)
    frames, messages = source.all_frames, source.messages
    stamps = frames.time_ns
    back = int((stamps < np.maximum.accumulate(stamps) - BACK_NS).sum())
    times = [time_ns for rows in source.samples.values() for time_ns, _ in rows]
    if len(frames):
        times += [int(stamps.min()), int(stamps.max())]
    rows = [(name, text) for name, text in logs.read_metadata(log).items() if name in ("vehicle", "source")]
    if times:
        begin = datetime.fromtimestamp(min(times) // 1_000_000_000, UTC)
        rows.append(("time", f"{clock((max(times) - min(times)) * 1e-9)} from {begin:%Y-%m-%d %H:%M:%S} UTC"))
    late = f", {back} of them earlier than others before them" if back else ""
    rows.append(("frames", f"{len(frames)}{late}" if len(frames) else "none"))
    for topic, samples in source.samples.items():
        if topic.removeprefix(_MESSAGE) not in messages:
            rows.append((topic.strip("/"), f"{len(samples)} rows"))
    if messages:
        rows.append(("signals", f"decoded, of {len(messages)} messages: {', '.join(sorted(messages))}"))
    if attached := sorted(logs.read_attachments(log)):
        rows.append(("DBC files", ", ".join(attached)))
    rows += [("damaged", text) for text in dict.fromkeys(map(str, source.damages))]
    return text_rows(str(log), rows)
