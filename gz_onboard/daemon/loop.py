"""The daemon: channels, clock, recorder and pipeline together.

The loop never waits for a disk: the log and the state are written by a thread each. Nor for the bus: what one tick
reads and decodes is bounded, so that the status goes out ten times a second whatever comes.
"""

from __future__ import annotations

import logging
import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from math import inf
from operator import itemgetter
from pathlib import Path
from typing import Any

from gz_onboard import state
from gz_onboard.background import Background
from gz_onboard.can.channel import CanChannel
from gz_onboard.can.recorder import BackgroundRecorder, Recorder
from gz_onboard.daemon.control import Control
from gz_onboard.events import Estimate, Frame, Reason, State
from gz_onboard.log_rows import reason_names
from gz_onboard.notify import notify, watchdog_interval
from gz_onboard.pipeline import Pipeline, SystemHealth
from gz_onboard.vehicle import Vehicle

TICK = 0.1  # s, the period of the status frame; a wake-up costs as much as ten frames
BUSY = 200  # frames in a tick after which the next is half as long, so that the kernel's buffer does not overflow
WORK_S = 0.06  # s of CPU that the frames of one tick may cost
FRAME_S = 20e-6  # s of CPU per frame, until it is measured
STOP_S = 6.0  # s to finish writing when stopped; systemd kills after 10 s
CLOCK_STEP_NS = 500_000_000
HELD_NS = 200_000_000  # a channel waits no longer for another that could not be read out
SAVE_PERIOD_NS, SAVE_AT_MOST_NS = 10_000_000_000, 1_000_000_000
SAVE_SOC = 0.001  # a change of the state of charge that is saved before the period is over

log = logging.getLogger("gz-onboard")


