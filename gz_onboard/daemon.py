"""The daemon: channels, clock, recorder and pipeline together. All that systemd runs."""

from __future__ import annotations

import argparse
import logging
import os
import signal
import time
from bisect import bisect_left
from operator import itemgetter
from pathlib import Path

from gz_onboard import notify, state
from gz_onboard.bus.channel import Channel
from gz_onboard.bus.recorder import Recorder
from gz_onboard.errors import InputError
from gz_onboard.events import Frame, Reason
from gz_onboard.physics.trust import ROOT
from gz_onboard.pipeline import TICK_NS, Pipeline, dbc_texts, reason_names
from gz_onboard.vehicle import Vehicle, read_vehicle

TICK = 0.1  # s: as often as a status is sent; each wake-up costs as much as ten frames
BUSY = 200  # frames in a tick from which the next is half as long: what waits in the kernel must fit its buffer
SAVE_PERIOD = 10.0  # s
CLOCK_STEP_NS = 500_000_000

log = logging.getLogger("gz-onboard")


class Daemon:
    """Runs until `stop` is called (by SIGTERM or SIGINT)."""

    def __init__(self, vehicle: Vehicle, channels: list[Channel], recorder: Recorder | None, state_file: Path | None,
                 filter_name: str = "scalar", tick: float = TICK) -> None:  # fmt: skip
        self.channels = channels
        self.recorder = recorder
        self.pipeline = Pipeline(vehicle, filter_name=filter_name, log=recorder)
        self._key = vehicle.key
        self._state_file = state_file
        self._tick = tick
        self._stopping = False
        self._later: list[Frame] = []
        self._offset = _wall_offset()
        self._save_at = 0.0
        self._said_at = 0.0
        self._said = ""
        self._state_failing = False
        self._log_error = ""

    def stop(self, *_: object) -> None:
        """End after the current round."""
        self._stopping = True

    def run(self) -> None:
        """Loop until stopped: each tick drain, estimate, send, record, save, feed the watchdog."""
        self._restore()
        watchdog = notify.watchdog_interval()
        fed = next_tick = time.monotonic()
        busy = False
        self._save_at = next_tick + SAVE_PERIOD
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
            if now >= self._save_at:
                self._save_at = now + SAVE_PERIOD
                self._save()
        notify.stopping()
        self.round()  # what waited for its tick
        self._save()
        if self.recorder:
            self.recorder.close()
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
        # What came while we read, or were held up, waits for its own tick: of a channel read before, some is missing.
        frames.sort(key=itemgetter(0))
        ahead = time.clock_gettime_ns(time.CLOCK_BOOTTIME) + offset + CLOCK_STEP_NS  # for the codec to drop
        end, beyond = bisect_left(frames, (now_ns,)), bisect_left(frames, (ahead,))
        frames, self._later = frames[:end] + frames[beyond:], frames[end:beyond]
        pipeline = self.pipeline
        step = offset - self._offset
        self._offset = offset
        if abs(step) > CLOCK_STEP_NS:  # by the network's or the GPS' time; what came meanwhile has either time
            log.warning("the clock was set by %.1f s", step * 1e-9)
            pipeline.clock_set(step)
            frames, self._later = [], []
        pipeline.kernel_lost = sum(channel.overflow for channel in self.channels)
        pipeline.send_failures = sum(channel.send_failures for channel in self.channels)
        reasons = Reason(0)
        if not all(channel.up for channel in self.channels):
            reasons |= Reason.BUS_DOWN
        if self.recorder and self.recorder.failing:
            reasons |= Reason.LOG_FAILED
        pipeline.extra_reasons = reasons
        for frame in pipeline.advance(frames, now_ns):
            self.channels[0].send(frame)
        if self.recorder:
            self.recorder.sync(now_ns)
        return len(frames)

    def _say(self, now: float) -> None:
        """Tell systemd how it stands and the journal what changed, at most once a second."""
        if now - self._said_at < 1.0:
            return
        self._said_at = now
        error = self.recorder.last_error if self.recorder and self.recorder.failing else ""
        if error and error != self._log_error:
            log.warning("cannot write the log: %s", error)
        self._log_error = error
        last = self.pipeline.last
        if last is None:
            return
        counts = self.pipeline.counts()
        text = f"{last.state.name.lower()}: {' '.join(reason_names(last.reasons)) or 'all inputs there'}"
        if text != self._said:
            log.info("%s; dropped %d, lost %d, unknown %d", text, counts.dropped, counts.lost, counts.unknown)
            self._said = text
        if last.range is not None and last.soc is not None:
            text = f"{last.range / 1000:.1f} km, {100 * last.soc:.0f} %, {text}"
        notify.status(text)

    def _restore(self) -> None:
        if self._state_file is None:
            return
        try:
            found = state.load(self._state_file, time.time())
            if found:
                snapshot, age = found
                self.pipeline.estimator.restore(snapshot, self._key, age)
                log.info(
                    "going on from the state saved %s", "at an unknown time" if age is None else f"{age:.0f} s ago"
                )
        except ValueError as error:
            log.warning("saved state %s %s: not used", self._state_file, error)

    def _save(self) -> None:
        snapshot = self.pipeline.estimator.snapshot(self._key) if self._state_file else None
        if snapshot is None or self._state_file is None:
            return
        try:
            state.save(self._state_file, snapshot, time.time())
        except OSError as error:
            if not self._state_failing:
                log.warning("cannot save the state: %s", error)
            self._state_failing = True
        else:
            if self._state_failing:
                log.info("the state is saved again")
            self._state_failing = False


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
    add("--channel", action="append", metavar="NAME", help="channel; twice, for a second bus (can0)")
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
    recorder = None
    if arguments.log_dir:
        recorder = Recorder(
            arguments.log_dir, vehicle.name, metadata={"vehicle_key": vehicle.key}, attachments=dbc_texts(vehicle),
            max_file_bytes=round(arguments.log_file_mb * 1e6), max_age_s=arguments.log_file_hours * 3600,
            max_total_bytes=round(arguments.log_total_mb * 1e6),
        )  # fmt: skip
    state_file = None
    if arguments.state_dir:
        state_file = arguments.state_dir / f"{vehicle.name}.json"
    from gz_onboard.bus.codec import known_identifiers

    wanted = None if arguments.all_frames else known_identifiers(vehicle.mapping)
    channels = [Channel(arguments.interface, name, index, wanted) for index, name in enumerate(names)]
    for channel in channels:
        channel.open()
    daemon = Daemon(vehicle, channels, recorder, state_file, arguments.filter, arguments.tick)
    signal.signal(signal.SIGTERM, daemon.stop)
    signal.signal(signal.SIGINT, daemon.stop)
    daemon.run()
    _summary(daemon)
    return 0


def _summary(daemon: Daemon) -> None:
    """What a person wants to read when the daemon ends."""
    pipeline, last = daemon.pipeline, daemon.pipeline.last
    counts = pipeline.counts()
    print(f"received {pipeline.codec.received} frames; dropped {counts.dropped}, lost {counts.lost}, "
          f"implausible {counts.implausible}, unknown identifiers {counts.unknown}")  # fmt: skip
    if last and last.soc is not None and last.soc_sd is not None:
        print(
            f"state of charge {100 * last.soc:.1f} % ± {100 * last.soc_sd:.1f} %, ridden {last.distance / 1000:.2f} km"
        )
    if last and last.range is not None and last.range_p10 is not None and last.range_p90 is not None:
        print(f"range {last.range / 1000:.1f} km ({last.range_p10 / 1000:.1f} to {last.range_p90 / 1000:.1f})")
    for path in [path for path in daemon.recorder.paths if path.exists()] if daemon.recorder else []:
        print(f"log {path}")
