"""What happens to a daemon on a scooter: killed, unplugged, stopped, flooded, its clock set."""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from statistics import median

import pytest

from gz_onboard.can.recorder import is_complete
from gz_onboard.events import State
from tests.support import S, Scooter
from tests.vcan.support import Daemon, Listener, Running, ip, number, raw_frames, wait_for

FRAME = struct.Struct("=IB3x8s")


@contextmanager
def sender(channel: str = "vcan0") -> Iterator[socket.socket]:
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
        raw.bind((channel,))
        yield raw


@contextmanager
def hold_ups() -> Iterator[list[float]]:
    """How long [s] a thread that only sleeps was held up, each time, until left."""
    stopping, found = threading.Event(), [0.0]

    def watch() -> None:
        before = time.monotonic()
        while not stopping.wait(0.02):
            now = time.monotonic()
            found.append(now - before)
            before = now

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield found
    finally:
        stopping.set()
        thread.join()


@contextmanager
def steady_ride(*channels: str) -> Iterator[list[float]]:
    """A ride at 10 m/s onto vcan0 (or the measuring system onto another channel), until left; gives when it failed."""
    names = channels or ("vcan0",)
    stopping = threading.Event()
    failures: list[float] = []

    def ride() -> None:
        sockets = [opened.enter_context(sender(name)) for name in names]
        frames = Scooter().steady(15.0, hbm=len(names) - 1)
        begin, first = time.monotonic(), frames[0][0]
        while not stopping.is_set():
            for time_ns, can_id, data, channel in frames:
                pause = begin + (time_ns - first) / S - time.monotonic()
                if pause > 0.002:
                    time.sleep(pause)
                if stopping.is_set():
                    break
                try:
                    sockets[channel].send(FRAME.pack(can_id, len(data), data))
                except OSError:
                    failures.append(time.monotonic())
            begin += 15.0  # as many frames of each message as make its counter run on

    with ExitStack() as opened:
        thread = threading.Thread(target=ride)
        thread.start()
        try:
            yield failures
        finally:
            stopping.set()
            thread.join()


def test_killed_it_goes_on_from_the_saved_state(running: Running, listener: Listener):
    daemon = running.daemon()
    with steady_ride(), hold_ups() as held_up:
        listener.wait_for_valid(2)
        time.sleep(12)  # the state is saved at least every 10 s
        before = listener.decoded("RANGE_Status")[-1]
        killed_ns = time.time_ns()
        daemon.process.kill()
        daemon.process.wait()
        first_log = daemon.logs[-1]
        daemon = running.daemon()
        assert "continuing from the state saved" in daemon.journal
        listener.wait_for_new("RANGE_Estimate", 10, RANGE_EstimateState=State.VALID)
        after = listener.decoded("RANGE_Status")[-1]
    daemon.stop()
    assert daemon.logs[-1] != first_log
    assert killed_ns - raw_frames(first_log)[-1][0] < (3 + 4 * max(held_up)) * S  # what is lost
    assert after["RANGE_StateOfCharge"] == pytest.approx(before["RANGE_StateOfCharge"], abs=0.3)
    assert after["RANGE_StateOfChargeSigma"] == pytest.approx(before["RANGE_StateOfChargeSigma"], abs=0.2)


@pytest.mark.administers
def test_bus_down_and_up(running: Running, listener: Listener):
    daemon = running.daemon()
    with steady_ride() as failures:
        listener.wait_for_new("RANGE_Estimate", 10, RANGE_EstimateState=State.VALID)
        ip("link", "set", "vcan0", "down")
        went_down = time.time_ns()
        time.sleep(6)
        came_up = time.time_ns()
        ip("link", "set", "vcan0", "up")
        time.sleep(4)
        assert failures
    check_taken_away_and_back(daemon, listener)
    daemon.stop()
    rows = {round((row["time_ns"] - went_down) / S): row for row in daemon.estimates()}
    during = [rows[t] for t in (3, 4, 5)]
    assert all("BUS_DOWN" in row["reasons"] and row["state"] == "INVALID" for row in during)
    assert all(row["speed"] is None and row["pack_current"] is None for row in during)
    after = [row for row in rows.values() if row["time_ns"] > came_up and row["state"] == "VALID"]
    assert after
    assert all("BUS_DOWN" not in row["reasons"] for row in after)
    assert "BUS_DOWN" in daemon.journal
    assert any(came_up < frame[0] < came_up + 4 * S for frame in listener.frames)
    soc = [row["soc"] for row in daemon.estimates() if row["soc"] is not None]
    assert all(abs(b - a) < 0.002 for a, b in pairwise(soc))


