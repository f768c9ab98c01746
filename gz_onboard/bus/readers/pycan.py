"""The formats that python-can reads: ASC, CSV and TRC, and MF4 where asammdf is installed."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO, cast

from gz_onboard.bus.readers.common import BATCH, ChannelNumbers, Clock, Contents, Damage, Reader, text_pieces
from gz_onboard.errors import InputError, shown
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, TRANSMITTED, Frame

if TYPE_CHECKING:
    import can


ASC_BASE = re.compile(r"^\s*base\s+(?P<base>hex|dec)(?:\s+timestamps\s+(?P<times>absolute|relative))?", re.I | re.M)
_HEAD = 4000  # characters within which the base of an ASC log and the version of a trace stand
_BEGINNING = 100  # characters that show a reader what a file is
_ASC_STAMP = re.compile(r"\s*(\d+\.\d+)(?=\s)")
_TRC_START = re.compile(r"^\s*(?:;\$FILEVERSION|\d+\)\s)", re.M)
_TRC_FRAME = re.compile(r"\d+\)?\s")
_TRC_1_2 = re.compile(r"(;\$FILEVERSION=1\.)2|(\s*\d+\)(?:\s+\S+){4})(?=\s)")  # up to the identifier
_ASC_LINE = re.compile(
    r"\s*(?:\d+\.\d+\s|//|date\b|base\b|(?:begin|end)\s+trigger|(?:no\s+)?internal\s+events|$)", re.I
)


class _LineFeed:
    """Lines for python-can's text readers, counted; `resume` lets a reader go on after one that it choked on."""

    def __init__(self, data: Contents) -> None:
        self._lines: Iterator[str] = (line for piece in text_pieces(data) for line in piece.splitlines(keepends=True))
        self._again = False
        self.number = 0
        self.line = ""
        self.name = ""

    def asc(self, damage: Damage, relative: bool) -> None:
        """The lines are those of an ASC log: note what is none. relative: each time is that since the line before."""
        lines, now = self._lines, 0.0

        def checked() -> Iterator[str]:
            nonlocal now
            for line in lines:
                if not _ASC_LINE.match(line):
                    damage.add(f"line {self.number + 1}", f"not a line of an ASC log: {line.strip()[:60]!r}")
                stamp = _ASC_STAMP.match(line) if relative else None
                now += float(stamp[1]) if stamp else 0.0
                yield f"{now:.9f}{line[stamp.end() :]}" if stamp else line

        self._lines = checked()
        self.resume()  # python-can takes the first line for a header, even if it is a frame

    def trc(self, beginning: str) -> None:
        """The lines are those of a PCAN trace: make version 1.2 of it 1.3, which has a column more."""
        if re.search(r"^;\$FILEVERSION=1\.2\s*$", beginning, re.M):
            lines = self._lines
            self._lines = (_TRC_1_2.sub(lambda m: f"{m[1]}3" if m[1] else f"{m[2]} -", line, count=1) for line in lines)

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
        pass


def text_reader(suffix: str) -> Reader:
    """The reader of one of the text formats .asc, .csv, .trc."""

    def read(path: Path, data: Contents, damage: Damage, _start: int | None, _end: int | None) -> Iterator[list[Frame]]:
        from gz_onboard.bus._can import can

        feed, clock = _LineFeed(data), Clock(damage)
        reader: can.io.generic.MessageReader
        beginning = str(data[:_HEAD], "utf-8-sig", "replace")
        if suffix == ".trc":
            if not _TRC_START.search(beginning):
                raise InputError(
                    f"{path}, line 1: not a PCAN trace: it has neither ';$FILEVERSION' nor lines that begin with '1)'"
                )
            feed.trc(beginning)
            reader = _trace_reader(cast("TextIO", feed))
        elif suffix == ".csv":
            reader = can.CSVReader(cast("TextIO", feed))
        else:
            base = ASC_BASE.search(beginning)
            feed.asc(damage, relative=bool(base and (base["times"] or "").lower() == "relative"))
            reader = can.ASCReader(cast("TextIO", feed), base["base"].lower() if base else "hex")
        channels = ChannelNumbers()
        any_frame = False
        messages = iter(reader)
        batch: list[Frame] = []
        while True:
            try:
                message = next(messages, None)
                if message is None:
                    break
                length = _length(message, suffix)
                if len(message.data) != length and not (message.is_remote_frame or message.is_error_frame):
                    raise ValueError(f"{len(message.data)} bytes of data where there should be {length}")
                if suffix == ".trc" and isinstance(message.channel, int):
                    message.channel = max(message.channel - 1, 0)  # PCAN counts its buses from 1
                batch.append(frame_of(message, channels))
            # python-can's readers have no error of their own: these are what a line that is none raises in them.
            except (ValueError, LookupError, TypeError, AttributeError, NotImplementedError) as error:
                damage.add(f"line {feed.number}", f"{str(error) or type(error).__name__}: {feed.line.strip()[:60]!r}")
                if not any_frame and damage.count >= BATCH:
                    break
                feed.resume()
                messages = iter(reader)
                continue
            any_frame = True
            if len(batch) >= BATCH:
                yield clock.timed(batch)
                batch = []
        if not any_frame and feed.number:
            if damage.count and suffix == ".csv":
                raise InputError(
                    f"{path}:1: neither a log of frames (SavvyCAN's or python-can's CSV) nor a table of signals, in "
                    "UTF-8 and with a column 'time [s]', or one that [table] in a vehicle file names; it begins with "
                    f"{shown(str(data[:_BEGINNING], 'latin-1').partition(chr(10))[0])}"
                )
            if damage.count:
                raise InputError(f"{path}, {damage.place}: not a line of the format {suffix}: {damage.reason}")
            if not _looks_like(suffix, data):
                raise InputError(f"{path}, line 1: not a log in the format {suffix}: it has no header of that format")
        if batch:
            yield clock.timed(batch)

    return read


