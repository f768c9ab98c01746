"""Frames and signals of logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gz_onboard.api.given import PathLike, VehicleLike, vehicle_of
from gz_onboard.arguments import checked, within
from gz_onboard.errors import InputError, brief
from gz_onboard.events import Frame
from gz_onboard.export.contents import FRAME, ExportSource, frame_columns
from gz_onboard.options import LONGEST_LOG
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.reports.tables import Columns, Tabular, array_of

_KINDS = {int: np.int64, bool: bool, str: object}


@dataclass(frozen=True)
class LoggedFrames(Tabular):
    """The frames in a log. damages: what of it could not be read."""

    frames: Sequence[Frame]
    damages: Sequence[LogDamage]

    __repr__ = brief

    def to_table(self) -> Columns:
        """A row for each frame, with the columns that ``gz-onboard export --frames`` writes."""
        columns = frame_columns(FrameColumns.of(self.frames))
        arrays = {name: np.array(column, _KINDS[FRAME[name]]) for name, column in columns.items()}
        return {"time": _times([frame[0] for frame in self.frames]), **arrays}


@dataclass(frozen=True)
class LoggedMessage(Tabular):
    """The signals of one message. times: [ns since the epoch]; columns: by name and unit, as long."""

    times: Sequence[int]
    columns: Columns

    __repr__ = brief

    def to_table(self) -> Columns:
        """A row for each frame, as in a folder of tables that ``gz-onboard export`` writes."""
        return {"time": _times(self.times), **self.columns}


@dataclass(frozen=True)
class LoggedSignals(Tabular):
    """The signals in a log. messages: of each its own table; damages: what of the log could not be read; unknown:
    frames that are in no DBC file, undecodable: that do not fit theirs; conflicts: messages that come from two channels
    or senders with different data, of which the first is here.
    """

    messages: Mapping[str, LoggedMessage]
    damages: Sequence[LogDamage]
    unknown: int = 0
    undecodable: int = 0
    conflicts: Sequence[str] = ()

    __repr__ = brief

    def to_table(self) -> Columns:
        """A row for each value: time, message, signal, value; message by message. What is no number is nan."""
        numbers = [
            np.column_stack([c if c.dtype.kind in "bf" else np.full(len(c), np.nan) for c in one.columns.values()])
            for one in self.messages.values()
        ]
        named = list(zip(self.messages.items(), numbers, strict=True))
        return {
            "time": np.concatenate([_times([]), *(np.repeat(_times(m.times), x.shape[1]) for (_, m), x in named)]),
            "message": np.array([name for (name, _), x in named for _ in range(x.size)], dtype=object),
            "signal": np.array([c for (_, m), x in named for _ in range(len(x)) for c in m.columns], dtype=object),
            "value": np.concatenate([np.empty(0), *(x.ravel() for x in numbers)]),
        }


@checked
def read_frames(log: PathLike, *, start: float = 0.0, end: float | None = None) -> LoggedFrames:
    """The frames in a log. start, end: only those in this part of it [s from its beginning]. Raises InputError."""
    source = _source(log, start, end)
    return LoggedFrames(source.frames().tuples(), source.damages)


@checked
def read_signals(
    log: PathLike,
    vehicle: VehicleLike | None = None,
    *,
    dbc: Sequence[PathLike] = (),
    columns: Sequence[str] | None = None,
    start: float = 0.0,
    end: float | None = None,
) -> LoggedSignals:
    """The signals in a log, in the units of the DBC files that decode it.

    These are `dbc`, else those of `vehicle`, else those attached to the log. columns: only these signals, with or
    without their units. start, end: as of `read_frames`. Raises InputError.
    """
    if dbc and vehicle is not None:
        raise InputError("dbc: a vehicle has DBC files of its own; give one of the two")
    source = _source(log, start, end, columns)
    known = None if vehicle is None else vehicle_of(vehicle)
    found = source.signals([Path(file) for file in dbc], known)
    messages = {
        name: LoggedMessage(rows.times, {column: array_of(values) for column, values in rows.columns.items()})
        for name, rows in found.messages.items()
    }
    if (decoder := found.decoder) is None:
        return LoggedSignals(messages, source.damages)
    conflicts = tuple(decoder.origins.conflicts.values())
    return LoggedSignals(messages, source.damages, decoder.unknown, decoder.undecodable, conflicts)


def _source(log: PathLike, start: float, end: float | None, columns: Sequence[str] | None = None) -> ExportSource:
    within("start", start, {"start": (0.0, LONGEST_LOG, "s")})
    if end is not None and not end > start:
        raise InputError(f"end {end:g} s: must be after start {start:g} s")
    return ExportSource(Path(log), start, None if end is None else min(end, LONGEST_LOG), columns)


def _times(times: Sequence[int]) -> np.ndarray[tuple[int], np.dtype[np.datetime64]]:
    return np.array(times, dtype="datetime64[ns]")