def open_files(pid: int, seconds: float = 1.5) -> int:
    """The fewest in this time: while it tries to open an interface, once a second, a process holds one more."""
    counts = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        counts.append(len(list(Path(f"/proc/{pid}/fd").iterdir())))
        time.sleep(0.05)
    return min(counts)


def check_taken_away_and_back(daemon: Daemon, listener: Listener) -> None:
    """The interface is deleted and made again: the daemon neither ends nor leaks files, and hears it again."""
    ip("link", "delete", "vcan0")
    time.sleep(2)
    first = open_files(daemon.process.pid)
    time.sleep(2)
    assert open_files(daemon.process.pid) <= first  # after four attempts and more to open what is not there
    ip("link", "add", "dev", "vcan0", "type", "vcan")
    ip("link", "set", "vcan0", "up")
    with steady_ride():
        listener.wait_for_new("RANGE_Estimate", 10, RANGE_EstimateState=State.VALID)
    assert daemon.process.poll() is None


def dropped_on_the_way() -> int:
    """Frames of any interface that the kernel dropped because its queue of received ones was full."""
    return sum(int(line.split()[1], 16) for line in Path("/proc/net/softnet_stat").read_text().splitlines())


def test_what_the_kernel_drops_is_counted(running: Running, listener: Listener):
    daemon = running.daemon()
    count = 30_000
    frame = FRAME.pack(0x413, 2, bytes(8))  # a message without counter: nothing but the kernel knows of the loss
    on_the_way = dropped_on_the_way()
    with sender() as raw:
        heard = len(listener.messages)
        os.kill(daemon.process.pid, signal.SIGSTOP)
        for _ in range(count):
            raw.send(frame)
        os.kill(daemon.process.pid, signal.SIGCONT)
        time.sleep(0.5)
        for _ in range(10):  # the kernel tells with the next frame
            raw.send(frame)
            time.sleep(0.02)
        # Told for a second of the bus' time, which may pass in no time where much has to be caught up.
        listener.wait_for_new("RANGE_Status", 15, heard, RANGE_FramesLost=1)
        listener.wait_for_new("RANGE_Status", 5, RANGE_FramesLost=0)
        for _ in range(3):  # seconds, whose rows are in the log: it leaves rows out while it has too much to write
            listener.wait_for_new("RANGE_Estimate", 15)
    summary = daemon.stop()
    received, lost = number(summary, r"received (\d+)"), number(summary, r"lost (\d+)")
    assert lost > 1000
    # What the kernel drops before any socket sees it, where frames come faster than it hands them on, nobody counts.
    assert count + 10 - (dropped_on_the_way() - on_the_way) <= received + lost <= count + 10
    assert 1000 < daemon.statuses()[-1]["kernel_lost"] <= lost  # more may be told after the log's last row
    told = [row for row in listener.decoded("RANGE_Status") if row["RANGE_FramesLost"]]
    assert len(told) >= 9  # a second; another loss while it catches up begins that anew
    assert listener.decoded("RANGE_Diagnosis")[-1]["RANGE_CountLost"] == min(lost, 4094)


def test_stopped_for_long_it_tells_nothing_old(running: Running, listener: Listener):
    """The kernel keeps the oldest frames for it: none of them makes an estimate that counts as good."""
    daemon = running.daemon()
    with steady_ride():
        listener.wait_for_valid(2)
        os.kill(daemon.process.pid, signal.SIGSTOP)
        time.sleep(12)
        heard = len(listener.messages)
        os.kill(daemon.process.pid, signal.SIGCONT)
        listener.wait_for_new("RANGE_Status", 20, heard, RANGE_StatusState=State.VALID)
    daemon.stop()
    soc = [row["soc"] for row in daemon.estimates() if row["soc"] is not None]
    assert all(abs(b - a) < 0.002 for a, b in pairwise(soc))


