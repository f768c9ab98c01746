from __future__ import annotations

import gzip
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard import cli
from gz_onboard.can.dbc import find_dbc, load_database
from gz_onboard.estimation.summary import KEYS, SUMMARY_VERSION
from gz_onboard.events import EFF_FLAG, WINDOW, Estimate
from gz_onboard.pipeline import Pipeline
from gz_onboard.recording.decode import feed
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.logs import read_attachments, read_frames, read_metadata, read_samples
from gz_onboard.vehicle import read_vehicle
from tests.support import HEARS_CTRL_C

LOGS = Path(__file__).resolve().parents[2] / "replay_logs"
COASTDOWN, RIDE = LOGS / "coastdown.blf", LOGS / "city_34C.blf"


@pytest.fixture(scope="module")
def frames():
    return list(chain.from_iterable(read_frames(COASTDOWN)))


def run(*arguments):
    return cli.main(["estimate", *map(str, arguments)])


def candump(file, frames):
    text = "".join(
        f"({t // 10**9}.{t // 1000 % 10**6:06}) can0 {i & ~EFF_FLAG:0{8 if i & EFF_FLAG else 3}X}#{d.hex().upper()}\n"
        for t, i, d, _ in frames
    )
    opened = gzip.open if file.suffix == ".gz" else open
    with opened(file, "wt") as stream:
        stream.write(text)
    return file


def estimates(log):
    return [(time, values) for topic, time, values in read_samples(log) if topic == "/estimate"]


def test_the_summary_of_a_ride_agrees_with_its_frames(tmp_path, capsys):
    assert run(RIDE, "--output", tmp_path, "--json", "--no-plot") == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["version"], document["failed"]) == (SUMMARY_VERSION, [])
    (ride,) = document["rides"]
    assert set(ride) == set(KEYS)

    # The same quantities from the frames themselves, by cantools.
    database = load_database([find_dbc("vehicle.dbc")])
    pack = database.get_message_by_name("BMS_Pack")
    every = list(chain.from_iterable(read_frames(RIDE)))
    energy = recovered = 0.0
    last = None
    for time_ns, identifier, data, _ in every:
        if identifier != pack.frame_id:
            continue
        values: Any = pack.decode(data, decode_choices=False)
        if last is not None:
            joule = values["BMS_PackVoltage"] * values["BMS_PackCurrent"] * (time_ns - last) * 1e-9
            energy += joule
            recovered -= min(joule, 0.0)
        last = time_ns
    assert ride["frames"] == len(every)
    assert ride["start_ns"] == every[0][0]
    assert ride["duration_s"] == pytest.approx((every[-1][0] - every[0][0]) * 1e-9, abs=WINDOW)
    assert ride["energy_wh"] == pytest.approx(energy / 3600, rel=0.03)
    assert ride["energy_recovered_wh"] == pytest.approx(recovered / 3600, rel=0.1)
    assert ride["consumption_wh_km"] == pytest.approx(ride["energy_wh"] / ride["energy_distance_km"])
    assert sum(ride["states"].values()) == pytest.approx(ride["duration_s"], abs=0.6)

    logged = [values for _, values in estimates(ride["log"])]
    assert len(logged) == pytest.approx(ride["duration_s"], abs=2)
    first = next(row["soc"] for row in logged if row["soc"] is not None)
    assert ride["soc_start"] == pytest.approx(first, abs=0.01)
    assert ride["soc_end"] == pytest.approx(logged[-1]["soc"], abs=0.002)
    assert ride["distance_km"] == pytest.approx(logged[-1]["distance"] / 1000, abs=0.02)
    assert ride["range_end_p10_km"] < ride["range_end_km"] < ride["range_end_p90_km"]
    why = ride["why"]
    assert sum(why["causes_km"].values()) == pytest.approx(why["range_km"] - why["reference_km"], abs=1e-3)
    assert ride["duration_s"] - 200 < why["time_s"] <= ride["duration_s"]
    told = [(topic, v) for topic, _, v in read_samples(Path(ride["log"])) if topic in ("/why", "/range_change")]
    assert [v["range"] / 1000 for topic, v in told if topic == "/range_change"] == pytest.approx(
        [change["range_km"] for change in ride["changes"]], abs=1e-4
    )
    assert told[-1][1]["range"] / 1000 == pytest.approx(why["range_km"], abs=1e-4)
    for _, v in told:
        causes = sum(size for name, size in v.items() if name not in ("time", "reference", "range"))
        assert causes == pytest.approx(v["range"] - v["reference"], abs=0.1)
    assert 0 < ride["innovation_rms_v"] < ride["innovation_max_v"] < 0.2


