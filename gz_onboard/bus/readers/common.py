"""What the readers of all formats share: the contents of a file, its lines, and a note of what is damaged."""

from __future__ import annotations

import mmap
import re
import zlib
from codecs import BOM_UTF8
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

from gz_onboard.errors import InputError
from gz_onboard.events import TRANSMITTED, Frame

BATCH = 1000
"""About how many frames a reader hands out at once."""

TIME_LIMIT_NS = 1 << 63
"""A time is from 0 to before this [ns since the epoch], the year 2262: what all the formats that we write can hold."""

Contents: TypeAlias = bytes | mmap.mmap

FD_LENGTHS = frozenset((*range(9), 12, 16, 20, 24, 32, 48, 64))
"""How many bytes of data a frame may have."""

_SINCE_1970_NS = 100_000_000 * 1_000_000_000  # in 1973: no log is so old, and no vehicle runs for so long
_MOST_BACK = 0.25  # share of the stamps that are before the one before: more are times since the frame before,
_LONGEST_STEP_NS = 60 * 1_000_000_000  # if none is longer than this

_MOST_UNPACKED = 4 << 30  # bytes: it is all in memory
_PIECE = 48 * BATCH


class Damage:
    """Collects the damage of one log while it is read."""

    def __init__(self) -> None:
        self.count = 0
        self.place = ""
        self.reason = ""
        self.notes: list[str] = []  # what else there is to say of the log

    def add(self, place: str, reason: str, count: int = 1) -> None:
        """Count a piece (or several) that cannot be read; the first one's place and reason are kept."""
        if not self.count:
            self.place, self.reason = place, reason
        self.count += count


class Clock:
    """Times out of the stamps of a text log: since 1970, since an unknown start, since the frame before, or none.

    Which of these, the first frames tell; what is not since 1970 is noted in `damage`.
    """

    def __init__(self, damage: Damage) -> None:
        self._damage = damage
        self._decided = self._steps = False
        self._start = self._now = 0  # ns

    def timed(self, frames: list[Frame]) -> list[Frame]:
        """The next `frames`, whose times are their stamps [ns], with their times [ns]."""
        if frames and not self._decided:
            self._decide([frame[0] for frame in frames])
        if self._steps:
            for i, (stamp, *rest) in enumerate(frames):
                self._now += stamp
                frames[i] = (self._now, *rest)  # type: ignore[assignment]
        elif self._start:
            return [(time_ns - self._start, *rest) for time_ns, *rest in frames]  # type: ignore[misc]
        return frames

    def _decide(self, stamps: list[int]) -> None:
        self._decided = True
        if stamps[0] >= _SINCE_1970_NS:
            return
        if not any(stamps):
            self._damage.notes.append("has no times: every frame is taken as at 0 s")
            return
        back = sum(after < before for before, after in pairwise(stamps))
        short = min(stamps) >= 0 and max(stamps) <= _LONGEST_STEP_NS
        self._steps = short and back > _MOST_BACK * len(stamps)
        self._start = min(stamps) if stamps[0] < 0 else 0  # of a clock that was set while recording
        since = "the frame before, and are added up" if self._steps else "an unknown start, not since 1970"
        self._damage.notes.append(f"its times are those since {since}")


def stamp_ns(text: str, unit_ns: int = 1_000_000_000) -> int:
    """A decimal number of seconds in ns; one without a point is of `unit_ns`. Raises ValueError."""
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


def unpacked(path: Path, data: Contents, damage: Damage) -> Contents:
    """The log itself: unpacked if gzipped, as far as that can be done."""
    if path.suffix.lower() != ".gz":
        return data
    parts = []
    position = size = 0
    while position < len(data):
        unpacker = zlib.decompressobj(wbits=31)
        try:
            while not unpacker.eof and position < len(data):
                piece = data[position : position + 16384]
                parts.append(unpacker.decompress(piece))
                position += len(piece) - len(unpacker.unused_data)
                size += len(parts[-1])
                if size > _MOST_UNPACKED:
                    damage.add(f"byte {position}", f"it unpacks to more than {_MOST_UNPACKED >> 30} GiB; the rest")
                    return b"".join(parts)
        except zlib.error as error:
            if not parts:
                raise InputError(f"{path}: not a gzip file ({error})") from None
            damage.add(f"byte {position}", f"the gzip stream is broken ({error}); nothing after it can be read")
            break
        if not unpacker.eof:
            damage.add(f"byte {len(data)}", "the gzip stream is cut off")
    return b"".join(parts)


def text_pieces(data: Contents) -> Iterator[str]:
    """The text in pieces of whole lines, without a byte order mark; bytes that are not ASCII do no harm."""
    position = len(BOM_UTF8) if data[: len(BOM_UTF8)] == BOM_UTF8 else 0
    while position < len(data):
        end = position + _PIECE
        if end < len(data):
            end = data.find(b"\n", end) + 1 or len(data)
        yield str(data[position:end], "latin-1")
        position = end


Reader: TypeAlias = Callable[[Path, Contents, Damage, int | None, int | None], Iterator[list[Frame]]]
"""(path for messages, contents, where damage is noted, start and end [ns]) -> frames; a reader may use the times
to skip what lies outside, but need not."""
