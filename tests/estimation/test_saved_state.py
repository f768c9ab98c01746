"""``gz-onboard estimate --state``: what was learned goes from ride to ride, as a daemon that is restarted has it."""

from __future__ import annotations

import csv
import fcntl
import json
import os
import shutil
import time
from bisect import bisect_left
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import gz_onboard as gz
from gz_onboard import state
from gz_onboard.can.channel import CanChannel
from gz_onboard.can.recorder import is_complete
from gz_onboard.cli import main
from gz_onboard.daemon import loop
from gz_onboard.daemon.loop import Daemon
from gz_onboard.estimation.ride import open_estimate
from gz_onboard.events import Frame
from gz_onboard.pipeline import TICK_NS
from gz_onboard.recording.logs import read_frames
from gz_onboard.vehicle import find_vehicle, read_vehicle
from tests.short_logs import short_log
from tests.support import S, recorded, reference, write_log

DAY = 86_400 * S
CUTS = {"a": (0.0, 60.0), "b": (70.0, 130.0), "c": (170.0, 220.0)}  # s of a ride, each a ride of its own
LATER = {"a": 0, "b": DAY, "c": 3 * DAY}  # ns: by so much later are they ridden


@pytest.fixture(scope="module")
def cuts() -> dict[str, list[Frame]]:
    frames = recorded("city_14C", 0.0, 220.0)
    times = [frame[0] for frame in frames]

    def cut(name: str) -> list[Frame]:
        begin, end = (bisect_left(times, times[0] + round(s * S)) for s in CUTS[name])
        return [(t + LATER[name], *rest) for t, *rest in frames[begin:end]]  # type: ignore[misc]

    return {name: cut(name) for name in CUTS}