def test_where_nothing_fits_the_vehicle_file_the_summary_says_how_to_check_it(tmp_path, capsys):
    wrong = tmp_path / "wrong.toml"
    text = read_vehicle("reference").file.read_text(encoding="utf-8")
    turned = '{ signal = "BMS_PackCurrent", scale = -1 }'
    wrong.write_text(text.replace('"BMS_PackCurrent"', turned), encoding="utf-8")
    for vehicle, hints in ("reference", 0), (wrong, 1):
        assert run(COASTDOWN, "--output", tmp_path, "--no-plot", "--vehicle", vehicle) == 0
        assert capsys.readouterr().out.count(f"with the same vehicle and {COASTDOWN}\n") == hints
    fewer = tmp_path / "fewer_cells.toml"
    fewer.write_text(text.replace("cells_series = 14", "cells_series = 13"), encoding="utf-8")
    assert run(LOGS / "city_14C.blf", "--output", tmp_path, "--no-plot", "--vehicle", fewer) == 0
    assert "points less: its gauge or the vehicle file is wrong; what is wrong, `gz-onboard" in capsys.readouterr().out


def test_a_capacity_that_the_vehicles_own_gauge_contradicts_is_told(tmp_path, capsys):
    right = read_vehicle("reference")
    assert right.battery is not None
    current, seconds = 50.0, 600
    rows = ["time [s],pack_voltage [V],pack_current [A],bms_state_of_charge [%],speed [km/h]"]
    for second in range(seconds + 1):
        soc = 0.9 - current * second / 3600 / right.battery.pack_capacity(25.0)
        volts = 14 * (right.battery.ocv(soc, 25.0)[0] - 0.065 * current / 12)
        rows.append(f"{second},{volts:.3f},{current},{100 * soc:.2f},36")
    (tmp_path / "ride.csv").write_text("\n".join(rows), encoding="utf-8")
    wrong = tmp_path / "wrong.toml"
    wrong.write_text(right.file.read_text(encoding="utf-8").replace("cells_parallel = 12", "cells_parallel = 24"))
    for vehicle, told in ("reference", False), (wrong, True):
        assert run(tmp_path / "ride.csv", "--output", tmp_path, "--no-plot", "--vehicle", vehicle) == 0
        out = capsys.readouterr().out
        assert ("over 8.2 A·h, as a pack of 32.5 A·h would; the file's has 65.6 A·h: cell_capacity," in out) is told
        assert ("\n  vehicle file " in out) is told


def test_a_summary_says_where_most_of_the_ride_was_not_on_its_route(tmp_path, capsys):
    route, found = LOGS / "city_34C.route.csv", tmp_path / "found.json"
    assert run(COASTDOWN, "--route", route, "--output", tmp_path, "--no-plot", "--json", found) == 0
    (ride,) = json.loads(found.read_text())["rides"]
    on, way = ride["route"]["ridden_km"], ride["distance_km"]
    assert 0.1 < on < way / 2
    assert f"\n{'':20}only {on:.2f} of the {way:.2f} km ridden were on the route\n" in capsys.readouterr().out


