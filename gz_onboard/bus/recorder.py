"""A directory of logs: begins, rotates, completes and deletes them; a full disk or a broken one raises nothing.

There is no clock: times come with the frames and samples.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from gz_onboard.bus.completion import complete, is_complete, lock
from gz_onboard.bus.logfile import LogFile
from gz_onboard.errors import InputError
from gz_onboard.events import Frame
from gz_onboard.state import sync_directory

_NAME = re.compile(r"(\d{8}T\d{6}Z)_(.+?)(?:~(\d{1,9}))?\.mcap")
_LEFT_FREE = 64 << 20  # bytes
_LEAST_ROOM = 64 << 10  # bytes: the beginning of a file has some 20 kB, with the DBC files


@dataclass(frozen=True)
class Limits:
    """How often a `Recorder` syncs, when it closes a file, how much it keeps, how long it waits after an error.

    InputError for limits that cannot be kept.
    """

    sync_s: float = 1.5
    max_file_bytes: int = 64 << 20
    max_age_s: float = 3600.0
    max_total_bytes: int = 1 << 30
    retry_s: float = 10.0

    def __post_init__(self) -> None:
        if not 0 < self.max_file_bytes <= self.max_total_bytes:
            raise InputError(
                f"log: a file of up to {self.max_file_bytes} bytes does not fit into {self.max_total_bytes} bytes in "
                "all; make the total larger or the files smaller"
            )


LIMITS = Limits()


class Recorder:
    """Logs into a directory of MCAP files named by their start in UTC, the vehicle and a running number.

    Nothing is raised for an error in writing: it closes the file and is counted in `errors` (its text in `last_error`);
    recording goes on with a new file `retry_s` later, and `lost_frames` counts the frames not known to be in a file.
    Before a new file is begun, the oldest of those named as ours (by their running numbers: clocks are set) are deleted
    until all together, with the new one, stay below `max_total_bytes`, and leave free on the file system what
    `free_space` says; other files are not touched, nor are files that are being written.
    """

    def __init__(
        self,
        directory: Path,
        vehicle: str,
        metadata: Mapping[str, str] | None = None,
        attachments: Mapping[str, bytes] | None = None,
        limits: Limits = LIMITS,
    ) -> None:
        self.path: Path | None = None
        self.paths: list[Path] = []
        self.errors = 0
        self.last_error = ""
        self.lost_frames = 0
        self._directory = directory
        self._vehicle = re.sub(r"[^\w.+-]+", "-", vehicle) or "vehicle"
        self._metadata = {"vehicle": vehicle, **(metadata or {})}
        self._attachments = dict(attachments or {})
        self._channels: dict[str, tuple[Mapping[str, Any], Mapping[str, str]]] = {}
        self._limits = limits
        self._sync_ns = round(limits.sync_s * 1e9)
        self._retry_ns = round(limits.retry_s * 1e9)
        self._max_age_ns = round(limits.max_age_s * 1e9)
        self._file_bytes = limits.max_file_bytes
        self._file: LogFile | None = None
        self._synced_ns: int | None = None
        self._failed_ns: int | None = None
        self._cut_off: list[Path] | None = None  # files without an end; None: to be looked for

    @property
    def failing(self) -> bool:
        """Whether the last attempt to write failed, and none has succeeded since."""
        return self._failed_ns is not None

    @property
    def _writing(self) -> Path | None:
        return self.path if self._file else None

    def channel(self, topic: str, json_schema: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
        """Declare a topic of JSON objects (a JSON schema of type object), for this file and all later ones."""
        self._channels[topic] = (json_schema, dict(metadata or {}))
        if self._file is not None:
            self._file.channel(topic, *self._channels[topic])

    def frames(self, batch: Sequence[Frame]) -> None:
        """Log raw frames, in the order received."""
        if not batch:
            return
        now_ns = batch[-1][0]
        file = self._open_file(batch[0][0])
        if file is None:
            self.lost_frames += len(batch)
            return
        try:
            file.frames(batch)
        except Exception as error:  # of the disk; whatever else it may be, it costs this file and nothing more
            self._fail(error, now_ns)

    def sample(self, topic: str, time_ns: int, values: Mapping[str, object], seen_ns: int | None = None) -> None:
        """Log one JSON object on a topic declared by `channel`; raises KeyError for any other topic.

        seen_ns: when it was so, if not at `time_ns`.
        """
        self._channels[topic]
        file = self._open_file(time_ns)
        if file is None:
            return
        try:
            file.sample(topic, time_ns, values, seen_ns)
        except Exception as error:
            self._fail(error, time_ns)

    def sync(self, now_ns: int) -> None:
        """Bring everything onto the disk, once in `sync_s`; call it in each round of the main loop."""
        file = self._file
        if file is None:
            return
        if self._synced_ns is None:
            self._synced_ns = now_ns
        if abs(now_ns - self._synced_ns) < self._sync_ns:
            return
        self._synced_ns = now_ns
        try:
            file.flush(to_disk=True)
            if self.path is not None and file.vanished(self.path):
                file.close()  # whole, wherever it was moved to
                self._file = None
                self._note(OSError(errno.ENOENT, "was deleted or moved while it was written", str(self.path)), now_ns)
                self._failed_ns = now_ns - self._retry_ns
            elif file.size() >= self._file_bytes or abs(now_ns - file.start_ns) >= self._max_age_ns:
                self._close_file(file)
            elif not self._free():
                self._close_file(file)
                self._note(OSError(errno.ENOSPC, "the disk is full", str(self._directory)), now_ns)
        except Exception as error:
            self._fail(error, now_ns)

    def complete_one(self) -> bool:
        """Complete the next of the files that a power cut or an error has cut off; False if there is none."""
        if self._cut_off is None:
            self._cut_off = []
            with contextlib.suppress(OSError):
                self._cut_off = [path for _, _, path in self._own() if path != self._writing and not is_complete(path)]
        if not self._cut_off:
            return False
        path = self._cut_off.pop()  # the latest first
        with contextlib.suppress(OSError):  # it can still be read as it is
            if path.stat().st_size:
                complete(path)
            else:
                _delete(path)
        return True

    def close(self) -> None:
        """Close the file; frames and samples logged later begin a new one."""
        if self._file is not None:
            try:
                self._close_file(self._file)
            except Exception as error:
                self._fail(error, self._file.start_ns)

    def _close_file(self, file: LogFile) -> None:
        file.close()
        self._file = None

    def _open_file(self, start_ns: int) -> LogFile | None:
        """The file in use, or a new one, or None while an error is waited out."""
        if self._file is not None:
            return self._file
        if self._failed_ns is not None and abs(start_ns - self._failed_ns) < self._retry_ns:
            return None
        self._synced_ns = None
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            self._make_room()
            path, stream = self._create(start_ns)
        except (OSError, ValueError, OverflowError) as error:  # of the disk, or the time is no date
            self._note(error, start_ns)
            return None
        self.path = path
        try:
            lock(stream)
            file = LogFile(stream, start_ns, self._metadata, self._attachments)
            for topic, (schema, metadata) in self._channels.items():
                file.channel(topic, schema, metadata)
        except Exception as error:
            with contextlib.suppress(OSError):
                stream.close()
            self._note(error, start_ns)
            self._discard(path)
            return None
        self._failed_ns = None
        self.paths.append(path)
        self._file = file
        return file

    def _create(self, start_ns: int) -> tuple[Path, IO[bytes]]:
        start = datetime.fromtimestamp(start_ns // 1_000_000_000, UTC).strftime("%Y%m%dT%H%M%SZ")
        number = max((number for number, _, _ in self._own()), default=0) + 1
        while True:
            suffix = "" if number == 1 else f"~{number}"
            path = self._directory / f"{start}_{self._vehicle}{suffix}.mcap"
            try:
                stream = path.open("xb")
            except FileExistsError:
                number += 1
                continue
            sync_directory(self._directory)  # else the name may be gone after a power cut, whatever the file holds
            return path, stream

    def _own(self) -> list[tuple[int, str, Path]]:
        """Running number, start and path of the files named as ours, the oldest first."""
        found = [(match, path) for path in self._directory.iterdir() if (match := _NAME.fullmatch(path.name))]
        return sorted((int(match[3] or 1), match[1], path) for match, path in found if path.is_file())

    def _make_room(self) -> None:
        """Delete our oldest files until a new one of full size fits. OSError if it cannot, on a full disk."""
        sizes = {path: path.stat().st_size for _, _, path in self._own()}
        total = sum(sizes.values())
        free, keep = free_space(self._directory)
        room = free - keep + total  # that all of ours may take together
        if room < _LEAST_ROOM:
            raise OSError(errno.ENOSPC, f"no room for a log: {max(free, 0) >> 10} kB are free", str(self._directory))
        # on a small disk small ones: the oldest goes whole
        self._file_bytes = min(self._limits.max_file_bytes, room // 4)
        allowed = min(self._limits.max_total_bytes, room) - self._file_bytes
        for path, size in sizes.items():
            if total <= allowed:
                return
            if _delete(path):
                total -= size

    def _free(self) -> bool:
        """Whether enough is free on the disk, after deleting as many of our oldest files as need be."""
        free, keep = free_space(self._directory)
        if free >= keep:
            return True
        for _, _, path in self._own():
            if path != self._writing and _delete(path):
                free, keep = free_space(self._directory)
                if free >= keep:
                    return True
        return False

    def _fail(self, error: Exception, now_ns: int) -> None:
        file = self._file
        self._file = None
        self._note(error, now_ns)
        if file is not None:
            self.lost_frames += file.unsynced_frames
            file.abandon()
            self._cut_off = None
            if not file.flushed and self.path is not None:
                self._discard(self.path)

    def _note(self, error: Exception, now_ns: int) -> None:
        self.errors += 1
        self.last_error = str(error) or repr(error)
        self._failed_ns = now_ns

    def _discard(self, path: Path) -> None:
        """Remove a file that never came to hold anything: on a full disk each attempt would leave one."""
        with contextlib.suppress(OSError):
            path.unlink()
        if path in self.paths:
            self.paths.remove(path)
        self.path = self.paths[-1] if self.paths else None


def free_space(directory: Path) -> tuple[int, int]:
    """Bytes free on the file system of a directory, and how many of them our logs leave to others.

    That is a twentieth of it, but 64 MiB on one below 1.3 GB, and a quarter on one below 256 MiB.
    """
    there = os.statvfs(directory)
    size = there.f_blocks * there.f_frsize
    if not size:  # some file systems do not tell
        return 1 << 62, 0
    return there.f_bavail * there.f_frsize, min(max(size // 20, _LEFT_FREE), size // 4)


def _delete(path: Path) -> bool:
    """Delete a log, unless it is being written."""
    try:
        with path.open("rb") as stream:
            if not lock(stream):
                return False
            path.unlink()
    except OSError:  # not ours to delete, or gone
        return False
    return True
