"""The formats that python-can reads: ASC, CSV and TRC, and MF4 where asammdf is installed."""

from __future__ import annotations

import importlib
import io
import re
from pathlib import Path
from typing import Any, cast

from gz_onboard.can.python_can import can, flagged
from gz_onboard.errors import InputError, shown
from gz_onboard.events import EFF_FLAG, ERR_FLAG, MOST_EXTENDED, RTR_FLAG, TRANSMITTED, Frame
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.readers.contents import Contents, LogDamage
from gz_onboard.recording.readers.text import ChannelNumbers, Parser, read_lines

_HEAD = 4000  # characters within which the base of an ASC log and the version of a trace stand
_SHOWN = 100  # characters that show a reader what a file is
_ASC_STAMP = re.compile(r"\s*(\d+\.\d+)(?=\s)")
_TRC_START = re.compile(r"^\s*(?:;\$FILEVERSION|\d+\)\s)", re.M)
_TRC_FRAME = re.compile(r"\d+\)?\s")
_TRC_1_2 = re.compile(r"^;\$FILEVERSION=1\.2\s*$", re.M)
_TRC_UP_TO_IDENTIFIER = re.compile(r"(;\$FILEVERSION=1\.)2|(\s*\d+\)(?:\s+\S+){4})(?=\s)")
_ASC_LINE = re.compile(
    r"\s*(?:\d+\.\d+\s|//|date\b|base\b|(?:begin|end)\s+trigger|(?:no\s+)?internal\s+events|$)", re.I
)
_HEADERS = {".csv": ("timestamp",), ".trc": (";",)}  # what lines begin with that hold no frame
_MASTER_CHANNELS = {"time", "t", "timestamps"}  # of an MF4
# python-can's readers have no error of their own: these are what a line that is none raises in them.
_BROKEN_LINE = (ValueError, LookupError, TypeError, AttributeError, NotImplementedError)


class _TraceReader(can.TRCReader):
    """python-can's reader of PCAN traces; raises for a damaged line instead of logging it."""

    def _parse_line(self, line: str) -> can.Message | None:
        if not line:
            return None
        if not _TRC_FRAME.match(line):
            raise ValueError("it does not begin with the frame's number")
        return self._parse_cols(tuple(line.split(maxsplit=self._num_columns)))


def _twice(line: str = "") -> io.StringIO:
    """A line as a file that has it twice, for python-can's readers, which take the first line for a header."""
    return io.StringIO(f"{line.rstrip()}\n" * 2)


def read(suffix: str, data: Contents, damage: LogDamage) -> FrameColumns:
    """Read a log in the format of `suffix`; what cannot be read is noted as damage."""
    if suffix == ".mf4":
        return _read_mf4(data, damage)
    if suffix == ".asc":
        return read_lines(data, damage, _asc_parser(), "an ASC log")
    beginning = str(data[:_HEAD], "utf-8-sig", "replace")
    if suffix == ".trc":
        if not _TRC_START.search(beginning):
            raise InputError(
                f"{damage.path}, line 1: not a PCAN trace: it has neither ';$FILEVERSION' nor lines that "
                "begin with '1)'"
            )
        as_read = _as_1_3 if _TRC_1_2.search(beginning) else str
        parse = _parser(_TraceReader(_twice()), suffix)
        return read_lines(data, damage, lambda line: parse(as_read(line)), "a PCAN trace")
    try:
        reader = can.CSVReader(_twice())
        return read_lines(data, damage, _parser(reader, suffix), "python-can's CSV")
    except InputError:
        raise InputError(
            f"{damage.path}:1: neither a log of frames (SavvyCAN's or python-can's CSV) nor a table of signals, in "
            "UTF-8 and with a column 'time [s]', or one that [table] in a vehicle file names; it begins with "
            f"{shown(beginning.partition(chr(10))[0][:_SHOWN])}"
        ) from None


def _parser(reader: Any, suffix: str) -> Parser:
    """Parse lines by one of python-can's readers, which remembers the header."""
    channels = ChannelNumbers()
    header = _HEADERS.get(suffix, ())

    def parse(line: str) -> Frame | None:
        reader.file = _twice(line)
        is_header = line.lstrip().lower().startswith(header)
        try:
            message = next(iter(reader), None)
            return None if is_header or message is None else frame_of(_checked(message, suffix), channels)
        except _BROKEN_LINE as error:
            if is_header:
                return None
            raise ValueError(str(error) or type(error).__name__) from None

    return parse


