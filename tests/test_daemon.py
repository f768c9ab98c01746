"""The daemon in this process, on python-can's virtual bus: frames in, frames out, and what fails around it."""

from __future__ import annotations

import json
import logging
import os
import shutil
import threading
import time
import zlib
from collections.abc import Callable
from contextlib import ExitStack
from itertools import count, pairwise
from pathlib import Path
from statistics import median
from typing import Any

import can
import pytest

from gz_onboard import state
from gz_onboard.can.channel import CanChannel
from gz_onboard.can.python_can import LibraryBus
from gz_onboard.can.recorder import LogLimits, Recorder
from gz_onboard.daemon.command import _lock
from gz_onboard.daemon.loop import Daemon
from gz_onboard.errors import InputError
from gz_onboard.events import TRANSMITTED, WINDOW, Frame, Reason, State
from gz_onboard.recording.logs import read_frames, read_samples
from tests.support import S, Scooter, check_frames, files_of_at_most, reference, ridden

_NUMBERS = count()


@pytest.fixture
def bus() -> str:
    """The name of a virtual bus of its own."""
    return f"bus{next(_NUMBERS)}"


class Scene:
    """A daemon in a thread, a ride onto its bus in real time, and all that is heard there."""

    def __init__(self, bus: str, **options: object) -> None:
        channel = CanChannel("virtual", bus)
        channel.open()
        self.daemon = Daemon(reference(), [channel], **{"recorder": None, "state_file": None, **options})  # type: ignore[arg-type]
        self.heard: list[Frame] = []
        self.end = threading.Event()
        self._bus = bus
        self._listening = can.Bus(interface="virtual", channel=bus)  # before the daemon says its first
        self._thread = threading.Thread(target=self.daemon.run)
        self._ear = threading.Thread(target=self._listen)

    def _listen(self) -> None:
        with self._listening as bus:
            while (message := bus.recv(0.1)) is not None or not self.end.is_set():  # to the last that is waiting
                if message is not None and message.arbitration_id >= 0x600:
                    stamp = round(message.timestamp * 1e9)
                    self.heard.append((stamp, message.arbitration_id, bytes(message.data), 0))

    def __enter__(self) -> Scene:
        self._ear.start()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.daemon.stop()
        self._thread.join(10)
        self.end.set()
        self._ear.join(10)
        assert not self._thread.is_alive()

    def ride(self, seconds: float, until: Callable[[], bool] = lambda: False) -> list[Frame]:
        """Send a steady ride for so long, or until something is so."""
        frames = Scooter().steady(seconds)
        sent: list[Frame] = []
        begin, first = time.monotonic(), frames[0][0]
        with can.Bus(interface="virtual", channel=self._bus) as bus:
            for frame in frames:
                pause = begin + (frame[0] - first) / S - time.monotonic()
                if pause > 0.005:
                    time.sleep(pause)
                    if until():
                        break
                bus.send(can.Message(arbitration_id=frame[1], data=frame[2], is_extended_id=False))
                sent.append(frame)
            time.sleep(0.2)
        return sent

    def reasons(self) -> Reason:
        last = self.daemon.pipeline.last
        return last.reasons if last else Reason(0)


def test_frames_in_frames_out(bus: str, tmp_path: Path):
    recorder = Recorder(tmp_path, "v")
    with Scene(bus, recorder=recorder) as scene:
        sent = scene.ride(4.0)
    decoded = check_frames(scene.heard)
    assert median(gaps(scene.heard)) == pytest.approx(0.1, abs=0.05)
    assert abs(len(decoded["RANGE_Status"]) - 10 * len(decoded["RANGE_Estimate"])) <= 10
    told = [row["RANGE_Remaining"] for row in decoded["RANGE_Estimate"] if row["RANGE_Remaining"] < 655.34]
    assert told
    (path,) = recorder.paths
    logged = [frame for batch in read_frames(path) for frame in batch]
    received = [frame for frame in logged if not frame[3] & TRANSMITTED]
    assert [f[1:3] for f in received] == [f[1:3] for f in sent]
    offline = ridden(received).estimates[-1]
    assert offline.range is not None
    assert told[-1] == pytest.approx(offline.range / 1000, rel=0.01)
    assert [f[1:3] for f in logged if f[3] & TRANSMITTED] == [f[1:3] for f in scene.heard]