def test_two_channels(running: Running, listener: Listener):
    daemon = running.daemon(channels=("vcan0", "vcan1"))
    with steady_ride("vcan0", "vcan1"):
        listener.wait_for_new("RANGE_Estimate", 10, RANGE_EstimateState=State.VALID)
        time.sleep(3)
    summary = daemon.stop()
    frames = raw_frames(daemon.logs[-1])
    assert number(summary, r"received (\d+)") == len(frames)
    assert {frame[3] for frame in frames if frame[1] < 0x400} == {0}
    assert {frame[3] for frame in frames if frame[1] >= 0x400} == {1}
    assert all(b[0] >= a[0] for a, b in pairwise(frames))  # in the order of time, whatever the channel
    assert not number(summary, r"dropped (\d+)")
    assert daemon.estimates()[-2]["speed"] == pytest.approx(10.0, abs=0.01)


@pytest.mark.administers
@pytest.mark.skipif(not Path("/run/vcan-guest").is_dir(), reason="sets the clock: only in a guest")
def test_the_clock_is_set(running: Running, listener: Listener):
    started = time.clock_gettime(time.CLOCK_BOOTTIME)
    daemon = running.daemon()
    real = time.clock_gettime(time.CLOCK_BOOTTIME)
    begin = time.time()

    def set_clock(ahead: float) -> None:
        now = begin + time.clock_gettime(time.CLOCK_BOOTTIME) - real
        time.clock_settime(time.CLOCK_REALTIME, now + ahead)

    try:
        with steady_ride(), hold_ups() as held_up:
            listener.wait_for_new("RANGE_Estimate", 10, RANGE_EstimateState=State.VALID)
            for ahead in (3600.0, -7200.0, 40.0):
                set_clock(ahead)
                time.sleep(4)
                assert listener.decoded("RANGE_Status")[-1]["time"] == pytest.approx(time.time(), abs=1.0)
    finally:
        set_clock(0.0)
    wait_for(lambda: daemon.journal.count("the clock was set") == 4, 5, "the daemon says that the clock was set")
    daemon.stop()
    elapsed = time.clock_gettime(time.CLOCK_BOOTTIME) - started
    rows = daemon.estimates()
    steps = [b["time"] - a["time"] for a, b in pairwise(rows)]
    # A busy machine may hold the daemon up, but no time is in the log that did not pass, and none comes twice.
    assert median(steps) == pytest.approx(1.0, abs=0.11)
    assert min(steps) > 0.5, [round(step, 2) for step in steps]
    assert sum(steps) < elapsed, [round(step, 2) for step in steps]
    riding = [row for row in rows if row["speed"] is not None]
    worse = [(row["state"], row["reasons"]) for row in riding[2:-2] if row["state"] != "VALID"]
    assert not worse or max(held_up) > 0.5, worse  # a machine so busy holds up the sender, too
    assert all(0 < b["distance"] - a["distance"] < 12 for a, b in pairwise(riding))
    assert "implausible time" not in daemon.statuses()[-1]["faults"]
    soc = [row["soc"] for row in riding if row["soc"] is not None]
    assert max(soc) - min(soc) < 0.005


@pytest.mark.administers
def test_a_full_disk(running: Running, listener: Listener, tmp_path: Path):
    """Others fill it, and room again: the log leaves them their share, and goes on in a new file."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(disk)], check=False, capture_output=True
    )
    if mount.returncode:
        pytest.skip(f"no mount here: {mount.stderr.decode()}")
    try:
        daemon = running.daemon("--log-dir", str(disk))
        with steady_ride():
            listener.wait_for_valid(4)
            assert not listener.decoded("RANGE_Status")[-1]["RANGE_LogFailed"]
            (disk / "ballast").write_bytes(bytes(1_800_000))
            listener.wait_for_new("RANGE_Status", 60, RANGE_LogFailed=1)
            wait_for(lambda: "cannot write the log" in daemon.journal, 10, "it says that the disk is full")
            (disk / "ballast").unlink()
            listener.wait_for_new("RANGE_Status", 30, RANGE_LogFailed=0, RANGE_StatusState=State.VALID)
            time.sleep(3)
        daemon.stop()
        logs = sorted(disk.glob("*.mcap"), key=lambda path: path.stat().st_mtime)
        assert len(logs) >= 2
        assert all(is_complete(log) for log in logs)
        assert all(len(raw_frames(log)) > 500 for log in (logs[0], logs[-1]))
    finally:
        running.kill()
        subprocess.run(["umount", str(disk)], check=False)
