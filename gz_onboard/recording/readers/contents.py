"""Contents of log files and the damage found in them."""

from __future__ import annotations

import gzip
import mmap
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TypeAlias

from gz_onboard.errors import InputError
from gz_onboard.recording.frames import FrameColumns

Contents: TypeAlias = bytes | mmap.mmap

_UNPACKED_AT_ONCE = 1 << 20  # bytes


@dataclass
class LogDamage:
    """Count of the pieces of a log (lines, objects, chunks) that could not be read; place and reason of the first."""

    path: Path
    count: int = 0
    place: str = ""
    reason: str = ""

    def __str__(self) -> str:
        more = f" and {self.count - 1} more" if self.count > 1 else ""
        return f"{self.path}: {self.place}: {self.reason}{more}: skipped"

    def add(self, place: str, reason: str, count: int = 1) -> None:
        """Count pieces that cannot be read; place and reason of the first are kept."""
        if not self.count:
            self.place, self.reason = place, reason
        self.count += count


Reader: TypeAlias = Callable[[Contents, LogDamage], FrameColumns]
"""Reads the contents of a log and notes its damage. Raises InputError for another format."""


def unpacked(data: Contents, damage: LogDamage) -> Contents:
    """Unpack a gzipped log as far as possible; others are returned as they are."""
    if damage.path.suffix.lower() != ".gz":
        return data
    parts: list[bytes] = []
    with gzip.GzipFile(fileobj=BytesIO(data)) as stream:
        try:
            while piece := stream.read1(_UNPACKED_AT_ONCE):
                parts.append(piece)
        except (OSError, EOFError, zlib.error) as error:
            if not parts:
                raise InputError(f"{damage.path}: not a gzip file ({error})") from None
            damage.add("the gzip stream", f"it is cut off or broken ({error}); nothing after it can be read")
    return b"".join(parts)
