"""The formats that python-can reads: ASC, CSV and TRC, and MF4 where asammdf is installed."""

from __future__ import annotations

import importlib
import io
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TextIO, cast

from gz_onboard.bus._can import can, flagged
from gz_onboard.errors import InputError, shown
from gz_onboard.events import EFF_FLAG, ERR_FLAG, MOST_EXTENDED, RTR_FLAG, TRANSMITTED, Frame
from gz_onboard.recording.frames import BATCH, FrameColumns
from gz_onboard.recording.readers.contents import ASC_BASE, ChannelNumbers, Contents, Damage, text_pieces, timed

_HEAD = 4000  # characters within which the base of an ASC log and the version of a trace stand
_BEGINNING = 100  # characters that show a reader what a file is
_ASC_STAMP = re.compile(r"\s*(\d+\.\d+)(?=\s)")
_TRC_START = re.compile(r"^\s*(?:;\$FILEVERSION|\d+\)\s)", re.M)
_TRC_FRAME = re.compile(r"\d+\)?\s")
_TRC_1_2 = re.compile(r"^;\$FILEVERSION=1\.2\s*$", re.M)
_TRC_UP_TO_IDENTIFIER = re.compile(r"(;\$FILEVERSION=1\.)2|(\s*\d+\)(?:\s+\S+){4})(?=\s)")
_ASC_LINE = re.compile(
    r"\s*(?:\d+\.\d+\s|//|date\b|base\b|(?:begin|end)\s+trigger|(?:no\s+)?internal\s+events|$)", re.I
)
_HEADERS = {".asc": ("date", "base", "//"), ".csv": ("timestamp",), ".trc": (";",)}
_MASTER_CHANNELS = {"time", "t", "timestamps"}  # of an MF4
# python-can's readers have no error of their own: these are what a line that is none raises in them.
_BROKEN_LINE = (ValueError, LookupError, TypeError, AttributeError, NotImplementedError)


class _LineFeed:
    """Lines for python-can's text readers, counted; `resume` lets a reader go on after one that it choked on."""

    def __init__(self, lines: Iterable[str], again: bool) -> None:
        self._lines = iter(lines)
        self._again = again
        self.number = 0
        self.line = ""
        self.name = ""

    def __iter__(self) -> _LineFeed:
        return self

    def __next__(self) -> str:
        if self._again:
            self._again = False
            return "\n"
        self.line = next(self._lines)
        self.number += 1
        return self.line

    def resume(self) -> None:
        """The reader will look for a header first: give it an empty line that it may drop."""
        self._again = True

    def close(self) -> None:
        """Nothing is open; python-can closes what it reads."""


def _asc_lines(lines: Iterable[str], damage: Damage, relative: bool) -> Iterator[str]:
    """The lines of an ASC log; what is none is noted. relative: each time is that since the line before."""
    now = 0.0
    for number, line in enumerate(lines, 1):
        if not _ASC_LINE.match(line):
            damage.add(f"line {number}", f"not a line of an ASC log: {line.strip()[:60]!r}")
        stamp = _ASC_STAMP.match(line) if relative else None
        now += float(stamp[1]) if stamp else 0.0
        yield f"{now:.9f}{line[stamp.end() :]}" if stamp else line


def _as_1_3(line: str) -> str:
    """A line of a PCAN trace of version 1.2 as one of 1.3, which has a column more."""
    return _TRC_UP_TO_IDENTIFIER.sub(lambda m: f"{m[1]}3" if m[1] else f"{m[2]} -", line, count=1)


def _opened(path: Path, suffix: str, data: Contents, damage: Damage) -> tuple[_LineFeed, can.io.generic.MessageReader]:
    """The lines of a log and the reader that takes them."""
    beginning = str(data[:_HEAD], "utf-8-sig", "replace")
    lines: Iterable[str] = (line for piece in text_pieces(data) for line in piece.splitlines(keepends=True))
    if suffix == ".csv":
        feed = _LineFeed(lines, again=False)
        return feed, can.CSVReader(cast("TextIO", feed))
    if suffix == ".asc":
        base = ASC_BASE.search(beginning)
        relative = bool(base and (base["times"] or "").lower() == "relative")
        # python-can takes the first line for a header, even if it is a frame
        feed = _LineFeed(_asc_lines(lines, damage, relative), again=True)
        return feed, can.ASCReader(cast("TextIO", feed), base["base"].lower() if base else "hex")
    if not _TRC_START.search(beginning):
        raise InputError(
            f"{path}, line 1: not a PCAN trace: it has neither ';$FILEVERSION' nor lines that begin with '1)'"
        )
    feed = _LineFeed(map(_as_1_3, lines) if _TRC_1_2.search(beginning) else lines, again=False)
    return feed, _TraceReader(cast("TextIO", feed))


class _TraceReader(can.TRCReader):
    """python-can's reader of PCAN traces; raises for a line that is none instead of logging it."""

    def _parse_line(self, line: str) -> can.Message | None:
        if not line:
            return None
        if not _TRC_FRAME.match(line):
            raise ValueError("it does not begin with the frame's number")
        return self._parse_cols(tuple(line.split(maxsplit=self._num_columns)))


