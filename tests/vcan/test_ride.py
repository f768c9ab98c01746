"""A recorded ride on a real vcan, in its own timing, with the daemon, the replay and the dashboard as processes."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import pytest

from gz_onboard.bus.logs import read_frames
from gz_onboard.events import Estimate, Frame, State
from tests.support import MS, ROOT, S, check_frames, recorded, ridden
from tests.vcan.support import COASTDOWN, Daemon, Listener, Running, number, raw_frames

RIDE = 60.16  # s


@dataclass
class Ride:
    """What a daemon left behind of the whole ride."""

    daemon: Daemon
    summary: str
    heard: list[Frame]
    listener: Listener
    dashboard: str


@pytest.fixture(scope="module")
def ride(tmp_path_factory: pytest.TempPathFactory, vcan_there: None) -> Iterator[Ride]:
    running = Running(tmp_path_factory.mktemp("ride"))
    try:
        with Listener() as listener:
            daemon = running.daemon()
            dashboard = running.start("dashboard", "--channel", "vcan0", stdout=subprocess.PIPE, text=True)
            assert running.replay().wait(RIDE + 30) == 0
            time.sleep(0.2)
            dashboard.terminate()
            lines, _ = dashboard.communicate(timeout=15)
            summary = daemon.stop()
        yield Ride(daemon, summary, listener.frames, listener, lines)
    finally:
        running.kill()


@pytest.fixture(scope="module")
def vcan_there() -> None:
    if not Path("/sys/class/net/vcan0").exists():
        pytest.skip("no vcan0 here: tests/vcan-guest -- .venv/bin/pytest tests/vcan")


def test_every_frame_is_received_and_logged_as_it_was_sent(ride: Ride):
    (log,) = ride.daemon.logs
    logged = raw_frames(log)
    sent = recorded("coastdown")
    assert len(logged) == len(sent)
    assert [frame[1:] for frame in logged] == [frame[1:] for frame in sent]
    assert number(ride.summary, r"received (\d+) frames") == len(sent)
    assert number(ride.summary, r"dropped (\d+)") == 0
    assert all(b[0] >= a[0] for a, b in pairwise(logged))
    late = [(a[0] - logged[0][0]) - (b[0] - sent[0][0]) for a, b in zip(logged, sent, strict=True)]
    assert sorted(late)[len(late) // 2] < 5 * MS  # the kernel's time stamps: the ride's own timing


def test_what_was_sent_is_in_the_log_too(ride: Ride):
    own = [frame[1:3] for frame in raw_frames(ride.daemon.logs[0], sent=True)]
    assert own == [frame[1:3] for frame in ride.heard]


@pytest.mark.parametrize(
    ("message", "period"),
    [("RANGE_Estimate", 1.0), ("RANGE_Energy", 1.0), ("RANGE_Diagnosis", 1.0), ("RANGE_Status", 0.1)],
)
def test_rates_by_the_kernels_time(ride: Ride, message: str, period: float):
    times = [row["time"] for row in ride.listener.decoded(message)]
    assert len(times) > RIDE / period
    first = next(frame[0] for frame in raw_frames(ride.daemon.logs[0])) / S
    riding = [t for t in times if t > first + 1.5 * period]
    steps = [b - a for a, b in pairwise(riding)]
    assert (riding[-1] - riding[0]) / len(steps) == pytest.approx(period, rel=0.01)
    # Sent in the round that follows, ten times a second, so a step may be longer by a round.
    assert sorted(steps)[int(0.98 * len(steps))] < period + 0.15
    assert max(steps) < period + 0.5


def test_frames_as_any_receiver_decodes_them(ride: Ride):
    decoded = check_frames(ride.heard)
    last = decoded["RANGE_Estimate"][-4]  # before the last frame of the ride
    assert last["RANGE_EstimateState"] == State.VALID
    assert 1 < last["RANGE_RemainingP10"] < last["RANGE_Remaining"] < last["RANGE_RemainingP90"] < 100


def test_cantools_decode(ride: Ride):
    text = "\n".join(f"({t / S:.6f}) vcan0 {can_id:03X}#{data.hex().upper()}" for t, can_id, data, _ in ride.heard)
    command = [sys.executable, "-m", "cantools", "decode", str(ROOT / "dbc" / "range.dbc")]
    out = subprocess.run(command, input=text, capture_output=True, text=True, check=True).stdout
    assert out.count("RANGE_Estimate(") == len(ride.listener.decoded("RANGE_Estimate"))
    assert out.count("RANGE_Status(") == len(ride.listener.decoded("RANGE_Status"))
    assert "Unknown frame" not in out
    assert "RANGE_EstimateState: Valid" in out


def test_the_summary(ride: Ride):
    last = ride.listener.decoded("RANGE_Estimate")[-1]
    assert number(ride.summary, r"range ([\d.]+) km") == pytest.approx(last["RANGE_Remaining"], abs=0.5)
    assert f"log {ride.daemon.logs[0]}" in ride.summary


def test_the_dashboard_writes_a_line_each_second(ride: Ride):
    lines = [line for line in ride.dashboard.splitlines() if "km" in line]
    assert RIDE - 10 < len(lines) < RIDE + 15
    assert "Traceback" not in ride.dashboard


# How far an estimate over vcan may be from that of the same log offline, at the same time since the first frame.
# Frames arrive with the jitter of the sender, so one on the border of a tenth of a second may count before or after
# it: what follows the frames at once is held against what the offline estimate had from 0.2 s before to 0.2 s after.
# The forecast is made once a second, and learns when 250 m are ridden: 1 s before to 1 s after.
TOLERANCE: dict[str, tuple[float, int]] = {  # in the field's SI unit; tenths of a second before and after
    "time": (1e-6, 0),
    "soc": (5e-5, 0),
    "soc_sd": (2e-5, 0),
    "v1": (3e-4, 0),
    "innovation_rms": (3e-4, 0),
    "cell_temperature": (0.0, 0),
    "grade": (0.002, 0),
    "distance": (0.5, 0),
    "innovation": (0.002, 2),
    "pack_voltage": (0.02, 2),
    "pack_current": (0.2, 2),
    "speed": (0.05, 2),
    "acceleration": (0.05, 2),
    "lean": (0.01, 2),
    "yaw_rate": (0.02, 2),
    "heading": (0.02, 2),
    "range": (150.0, 10),
    "range_p10": (150.0, 10),
    "range_p90": (200.0, 10),
    "energy_left": (3000.0, 10),
    "energy_left_sd": (1000.0, 10),
    "consumption_recent": (2.0, 10),
    "consumption_expected": (0.4, 10),
    "consumption_expected_sd": (0.1, 10),
    "consumption_factor": (0.003, 10),
    "consumption_factor_sd": (0.0005, 10),
}


def test_live_and_offline_agree_field_by_field(ride: Ride):
    assert set(TOLERANCE) | {"state", "reasons"} == {field.name for field in fields(Estimate)}
    live = raw_frames(ride.daemon.logs[0])
    sent = recorded("coastdown")
    # The replay had to start: its first frame was late, and from it all times count.
    late = sorted((a[0] - live[0][0]) - (b[0] - sent[0][0]) for a, b in zip(live, sent, strict=True))
    begin = sent[0][0] - min(late[len(late) // 2], 0)
    offline = ridden([(max(frame[0], begin), *frame[1:]) for frame in sent]).estimates
    compared = 0
    worst: dict[str, float] = {}
    for row in ride.daemon.estimates():
        index = round(10 * (row["time_ns"] - live[0][0]) / S) - 1
        if row["time_ns"] <= live[0][0] or not 0 <= index < len(offline) - 2:
            continue
        compared += 1
        there = offline[index]
        assert row["state"] == there.state.name, f"at {there.time:.1f} s"
        for name, (_, span) in TOLERANCE.items():
            near = [getattr(e, name) for e in offline[max(index - span, 0) : index + span + 1]]
            worst[name] = max(worst.get(name, 0.0), off(row[name], near))
    assert compared >= 55
    beyond = [name for name, value in worst.items() if value > TOLERANCE[name][0]]
    assert not beyond, {name: f"{value:.2g}" for name, value in worst.items()}


def off(live: float | None, offline: list[float | None]) -> float:
    """How far a number is from the nearest of a span; infinite if it is known on one side only."""
    known = [value for value in offline if value is not None]
    if live is None:
        return 0.0 if len(known) < len(offline) else float("inf")
    return max(min(known) - live, live - max(known), 0.0) if known else float("inf")


def test_the_log_again_offline_gives_the_same(ride: Ride):
    """What the daemon logged, estimated again: the same frames with the same stamps, so the same numbers."""
    again = ridden(raw_frames(ride.daemon.logs[0]))
    live = {row["time"]: row for row in ride.daemon.estimates()}
    ends = {float(f"{e.time:.7g}"): e for e in again.estimates}
    shared = sorted(set(live) & set(ends))
    assert len(shared) >= 55
    for time_s in shared[2:]:
        for name in ("soc", "soc_sd", "v1", "range", "consumption_factor", "distance"):
            assert live[time_s][name] == pytest.approx(getattr(ends[time_s], name), rel=1e-4), f"{name} at {time_s} s"


def test_coastdown_is_what_was_replayed():
    assert sum(len(batch) for batch in read_frames(COASTDOWN)) == len(recorded("coastdown"))
