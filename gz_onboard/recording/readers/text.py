"""Text logs with a frame on each line: candump's and SavvyCAN's CSV."""

from __future__ import annotations

import logging
import re
from codecs import BOM_UTF8
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from io import StringIO
from typing import TypeAlias

import numpy as np

from gz_onboard.errors import InputError, shown
from gz_onboard.events import EFF_FLAG, ERR_FLAG, MOST_EXTENDED, MOST_STANDARD, RTR_FLAG, TRANSMITTED, Frame
from gz_onboard.recording.frames import BATCH, FD_LENGTHS, FrameColumns
from gz_onboard.recording.readers.contents import Contents, LogDamage

_LOG = logging.getLogger(__name__)

_SINCE_1970_NS = 100_000_000 * 1_000_000_000  # in 1973: no log is so old, and no vehicle runs for so long
_MOST_BACK = 0.25  # share of the stamps that are before the one before: more are times since the frame before,
_LONGEST_STEP_NS = 60 * 1_000_000_000  # if none is longer than this
_PIECE = 48 * BATCH  # characters of text that are parsed at once


Parser: TypeAlias = Callable[[str], Frame | None]
"""Takes a line with its line end; None for one that holds no frame. Raises ValueError for one that is damaged."""


def read_lines(data: Contents, damage: LogDamage, parse: Parser, name: str) -> FrameColumns:
    """Read a text log with a frame on each line. name: of the format, for messages.

    InputError if there is no frame before the first damage.
    """
    number, position = 0, len(BOM_UTF8) if data[: len(BOM_UTF8)] == BOM_UTF8 else 0
    parts: list[FrameColumns] = []
    while position < len(data):
        end = data.find(b"\n", position + _PIECE) + 1 or len(data)
        text, position = str(data[position:end], "latin-1"), end  # bytes that are not ASCII do no harm
        frames: list[Frame] = []
        for line in StringIO(text):
            number += 1
            try:
                if line.strip() and (frame := parse(line)):
                    frames.append(frame)
            except ValueError as error:
                damage.add(f"line {number}", f"{error}: {shown(line.strip()[:60])}")
        if damage.count and not frames and not parts:
            raise InputError(f"{damage.path}, {damage.place}: cannot be read as {name}: {damage.reason}")
        if frames:
            parts.append(FrameColumns.of(frames))
    return timed(FrameColumns.concatenate(parts), damage)


def timed(frames: FrameColumns, damage: LogDamage) -> FrameColumns:
    """Turn the stamps of a text log into times.

    Stamps count since 1970, since an unknown start, or since the frame before; or there are none. The first frames tell
    which; times that are not since 1970 cause a warning.
    """
    stamps = frames.time_ns
    first = stamps[:BATCH]
    if not len(stamps) or first[0] >= _SINCE_1970_NS:
        return frames
    if not first.any():
        _LOG.warning("%s: has no times: every frame is taken as at 0 s", damage.path)
        return frames
    short = first.min() >= 0 and first.max() <= _LONGEST_STEP_NS
    if short and (np.diff(first) < 0).sum() > _MOST_BACK * len(first):
        _LOG.warning("%s: its times are those since the frame before, and are added up", damage.path)
        return replace(frames, time_ns=np.cumsum(stamps))
    _LOG.warning("%s: its times are those since an unknown start, not since 1970", damage.path)
    start = first.min() if first[0] < 0 else 0  # of a clock that was set while recording
    return replace(frames, time_ns=stamps - start)


def stamp_ns(text: str, unit_ns: int = 1_000_000_000) -> int:
    """A decimal number of seconds in ns; one without a point is in units of `unit_ns`. Raises ValueError."""
    whole, point, fraction = text.partition(".")
    if not point:
        return int(whole) * unit_ns
    nanoseconds = int(fraction[:9].ljust(9, "0"))
    return int(whole) * 1_000_000_000 + (-nanoseconds if whole.startswith("-") else nanoseconds)


class ChannelNumbers(dict[str, int]):
    """Name of an interface -> channel: the number that the name ends in, or the next that is free."""

    def __missing__(self, name: str) -> int:
        digits = re.search(r"\d+$", name)
        number = int(digits[0]) if digits else 0
        if number >= TRANSMITTED or number in self.values():
            number = next(free for free in range(TRANSMITTED) if free not in self.values())
        self[name] = number
        return number


# --- candump ------------------------------------------------------------------------------------------------------