def test_the_same_log_gives_the_same_bytes(tmp_path):
    made = []
    for seed in "1", "2":  # what goes by hash would come out in another order
        folder = tmp_path / seed
        command = [
            sys.executable,
            "-m",
            "gz_onboard",
            "estimate",
            COASTDOWN,
            "--signals",
            "--frames",
            "--output",
            folder,
        ]
        subprocess.run(
            command, check=True, env={**os.environ, "PYTHONHASHSEED": seed, "TZ": f"UTC+{seed}"}, capture_output=True
        )
        made.append({file.name: file.read_bytes() for file in sorted(folder.iterdir())})
    assert set(made[0]) == {"coastdown.estimate.mcap", "coastdown.estimate.png"}
    assert made[0] == made[1]


def test_what_goes_into_the_log(tmp_path, frames):
    candump(tmp_path / "a.log", frames[:6000])
    assert run(tmp_path / "a.log", "--output", tmp_path, "--no-plot", "--payload", 75) == 0
    log = tmp_path / "a.estimate.mcap"
    assert {topic for topic, _, _ in read_samples(log)} == {"/estimate", "/status", "/why"}
    assert not list(chain.from_iterable(read_frames(log)))
    metadata = read_metadata(log)
    assert (metadata["source"], metadata["filter"], metadata["payload_kg"]) == ("a.log", "scalar", "75")
    assert "range.dbc" in read_attachments(log)

    assert run(tmp_path / "a.log", "--output", tmp_path, "--no-plot", "--frames", "--signals") == 0
    topics = {topic for topic, _, _ in read_samples(log)}
    assert {"/can/BMS_Pack", "/can/INV_Motion"} <= topics
    written = [(t, i, d) for t, i, d, _ in chain.from_iterable(read_frames(log)) if not 0x600 <= i <= 0x607]
    read = [(t, i, d) for t, i, d, _ in chain.from_iterable(read_frames(tmp_path / "a.log"))]
    assert sorted(written) == sorted(read)


def test_a_log_of_ours_gives_the_same_estimates_again(tmp_path):
    assert run(COASTDOWN, "--output", tmp_path, "--no-plot", "--frames") == 0
    first = tmp_path / "coastdown.estimate.mcap"
    shutil.copy(first, tmp_path / "again.mcap")  # it holds range frames too: they are no frames of the vehicle
    assert run(tmp_path / "again.mcap", "--output", tmp_path, "--no-plot") == 0
    assert estimates(tmp_path / "again.estimate.mcap") == estimates(first)
    status = [values for topic, _, values in read_samples(tmp_path / "again.estimate.mcap") if topic == "/status"]
    assert status[-1]["unknown"] == {}


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_broken_log_does_not_stop_the_others(tmp_path, frames, capsys, jobs):
    good = [candump(tmp_path / "good.log", frames[:4000]), candump(tmp_path / "zipped.log.gz", frames[:4000])]
    empty, other, text = tmp_path / "empty.blf", tmp_path / "other.log", tmp_path / "text.blf"
    empty.touch()
    candump(other, [(t, 0x7A0 + n % 5, d, c) for n, (t, _, d, c) in enumerate(frames[:500])])
    text.write_text("LOGically not a BLF file\n" * 20)
    missing = tmp_path / "missing.blf"
    bad = [empty, other, text, missing]
    out = tmp_path / "out"
    assert run(*bad, *good, "--output", out, "--jobs", jobs, "--json", out / "s.json", "--no-plot") == 2
    said = capsys.readouterr()
    document = json.loads((out / "s.json").read_text())
    assert [ride["file"] for ride in document["rides"]] == list(map(str, good))
    assert [failure["file"] for failure in document["failed"]] == list(map(str, bad))
    for failure, file in zip(document["failed"], bad, strict=True):
        assert str(file) in failure["error"]
        assert failure["error"] in said.err
    assert "knows none of its 500 frames (identifiers 0x7a0" in document["failed"][1]["error"]
    assert sorted(f.name for f in out.iterdir()) == ["good.estimate.mcap", "s.json", "zipped.estimate.mcap"]
    one, two = (estimates(out / f"{name}.estimate.mcap") for name in ("good", "zipped"))
    assert one == two


