"""The daemon: channels, clock, recorder and pipeline together. All that systemd runs.

The loop never waits for a disk: the log and the state are written by a thread each. Nor for the bus: what one tick
reads and decodes is bounded, so that the status goes out ten times a second whatever comes.
"""

from __future__ import annotations

import argparse
import errno
import fcntl
import logging
import os
import re
import signal
import socket
import sys
import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from operator import itemgetter
from pathlib import Path
from typing import Any

from gz_onboard import notify, state
from gz_onboard.background import Background
from gz_onboard.bus.channel import CanChannel
from gz_onboard.bus.recorder import BackgroundRecorder, Recorder
from gz_onboard.errors import FAILED, InputError
from gz_onboard.events import Frame, Reason, State
from gz_onboard.physics.trust import ROOT
from gz_onboard.pipeline import TICK_NS, Pipeline, dbc_texts, reason_names
from gz_onboard.vehicle import Vehicle, read_vehicle

TICK = 0.1  # s: as often as a status is sent; each wake-up costs as much as ten frames
BUSY = 200  # frames in a tick from which the next is half as long: what waits in the kernel must fit its buffer
WORK_S = 0.06  # s of CPU that the frames of one tick may cost
FRAME_S = 20e-6  # s of CPU for a frame, until it is measured
SAVE_PERIOD_NS, SAVE_AT_MOST_NS = 10_000_000_000, 1_000_000_000
SAVE_SOC = 0.001  # a change that is saved before the period is over: what a power cut may cost, and the next save
STATE_STUCK_S = 10.0
STOP_S = 6.0  # to write what waits when stopped; systemd kills after 10 s
LOCK_S = 3.0  # to wait for one that is ending
CLOCK_STEP_NS = 500_000_000

log = logging.getLogger("gz-onboard")


