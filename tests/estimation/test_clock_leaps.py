"""A log whose clock was set, or that pauses: time is what passed while frames came, and the leap is told in words."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from gz_onboard import cli
from gz_onboard.errors import InputError
from gz_onboard.recording.logs import read_frames
from gz_onboard.recording.recording import read_recording
from gz_onboard.vehicle import read_vehicle
from gz_onboard.vehicle_check.check import check_log, check_text
from tests.support import LOGS, write_log

DAY = 86_400 * 10**9
YEARS = 5 * 365 * DAY
SECONDS, METRES = 60.2, 360.0  # of the whole ride


def leaping(file: Path, leap_ns: int) -> Path:
    """A recorded ride whose clock leaps in its middle."""
    frames = [frame for batch in read_frames(LOGS / "coastdown.blf") for frame in batch]
    half = frames[len(frames) // 2][0]
    write_log(file, [(t + leap_ns * (t >= half), i, data, channel) for t, i, data, channel in frames])
    return file


def estimated(log: Path, capsys: pytest.CaptureFixture[str]) -> tuple[dict[str, float | list[str]], str]:
    """(its summary, what is said on the terminal)."""
    out = log.parent / "summary.json"
    options = ["--no-plot", "--quiet", "--output", str(log.parent), "--json", str(out)]
    assert cli.main(["estimate", str(log), *options]) == 0
    (ride,) = json.loads(out.read_text())["rides"]
    return ride, capsys.readouterr().out


def test_a_clock_that_was_set_is_one_ride(tmp_path, capsys):
    log, told = leaping(tmp_path / "leap.mcap", YEARS), "ahead by 1825.0 days"
    ride, said = estimated(log, capsys)
    assert ride["duration_s"] == pytest.approx(SECONDS, abs=1)
    assert ride["distance_km"] == pytest.approx(METRES / 1e3, rel=0.02)
    assert (ride["paused_s"], ride["gaps_s"]) == (0, 0)
    assert f"clock leaps {told} after 0 min 30 s: taken as set then, and the ride continues" in said
    assert ride["clock"] == [said.partition("clock  ")[2].partition("\n")[0].strip()]
    checked = check_log(log, read_vehicle("reference"), quick=True)
    assert checked.duration_s == pytest.approx(SECONDS, abs=1)
    assert f"\n  clock: the log's clock leaps {told}" in check_text(checked)


def test_a_pause_is_not_counted_as_ridden(tmp_path, capsys):
    log = leaping(tmp_path / "pause.blf", DAY)
    ride, said = estimated(log, capsys)
    assert ride["duration_s"] == pytest.approx(SECONDS, abs=1)
    assert ride["paused_s"] == pytest.approx(86_400, abs=1)
    assert ride["clock"] == []
    assert re.search(r"^  pauses +2[34] h \d+ min \d+ s without frames, not counted as ridden$", said, re.M)
    checked = check_log(log, read_vehicle("reference"), quick=True)
    assert checked.duration_s == pytest.approx(SECONDS, abs=2)
    assert max(role.share for role in checked.roles) > 0.9


def restamped(file: Path, time_of: Callable[[int, int], int]) -> Path:
    """The ride with the time [ns] that `time_of` makes of each frame's number and time since the beginning."""
    frames = [frame for batch in read_frames(LOGS / "coastdown.blf") for frame in batch]
    first = frames[0][0]
    changed = [(first + time_of(n, t - first), i, data, channel) for n, (t, i, data, channel) in enumerate(frames)]
    write_log(file, changed)
    return file


@pytest.mark.parametrize(
    ("time_of", "said"),
    [
        (lambda _, time: 60_300_000_000 - time, "its time runs back again and again, at least 100 times within 0 s"),
        (lambda _, time: 0, "all its 32721 frames have one and the same time"),
    ],
)
def test_times_that_make_no_ride_are_refused(tmp_path, capsys, time_of, said):
    log = restamped(tmp_path / "ride.mcap", time_of)
    with pytest.raises(InputError, match=said):
        read_recording(log, read_vehicle("reference"))
    assert cli.main(["estimate", str(log), "--no-plot", "--quiet", "--output", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "ride.estimate.mcap").exists()


@pytest.mark.parametrize("count", [60, 90])
def test_a_short_log_in_reverse_is_refused(tmp_path, count):
    frames = [frame for batch in read_frames(LOGS / "coastdown.blf") for frame in batch][:count]
    log = tmp_path / "ride.log"
    write_log(log, frames[::-1])
    with pytest.raises(InputError, match="its last frame is not after its first; sort its frames by time"):
        read_recording(log, read_vehicle("reference"))


def test_what_a_log_holds_says_that_its_time_runs_back(tmp_path, capsys):
    log = restamped(tmp_path / "ride.mcap", lambda n, time: time if n < 16_000 else 90_000_000_000 - time)
    assert cli.main(["export", str(log)]) == 0
    said = capsys.readouterr().out
    assert re.search(r"^  time +1 min 00 s from 2025-06-15 15:06:40 UTC$", said, re.M)
    assert re.search(r"^  frames +32721, 16\d\d\d of them earlier than others before them$", said, re.M)


def test_single_frames_ahead_of_all_others_do_not_move_time(tmp_path, capsys):
    log = restamped(tmp_path / "ride.mcap", lambda n, time: time + 9_000_000_000 * (n % 500 == 250))
    ride, _ = estimated(log, capsys)
    assert ride["duration_s"] == pytest.approx(SECONDS, abs=1)
    assert ride["distance_km"] == pytest.approx(METRES / 1e3, rel=0.02)
    assert (ride["clock"], ride["gaps_s"], ride["paused_s"], ride["dropped"]) == ([], 0, 0, 65)
    samples = read_recording(log, read_vehicle("reference"))
    assert max(times[-1] for times, _ in samples.columns.values()) == pytest.approx(SECONDS, abs=1)
    assert all((times[1:] >= times[:-1]).all() for times, _ in samples.columns.values())