CANDUMP_LINE = re.compile(
    r"(?:\((?P<stamp>[^)]+)\)\s+)?(?P<channel>[^\s(]\S*)\s+(?:(?P<screen>[RT])X\s+\S\s+\S\s+)?"
    r"(?P<id>[0-9A-Fa-f]{1,8})(?:"
    r"#(?:#[0-9A-Fa-f](?P<fd>(?:[0-9A-Fa-f]{2}){0,64})|[Rr](?P<asked>[0-8]?)|(?P<data>(?:[0-9A-Fa-f]{2}){0,8}))"
    r"(?:\s+(?P<log>[RrTt]))?|"
    r"\s+\[(?P<length>\d{1,2})\](?:\s+(?P<remote>remote request)|(?P<spaced>(?:\s*[0-9A-Fa-f]{2})*))"
    r"\s*(?:'.*'|ERRORFRAME)?)"
)
_EIGHT_BYTES = 16  # digits


class _Identifiers(dict[str, int]):
    """Text of an identifier in a candump -> identifier with flags: more than 3 digits mean 29 bits."""

    def __missing__(self, text: str) -> int:
        value = int(text, 16)
        if len(text) > 3:
            value = value if value & ERR_FLAG else (value & MOST_EXTENDED) | EFF_FLAG
        elif value > MOST_STANDARD:
            raise ValueError(f"identifier {text} has more than 11 bits")
        self[text] = value
        return value


def read_candump(data: Contents, damage: LogDamage) -> FrameColumns:
    """Read the frames of a candump log, whose dates are UTC; other lines are noted as damage."""
    identifiers, channels = _Identifiers(), ChannelNumbers()

    def parse(line: str) -> Frame | None:
        if line.startswith("\t"):  # explains the error frame above it
            return None
        if not (match := CANDUMP_LINE.fullmatch(line.strip())):
            raise ValueError("not a line of a candump log")
        if not line.endswith("\n") and match["length"] is None and len(match["data"] or "") < _EIGHT_BYTES:
            raise ValueError("the last line has no end, so data may be missing")
        identifier = identifiers[match["id"]]
        data = bytes.fromhex(match["fd"] or match["data"] or match["spaced"] or "")
        length = int(match["length"] or match["asked"] or len(data))
        if match["remote"] or match["asked"] is not None:
            identifier |= RTR_FLAG
            data = bytes(min(length, 8))
        elif len(data) != length:
            raise ValueError(f"{len(data)} bytes where there should be {length}")
        time_ns, stamp, channel = 0, match["stamp"], channels[match["channel"]]
        if stamp and "-" in stamp[1:]:
            since = datetime.fromisoformat(stamp).replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
            time_ns = since // timedelta(microseconds=1) * 1000
        elif stamp:
            time_ns = stamp_ns(stamp)
        sent = (match["screen"] or match["log"] or "R").upper() == "T"
        return time_ns, identifier, data, channel | (TRANSMITTED if sent else 0)

    return read_lines(data, damage, parse, "a candump log")


# --- SavvyCAN -----------------------------------------------------------------------------------------------------

SAVVYCAN_HEADER = re.compile(r"\s*\"?time ?stamp[^,]*,\s*id,\s*extended,(?P<direction>\s*dir,)?\s*bus,\s*len\b", re.I)
_BEGINNING = 200  # bytes that hold the header
_MICROSECOND_NS = 1000  # unit of stamps without a decimal point


def read_savvycan(data: Contents, damage: LogDamage) -> FrameColumns:
    """Read SavvyCAN's CSV; other lines are noted as damage.

    Columns: time stamp, identifier, extended, direction (not in the older form), bus, length, bytes.
    """
    header = SAVVYCAN_HEADER.search(str(data[:_BEGINNING], "latin-1"))
    later = 1 if header and header["direction"] else 0

    def parse(line: str) -> Frame | None:
        if SAVVYCAN_HEADER.match(line):
            return None
        cells = [cell.strip() for cell in line.split(",")]
        if len(cells) < 5 + later:
            raise ValueError(f"{len(cells)} columns where there should be {5 + later} or more")
        identifier, length = int(cells[1], 16), int(cells[4 + later])
        if not 0 <= identifier <= MOST_EXTENDED:
            raise ValueError(f"identifier {identifier:X} has more than 29 bits")
        if cells[2].lower() in ("true", "1") or identifier > MOST_STANDARD:
            identifier |= EFF_FLAG
        digits = cells[5 + later : 5 + later + length]
        if length not in FD_LENGTHS or len(digits) != length or any(len(byte) != 2 for byte in digits):
            raise ValueError(f"not {length} bytes of two digits, as a frame may have")
        channel = int(cells[3 + later]) & ~TRANSMITTED | (TRANSMITTED if later and cells[3][:1] in "Tt" else 0)
        return stamp_ns(cells[0], _MICROSECOND_NS), identifier, bytes.fromhex("".join(digits)), channel

    return read_lines(data, damage, parse, "SavvyCAN's CSV")
