"""Record a directory of MCAP logs, on a separate thread if need be: start, rotate and delete files.

A full or broken disk raises nothing. There is no clock: times come with the frames and samples. A log that a power cut
ended is left as it is; the readers need no summary.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

from gz_onboard.background import Background
from gz_onboard.can.logfile import MAGIC, LogFile
from gz_onboard.errors import InputError
from gz_onboard.events import Frame
from gz_onboard.state import sync_directory

_NAME = re.compile(r"(\d{8}T\d{6}Z)_(.+?)(?:~(\d{1,9}))?\.mcap")
MAX_WAITING = 40_000  # frames for the disk; each value of a sample counts as one
PORTION_NS = 450_000_000  # between two portions that the thread gets: every fifth tick, also if one comes early
_LEFT_FREE = 64 << 20  # bytes
_LEAST_ROOM = 64 << 10  # bytes: the beginning of a file has some 20 kB, with the DBC files


@dataclass(frozen=True)
class LogLimits:
    """How often a `Recorder` syncs, when it closes a file, how much it keeps, how long it waits after an error.

    InputError if one file may be larger than all files together.
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


LIMITS = LogLimits()


class Recorder:
    """Writes MCAP files named by their start in UTC, the vehicle and a running number.

    A write error raises nothing: it is counted in `errors` (text in `last_error`), closes the file, and recording
    continues with a new file `retry_s` later. `lost_frames` counts the frames not known to be in a file. Before a new
    file is started, the oldest files with such a name (by running number, because clocks are set) are deleted until
    all of them stay below `max_total_bytes` and the file system keeps the room that `spare_bytes` reserves. Other
    files, and files that are being written, are not touched.
    """

    def __init__(
        self,
        directory: Path,
        vehicle: str,
        metadata: Mapping[str, str] | None = None,
        attachments: Mapping[str, bytes] | None = None,
        limits: LogLimits = LIMITS,
    ) -> None:
        self.paths: list[Path] = []
        self.errors = 0
        self.last_error = ""
        self.lost_frames = 0
        self._directory = directory
        self._vehicle = re.sub(r"[^\w.+-]+", "-", vehicle) or "vehicle"
        self._metadata = {"vehicle": vehicle, **(metadata or {})}
        self._attachments = dict(attachments or {})
        self._channels: dict[str, Mapping[str, Any]] = {}
        self._limits = limits
        self._retry_ns = round(limits.retry_s * 1e9)
        self._file_bytes = limits.max_file_bytes
        self._stream: IO[bytes] | None = None  # of the file in use, or of one that is being started
        self._file: LogFile | None = None
        self._synced_ns = 0
        self._failed_ns: int | None = None

    @property
    def path(self) -> Path | None:
        """The latest file."""
        return self.paths[-1] if self.paths else None

    @property
    def failing(self) -> bool:
        """Whether the last attempt to write failed, and none has succeeded since."""
        return self._failed_ns is not None

    def channel(self, topic: str, json_schema: Mapping[str, Any]) -> None:
        """Declare a topic of JSON objects (a JSON schema of type object), for all files; before the first of them."""
        self._channels[topic] = json_schema

    def frames(self, batch: Sequence[Frame]) -> None:
        """Log raw frames, in the order received."""
        if batch and not self._write(batch[0][0], lambda file: file.frames(batch)):
            self.lost_frames += len(batch)

    def sample(self, topic: str, time_ns: int, values: Mapping[str, object], seen_ns: int | None = None) -> None:
        """Log one JSON object on a topic declared by `channel`; raises KeyError for any other topic.

        seen_ns: when the values were true, if not at `time_ns`.
        """
        self._channels[topic]
        self._write(time_ns, lambda file: file.sample(topic, time_ns, values, seen_ns))

    def sync(self, now_ns: int) -> None:
        """Bring everything onto the disk, once in `sync_s`; call it in each round of the main loop."""
        if self._file and abs(now_ns - self._synced_ns) >= self._limits.sync_s * 1e9:
            self._synced_ns = now_ns
            self._write(now_ns, lambda file: self._sync(file, now_ns))

    def close(self) -> None:
        """Close the file; frames and samples logged later start a new one."""
        if self._file is not None:
            self._write(self._file.start_ns, self._close_file)

    def _write(self, now_ns: int, write: Callable[[LogFile], None]) -> bool:
        """Call `write` with the file in use, or a new one; False while an error is waited out, and if no file starts.

        Whatever is raised costs this file and nothing more.
        """
        if self._file is None and self._failed_ns is not None and abs(now_ns - self._failed_ns) < self._retry_ns:
            return False
        try:
            write(self._file or self._start_file(now_ns))
        except Exception as error:  # of the disk, or the time is no date
            self._note(error, now_ns)
            file, self._file, stream, self._stream = self._file, None, self._stream, None
            if stream:
                with contextlib.suppress(OSError):
                    stream.close()
                if not (file and file.flushed):  # it never came to hold anything: each attempt would leave one
                    with contextlib.suppress(OSError):
                        self.paths.pop().unlink()
            if file is None:
                return False
            self.lost_frames += file.unsynced_frames
        return True

    def _sync(self, file: LogFile, now_ns: int) -> None:
        file.flush(to_disk=True)
        path = self.paths[-1]
        if not path.exists():
            self._close_file(file)  # complete, wherever it was moved to
            self._note(OSError(errno.ENOENT, "was deleted or moved while it was written", str(path)), now_ns)
            self._failed_ns = now_ns - self._retry_ns
        elif file.stream.tell() >= self._file_bytes or abs(now_ns - file.start_ns) >= self._limits.max_age_s * 1e9:
            self._close_file(file)
        elif not self._delete_oldest(lambda: spare_bytes(self._directory) >= 0):
            self._close_file(file)
            self._note(OSError(errno.ENOSPC, "the disk is full", str(self._directory)), now_ns)

    def _close_file(self, file: LogFile) -> None:
        file.close()
        self._file = self._stream = None

    def _start_file(self, start_ns: int) -> LogFile:
        self._directory.mkdir(parents=True, exist_ok=True)
        self._make_room()
        start = datetime.fromtimestamp(start_ns // 1_000_000_000, UTC).strftime("%Y%m%dT%H%M%SZ")
        number = max((number for number, _, _ in self._log_files()), default=0) + 1
        path = self._directory / f"{start}_{self._vehicle}{'' if number == 1 else f'~{number}'}.mcap"
        self._stream = path.open("xb")
        self.paths.append(path)
        lock(self._stream)
        sync_directory(self._directory)  # else the name may be gone after a power cut, whatever the file holds
        file = LogFile(self._stream, start_ns, self._metadata, self._attachments)
        for topic, schema in self._channels.items():
            file.channel(topic, schema)
        self._synced_ns, self._failed_ns, self._file = start_ns, None, file
        return file

    def _log_files(self) -> list[tuple[int, str, Path]]:
        """Running number, start and path of the files named as ours, the oldest first."""
        found = [(match, path) for path in self._directory.iterdir() if (match := _NAME.fullmatch(path.name))]
        return sorted((int(match[3] or 1), match[1], path) for match, path in found if path.is_file())

    def _make_room(self) -> None:
        """Delete our oldest files until a new one of full size fits. OSError if it cannot, on a full disk."""
        for _, _, path in self._log_files():
            if not path.stat().st_size:  # a power cut came before the first sync
                _delete(path)
        total = self._total_bytes()
        spare = spare_bytes(self._directory)
        room = spare + total  # for all of ours together
        if room < _LEAST_ROOM:
            raise OSError(errno.ENOSPC, f"no room: {max(spare, 0) >> 10} kB are free for logs", str(self._directory))
        self._file_bytes = min(self._limits.max_file_bytes, room // 4)  # small on a small disk: the oldest goes whole
        allowed = min(self._limits.max_total_bytes, room) - self._file_bytes
        self._delete_oldest(lambda: self._total_bytes() <= allowed)

    def _total_bytes(self) -> int:
        return sum(path.stat().st_size for _, _, path in self._log_files())

    def _delete_oldest(self, is_enough: Callable[[], bool]) -> bool:
        """Delete our oldest files, but for the one being written, until `is_enough`; False if it never is."""
        for _, _, path in self._log_files():
            if is_enough():
                return True
            if self._file is None or path != self.path:
                _delete(path)
        return is_enough()

    def _note(self, error: Exception, now_ns: int) -> None:
        self.errors += 1
        self.last_error = str(error) or repr(error)
        self._failed_ns = now_ns


def is_complete(path: Path) -> bool:
    """Whether the log was closed, and not cut off. OSError if it cannot be read."""
    with path.open("rb") as stream:
        size = stream.seek(0, os.SEEK_END)
        stream.seek(max(size - len(MAGIC), 0))
        return size > 2 * len(MAGIC) and stream.read() == MAGIC


def lock(stream: IO[bytes]) -> bool:
    """Mark an open log as being written, until it is closed; False if another writes it. True without locks."""
    try:
        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        pass
    return True


def spare_bytes(directory: Path) -> int:
    """Bytes free on the file system of a directory beyond those that our logs leave to others.

    These are a twentieth of it, but 64 MiB on one below 1.3 GB, and a quarter on one below 256 MiB.
    """
    there = os.statvfs(directory)
    size = there.f_blocks * there.f_frsize
    if not size:  # unknown on some file systems
        return 1 << 62
    return there.f_bavail * there.f_frsize - min(max(size // 20, _LEFT_FREE), size // 4)


def _delete(path: Path) -> None:
    """Delete a log, unless it is being written, is not ours to delete, or is gone."""
    with contextlib.suppress(OSError), path.open("rb") as stream:
        if lock(stream):
            path.unlink()


class BackgroundRecorder:
    """Runs a `Recorder` on its own thread, so that the caller never waits for the disk.

    Frames and samples are handed over at `sync`, twice a second and all at once: waking the thread costs as much as a
    hundred frames. Beyond `MAX_WAITING` a whole portion is dropped, and its frames are counted in `lost_frames`. Nobody
    else may use the recorder.
    """

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._thread = Background("log", MAX_WAITING)
        self._dropped_frames = 0
        self._is_full = False
        self._frames: list[Frame] = []  # since they were last handed over
        self._samples: list[tuple[str, int, Mapping[str, object], int | None]] = []
        self._handed_ns = 0
        self.channel = recorder.channel
        """As `Recorder.channel`."""

    @property
    def error(self) -> str:
        """Why frames are lost: errors, or a disk that is too slow or does not answer; empty if none are."""
        if self._recorder.failing:
            return self._recorder.last_error
        if self._is_full:
            return "the disk is too slow"
        return self._thread.error

    @property
    def lost_frames(self) -> int:
        """Frames not known to be in a file."""
        return self._recorder.lost_frames + self._dropped_frames

    def frames(self, batch: Sequence[Frame]) -> None:
        """As `Recorder.frames`, later."""
        self._frames += batch

    def sample(self, topic: str, time_ns: int, values: Mapping[str, object], seen_ns: int | None = None) -> None:
        """As `Recorder.sample`, later; `values` may not be changed afterwards."""
        self._samples.append((topic, time_ns, values, seen_ns))

    def sync(self, now_ns: int) -> None:
        """Hand over what was logged, if it is time, and sync as `Recorder.sync`; call it once a tick."""
        if abs(now_ns - self._handed_ns) >= PORTION_NS:
            self._handed_ns = now_ns
            self._is_full &= self._thread.load >= 0.5
            self._hand_over(now_ns)

    def close(self, seconds: float) -> bool:
        """Write what waits and close the file; False if that takes longer than `seconds`: the rest is lost then."""
        self._hand_over(self._handed_ns)
        self._thread.call(self._recorder.close, weight=0)
        return self._thread.close(seconds)

    def _hand_over(self, now_ns: int) -> None:
        frames, samples = self._frames, self._samples
        self._frames, self._samples = [], []
        weight = len(frames) + sum(len(values) for _, _, values, _ in samples)
        # A mere sync has a weight, too: else they would pile up behind a disk that does not answer.
        if not self._thread.call(self._write, frames, samples, now_ns, weight=max(weight, 1)) and weight:
            self._dropped_frames += len(frames)
            self._is_full = True

    def _write(
        self, frames: list[Frame], samples: list[tuple[str, int, Mapping[str, object], int | None]], now_ns: int
    ) -> None:
        self._recorder.frames(frames)
        for sample in samples:
            self._recorder.sample(*sample)
        self._recorder.sync(now_ns)