def _trace_reader(lines: TextIO) -> can.io.generic.MessageReader:
    """python-can's reader of PCAN traces, which raises for a line that is none instead of logging it."""
    from gz_onboard.bus._can import can

    class TraceReader(can.TRCReader):
        def _parse_line(self, line: str) -> can.Message | None:
            if not line:
                return None
            if not _TRC_FRAME.match(line):
                raise ValueError("it does not begin with the frame's number")
            return self._parse_cols(tuple(line.split(maxsplit=self._num_columns)))

    return TraceReader(lines)


def _length(message: can.Message, suffix: str) -> int:
    """How many bytes of data a message should have, by what python-can's reader of the format makes of its DLC."""
    from gz_onboard.bus._can import can

    if suffix == ".trc":  # the code of 9 to 15 for 12 to 64 bytes
        return int(can.util.dlc2len(message.dlc))
    return message.dlc if message.is_fd or suffix != ".asc" else min(message.dlc, 8)  # a classic frame has no more


def _looks_like(suffix: str, data: Contents) -> bool:
    """Whether a text without a frame in it has at least a header of its format."""
    head = str(data[:200], "latin-1").lstrip().lower()
    return head.startswith({".asc": ("date", "base", "//"), ".csv": ("timestamp",), ".trc": (";",)}[suffix])


def read_mf4(path: Path, data: Contents, damage: Damage, _start: int | None, _end: int | None) -> Iterator[list[Frame]]:
    """The frames of an MF4 file; needs asammdf."""
    import io

    from gz_onboard.bus._can import can

    with_asammdf(path)
    channels = ChannelNumbers()
    batch: list[Frame] = []
    any_frame = False
    try:
        reader = can.io.mf4.MF4Reader(io.BytesIO(bytes(data)))
        for message in reader:
            batch.append(frame_of(message, channels))
            if len(batch) >= BATCH:
                yield batch
                any_frame = True
                batch = []
    except Exception as error:  # asammdf raises all sorts of exceptions for a broken file
        if not any_frame and not batch:
            raise InputError(f"{path}: not a readable MF4 file: {error}") from None
        damage.add("after the last frame read", str(error))
    if batch:
        yield batch
    elif not any_frame and (signals := sorted(set(reader._mdf.channels_db) - {"time", "t", "timestamps"})):
        raise InputError(
            f"{path}: holds signals ({', '.join(signals[:3])}{', ...' if len(signals) > 3 else ''}) and no frames; "
            "save it as Parquet, which is read as a table of signals"
        )


def with_asammdf(path: Path) -> None:
    """Give python-can the asammdf that it was imported without; InputError if it is not installed."""
    import importlib

    from gz_onboard.bus._can import can

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
    from gz_onboard.bus._can import flagged

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
    from gz_onboard.bus._can import can

    time_ns, identifier, data, channel = frame
    remote = bool(identifier & RTR_FLAG)
    return can.Message(
        timestamp=time_ns / 1_000_000_000 if with_time else 0.0,
        arbitration_id=identifier & 0x1FFF_FFFF,
        is_extended_id=bool(identifier & EFF_FLAG),
        is_remote_frame=remote,
        is_error_frame=bool(identifier & ERR_FLAG),
        is_fd=len(data) > 8,
        is_rx=not channel & TRANSMITTED,
        dlc=len(data),
        data=None if remote else data,
        channel=channel & ~TRANSMITTED,
    )