def test_a_log_that_cannot_be_written_is_told_and_begun_again(bus: str, tmp_path: Path):
    recorder = Recorder(tmp_path, "v", limits=LogLimits(sync_s=0.2, retry_s=0.5))
    with Scene(bus, recorder=recorder) as scene:
        with files_of_at_most(8_000):
            failed: list[bool] = []  # that it was, once: half a second later it is tried again

            def has_failed() -> bool:
                failed.extend([True] if scene.reasons() & Reason.LOG_FAILED else [])
                return bool(failed)

            for _ in range(5):
                scene.ride(8.0, has_failed)
                if failed:
                    break
            assert failed
        begin = time.time_ns()
        scene.ride(4.0)
        assert not scene.reasons() & Reason.LOG_FAILED
    assert recorder.errors >= 1
    assert "too large" in recorder.last_error
    assert recorder.lost_frames > 0
    told = [row for row in check_frames(scene.heard)["RANGE_Status"] if row["RANGE_LogFailed"]]
    assert any(row["RANGE_StateOfCharge"] <= 100 for row in told)
    frames = [frame for batch in read_frames(recorder.paths[-1]) for frame in batch]
    assert sum(frame[0] > begin for frame in frames) > 1000
    reasons = [v["reasons"] for topic, _, v in read_samples(recorder.paths[-1]) if topic == "/estimate"]
    assert "LOG_FAILED" not in reasons[-1]


def state_of(file: Path) -> dict[str, object]:
    found = json.loads(file.read_text())
    assert isinstance(found, dict)
    return found


def test_it_goes_on_where_it_was(bus: str, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    caplog.set_level(logging.INFO)
    file = tmp_path / "scooter.json"
    with Scene(bus, state_file=file) as scene:
        scene.ride(2.0)
    assert "going on" not in caplog.text
    before = scene.daemon.pipeline.estimator.pack.state
    saved = state_of(file)
    with Scene(bus, state_file=file) as scene:
        estimator = scene.daemon.pipeline.estimator
        scene.ride(10.0, lambda: estimator.pack.is_started)  # it waits for an odometer that does not come
        assert "continuing from the state saved" in caplog.text
        after = estimator.pack.state
    assert after.soc == pytest.approx(before.soc, abs=1e-3)
    assert state_of(file)["saved_at"] > saved["saved_at"]  # type: ignore[operator]


Snapshot = dict[str, Any]


@pytest.fixture(scope="module")
def learned() -> Snapshot:
    """What five seconds of riding have taught, with a bias that no fresh estimator has."""
    estimator = ridden(Scooter().steady(5.0)).pipeline.estimator
    estimator.motion.gyro_bias = 0.01, 0.0
    snapshot = estimator.snapshot(reference().key)
    assert snapshot is not None
    return snapshot


def is_fresh(daemon: Daemon) -> bool:
    ours, new = daemon.pipeline.estimator, Daemon(reference(), [], None, None).pipeline.estimator
    same_bias = ours.motion.gyro_bias == new.motion.gyro_bias
    return ours.snapshot("") == new.snapshot("") is None and same_bias and ours.pack.past is None


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        ({"soc": 5.0}, "state.soc is 5.0, not from 0 to 1"),
        ({"soc_variance": "a"}, "state.soc_variance is 'a'"),
        ({"learned": [1, 2]}, "state.learned has [1, 2], not "),
        ({"more": 1.0}, "state has "),
        ({"key": "another scooter|10s4p"}, "['another scooter', '10s4p'] saved"),
        ({"version": 99}, "is of version 99"),
        ({"v1": float("nan")}, "state.v1 is nan"),
    ],
)
def test_a_state_that_is_damaged_or_does_not_fit_is_refused_whole_and_the_one_before_is_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, learned: Snapshot, odd: Snapshot, said: str
):
    file = tmp_path / "scooter.json"
    sealed = json.dumps({"saved_at": time.time(), "uptime": None, "estimator": learned | odd}).encode()[1:]
    state.write(file, b'{"crc32": "%08x", %s\n' % (zlib.crc32(sealed), sealed))
    daemon = Daemon(reference(), [], None, file)
    assert daemon.restore() is None
    assert said in caplog.text
    assert "no saved state can be used: starting fresh" in caplog.text
    assert is_fresh(daemon)
    file.with_name("scooter.json.refused").replace(file)
    state.copies(file)[1].write_bytes(state.encode({**learned, "soc": 0.41}, time.time()))
    found = Daemon(reference(), [], None, file).restore()
    assert found is not None
    assert found["soc"] == 0.41


