"""The power is cut while log and state are written: what a disk then holds, what is read of it, how much is missing.

The disk is a model that promises no more than real ones keep: what was synced stays; of what was written since, any
part may be there, or zeros or rubbish in its place; of names changed since the directory was synced, only the first
few may have been. It answers at once: what a real one takes for a sync is lost on top. At the full count the power of
some real ext4 is cut as well, where a guest can be had.
"""

from __future__ import annotations

import os
import tempfile
import threading
from bisect import bisect_left
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any
from unittest import mock

from mcap.writer import MCAP0_MAGIC

from gz_onboard.can.channel import CanChannel
from gz_onboard.can.recorder import LogLimits, Recorder
from gz_onboard.daemon.loop import Daemon
from gz_onboard.events import TRANSMITTED
from gz_onboard.pipeline import TICK_NS
from gz_onboard.recording.logs import read_frames
from gz_onboard.recording.readers.contents import LogDamage
from tests.hardening import Report, _ext4, quiet
from tests.support import S, Scooter, reference

TITLE = "Power cuts while log and state are written"
COUNT = 200
FULL_COUNT = 1000

LOG_S = 2.0  # at most so much of the log is lost
SOC = 0.003  # and so much of the state of charge
REAL_CUTS_S = (30.0, 33.3, 36.7, 41.1, 45.9)  # from the start of the guest; the daemon is ready at 15 or so

Image = dict[str, bytes]  # files by name, as a disk holds them


class Disk:
    """What of a folder would be there if the power were cut now."""

    def __init__(self, folder: Path, source: Random) -> None:
        self.folder = folder
        self._source = source
        self._synced: dict[int, int] = {}  # inode -> bytes
        self._names: list[dict[str, int]] = [{}]  # name -> inode, as it may be found: the last is how it is
        self._lock = threading.Lock()
        self.on_change: Callable[[], None] = lambda: None

    @contextmanager
    def watched(self) -> Iterator[None]:
        """While the calls that bring something onto a disk are noted."""
        real = os.fsync, os.fdatasync, os.replace

        def sync(call: Callable[[Any], None], descriptor: int) -> None:
            with self._lock:
                self.on_change()
                call(descriptor)
                there = os.fstat(descriptor)
                if os.path.isdir(descriptor):  # noqa: PTH112  # of a descriptor
                    self._names = [self._now()]
                else:
                    self._synced[there.st_ino] = there.st_size
                self.on_change()

        def replace(old: Any, new: Any) -> None:
            with self._lock:
                real[2](old, new)
                self._names.append(self._now())
                self.on_change()

        with (
            mock.patch("os.fsync", lambda descriptor: sync(real[0], descriptor)),
            mock.patch("os.fdatasync", lambda descriptor: sync(real[1], descriptor)),
            mock.patch("os.replace", replace),
        ):
            yield

    def _now(self) -> dict[str, int]:
        return {path.name: path.stat().st_ino for path in self.folder.rglob("*") if path.is_file()}

    @property
    def sure_names(self) -> dict[str, int]:
        """The names that will be found, whatever happens."""
        return self._names[0]

    def image(self) -> Image:
        """What may be found."""
        data = {path.stat().st_ino: path.read_bytes() for path in self.folder.rglob("*") if path.is_file()}
        names = self._source.choice([*self._names, self._now()])
        return {name: self._left(inode, data[inode]) for name, inode in names.items() if inode in data}

    def _left(self, inode: int, data: bytes) -> bytes:
        sure = self._synced.get(inode, 0)
        if sure >= len(data):
            return data
        end = self._source.randint(sure, len(data))
        rest = self._source.choice((0, len(data) - end, self._source.randrange(5000)))
        return data[:end] + self._source.choice((bytes(rest), self._source.randbytes(rest)))


@dataclass
class Cut:
    """One power cut, and what the daemon would have told at that time."""

    case: str
    image: Image
    time_ns: int
    begin_ns: int
    soc: float | None
    saved: bool  # whether any save had been finished


@dataclass
class Found:
    """What was lost."""

    log_s: list[float] = field(default_factory=list)
    soc: list[float] = field(default_factory=list)
    failures: list[str] = field(default_factory=list)


