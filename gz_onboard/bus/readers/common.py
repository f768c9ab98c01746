"""What the readers of all formats share: the contents of a file, its lines, and a note of what is damaged."""

from __future__ import annotations

import mmap
import re
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

from gz_onboard.errors import InputError
from gz_onboard.events import TRANSMITTED, Frame

BATCH = 1000
"""About how many frames a reader hands out at once."""

TIME_LIMIT_NS = 1 << 63
"""A time is from 0 to before this [ns since the epoch], the year 2262: what all the formats that we write can hold."""

Contents: TypeAlias = bytes | mmap.mmap

_MOST_UNPACKED = 4 << 30  # bytes: it is all in memory
_PIECE = 48 * BATCH


class Damage:
    """Collects the damage of one log while it is read."""

    def __init__(self) -> None:
        self.count = 0
        self.place = ""
        self.reason = ""

    def add(self, place: str, reason: str, count: int = 1) -> None:
        """Count a piece (or several) that cannot be read; the first one's place and reason are kept."""
        if not self.count:
            self.place, self.reason = place, reason
        self.count += count


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
    """The text in pieces of whole lines; bytes that are not ASCII do no harm."""
    position = 0
    while position < len(data):
        end = position + _PIECE
        if end < len(data):
            end = data.find(b"\n", end) + 1 or len(data)
        yield str(data[position:end], "latin-1")
        position = end


Reader: TypeAlias = Callable[[Path, Contents, Damage, int | None, int | None], Iterator[list[Frame]]]
"""(path for messages, contents, where damage is noted, start and end [ns]) -> frames; a reader may use the times
to skip what lies outside, but need not."""