def test_a_cut_log_is_estimated_as_far_as_it_goes(tmp_path, capsys):
    cut = tmp_path / "cut.blf"
    cut.write_bytes(COASTDOWN.read_bytes()[:200_000])
    assert run(cut, "--output", tmp_path, "--no-plot") == 0
    assert "cut.blf" in capsys.readouterr().err
    assert 20 < len(estimates(tmp_path / "cut.estimate.mcap")) < 50


def test_a_folder_of_logs_is_its_logs(tmp_path, frames, capsys):
    for name in "b.log", "a.log.gz":
        candump(tmp_path / name, frames[:2000])
    for name in "a.route.csv", "c.estimate.mcap":
        (tmp_path / name).touch()
    (tmp_path / "rides.json").write_text("[]")
    (tmp_path / "d.log").mkdir()
    assert run(tmp_path, tmp_path / "b.log", "--output", tmp_path, "--no-plot", "--json") == 0
    rides = json.loads(capsys.readouterr().out)["rides"]
    assert [Path(ride["file"]).name for ride in rides] == ["a.log.gz", "b.log"]


def test_a_folder_of_rides_makes_a_table_of_summaries(tmp_path, frames):
    folder = tmp_path / "logs"
    folder.mkdir()
    for ride in ("a.log", "b.log"):
        candump(folder / ride, frames[:3000])
    (folder / "c.blf").write_text("noise")
    out, told = tmp_path / "rides.parquet", tmp_path / "s.json"
    assert run(folder, "--output", tmp_path, "--no-plot", "--jobs", 1, "--table", out, "--json", told) == 2
    summary = json.loads(told.read_text())
    import pyarrow.parquet as pq

    rows = pq.read_table(out).to_pylist()
    assert [row["file"] for row in rows] == [str(folder / ride) for ride in ("a.log", "b.log", "c.blf")]
    for row, ride in zip(rows, summary["rides"], strict=False):
        for key in ("start_ns", "vehicle", "frames", "distance_km", "range_end_km"):
            assert row[key] == ride[key]
        assert row["valid_s"] == ride["states"].get("VALID", 0.0)
        assert row["reasons"].split() == list(ride["reasons"])
        assert row["plot"] is row["error"] is None
    assert rows[2]["error"] == summary["failed"][0]["error"]
    assert rows[2]["distance_km"] is None


def test_rides_of_the_same_name_in_several_folders(tmp_path, frames):
    for folder in "a", "b":
        (tmp_path / folder).mkdir()
        candump(tmp_path / folder / "ride.log", frames[:2000])
    assert run(tmp_path / "a" / "ride.log", tmp_path / "b" / "ride.log", "--output", tmp_path, "--no-plot") == 0
    assert {f.name for f in tmp_path.glob("*.mcap")} == {"a-ride.estimate.mcap", "b-ride.estimate.mcap"}
    candump(tmp_path / "a" / "ride.csv", frames[:2000])
    assert run(tmp_path / "a" / "ride.log", tmp_path / "a" / "ride.csv", "--output", tmp_path / "c", "--no-plot") == 0
    assert {f.name for f in (tmp_path / "c").glob("*.mcap")} == {"ride.log.estimate.mcap", "ride.csv.estimate.mcap"}


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--vehicle", "referense"], "did you mean 'reference'"),
        (["--jobs", "0"], "--jobs 0"),
        (["--json", "x.blf"], "the name of a log"),
        (["--table", "rides.xls"], "rides.xls: a table is written as .csv, .parquet, .jsonl"),
        (["--output", "/dev/null/x"], "cannot be written"),
        (["--json", "/dev/null/x", "--no-plot"], "cannot be written"),
    ],
)
def test_what_cannot_be_done_is_told(tmp_path, monkeypatch, capsys, frames, arguments, told):
    monkeypatch.chdir(tmp_path)
    candump(tmp_path / "a.log", frames[:300])
    assert run("a.log", *arguments) != 0
    assert told in capsys.readouterr().err