def read(path: Path, suffix: str, data: Contents, damage: Damage) -> FrameColumns:
    """Read a log in the format of `suffix`; what cannot be read is noted as damage."""
    if suffix == ".mf4":
        return _read_mf4(path, data, damage)
    feed, reader = _opened(path, suffix, data, damage)
    channels = ChannelNumbers()
    messages = iter(reader)
    parts: list[FrameColumns] = []
    batch: list[Frame] = []
    while True:
        try:
            message = next(messages, None)
            if message is None:
                break
            batch.append(frame_of(_checked(message, suffix), channels))
        except _BROKEN_LINE as error:
            damage.add(f"line {feed.number}", f"{str(error) or type(error).__name__}: {feed.line.strip()[:60]!r}")
            if not parts and not batch and damage.count >= BATCH:
                break
            feed.resume()
            messages = iter(reader)
        if len(batch) >= BATCH:
            parts.append(FrameColumns.of(batch))
            batch = []
    parts.append(FrameColumns.of(batch))
    if not any(map(len, parts)) and feed.number:
        _refuse(path, suffix, data, damage)
    return timed(FrameColumns.concatenate(parts), damage)


def _checked(message: can.Message, suffix: str) -> can.Message:
    """The message with its channel counted from 0. ValueError if it has not as many bytes as its DLC says."""
    length = message.dlc if message.is_fd or suffix != ".asc" else min(message.dlc, 8)  # a classic frame has no more
    if suffix == ".trc":  # the code of 9 to 15 for 12 to 64 bytes
        length = can.util.dlc2len(message.dlc)
        message.channel = max(cast("int", message.channel) - 1, 0)  # PCAN counts its buses from 1
    if len(message.data) != length and not (message.is_remote_frame or message.is_error_frame):
        raise ValueError(f"{len(message.data)} bytes of data where there should be {length}")
    return message


def _refuse(path: Path, suffix: str, data: Contents, damage: Damage) -> None:
    """InputError for a text without any frame, unless it has the header of its format and no damage."""
    if damage.count and suffix == ".csv":
        raise InputError(
            f"{path}:1: neither a log of frames (SavvyCAN's or python-can's CSV) nor a table of signals, in "
            "UTF-8 and with a column 'time [s]', or one that [table] in a vehicle file names; it begins with "
            f"{shown(str(data[:_BEGINNING], 'latin-1').partition(chr(10))[0])}"
        )
    if damage.count:
        raise InputError(f"{path}, {damage.place}: not a line of the format {suffix}: {damage.reason}")
    if not str(data[:_BEGINNING], "latin-1").lstrip().lower().startswith(_HEADERS[suffix]):
        raise InputError(f"{path}, line 1: not a log in the format {suffix}: it has no header of that format")


def _read_mf4(path: Path, data: Contents, damage: Damage) -> FrameColumns:
    """Read the frames of an MF4 file; needs asammdf."""
    with_asammdf(path)
    channels = ChannelNumbers()
    frames: list[Frame] = []
    try:
        reader = can.io.mf4.MF4Reader(io.BytesIO(bytes(data)))
        frames.extend(frame_of(message, channels) for message in reader)
    except Exception as error:  # asammdf raises all sorts of exceptions for a broken file
        if not frames:
            raise InputError(f"{path}: not a readable MF4 file: {error}") from None
        damage.add("after the last frame read", str(error))
    if not frames and (signals := sorted(set(reader._mdf.channels_db) - _MASTER_CHANNELS)):
        raise InputError(
            f"{path}: holds signals ({', '.join(signals[:3])}{', ...' if len(signals) > 3 else ''}) and no frames; "
            "save it as Parquet, which is read as a table of signals"
        )
    return FrameColumns.of(frames)


def with_asammdf(path: Path) -> None:
    """Give python-can the asammdf that it was imported without; InputError if it is not installed."""
    try:
        importlib.import_module("asammdf")
    except ImportError:
        raise InputError(f"{path}: .mf4 needs asammdf: pip install 'gz-onboard[mf4]'") from None
    if vars(can.io.mf4)["asammdf"] is None:
        importlib.reload(can.io.mf4)


def frame_of(message: can.Message, channels: dict[str, int] | None = None) -> Frame:
    """A python-can message as a frame; channels numbers the named channels (a name that it lacks raises KeyError).

    The time is rounded to a microsecond: the message's is a float of seconds, which has no more since 1970.
    """
    data = bytes(min(message.dlc, 8)) if message.is_remote_frame else bytes(message.data)
    channel: Any = message.channel
    if channel is None:
        channel = 0
    elif isinstance(channel, str):
        channel = (channels if channels is not None else {})[channel]
    return (
        round(message.timestamp * 1e6) * 1000,
        flagged(message),
        data,
        channel & 0x7F if message.is_rx else channel & 0x7F | TRANSMITTED,
    )


def message_of(frame: Frame, *, with_time: bool = True) -> can.Message:
    """A frame as a python-can message, the inverse of `frame_of`; more than 8 bytes make it a CAN FD frame."""
    time_ns, identifier, data, channel = frame
    remote = bool(identifier & RTR_FLAG)
    return can.Message(
        timestamp=time_ns * 1e-9 if with_time else 0.0,
        arbitration_id=identifier & MOST_EXTENDED,
        is_extended_id=bool(identifier & EFF_FLAG),
        is_remote_frame=remote,
        is_error_frame=bool(identifier & ERR_FLAG),
        is_fd=len(data) > 8,
        is_rx=not channel & TRANSMITTED,
        dlc=len(data),
        data=None if remote else data,
        channel=channel & ~TRANSMITTED,
    )