class Daemon:
    """Runs until `stop` is called (by SIGTERM or SIGINT)."""

    def __init__(
        self,
        vehicle: Vehicle,
        channels: list[CanChannel],
        recorder: Recorder | None,
        state_file: Path | None,
        filter_name: str = "scalar",
        tick: float = TICK,
    ) -> None:
        self.channels = channels
        self.recorder = recorder
        self.finished = True  # whether log and state were written to their end
        self._log = BackgroundRecorder(recorder) if recorder else None
        self._make_pipeline: Callable[[], Pipeline] = lambda: Pipeline(vehicle, filter_name=filter_name, log=self._log)
        self.pipeline = self._make_pipeline()
        self._keeper = _Keeper(state_file, vehicle.key) if state_file else None
        self._tick = tick
        self._stopping = False
        self._later: list[Frame] = []
        self._overrun = 0
        self._frame_s = FRAME_S
        self._offset = _wall_offset()
        self._boot_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        self._said_at = 0.0
        self._said = ""
        self._log_error = ""

    def stop(self, *_: object) -> None:
        """End after the current round."""
        self._stopping = True

    def run(self) -> None:
        """Loop until stopped: each tick drain, estimate, send, record, save, feed the watchdog.

        Whatever is raised, log and state are written to their end first.
        """
        try:
            self._loop()
            notify.stopping()
            self.round()  # what waited for its tick
        finally:
            self.close()

    def _loop(self) -> None:
        self.restore()
        watchdog = notify.watchdog_interval()
        fed = next_tick = time.monotonic()
        busy = False
        notify.ready("waiting for frames")
        log.info("ready after %.2f s of CPU", time.process_time())
        while not self._stopping:
            next_tick += self._tick / 2 if busy else self._tick
            pause = next_tick - time.monotonic()
            if pause > 0:
                time.sleep(pause)
            else:  # overloaded or suspended: do not try to catch up
                next_tick -= pause
            busy = self.round() > BUSY
            now = time.monotonic()
            if watchdog and now - fed >= watchdog:
                fed = now
                notify.alive()
            self._say(now)

    def close(self) -> None:
        """Save the state, write the log to its end as far as the disks allow it in time, and close the channels."""
        until = time.monotonic() + STOP_S
        if self._keeper:
            self._keeper.save(self.pipeline, time.time_ns())
        if self._log and not self._log.close(until - time.monotonic()):
            log.warning("the disk does not take the log in time: its end is lost")
            self.finished = False
        if self._keeper and not self._keeper.close(max(until - time.monotonic(), 1.0)):
            log.warning("the disk does not take the state in time")
            self.finished = False
        for channel in self.channels:
            channel.close()

    def round(self) -> int:
        """One tick; gives the number of frames that came."""
        boot_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        frames, self._later = self._later, []
        for channel in self.channels:
            frames += channel.drain()
        offset = _wall_offset()
        now_ns = boot_ns + offset  # by the same clock as `offset`, whenever that was set
        self.pipeline.estimator.wait((boot_ns - self._boot_ns) * 1e-9)
        self._boot_ns = boot_ns
        # What came while we read, or were held up, waits for its own tick: of a channel read before, some is missing.
        frames.sort(key=itemgetter(0))
        ahead = time.clock_gettime_ns(time.CLOCK_BOOTTIME) + offset + CLOCK_STEP_NS  # for the codec to drop
        end, beyond = bisect_left(frames, (now_ns,)), bisect_left(frames, (ahead,))
        frames, self._later = frames[:end] + frames[beyond:], frames[end:beyond]
        step = offset - self._offset
        self._offset = offset
        if abs(step) > CLOCK_STEP_NS:  # by the network's or the GPS' time; what came meanwhile has either time
            log.warning("the clock was set by %.1f s", step * 1e-9)
            self.pipeline.clock_set(step)
            frames, self._later = [], []
        count = len(frames)
        kept = fair_share(frames, max(int(WORK_S / self._frame_s), 2 * BUSY))
        self._overrun += count - len(kept)
        began = time.thread_time()
        self.step(kept, now_ns)
        if len(kept) > BUSY:
            self._frame_s += 0.2 * ((time.thread_time() - began) / len(kept) - self._frame_s)
        else:  # so few tell nothing: it is the estimates that cost
            self._frame_s = max(0.98 * self._frame_s, FRAME_S)
        return count

    def step(self, frames: list[Frame], now_ns: int) -> None:
        """Take in frames, in the order of their times, up to `now_ns`; send, record and save what comes of them."""
        pipeline = self.pipeline
        pipeline.kernel_lost = sum(channel.overflow for channel in self.channels)
        pipeline.send_failures = sum(channel.send_failures for channel in self.channels)
        pipeline.overrun = self._overrun
        reasons = Reason(0)
        if not all(channel.up for channel in self.channels):
            reasons |= Reason.BUS_DOWN
        if self._log:
            pipeline.log_lost = self._log.lost_frames
            if self._log.failing:
                reasons |= Reason.LOG_FAILED
        pipeline.extra_reasons = reasons
        for frame in pipeline.advance(frames, now_ns):
            self.channels[0].send(frame)
        if self._log:
            self._log.sync(now_ns)
        if self._keeper:
            self._keeper.save_if_due(pipeline, now_ns)

    def _say(self, now: float) -> None:
        """Tell systemd how it stands and the journal what changed, at most once a second."""
        if now - self._said_at < 1.0:
            return
        self._said_at = now
        error = self._log.last_error if self._log and self._log.failing else ""
        if error and error != self._log_error:
            log.warning("cannot write the log: %s", error)
        self._log_error = error
        if self._keeper:
            self._keeper.say()
        last = self.pipeline.last
        if last is None:
            return
        counts = self.pipeline.counts()
        state, remaining, _, _ = self.pipeline.publisher.told(last)
        text = state_text(state, last.reasons)
        if text != self._said:
            log.info("%s; dropped %d, lost %d, unknown %d", text, counts.dropped, counts.lost, counts.unknown)
            self._said = text
        if remaining is not None and last.soc is not None:
            text = f"{remaining:.1f} km, {100 * last.soc:.0f} %, {text}"
        notify.status(text)

    def restore(self) -> dict[str, Any] | None:
        """Go on from the latest saved state that can be used; gives it. Others are set aside. Nothing is raised."""
        keeper = self._keeper
        if keeper is None:
            return None
        for copy in state.copies(keeper.file):
            try:
                found = state.load(copy, time.time(), _uptime(), state.kept_time())
                if found is None:
                    continue
                snapshot, age = found
                self.pipeline.estimator.restore(snapshot, keeper.key, age)
            except Exception as error:  # whatever it holds: an estimate from nothing is better than none
                if not isinstance(error, ValueError):  # it may have been taken over in part
                    self.pipeline = self._make_pipeline()
                aside = state.set_aside(keeper.file, copy)
                log.warning(
                    "saved state %s %s: not used%s",
                    copy,
                    str(error) or repr(error),
                    f", kept as {aside}" if aside else "",
                )
            else:
                log.info(
                    "going on from the state saved %s", "at an unknown time" if age is None else f"{age:.0f} s ago"
                )
                return dict(snapshot)
        return None


