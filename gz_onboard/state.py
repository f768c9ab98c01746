"""The saved state of the estimator: a JSON file with a checksum, written whole or not at all, and the one before it.

NAME.json is the state, NAME.previous.json the one saved before. What cannot be used is set aside as NAME.refused-1.json
(the latest) to NAME.refused-3.json, so that it can be looked into and a restart does not meet it again.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import zlib
from collections.abc import Mapping
from math import inf
from pathlib import Path
from typing import Any

FORMAT = 2
CLOCKS_AGREE = 2.0  # s
CLOCK_BEHIND = 60.0  # s: by more, no clock that goes on while the power is off is behind the time that was saved
REFUSED = 3
"""So many refused states are kept."""

_LARGEST = 1 << 20  # bytes; a state has some thousand
_HEAD = re.compile(rb'\{"format": (\d{1,9}), "crc32": "([0-9a-f]{8})", ')


def encode(snapshot: Mapping[str, Any], time: float, uptime: float | None = None) -> bytes:
    """The text of a state file of `snapshot`, taken at `time` [s since the epoch], `uptime` [s] since the system began.

    ValueError or TypeError if the snapshot holds what JSON has no word for: not-a-number, infinities, objects.
    """
    document = {"saved_at": time, "uptime": uptime, "estimator": snapshot}
    text = json.dumps(document, allow_nan=False).encode("ascii")
    body = text[1:]  # behind the brace: what the checksum is of
    return b'{"format": %d, "crc32": "%08x", %s\n' % (FORMAT, zlib.crc32(body), body)


def decode(
    text: bytes, time: float, uptime: float | None = None, kept: float = inf
) -> tuple[Mapping[str, Any], float | None]:
    """(snapshot, its age [s] at `time` and `uptime` if the clock can be believed).

    kept: what a clock says that goes on while the power is off (`kept_time`) [s since the epoch]; inf: `time` is of
    such a clock. ValueError unless it is as it was saved.
    """
    head = _HEAD.match(text)
    if not head:
        raise ValueError("is not a saved state" if text else "is empty")
    if int(head[1]) != FORMAT:
        raise ValueError(f"is of format {int(head[1])}, not {FORMAT}")
    body = text[head.end() :]
    if not body.endswith(b"}\n") or zlib.crc32(body[:-1]) != int(head[2], 16):
        raise ValueError("is damaged: its checksum is wrong")
    try:
        document = json.loads(b"{" + body, parse_constant=_no_number)
        snapshot, saved_at, began = document["estimator"], document["saved_at"], document.get("uptime")
    except (ValueError, LookupError, TypeError, RecursionError) as error:  # the checksum is right: not written by us
        raise ValueError("is not a saved state, although its checksum is right") from error
    age = time - saved_at if isinstance(saved_at, int | float) and saved_at > 1e9 and time >= saved_at else None
    # A board without a clock of its own goes on from the last time it knew, however long it was off; one whose clock
    # has no battery as well, but that clock begins anew. What two clocks say of the same boot is believed all the same.
    if age is not None and kept < saved_at - CLOCK_BEHIND:
        same_boot = uptime and began and abs(uptime - began - age) < CLOCKS_AGREE
        age = age if same_boot else None
    return snapshot, age


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")


def kept_time(clocks: Path = Path("/sys/class/rtc")) -> float:
    """What the machine's real-time clocks say, the latest of them [s since the epoch]; -inf if there is none.

    A clock whose battery is missing, as on a Raspberry Pi 5 without one, begins at 1970 when the power comes back.
    """
    latest = -inf
    for clock in clocks.glob("rtc*/since_epoch"):
        with contextlib.suppress(OSError, ValueError):
            latest = max(latest, float(clock.read_text()))
    return latest


def write(file: Path, text: bytes) -> None:
    """Write the text of a state file, so that a power cut leaves the old one or the new one.

    The directory is made if it is not there. OSError if it cannot be written.
    """
    unfinished, file, previous = copies(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        with unfinished.open("wb") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
    except OSError:
        with contextlib.suppress(OSError):
            unfinished.unlink()
        raise
    with contextlib.suppress(FileNotFoundError):
        file.replace(previous)
    unfinished.replace(file)
    sync_directory(file.parent)


def target(file: Path) -> Path:
    """The file that is meant, where `file` is a link to it: what is beside a state is beside that."""
    with contextlib.suppress(OSError):  # it cannot be looked up: whoever reads or writes it says so
        if file.is_symlink():
            return Path(os.path.realpath(file))
    return file


def copies(file: Path) -> tuple[Path, Path, Path]:
    """Where states are, the latest first: one not yet in its place (whole or cut off), the state, the one before."""
    file = target(file)
    return file.with_suffix(".new"), file, file.with_suffix(".previous.json")


def load(
    file: Path, time: float, uptime: float | None = None, kept: float = inf
) -> tuple[Mapping[str, Any], float | None] | None:
    """What `decode` makes of one file; None if there is no such file. ValueError if it cannot be read or is damaged."""
    try:
        if not file.exists():
            return None
        if not file.is_file():
            raise ValueError("cannot be read: it is not a file")
        with file.open("rb") as stream:
            return decode(stream.read(_LARGEST), time, uptime, kept)
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from error


def set_aside(file: Path, copy: Path) -> Path | None:
    """Rename `copy` of the state `file`, which cannot be used; gives its new name, None if it cannot be renamed."""
    names = [target(file).with_suffix(f".refused-{number}.json") for number in range(1, REFUSED + 1)]
    with contextlib.suppress(OSError):
        for newer, older in zip(names[-2::-1], names[:0:-1], strict=True):
            if newer.exists():
                newer.replace(older)
        return copy.replace(names[0])
    return None


def sync_directory(directory: Path) -> None:
    """Bring the names of a directory onto the disk: else a new file may be gone after a power cut."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