def test_a_summary_names_the_sensors_that_were_left_out(tmp_path, capsys):
    rows = "".join(f"{t / 2},361,14,{36 + t % 4},{0 if t > 60 else 36}\n" for t in range(241))
    (tmp_path / "ride.csv").write_text(
        "time [s],pack_voltage [V],pack_current [A],vehicle_speed [km/h],gps_speed [km/h]\n" + rows
    )
    i3 = LOGS.parent / "tests" / "vehicles" / "i3" / "i3.toml"
    arguments = ["--vehicle", i3, "--no-plot", "--output", tmp_path]
    assert run(tmp_path / "ride.csv", *arguments) == 0
    assert re.search(r"(?m)^  left out +GPS speed \d+\.\d s", capsys.readouterr().out)
    assert run(tmp_path / "ride.csv", *arguments, "--json") == 0
    (ride,) = json.loads(capsys.readouterr().out)["rides"]
    assert 0 < ride["distrusted"]["gps_speed"] <= ride["reasons"]["SENSOR_DISTRUSTED"] < 120


def test_without_a_voltage_a_summary_says_why_there_is_no_range(tmp_path, capsys):
    (tmp_path / "ride.csv").write_text("time [s],speed [m/s]\n" + "".join(f"{t},5\n" for t in range(40)))
    assert run(tmp_path / "ride.csv", "--no-plot", "--output", tmp_path) == 0
    assert "range at the end  none: no voltage of the pack or the inverter came" in capsys.readouterr().out


@settings(max_examples=25, deadline=None)
@given(
    jumps=st.lists(
        st.tuples(st.integers(0, 1500), st.integers(-(10**12), 10**13), st.sampled_from([1, 2, 40, 5000])), max_size=4
    )
)
def test_no_jump_of_the_clock_stops_it(jumps):
    moved = list(HEAD)
    for place, jump, length in jumps:
        moved[place : place + length] = [(t + jump, i, d, c) for t, i, d, c in moved[place : place + length]]
    made: list[Estimate] = []
    counted: list[float] = []
    pipeline = Pipeline(REFERENCE, observer=made.append)
    feed(pipeline, FrameColumns.of(moved), counted.append)
    assert sum(counted) == len(moved) == pipeline.codec.received
    assert len(made) < 3000
    for e in made:
        assert e.range is None or 0 <= e.range < 1e6
        assert e.soc is None or 0 <= e.soc <= 1


HEAD = list(chain.from_iterable(read_frames(COASTDOWN)))[:1500]
REFERENCE = read_vehicle("reference")


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_ctrl_c_leaves_nothing_half_written(tmp_path, jobs):
    command = [
        *HEARS_CTRL_C,
        sys.executable,
        "-m",
        "gz_onboard",
        "estimate",
        RIDE,
        LOGS / "city_14C.blf",
        "--jobs",
        jobs,
        "--output",
        tmp_path,
    ]
    child = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, start_new_session=True)
    while not list(tmp_path.glob("*.part")) and child.poll() is None:
        time.sleep(0.01)
    os.killpg(child.pid, signal.SIGINT)  # as a terminal does: to all the processes
    _, said = child.communicate(timeout=120)
    # A shell shows 130 for both; Python kills itself by the signal if Ctrl-C reached it in an import.
    assert child.returncode in (130, -signal.SIGINT)
    assert b"Traceback" not in said
    assert b"--resume" in said or not said
    assert not list(tmp_path.glob("*.part"))
