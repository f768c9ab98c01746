"""What the readers of all formats share: the contents of a file, its lines and times, and a note of what is damaged."""

from __future__ import annotations

import gzip
import mmap
import re
import zlib
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator
from dataclasses import replace
from io import BytesIO, StringIO
from pathlib import Path
from typing import TypeAlias

import numpy as np

from gz_onboard.errors import InputError, shown
from gz_onboard.events import TRANSMITTED, Frame
from gz_onboard.recording.frames import BATCH, FrameColumns

Contents: TypeAlias = bytes | mmap.mmap

_SINCE_1970_NS = 100_000_000 * 1_000_000_000  # in 1973: no log is so old, and no vehicle runs for so long
_MOST_BACK = 0.25  # share of the stamps that are before the one before: more are times since the frame before,
_LONGEST_STEP_NS = 60 * 1_000_000_000  # if none is longer than this
_MOST_UNPACKED = 4 << 30  # bytes: it is all in memory
_UNPACKED_AT_ONCE = 1 << 20  # bytes
_PIECE = 48 * BATCH  # characters of text that are parsed at once


class Damage:
    """Collects the damage of one log while it is read."""

    def __init__(self) -> None:
        self.count = 0
        self.place = ""
        self.reason = ""
        self.notes: list[str] = []  # what else there is to say of the log

    def add(self, place: str, reason: str, count: int = 1) -> None:
        """Count pieces that cannot be read; place and reason of the first are kept."""
        if not self.count:
            self.place, self.reason = place, reason
        self.count += count


Reader: TypeAlias = Callable[[Path, Contents, Damage], FrameColumns]
"""Takes the path for messages, the contents, and where damage is noted. Raises InputError for another format."""

Parser: TypeAlias = Callable[[str], Frame | None]
"""Takes a line with its line end; None for one that holds no frame. Raises ValueError for one that is damaged."""


def unpacked(path: Path, data: Contents, damage: Damage) -> Contents:
    """Unpack a gzipped log as far as possible; others are returned as they are."""
    if path.suffix.lower() != ".gz":
        return data
    parts: list[bytes] = []
    size = 0
    with gzip.GzipFile(fileobj=BytesIO(data)) as stream:
        try:
            while piece := stream.read1(_UNPACKED_AT_ONCE):
                parts.append(piece)
                size += len(piece)
                if size > _MOST_UNPACKED:
                    damage.add(f"byte {size} of what is packed", f"more than {_MOST_UNPACKED >> 30} GiB; the rest")
                    break
        except (OSError, EOFError, zlib.error) as error:
            if not parts:
                raise InputError(f"{path}: not a gzip file ({error})") from None
            damage.add("the gzip stream", f"it is cut off or broken ({error}); nothing after it can be read")
    return b"".join(parts)


def text_pieces(data: Contents) -> Iterator[str]:
    """Yield the text in pieces of whole lines, without a byte order mark; bytes that are not ASCII do no harm."""
    position = len(BOM_UTF8) if data[: len(BOM_UTF8)] == BOM_UTF8 else 0
    while position < len(data):
        end = position + _PIECE
        if end < len(data):
            end = data.find(b"\n", end) + 1 or len(data)
        yield str(data[position:end], "latin-1")
        position = end


def read_lines(
    path: Path,
    data: Contents,
    damage: Damage,
    parse: Parser,
    name: str,
    parse_many: Callable[[str], list[Frame] | None] = lambda _text: None,
) -> FrameColumns:
    """Read a text log with a frame on each line.

    parse_many: parses many lines at once; None if any line needs `parse`. name: of the format, for messages. Raises
    InputError if there is no frame before the first damage.
    """
    number = 0
    parts: list[FrameColumns] = []
    for text in text_pieces(data):
        frames = parse_many(text)
        if frames is None:
            frames = []
            for at, line in enumerate(StringIO(text), number + 1):
                try:
                    if line.strip() and (frame := parse(line)):
                        frames.append(frame)
                except ValueError as error:
                    damage.add(f"line {at}", f"{error}: {shown(line.strip()[:60])}")
            if damage.count and not frames and not parts:
                raise InputError(f"{path}, {damage.place}: not a line of {name}: {damage.reason}")
        if frames:
            parts.append(FrameColumns.of(frames))
        number += text.count("\n")
    return timed(FrameColumns.concatenate(parts), damage)


def timed(frames: FrameColumns, damage: Damage) -> FrameColumns:
    """Turn the stamps of a text log into times.

    Stamps count since 1970, since an unknown start, or since the frame before; or there are none. The first frames tell
    which; what is not since 1970 is noted in `damage`.
    """
    stamps = frames.time_ns
    first = stamps[:BATCH]
    if not len(stamps) or first[0] >= _SINCE_1970_NS:
        return frames
    if not first.any():
        damage.notes.append("has no times: every frame is taken as at 0 s")
        return frames
    short = first.min() >= 0 and first.max() <= _LONGEST_STEP_NS
    if short and (np.diff(first) < 0).sum() > _MOST_BACK * len(first):
        damage.notes.append("its times are those since the frame before, and are added up")
        return replace(frames, time_ns=np.cumsum(stamps))
    damage.notes.append("its times are those since an unknown start, not since 1970")
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