@pytest.fixture(scope="module")
def rides(cuts: dict[str, list[Frame]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the log of each cut, whose names are not in the order of their times."""
    folder = tmp_path_factory.mktemp("rides")
    for name, frames in cuts.items():
        write_log(folder / f"{'cab'['abc'.index(name)]}.blf", frames)
    return folder


@pytest.fixture(scope="module")
def kept(rides: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what ``estimate`` made of all the rides, one state going through them."""
    out = tmp_path_factory.mktemp("kept")
    assert estimate(out, rides, options=["--table", out / "rides.csv"]) == 0
    return out


def estimate(out: Path, *rides: Path, options: Sequence[object] = ()) -> int:
    """``gz-onboard estimate`` with its state and its results in `out`."""
    given = ["--no-plot", "--output", out, "--state", out / "s.json", "--json", out / "said.json", *options]
    return main(["estimate", *map(str, (*rides, *given))])


def snapshot(file: Path) -> dict[str, Any]:
    found = state.load(file, 4e9)
    assert found
    return dict(found[0])


def by_the_daemon(frames: list[Frame], file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The frames through a daemon that is started as they begin and stopped as they end, whose clock is theirs."""
    now = [frames[0][0]]
    theirs = {"time": lambda: now[0] * 1e-9, "clock_gettime": lambda _: now[0] * 1e-9}
    clock = SimpleNamespace(**{**vars(time), **theirs})
    monkeypatch.setattr(loop, "time", clock)
    monkeypatch.setattr(state, "kept_time", lambda: float("inf"))
    channel = CanChannel("virtual", str(file))
    channel.open()
    daemon = Daemon(reference(), [channel], None, file)
    daemon.restore()
    times = [frame[0] for frame in frames]
    done = 0
    for until in [*range(times[0], times[-1], TICK_NS)[1:], times[-1]]:
        end = bisect_left(times, until + (until == times[-1]))
        daemon.step(frames[done:end], until)
        daemon.pipeline.estimator.pack.wait(TICK_NS * 1e-9)
        now[0], done = until, end
    assert daemon._keeper
    assert daemon._keeper._thread.wait(60)
    daemon._keeper.save(daemon.pipeline, now[0])
    assert daemon._keeper.close(60)
    channel.close()


def table(begin: float) -> dict[str, Any]:
    """A minute at 36 km/h from `begin` [s since the epoch]."""
    seconds = np.arange(0, 60, 0.5)
    columns = {"pack_voltage [V]": 52 - 1e-4 * seconds, "pack_current [A]": 14 + np.sin(seconds), "speed [km/h]": 36.0}
    return {"time [s]": begin + seconds, **{name: x * np.ones(len(seconds)) for name, x in columns.items()}}


# --- as the daemon -----------------------------------------------------------------------------------------------


def test_the_rides_are_in_their_order_and_each_goes_on_from_the_one_before(kept):
    rides = json.loads((kept / "said.json").read_text())["rides"]
    assert [Path(ride["file"]).stem for ride in rides] == ["c", "a", "b"]
    assert [ride["saved_state"] for ride in rides] == ["new", "resumed", "resumed"]
    ages = [ride["saved_state_age_s"] for ride in rides]
    assert ages[0] is None
    assert ages[1:] == pytest.approx([86_400 + 10, 2 * 86_400 + 40], abs=0.1)
    with (kept / "rides.csv").open() as table:
        assert [row["saved_state"] for row in csv.DictReader(table)] == ["new", "resumed", "resumed"]


def test_it_is_as_of_a_daemon_that_is_restarted(kept, cuts, tmp_path, monkeypatch):
    """Each goes on where the other ended: the daemon rides the first, `estimate` the second, the daemon the third."""
    file = tmp_path / "s.json"
    by_the_daemon(cuts["a"], file, monkeypatch)
    log = tmp_path / "second.mcap"
    write_log(log, cuts["b"])
    assert estimate(tmp_path, log) == 0
    second = snapshot(file)
    by_the_daemon(cuts["c"], file, monkeypatch)
    for one, other in (second, snapshot(kept / "s.previous.json")), (snapshot(file), snapshot(kept / "s.json")):
        assert one["soc"] == pytest.approx(other["soc"], abs=1e-3)  # the daemon ages a state ten times a second
        assert one["consumption"] == pytest.approx(other["consumption"], rel=0.01)
        assert one["odometer"] == other["odometer"]
    monkeypatch.undo()
    assert snapshot(kept / "s.json")["soc"] != pytest.approx(snapshot(kept / "s.previous.json")["soc"], rel=1e-6)


def test_from_python_it_is_the_same(kept, rides, tmp_path):
    file = tmp_path / "s.json"
    shutil.copy(kept / "s.previous.json", file)
    found = gz.estimate(rides / "b.blf", state=file).summary
    assert file.read_bytes() == (kept / "s.json").read_bytes()
    told = json.loads((kept / "said.json").read_text())["rides"][-1]
    assert (found.range_end_km, found.saved_state_age_s) == (told["range_end_km"], told["saved_state_age_s"])
    with pytest.raises(gz.InputError, match=r"b\.blf: began at .*, before the state .*s\.json was saved at"):
        gz.estimate(rides / "b.blf", state=file)


def test_a_table_of_signals_goes_on_too(tmp_path):
    rides = [table(1.7e9), table(1.7e9 + 3600)]
    first, second = (gz.estimate(ride, state=tmp_path / "s.json").summary for ride in rides)
    assert (first.saved_state, second.saved_state) == ("new", "resumed")
    assert second.saved_state_age_s == pytest.approx(3600 - 59.5)
    with pytest.raises(gz.InputError, match="has no date"):
        gz.estimate(table(0.0), state=tmp_path / "other.json")


def test_who_rides_is_as_written_beside_the_logs(tmp_path):
    short_log(tmp_path / "ride.blf")
    (tmp_path / "rides.json").write_text(json.dumps([{"name": "ride", "rider": "Jo"}]))
    gz.estimate(tmp_path / "ride.blf", state=tmp_path / "s.json")
    assert next(iter(gz.read_learned(tmp_path / "s.json").riders)) == "Jo"
    (tmp_path / "rides.json").write_text(json.dumps([{"name": "ride", "rider": 41 * "Jo"}]))
    with pytest.raises(gz.InputError, match="must have at most 40 letters"):
        gz.estimate(tmp_path / "ride.blf", state=tmp_path / "new.json")


def test_a_log_that_was_cut_in_two_is_two_rides(cuts, tmp_path, capsys):
    """Where it was cut, frames of two channels overtake each other by a little."""
    frames = cuts["c"][:4000]
    for name, part, moved in (("x", frames[:2000], 20 * 10**6), ("y", frames[2000:], 0)):
        write_log(tmp_path / f"{name}.blf", [*part[:-1], (part[-1][0] + moved, *part[-1][1:])])
    assert estimate(tmp_path, tmp_path) == 0
    rides = json.loads((tmp_path / "said.json").read_text())["rides"]
    assert [ride["saved_state_age_s"] for ride in rides] == [None, 0.0]


# --- what is refused ---------------------------------------------------------------------------------------------


@pytest.fixture
def short(tmp_path: Path) -> Path:
    """The log of a short ride in a folder of its own."""
    return short_log(tmp_path / "ride.blf")


def refused(out: Path, capsys: pytest.CaptureFixture[str], *rides: Path, options: Sequence[object] = ()) -> str:
    """What is said of it; no state and no log is written."""

    def written() -> dict[Path, bytes]:
        return {file: file.read_bytes() for file in out.iterdir() if file.name != "said.json"}

    before = written()
    assert estimate(out, *rides, options=options) == 2
    assert written() == before
    return "".join(capsys.readouterr())


def test_a_state_is_of_one_of_several_vehicles(short, tmp_path, capsys):
    (out := tmp_path / "out").mkdir()
    assert estimate(out, short, options=["--vehicle-id", "17"]) == 0
    later = tmp_path / "later.blf"
    frames = [frame for batch in read_frames(short) for frame in batch]
    write_log(later, [(t + 600 * S, i, data, channel) for t, i, data, channel in frames])
    assert "effects: ['reference-scooter-17'] saved, ['reference-scooter-18'] in" in refused(
        out, capsys, later, options=["--vehicle-id", "18"]
    )
    assert estimate(out, later, options=["--vehicle-id", "17"]) == 0


def test_a_signal_shows_which_vehicle_it_is(short, tmp_path):
    text = find_vehicle("reference").read_text(encoding="utf-8")
    file = tmp_path / "mine.toml"
    file.write_text(text.replace("[instruments]\n", '[instruments]\nvehicle_id = "Number"\n'))
    dbc = tmp_path / "mine.dbc"
    dbc.write_text('VERSION ""\nBS_:\nBU_: A\nBO_ 1911 SerialNumber: 4 A\n SG_ Number : 0|32@1+ (1,0) [0|0] "" A\n')
    file.write_text(file.read_text().replace('dbc = ["vehicle.dbc"', 'dbc = ["mine.dbc", "vehicle.dbc"'))
    frames = [frame for batch in read_frames(short) for frame in batch]
    begin = frames[0][0]
    for number, shown in ((17, "-17"), (None, "")):
        own = [] if number is None else [(begin + S, 1911, number.to_bytes(4, "little"), 0)]
        write_log(log := tmp_path / "numbered.blf", sorted([*frames, *own]))
        ride = open_estimate(log, read_vehicle(file))
        assert ride.vehicle.name == f"reference-scooter{shown}"
        assert len(ride.frames) == len(frames) + len(own)


def test_what_does_not_go_together(short, tmp_path, capsys):
    (out := tmp_path / "out").mkdir()
    assert "--jobs 2 with --state" in refused(out, capsys, short, options=["--jobs", 2])
    undated = tmp_path / "undated.blf"
    write_log(undated, [(t % DAY, *rest) for t, *rest in recorded("coastdown", 0, 5)])  # type: ignore[misc]
    assert f"{undated}: has no date" in refused(out, capsys, undated)
    assert "ends in .json" in refused(out, capsys, short, options=["--state", "s.blf"])
    assert "would overwrite the input" in refused(out, capsys, short, options=["--state", short])
    descriptor = os.open(out, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    assert "saves states in its folder" in refused(out, capsys, short)
    os.close(descriptor)
    copy = short_log(tmp_path / "again.blf", 3000)
    assert estimate(out, short, copy) == 2
    assert f"{copy}: began at 2025-06-15 " in capsys.readouterr().err
    assert [ride["file"] for ride in json.loads((out / "said.json").read_text())["rides"]] == [str(short)]


def test_where_the_state_finds_no_room_it_is_named_and_the_log_is_whole(short, tmp_path, capsys):
    (out := tmp_path / "out").mkdir()
    (out / "s.new").symlink_to("/dev/full")
    assert estimate(out, short) == 1
    assert f"{out / 's.json'}: cannot be written: No space left on device" in capsys.readouterr().err
    assert [file.name for file in out.iterdir()] == ["ride.estimate.mcap"]
    assert is_complete(out / "ride.estimate.mcap")


def test_a_state_that_cannot_be_used_is_left_as_it_is(short, tmp_path, capsys):
    built_in = find_vehicle("reference")
    text = built_in.read_text().replace('name = "reference-scooter"', 'name = "another"')
    (tmp_path / "other.toml").write_text(text.replace("../../dbc/", f"{built_in.parents[2]}/dbc/"))
    (out := tmp_path / "out").mkdir()
    assert estimate(out, short) == 0
    capsys.readouterr()
    good = (out / "s.json").read_bytes()
    assert "before the state" in refused(out, capsys, short)
    before = state.encode(snapshot(out / "s.json"), 1.7e9)
    (out / "s.json").write_bytes(before)
    assert "effects: ['reference-scooter'] saved, ['another'] in this vehicle file" in refused(
        out, capsys, short, options=["--vehicle", tmp_path / "other.toml"]
    )
    (out / "s.json").write_bytes(before[:-9])
    said = refused(out, capsys, short)
    assert f"{short}: {out / 's.json'}: is damaged: its checksum is wrong" in said
    assert "what was learned" not in said
    (out / "s.json").write_bytes(state.encode({"version": 1}, 1.7e9))
    assert "is of version 1" in refused(out, capsys, short)
    (out / "s.json").write_bytes(before)
    (out / "s.new").write_bytes(good[:-9])  # cut off while it was written
    assert estimate(out, short) == 0
    assert not (out / "s.new").exists()


# --- resumed -----------------------------------------------------------------------------------------------------


def resumed(out: Path, *rides: Path) -> list[bool]:
    """Which rides are kept from an earlier run."""
    assert estimate(out, *rides, options=["--resume"]) == 0
    return [ride["cpu_s"] == 0 for ride in json.loads((out / "said.json").read_text())["rides"]]


def test_a_run_that_was_interrupted_goes_on(kept, rides, tmp_path):
    shutil.copytree(kept, out := tmp_path / "out")
    before, after = (kept / "s.previous.json").read_bytes(), (kept / "s.json").read_bytes()
    assert resumed(out, rides) == [True, True, True]
    assert (out / "s.json").read_bytes() == after
    (out / "s.json").write_bytes(before)  # of the last ride the log was written, the state was not
    assert resumed(out, rides) == [True, True, False]
    assert (out / "s.json").read_bytes() == after