def _uptime() -> float:
    """Time since the system was started, suspended or not [s]."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class _Keeper:
    """Saves what the estimator knows, as often as it is worth it, on a thread of its own."""

    def __init__(self, file: Path, key: str) -> None:
        self.file = file
        self.key = key
        self._thread = Background("state")
        self._saved_ns: int | None = None
        self._saved_soc: float | None = None
        self._failing = self._stuck = False

    def save_if_due(self, pipeline: Pipeline, now_ns: int) -> None:
        """Save once in the period, or when the state of charge has moved; not while the last save is under way."""
        if self._thread.load:
            return
        soc = pipeline.last.soc if pipeline.last else None
        if self._saved_ns is not None:
            since = abs(now_ns - self._saved_ns)  # the clock may be set back
            before = self._saved_soc
            moved = soc is not None and (before is None or abs(soc - before) >= SAVE_SOC)
            if since < (SAVE_AT_MOST_NS if moved else SAVE_PERIOD_NS):
                return
        elif soc is None:
            return
        self.save(pipeline, now_ns)

    def save(self, pipeline: Pipeline, now_ns: int) -> None:
        """Save now."""
        snapshot = pipeline.estimator.snapshot(self.key)
        if snapshot is None:
            return
        self._saved_ns, self._saved_soc = now_ns, pipeline.last.soc if pipeline.last else None
        try:
            text = state.encode(snapshot, now_ns * 1e-9, _uptime())
        except (ValueError, TypeError) as error:
            self._failed(error)
        else:
            self._thread.call(self._write, text, weight=0 if self._thread.load else 1)

    def say(self) -> None:
        """Tell once of a disk that does not answer."""
        stuck = self._thread.stuck > STATE_STUCK_S
        if stuck and not self._stuck:
            log.warning("cannot save the state: the disk does not answer")
        self._stuck = stuck

    def close(self, seconds: float) -> bool:
        """Wait until all is saved; False if that takes longer than `seconds`."""
        return self._thread.close(seconds)

    def _write(self, text: bytes) -> None:
        try:
            state.write(self.file, text)
        except OSError as error:
            self._failed(error)
        else:
            if self._failing:
                log.info("the state is saved again")
            self._failing = False

    def _failed(self, error: Exception) -> None:
        if not self._failing:
            log.warning("cannot save the state: %s", error)
        self._failing = True


def fair_share(frames: list[Frame], most: int) -> list[Frame]:
    """About `most` of the frames, the latest of each identifier: one that floods the bus takes no other's place."""
    if len(frames) <= most:
        return frames
    counts = Counter(itemgetter(1, 3)(frame) for frame in frames)
    left = most
    for done, count in enumerate(sorted(counts.values())):
        share = max(left // (len(counts) - done), 1)
        if count > share:
            break
        left -= count
    taken: Counter[tuple[int, int]] = Counter()
    kept = []
    for frame in reversed(frames):
        kind = frame[1], frame[3]
        taken[kind] += 1
        if taken[kind] <= share:
            kept.append(frame)
    return kept[::-1]


def _wall_offset() -> int:
    """The wall clock less the time since boot, suspended or not [ns]: changes only when the clock is set."""
    for _ in range(10):
        before, wall = time.clock_gettime_ns(time.CLOCK_BOOTTIME), time.time_ns()
        if time.clock_gettime_ns(time.CLOCK_BOOTTIME) - before < 1_000_000:  # else we were held up between the two
            break
    return wall - before


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard run``."""
    add = parser.add_argument
    add(
        "--vehicle",
        default="reference",
        metavar="NAME|TOML",
        help="vehicle file, or one of the package's (%(default)s)",
    )
    add("--interface", default="socketcan", help="python-can's interface (%(default)s)")
    add("--channel", action="append", metavar="NAME", help="channel (can0, the vehicle's bus); twice, for a second bus")
    add("--payload", type=float, metavar="KG", help="mass of rider and luggage, where it is known")
    add("--effects", type=Path, metavar="DIR", help="folder with effects of your own, Python that you trust")
    add("--filter", default="scalar", choices=("scalar", "filterpy"), help="backend of the SOC filter (%(default)s)")
    add("--log-dir", type=Path, default=_directory("LOGS_DIRECTORY"), metavar="DIR", help="write MCAP logs here")
    add("--log-file-mb", type=float, default=64, metavar="MB", help="begin a new log at this size (%(default)g)")
    add("--log-file-hours", type=float, default=6, metavar="H", help="or at this age (%(default)g)")
    add("--log-total-mb", type=float, default=2048, metavar="MB", help="delete the oldest beyond this (%(default)g)")
    add("--state-dir", type=Path, default=_directory("STATE_DIRECTORY"), metavar="DIR", help="keep the state here")
    add("--all-frames", action="store_true", help="take in, count and log identifiers that the DBC files do not know")
    add("--tick", type=float, default=TICK, metavar="S", help="drain the bus this often (%(default)g)")


def _directory(variable: str) -> Path | None:
    value = os.environ.get(variable, "").split(":")[0]  # systemd gives several, colon-separated
    return Path(value) if value else None


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard run``."""
    logging.basicConfig(
        level=logging.INFO, format="%(message)s" if "JOURNAL_STREAM" in os.environ else "%(asctime)s %(message)s"
    )
    logging.getLogger("can").setLevel(logging.WARNING)
    if not 0.005 <= arguments.tick <= TICK_NS * 1e-9:
        raise InputError(f"--tick {arguments.tick:g}: must be 0.005 to {TICK_NS * 1e-9:g} s")
    if arguments.payload is not None and not 0 <= arguments.payload <= 300:
        raise InputError(f"--payload {arguments.payload:g}: must be 0 to 300 kg")
    for option in ("log_file_mb", "log_file_hours", "log_total_mb"):
        if not 1e-3 <= (value := getattr(arguments, option)) <= 1e9:
            raise InputError(f"--{option.replace('_', '-')} {value:g}: must be 0.001 to 1e9")
    names = arguments.channel or ["can0"]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"--channel {name}: given twice; each of its frames would come twice")
    # Nobody watches a daemon: the vehicle file's own code runs only if it is root's.
    vehicle = read_vehicle(arguments.vehicle, arguments.payload, arguments.effects, users={ROOT})
    with ExitStack() as locks:
        _lock(locks, arguments.interface, names, arguments.state_dir)
        return _run(arguments, vehicle, names)