def _asc_parser() -> Parser:
    """Parse lines of an ASC log; where its times are relative, each is that since the line before."""
    reader = can.ASCReader(_twice())
    parse_line, now = _parser(reader, ".asc"), 0.0

    def parse(line: str) -> Frame | None:
        nonlocal now
        if not _ASC_LINE.match(line):
            raise ValueError("not a line of an ASC log")
        if reader.timestamps_format == "relative" and (stamp := _ASC_STAMP.match(line)):
            now += float(stamp[1])
            line = f"{now:.9f}{line[stamp.end() :]}"
        return parse_line(line)

    return parse


def _as_1_3(line: str) -> str:
    """A line of a PCAN trace of version 1.2 as one of 1.3, which has a column more."""
    return _TRC_UP_TO_IDENTIFIER.sub(lambda m: f"{m[1]}3" if m[1] else f"{m[2]} -", line, count=1)


def _checked(message: can.Message, suffix: str) -> can.Message:
    """The message with its channel counted from 0. ValueError if it has not as many bytes as its DLC says."""
    length = message.dlc if message.is_fd or suffix != ".asc" else min(message.dlc, 8)  # a classic frame has no more
    if suffix == ".trc":  # the code of 9 to 15 for 12 to 64 bytes
        length = can.util.dlc2len(message.dlc)
        message.channel = max(cast("int", message.channel) - 1, 0)  # PCAN counts its buses from 1
    if len(message.data) != length and not (message.is_remote_frame or message.is_error_frame):
        raise ValueError(f"{len(message.data)} bytes of data where there should be {length}")
    return message


def _read_mf4(data: Contents, damage: LogDamage) -> FrameColumns:
    """Read the frames of an MF4 file; needs asammdf."""
    with_asammdf(damage.path)
    channels = ChannelNumbers()
    frames: list[Frame] = []
    try:
        reader = can.io.mf4.MF4Reader(io.BytesIO(bytes(data)))
        frames.extend(frame_of(message, channels) for message in reader)
    except Exception as error:  # asammdf raises all sorts of exceptions for a broken file
        if not frames:
            raise InputError(f"{damage.path}: not a readable MF4 file: {error}") from None
        damage.add("after the last frame read", str(error))
    if not frames and (signals := sorted(set(reader._mdf.channels_db) - _MASTER_CHANNELS)):
        raise InputError(
            f"{damage.path}: holds signals ({', '.join(signals[:3])}{', ...' if len(signals) > 3 else ''}) "
            "and no frames; save it as Parquet, which is read as a table of signals"
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
    """Convert a python-can message to a frame; `channels` maps named channels (KeyError for an unknown name).

    The time is rounded to a microsecond: the message's is a float of seconds, which has no more since 1970.
    """
    data = bytes(min(message.dlc, 8)) if message.is_remote_frame else bytes(message.data)
    channel: Any = message.channel or 0
    if isinstance(channel, str):
        channel = ({} if channels is None else channels)[channel]
    return (
        round(message.timestamp * 1e6) * 1000,
        flagged(message),
        data,
        channel & 0x7F if message.is_rx else channel & 0x7F | TRANSMITTED,
    )


def message_of(frame: Frame) -> can.Message:
    """A frame as a python-can message, the inverse of `frame_of`; more than 8 bytes make it a CAN FD frame."""
    time_ns, identifier, data, channel = frame
    return can.Message(
        timestamp=time_ns / 1_000_000_000,
        arbitration_id=identifier & MOST_EXTENDED,
        is_extended_id=bool(identifier & EFF_FLAG),
        is_remote_frame=bool(identifier & RTR_FLAG),
        is_error_frame=bool(identifier & ERR_FLAG),
        is_fd=len(data) > 8,
        is_rx=not channel & TRANSMITTED,
        dlc=len(data),
        data=None if identifier & RTR_FLAG else data,
        channel=channel & ~TRANSMITTED,
    )