def test_a_state_that_cannot_be_saved_is_told_and_counts_at_the_end(
    bus: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    channel = CanChannel("virtual", bus)
    channel.open()
    sent: list[Frame] = []
    monkeypatch.setattr(channel, "send", sent.append)
    daemon = Daemon(reference(), [channel], None, tmp_path / "folder" / "scooter.json")
    assert daemon._keeper is not None
    keeper, folder, frames = daemon._keeper, tmp_path / "folder", Scooter().steady(2.0)

    def told(second: int) -> float:
        later = [(frame[0] + second * S, *frame[1:]) for frame in frames]
        daemon.step(later, later[-1][0])
        assert keeper._thread.wait(20)
        daemon.step([], later[-1][0] + S)
        return check_frames(sent)["RANGE_Status"][-1]["RANGE_SaveFailed"]

    folder.write_text("in the way")
    assert told(0) == 1
    folder.unlink()
    assert told(20) == 0
    shutil.rmtree(folder)
    folder.write_text("in the way")
    assert told(40) == 1
    daemon.close()
    assert not daemon.finished
    assert "the last state is not saved" in caplog.text


@pytest.mark.parametrize("delta", [3600.0, -7200.0, 40.0])
def test_the_clock_is_set_in_the_middle_of_a_round(bus: str, monkeypatch: pytest.MonkeyPatch, delta: float):
    """Between the reading of the clock and that of the frames: no time is lost or comes twice, all is counted."""
    channel = CanChannel("virtual", bus)
    channel.open()
    daemon = Daemon(reference(), [channel], recorder=None, state_file=None)
    ticks: list[tuple[float, float]] = []  # s: of the estimate, of a clock that nobody sets
    rounds, ahead = count(), 0
    wall, drain = time.time_ns, channel.drain

    def drain_and_set() -> list[Frame]:
        nonlocal ahead
        if next(rounds) == 5:
            send(3)
            ahead = round(delta * S)
        return drain()

    def send(frames: int) -> None:
        for _ in range(frames):
            other.send(can.Message(arbitration_id=0x413, data=bytes(2), is_extended_id=False))

    monkeypatch.setattr(time, "time_ns", lambda: wall() + ahead)
    monkeypatch.setattr(channel, "drain", drain_and_set)
    with can.Bus(interface="virtual", channel=bus) as other:
        send(1)  # time begins with the first frame
        for _ in range(20):
            time.sleep(0.1)
            daemon.tick()
            last = daemon.pipeline.last
            ticks += [(last.time, time.monotonic())] if last else []
    channel.close()
    assert ahead
    assert daemon.pipeline.codec.received + daemon.pipeline.health.overrun == 4
    assert daemon.pipeline.health.overrun == 3
    assert all(0 <= b[0] - a[0] <= WINDOW + 1e-6 for a, b in pairwise(ticks)), ticks
    assert ticks[-1][0] - ticks[0][0] == pytest.approx(ticks[-1][1] - ticks[0][1], abs=WINDOW + 0.21)


def test_a_channel_that_was_not_read_out_is_waited_for(monkeypatch: pytest.MonkeyPatch):
    """Two channels, one read in parts by a busy machine: frames are taken in the order of their times, and all."""
    left, right = (CanChannel("virtual", f"unused{i}", index=i) for i in range(2))
    daemon = Daemon(reference(), [left, right], recorder=None, state_file=None)
    taken: list[Frame] = []
    monkeypatch.setattr(daemon, "step", lambda frames, now_ns: taken.extend(frames))
    left.open()
    right.open()
    came = [(time.time_ns() - (60 - i) * 1_000_000, 0x123, b"", i % 2) for i in range(60)]

    def parts(channel: CanChannel, of: list[Frame], count: int):
        def drain() -> list[Frame]:
            new, of[:] = of[:count], of[count:]
            channel.behind = bool(of)
            return new

        return drain

    monkeypatch.setattr(left, "drain", parts(left, came[0::2], 4))
    monkeypatch.setattr(right, "drain", parts(right, came[1::2], 100))
    for _ in range(10):
        daemon.tick()
    assert taken == came
    silent = [(time.time_ns() - 10_000_000, 0x123, b"", 1)]
    monkeypatch.setattr(left, "drain", parts(left, [(time.time_ns() - S, 0x123, b"", 0)] * 100, 1))  # a second behind
    monkeypatch.setattr(right, "drain", parts(right, silent[:], 1))
    for _ in range(5):
        time.sleep(0.1)
        daemon.tick()
    assert silent[0] in taken


# --- more than it can take, and disks that do not answer ---------------------------------------------------------


def gaps(heard: list[Frame]) -> list[float]:
    """The times [s] between the status frames heard."""
    times = [frame[0] / S for frame in heard if frame[1] == 0x602]
    return [b - a for a, b in pairwise(times)]


def test_a_bus_that_never_runs_dry_does_not_silence_it(bus: str, monkeypatch: pytest.MonkeyPatch):
    """Frames come faster than they can be read, without end: each round reads some of them, and tells."""
    with Scene(bus) as scene:
        message = can.Message(arbitration_id=0x413, data=bytes(2), is_extended_id=False)
        (channel,) = scene.daemon.channels
        assert isinstance(channel._bus, LibraryBus)
        monkeypatch.setattr(channel._bus._bus, "recv", lambda timeout: message)
        begin = len(scene.heard)
        time.sleep(3.0)
        heard = scene.heard[begin:]
    assert scene.daemon.pipeline.codec.received > 1000
    assert len(check_frames(heard)["RANGE_Status"]) >= 8  # 30 on a machine with nothing else to do


def test_what_cannot_be_decoded_in_time_is_left_out_fairly_counted_and_flagged(
    bus: str, monkeypatch: pytest.MonkeyPatch
):
    """One identifier floods the bus; the others' frames are all taken, and the estimate stays good."""
    with Scene(bus) as scene:
        daemon = scene.daemon
        monkeypatch.setattr("gz_onboard.daemon.loop.WORK_S", 0.0)  # as on a slow board: 400 frames a tick
        stop = threading.Event()

        def flood() -> None:
            with can.Bus(interface="virtual", channel=bus) as other:
                message = can.Message(arbitration_id=0x5FF, data=bytes(2), is_extended_id=False)
                while not stop.is_set():
                    for _ in range(400):
                        other.send(message)
                    time.sleep(0.05)

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            scene.ride(5.0)
        finally:
            stop.set()
            thread.join()
    last = [row for row in check_frames(scene.heard)["RANGE_Status"] if row["RANGE_FramesLost"]]
    assert any(row["RANGE_StatusState"] == State.VALID for row in last)
    assert daemon.pipeline.health.overrun > 1000
    assert daemon.pipeline.counts().lost >= daemon.pipeline.health.overrun
    assert daemon.pipeline.status()["overrun"] == daemon.pipeline.health.overrun


def test_disks_that_do_not_answer_do_not_silence_it(bus: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    answer = threading.Event()
    real = os.fdatasync, os.fsync

    def late(number: int, descriptor: int) -> None:
        answer.wait(60)
        real[number](descriptor)

    file = tmp_path / "scooter.json"
    recorder = Recorder(tmp_path / "log", "v", limits=LogLimits(sync_s=0.3))
    with Scene(bus, recorder=recorder, state_file=file) as scene:
        log = scene.daemon._log
        assert log is not None
        log._thread._limit = 2000
        scene.ride(2.0)
        monkeypatch.setattr(os, "fdatasync", lambda descriptor: late(0, descriptor))
        monkeypatch.setattr(os, "fsync", lambda descriptor: late(1, descriptor))
        begin = len(scene.heard)
        scene.ride(20.0, lambda: log.lost_frames > 500)
        during = scene.heard[begin:]
        assert scene.reasons() & Reason.LOG_FAILED
        answer.set()
        scene.ride(10.0, lambda: not scene.reasons() & Reason.LOG_FAILED)
        assert not scene.reasons() & Reason.LOG_FAILED
        scene.ride(1.2)
    assert max(gaps(during)) < 2.0  # were it to wait for a disk, it would be for as long as that does not answer
    status = [values for topic, _, values in read_samples(recorder.paths[-1]) if topic == "/status"]
    assert status[-1]["log_lost"] == log.lost_frames > 500
    last = scene.daemon.pipeline.last
    found = state.load(file, time.time())
    assert last is not None
    assert found is not None
    assert found[0]["soc"] == pytest.approx(last.soc, abs=1e-3)


# --- alone -------------------------------------------------------------------------------------------------------


def take(interface: str, name: str, folder: Path) -> None:
    with ExitStack() as locks:
        _lock(locks, interface, [name], folder)


def test_of_two_daemons_on_one_bus_or_state_directory_the_second_is_refused(tmp_path: Path):
    name = f"can{os.getpid()}"  # the names are those of the whole machine
    with ExitStack() as first:
        _lock(first, "socketcan", [name], tmp_path / "a")
        with pytest.raises(InputError, match=f"--channel {name}: another gz-onboard run has it"):
            take("socketcan", name, tmp_path / "b")
        with pytest.raises(InputError, match=r"--state-dir .*another gz-onboard run uses it"):
            take("socketcan", f"{name}x", tmp_path / "a")
        take("socketcan", f"{name}x", tmp_path / "b")
        take("virtual", name, tmp_path / "b")
    take("socketcan", name, tmp_path / "a")