def _run(arguments: argparse.Namespace, vehicle: Vehicle, names: list[str]) -> int:
    recorder = None
    if arguments.log_dir:
        recorder = Recorder(
            arguments.log_dir,
            vehicle.name,
            metadata={"vehicle_key": vehicle.key},
            attachments=dbc_texts(vehicle),
            max_file_bytes=round(arguments.log_file_mb * 1e6),
            max_age_s=arguments.log_file_hours * 3600,
            max_total_bytes=round(arguments.log_total_mb * 1e6),
        )
    state_file = None
    if arguments.state_dir:
        state_file = arguments.state_dir / (re.sub(r"[^\w.+-]+", "-", vehicle.name) + ".json")
    from gz_onboard.bus.codec import known_identifiers

    wanted = None if arguments.all_frames else known_identifiers(vehicle.mapping)
    channels = [CanChannel(arguments.interface, name, index, wanted) for index, name in enumerate(names)]
    for channel in channels:
        channel.open()
    daemon = Daemon(vehicle, channels, recorder, state_file, arguments.filter, arguments.tick)
    signal.signal(signal.SIGTERM, daemon.stop)
    signal.signal(signal.SIGINT, daemon.stop)
    daemon.run()
    _summary(daemon)
    if not daemon.finished:  # a thread still waits for its disk: the interpreter would abort over its files
        sys.stdout.flush()
        logging.shutdown()
        os._exit(FAILED)
    return 0