def cuts(count: int, source: Random, folder: Path, case: str) -> list[Cut]:
    """A hard ride of a daemon, its power cut `count` times: the disk is copied, and it rides on."""
    disk = Disk(folder, source)
    file = folder / "state" / "scooter.json"
    channel = CanChannel("virtual", case)
    channel.open()
    recorder = Recorder(folder / "log", "v", limits=LogLimits(max_file_bytes=200_000))
    daemon = Daemon(reference(), [channel], recorder, file)
    log, keeper = daemon._log, daemon._keeper
    assert log is not None
    assert keeper is not None
    current = source.uniform(30.0, 110.0)
    frames = Scooter().steady(20.0, current=current, voltage=52.0 - 0.07 * current)
    wanted = sorted(source.sample(range(430), count))
    made: list[Cut] = []
    moments = 0
    now_ns = 0

    def moment() -> None:
        nonlocal moments
        moments += 1
        if wanted and moments >= wanted[0]:
            del wanted[0]
            last = daemon.pipeline.last
            soc = last.soc if last else None
            case_name = f"{case}, cut {len(made)}"
            made.append(Cut(case_name, disk.image(), now_ns, frames[0][0], soc, file.name in disk.sure_names))

    disk.on_change = moment
    at = 0
    with disk.watched():
        for now_ns in range(frames[0][0], frames[-1][0], TICK_NS):  # read by `moment`
            end = bisect_left(frames, (now_ns,))
            daemon.step(frames[at:end], now_ns)
            at = end
            if not (keeper._thread.wait(60) and log._thread.wait(60)):
                raise TimeoutError("the disk does not answer")
            moment()
            moment()
    daemon.close()
    if wanted:
        raise RuntimeError(f"{case}: {len(wanted)} cuts were not made, there were {moments} moments to cut at")
    return made


def judge(cut: Cut, folder: Path, daemon: Daemon, found: Found) -> None:
    """Start again on what the cut has left, and hold it against what there was."""
    for name, data in cut.image.items():
        (folder / name).write_bytes(data)
    last_ns = cut.begin_ns
    for log in sorted(folder.glob("*.mcap")):
        if log.read_bytes()[:8] != MCAP0_MAGIC:  # just begun, nothing of it was synced
            continue
        damages: list[LogDamage] = []
        for batch in read_frames(log, on_damage=damages.append):
            last_ns = max(last_ns, *(frame[0] for frame in batch if not frame[3] & TRANSMITTED), cut.begin_ns)
        if any(damage.count > 2 for damage in damages):  # a broken last chunk, and the missing end
            found.failures.append(f"{cut.case}: {damages[0]}")
    found.log_s.append((cut.time_ns - last_ns) / S)
    if found.log_s[-1] > LOG_S:
        found.failures.append(f"{cut.case}: {found.log_s[-1]:.2f} s of the log are lost")
    assert daemon._keeper is not None
    daemon._keeper.file = folder / "scooter.json"
    state = daemon.restore()
    if state is None:
        if cut.saved:
            found.failures.append(f"{cut.case}: no state was found")
    elif cut.soc is not None:
        found.soc.append(abs(state["soc"] - cut.soc))
        if found.soc[-1] > SOC:
            found.failures.append(f"{cut.case}: {100 * found.soc[-1]:.2f} points of the state of charge are lost")


def run(count: int, seed: int) -> Report:
    """`count` cuts, twenty in each of some rides."""
    found = Found()
    with quiet():
        for ride in range(-(-count // 20)):
            source = Random(f"{seed} {ride}")
            with tempfile.TemporaryDirectory() as folder:
                made = cuts(min(20, count - 20 * ride), source, Path(folder), f"seed {seed}, ride {ride}")
            daemon = Daemon(reference(), [], None, Path("scooter.json"))
            for cut in made:
                with tempfile.TemporaryDirectory() as folder:
                    judge(cut, Path(folder), daemon, found)
    rows = {
        "cuts": str(len(found.log_s)),
        f"of the log lost, at worst (promised: {LOG_S:g} s)": f"{max(found.log_s, default=0):.2f} s",
        f"of the state of charge lost, at worst (promised: {100 * SOC:g} points)": (
            f"{100 * max(found.soc, default=0):.2f} points"
        ),
    }
    real_row = f"of {len(REAL_CUTS_S)} cuts of a real ext4, at worst"
    if count < FULL_COUNT:
        rows[real_row] = "not run at this count"
    elif not _ext4.is_there():
        rows[real_row] = "not run: no guest can be had here"
    else:
        real = [_ext4.cut(seconds) for seconds in REAL_CUTS_S]
        log_s, soc = max(log_s for log_s, _ in real), max(soc for _, soc in real)
        rows[real_row] = f"{log_s:.2f} s, {100 * soc:.2f} points"
        if log_s > LOG_S or soc > SOC:
            found.failures.append(f"real cuts: {real}")
    return Report(rows, found.failures)