class Daemon:
    """Runs until `stop` is called (by SIGTERM or SIGINT)."""

    def __init__(
        self,
        vehicle: Vehicle,
        channels: list[CanChannel],
        recorder: Recorder | None,
        state_file: Path | None,
        *,
        filter_name: str = "scalar",
        control_socket: Path | None = None,
        rider: str = "",
    ) -> None:
        self.finished = True  # whether log and state were written to their end
        self.channels = channels
        self._rider = rider
        self._log = BackgroundRecorder(recorder) if recorder else None
        self._make_pipeline: Callable[[], Pipeline] = lambda: Pipeline(vehicle, filter_name=filter_name, log=self._log)
        self.pipeline = self._make_pipeline()
        self.control = Control(control_socket, lambda: self.pipeline)
        self._keeper = StateKeeper(state_file, vehicle.key) if state_file else None
        self._stopping = False
        self._later: list[Frame] = []  # read before their tick
        self._overrun = 0  # frames left out: too many, or stamped while the clock was set
        self._frame_s = FRAME_S
        self._offset = _wall_offset()
        self._boot_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        self._reported_at = 0.0
        self._problems: list[str] = []  # a second ago, as the next two
        self._state: tuple[State, Reason] | None = None
        self._status = ""

    def stop(self, *_: object) -> None:
        """End after the present tick."""
        self._stopping = True

    def run(self) -> None:
        """Loop until stopped: each tick drain, estimate, send, record, save, feed the watchdog.

        Whatever is raised, log and state are written to their end first.
        """
        try:
            self._loop()
            notify(STOPPING=1)
            self.tick()  # frames that waited for theirs
        finally:
            self.close()

    def _loop(self) -> None:
        self.restore()
        watchdog = watchdog_interval() or inf
        fed = next_tick = time.monotonic()
        busy = False
        notify(READY=1, STATUS="waiting for frames")
        log.info("ready after %.2f s of CPU", time.process_time())
        while not self._stopping:
            now = time.monotonic()
            next_tick = max(next_tick + (TICK / 2 if busy else TICK), now)  # overloaded or suspended: no catching up
            time.sleep(next_tick - now)
            busy = self.tick() > BUSY
            if next_tick - fed >= watchdog:
                fed = next_tick
                notify(WATCHDOG=1)
            if next_tick - self._reported_at >= 1.0:
                self._reported_at = next_tick
                self._report()

    def close(self) -> None:
        """Save the state, finish the log as far as the disks allow in time, and close the channels."""
        until = time.monotonic() + STOP_S
        self.control.close()
        if self._keeper:
            self._keeper.save(self.pipeline, time.time_ns())
        if self._log and not self._log.close(until - time.monotonic()):
            log.warning("the disk does not take the log in time: its end is lost")
            self.finished = False
        if self._keeper and not self._keeper.close(max(until - time.monotonic(), 1.0)):
            log.warning("the last state is not saved")
            self.finished = False
        for channel in self.channels:
            channel.close()

    def restore(self) -> Mapping[str, Any] | None:
        """Continue from the latest saved state that can be used; return it."""
        snapshot = None
        if self._keeper:
            self.pipeline, snapshot = self._keeper.restore(self.pipeline, self._make_pipeline)
        if self._rider:  # not the one of the saved state
            self.pipeline.estimator.forecaster.ridden_by(self._rider)
        return snapshot

    def tick(self) -> int:
        """Read and process the frames since the last tick; return their number."""
        boot_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        frames, self._later = self._later, []
        read_until = []  # ns, of the channels with more to read
        for channel in self.channels:
            frames += (new := channel.drain())
            read_until += [new[-1][0]] if channel.behind and new else []
        offset = _wall_offset()
        now_ns = boot_ns + offset  # by the same clock as `offset`, whenever that was set
        now_ns = max(min([now_ns, *read_until]), now_ns - HELD_NS)
        self.pipeline.estimator.pack.wait((boot_ns - self._boot_ns) * 1e-9)
        self._boot_ns = boot_ns
        # Frames that came while we read wait for the next tick: some of a channel that was read earlier are missing.
        frames.sort(key=itemgetter(0))
        ahead = time.clock_gettime_ns(time.CLOCK_BOOTTIME) + offset + CLOCK_STEP_NS  # for the codec to drop
        end, beyond = bisect_left(frames, (now_ns,)), bisect_left(frames, (ahead,))
        frames, self._later = frames[:end] + frames[beyond:], frames[end:beyond]
        step = offset - self._offset
        self._offset = offset
        if abs(step) > CLOCK_STEP_NS:  # the network or GPS set the clock; frames have the old or the new time
            log.warning("the clock was set by %.1f s", step * 1e-9)
            self.pipeline.clock_set(step)
            self._overrun += len(frames) + len(self._later)
            frames, self._later = [], []
        kept = fair_share(frames, max(int(WORK_S / self._frame_s), 2 * BUSY))
        self._overrun += len(frames) - len(kept)
        began = time.thread_time()
        self.step(kept, now_ns)
        if len(kept) > BUSY:  # with fewer the estimates cost more than the frames
            self._frame_s += 0.2 * ((time.thread_time() - began) / len(kept) - self._frame_s)
        return len(frames)

    def step(self, frames: list[Frame], now_ns: int) -> None:
        """Process frames, in the order of their times, up to `now_ns`; send, record and save the results."""
        pipeline = self.pipeline
        problems = {
            Reason.BUS_DOWN: not all(channel.up for channel in self.channels),
            Reason.LOG_FAILED: self._log and self._log.error,
            Reason.SAVE_FAILED: self._keeper and self._keeper.error,
        }
        pipeline.health = SystemHealth(
            kernel_lost=sum(channel.overflow for channel in self.channels),
            overrun=self._overrun,
            send_failures=sum(channel.send_failures for channel in self.channels),
            log_lost=self._log.lost_frames if self._log else 0,
            reasons=Reason(sum(reason for reason, found in problems.items() if found)),
        )
        self.control.take()
        for frame in pipeline.advance(frames, now_ns):
            self.channels[0].send(frame)
        if self._log:
            self._log.sync(now_ns)
        if self._keeper:
            self._keeper.save_if_due(pipeline, now_ns)

    def _report(self) -> None:
        """Log new problems and a new state, and give systemd a new status."""
        pipeline, last = self.pipeline, self.pipeline.last
        problems = [foreign_text(pipeline)] if pipeline.foreign else []
        if self._log and self._log.error:
            problems.append(f"cannot write the log: {self._log.error}")
        if self._keeper and self._keeper.error:
            problems.append(f"cannot save the state: {self._keeper.error}")
        for text in problems:
            if text not in self._problems:
                log.warning("%s", text)
        self._problems = problems
        if last is None:
            return
        state, status = (last.state, last.reasons), status_text(pipeline, last)
        if state != self._state:
            counts = pipeline.counts()
            log.info("%s; dropped %d, lost %d, unknown %d", status, counts.dropped, counts.lost, counts.unknown)
        if status != self._status:
            notify(STATUS=status)
        self._state, self._status = state, status


