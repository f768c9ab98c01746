"""The file of the saved state: JSON with a checksum, replaced atomically, and one previous copy.

``NAME.json`` is the state, ``NAME.previous.json`` the one saved before it.
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

CLOCKS_AGREE_S = 2.0
CLOCK_BEHIND_S = 60.0  # a clock that runs while the power is off is behind the saved time by no more
CLOCK_SET_S = 1e9  # since the epoch: an earlier time is of a clock that was never set
LARGEST_FILE_BYTES = 1 << 20  # a state has some thousand

_HEAD = re.compile(rb'\{"crc32": "([0-9a-f]{8})", ')


def state_file(directory: Path, vehicle: str) -> Path:
    """Return the path of the saved state of the vehicle with this name."""
    return directory / (re.sub(r"[^\w.+-]+", "-", vehicle) + ".json")


def encode(snapshot: Mapping[str, Any], time: float, uptime: float | None = None) -> bytes:
    """Encode a snapshot taken at `time` [s since the epoch], `uptime` [s] after the system started.

    ValueError or TypeError if the snapshot holds something that JSON cannot: not-a-number, infinities, objects.
    """
    document = {"saved_at": time, "uptime": uptime, "estimator": snapshot}
    body = json.dumps(document, allow_nan=False).encode("ascii")[1:]
    return b'{"crc32": "%08x", %s\n' % (zlib.crc32(body), body)


def decode(
    text: bytes, time: float, uptime: float | None = None, kept: float = inf
) -> tuple[Mapping[str, Any], float | None]:
    """Decode a file to (snapshot, its age [s] at `time` and `uptime`; None where no clock can be believed).

    kept: time of a clock that runs while the power is off (`kept_time`) [s since the epoch]; inf: `time` is of such a
    clock. ValueError unless the file is exactly as `encode` made it.
    """
    head = _HEAD.match(text)
    if not head:
        raise ValueError("is not a saved state" if text else "is empty")
    body = text[head.end() :]
    if zlib.crc32(body[:-1]) != int(head[1], 16) or not body.endswith(b"}\n"):
        raise ValueError("is damaged: its checksum is wrong")
    try:
        document = json.loads(b"{" + body)
        snapshot, saved_at, saved_uptime = document["estimator"], float(document["saved_at"]), document["uptime"]
    except (ValueError, LookupError, TypeError, OverflowError, RecursionError) as error:  # not written by `encode`
        raise ValueError("is not a saved state, although its checksum is right") from error
    age = time - saved_at if CLOCK_SET_S < saved_at <= time else None
    # A board without a real-time clock continues from the last time it knew, however long it was off. Two clocks that
    # agree on the time since the same boot are believed all the same.
    if age is not None and kept < saved_at - CLOCK_BEHIND_S:
        same_boot = uptime and saved_uptime and abs(uptime - saved_uptime - age) < CLOCKS_AGREE_S
        age = age if same_boot else None
    return snapshot, age


def kept_time(clocks: Path = Path("/sys/class/rtc")) -> float:
    """Read the latest of the machine's real-time clocks [s since the epoch]; -inf if there is none.

    A clock without a battery, as on a bare Raspberry Pi 5, restarts in 1970 when the power comes back.
    """
    latest = -inf
    for clock in clocks.glob("rtc*/since_epoch"):
        with contextlib.suppress(OSError, ValueError):
            latest = max(latest, float(clock.read_text()))
    return latest


def write(file: Path, text: bytes) -> None:
    """Write a state file and keep the one before it; a power cut leaves at least one of them whole.

    Makes the folder if there is none. OSError if the file cannot be written.
    """
    file, previous = copies(file)
    new = file.with_suffix(".new")
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        with new.open("wb") as stream:
            stream.write(text)
            stream.flush()
            os.fsync(stream.fileno())
    except OSError:
        new.unlink(missing_ok=True)
        raise
    with contextlib.suppress(FileNotFoundError):
        file.replace(previous)
    new.replace(file)
    sync_directory(file.parent)


def copies(file: Path) -> tuple[Path, Path]:
    """Return the paths of the state and of the one before it, of the target if `file` is a symbolic link."""
    file = Path(os.path.realpath(file))
    return file, file.with_suffix(".previous.json")


def load(
    file: Path, time: float, uptime: float | None = None, kept: float = inf
) -> tuple[Mapping[str, Any], float | None] | None:
    """`decode` one file; None if there is no such file. ValueError if it cannot be read or is damaged."""
    try:
        if file.exists() and not file.is_file():
            raise ValueError("cannot be read: it is not a file")  # reading a pipe would never end
        with file.open("rb") as stream:
            text = stream.read(LARGEST_FILE_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ValueError(f"cannot be read: {error.strerror or error}") from error
    return decode(text, time, uptime, kept)


def sync_directory(directory: Path) -> None:
    """Write a folder's entries to the disk; otherwise a new file may be gone after a power cut."""
    descriptor = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