def _lock(locks: ExitStack, interface: str, names: list[str], state_dir: Path | None) -> None:
    """Hold the channels and the state directory until `locks` is left, or the process ends, however it does.

    InputError if another daemon has one of them and does not give it back soon, as one that is being restarted does.
    """
    until = time.monotonic() + LOCK_S
    # The names of abstract sockets are those of the network namespace, as the interfaces are; a virtual bus is the
    # process' own.
    for name in names if interface != "virtual" else ():
        holder = locks.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        address = f"\0gz-onboard:{interface}:{name}"[:107]
        if not _retried(lambda holder=holder, address=address: holder.bind(address), until):  # type: ignore[misc]
            raise InputError(f"--channel {name}: another gz-onboard run has it; two would send the same identifiers")
    if state_dir is None:
        return
    try:
        state_dir.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(state_dir, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:  # then nothing can be saved there either, and the daemon says so
        return
    locks.callback(os.close, descriptor)
    if not _retried(lambda: fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB), until):
        raise InputError(f"--state-dir {state_dir}: another gz-onboard run uses it; give each its own")


def _retried(take: Callable[[], None], until: float) -> bool:
    """Take a lock, again and again `until` a monotonic time [s]; False if another holds it. True without locks."""
    while True:
        try:
            take()
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EWOULDBLOCK):
                log.warning("without a lock: %s", error)
                return True
        else:
            return True
        if time.monotonic() > until:
            return False
        time.sleep(0.1)


def state_text(state: State, reasons: Reason) -> str:
    """A state with its reasons, on one line."""
    return f"{state.name.lower()}: {' '.join(reason_names(reasons)) or 'all inputs there'}"


def _summary(daemon: Daemon) -> None:
    """What a person wants to read when the daemon ends."""
    print("\n".join(summary(daemon.pipeline)))
    for path in [path for path in daemon.recorder.paths if path.exists()] if daemon.recorder else []:
        print(f"log {path}")


def summary(pipeline: Pipeline) -> list[str]:
    """What came, the last numbers and the last state, as they were sent: numbers may be older than the state."""
    last, known, counts = pipeline.last, pipeline.last_known, pipeline.counts()
    lines = [
        f"received {pipeline.codec.received} frames; dropped {counts.dropped}, lost {counts.lost}, "
        f"implausible {counts.implausible}, unknown identifiers {counts.unknown}"
    ]
    if last is None:
        return lines
    ago = ""
    if known and known.soc is not None and known.soc_sd is not None:
        _, *told = pipeline.publisher.told(known)
        remaining, p10, p90 = ("–" if value is None else f"{value:.1f}" for value in told)
        lines += [
            f"state of charge {100 * known.soc:.1f} % ± {100 * known.soc_sd:.1f} %, "
            f"ridden {last.distance / 1000:.2f} km",
            f"range {remaining} km ({p10} to {p90})",
        ]
        ago = f"; the numbers are of {last.time - known.time:.1f} s before" if known is not last else ""
    state = pipeline.publisher.told(last)[0]
    return [*lines, f"state at the end {state_text(state, last.reasons)}{ago}"]