class StateKeeper:
    """Restores the estimator's state at start, and saves it on a separate thread."""

    def __init__(self, file: Path, key: str) -> None:
        self.file = file
        self.key = key
        self._thread = Background("state")
        self._saved_ns, self._saved_soc = 0, inf
        self._error = ""

    @property
    def error(self) -> str:
        """Why the state cannot be saved; empty if it can."""
        return self._thread.error or self._error

    def restore(self, pipeline: Pipeline, make: Callable[[], Pipeline]) -> tuple[Pipeline, Mapping[str, Any] | None]:
        """Restore the newest copy that can be used into `pipeline`; return the pipeline to use, and the snapshot.

        Never raises: without a usable copy the pipeline starts fresh. A copy that cannot be used is renamed to end in
        ``.refused``, and the pipeline, into which parts of it may have been restored, is replaced by one from `make`.
        """
        refused = False
        for copy in state.copies(self.file):
            try:
                found = state.load(copy, time.time(), time.clock_gettime(time.CLOCK_BOOTTIME), state.kept_time())
                if found is None:
                    continue
                snapshot, age = found
                pipeline.estimator.restore(snapshot, self.key, age)
            except Exception as error:  # whatever the file holds: an estimate from nothing is better than none
                refused, pipeline, kept = True, make(), copy
                with suppress(OSError):
                    kept = copy.replace(copy.with_name(f"{copy.name}.refused"))
                log.warning("saved state not used, kept as %s: %s", kept, str(error) or repr(error))
            else:
                when = "at an unknown time" if age is None else f"{age:.0f} s ago"
                log.info("continuing from the state saved %s", when)
                return pipeline, snapshot
        if refused:
            log.warning("no saved state can be used: starting fresh")
        return pipeline, None

    def save_if_due(self, pipeline: Pipeline, now_ns: int) -> None:
        """Save once in the period, or when the state of charge has moved; not while the last save is under way."""
        soc = pipeline.last.soc if pipeline.last else None
        moved = soc is not None and abs(soc - self._saved_soc) >= SAVE_SOC
        since = abs(now_ns - self._saved_ns)  # the clock may be set back
        if since >= (SAVE_AT_MOST_NS if moved else SAVE_PERIOD_NS) and not self._thread.load:
            self.save(pipeline, now_ns)

    def save(self, pipeline: Pipeline, now_ns: int) -> None:
        """Save now, if there is something to save."""
        snapshot = pipeline.estimator.snapshot(self.key)
        if snapshot is None:
            return
        if pipeline.last and pipeline.last.soc is not None:
            self._saved_soc = pipeline.last.soc
        self._saved_ns = now_ns
        uptime = time.clock_gettime(time.CLOCK_BOOTTIME)
        self._thread.call(self._write, snapshot, now_ns * 1e-9, uptime, weight=0 if self._thread.load else 1)

    def close(self, seconds: float) -> bool:
        """Wait until all is saved; False if it cannot be, or if that takes longer than `seconds`."""
        return self._thread.close(seconds) and not self._error

    def _write(self, snapshot: Mapping[str, Any], saved_at: float, uptime: float) -> None:
        try:
            state.write(self.file, state.encode(snapshot, saved_at, uptime))
            self._error = ""
        except (OSError, ValueError, TypeError) as error:
            self._error = str(error)


def foreign_text(pipeline: Pipeline) -> str:
    """Warn of another sender on the identifiers of our own frames."""
    found = ", ".join(pipeline.foreign)
    return f"someone else sends on the identifiers of the range frames ({found}): choose others by range_identifier"


def fair_share(frames: list[Frame], most: int) -> list[Frame]:
    """Keep about `most` frames, the latest of each identifier, so that one that floods the bus displaces no other."""
    if len(frames) <= most:
        return frames
    identifiers = {(identifier, channel) for _, identifier, _, channel in frames}
    share = max(most // len(identifiers), 1)
    taken: Counter[tuple[int, int]] = Counter()
    kept = []
    for frame in reversed(frames):
        kind = frame[1], frame[3]
        taken[kind] += 1
        if taken[kind] <= share:
            kept.append(frame)
    return kept[::-1]


def _wall_offset() -> int:
    """Wall clock minus time since boot, suspended or not [ns]; changes only when the clock is set."""
    for _ in range(10):
        before, wall = time.clock_gettime_ns(time.CLOCK_BOOTTIME), time.time_ns()
        if time.clock_gettime_ns(time.CLOCK_BOOTTIME) - before < 1_000_000:  # else we were held up between the two
            break
    return wall - before


def status_text(pipeline: Pipeline, estimate: Estimate) -> str:
    """Describe an estimate, as it was sent, on one line."""
    state, remaining, _, _ = pipeline.publisher.reported(estimate)
    text = f"{state.name.lower()}: {' '.join(reason_names(estimate.reasons)) or 'all inputs there'}"
    if remaining is None or estimate.soc is None:
        return text
    return f"range {remaining / 1000:.1f} km, charge {100 * estimate.soc:.0f} %, {text}"
