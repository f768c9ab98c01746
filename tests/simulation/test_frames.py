"""A simulated ride as frames: the bus is right, and what runs on a recorded ride runs on it."""

from __future__ import annotations

import json
import tracemalloc
from collections import Counter
from functools import cache
from math import atan, pi, sin

import numpy as np
import pytest

from gz_onboard.can.codec import NOT_AVAILABLE, Codec
from gz_onboard.cli import main
from gz_onboard.errors import InputError
from gz_onboard.events import WINDOW, State
from gz_onboard.recording.logs import read_frames
from gz_onboard.simulation.frames import START_NS, Dropouts, batches, simulate_frames, write_frames
from gz_onboard.simulation.parts import Dynamometer, road_table
from gz_onboard.simulation.run import along, drive
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.simulation.truth import Truth
from gz_onboard.vehicle import read_vehicle
from tests.events import events_of
from tests.support import ROOT, reference, ridden

NONE = Dropouts(frames=0.0, gps_gap_every=0.0)
SECONDS = 180.0


@cache
def ride():
    """Three minutes: level, a bend to the left, a hill of 3 %."""
    road = road_table(
        [0.0, 400.0, 500.0, 700.0, 1000.0], [0.0, 0.0, 0.0, sin(atan(0.03)), 0.0], [0.0, 1 / 60, 0.0, 0.0, 0.0]
    )
    scooter = Scooter(reference(), road, soc=0.8)
    metres = [10.0] * 5000
    run = drive(scooter, along(metres), SECONDS, keep_steps=True)
    return run, Truth(run, scooter)


def frames(seed=1, dropouts=NONE):
    sent = simulate_frames(reference(), ride()[1], seed, dropouts=dropouts)
    return [frame for batch in batches(sent) for frame in batch]


@cache
def estimated():
    return ridden(frames())


def column(role, all_frames=None):
    """(times [s since the start], values) of a role as the codec decodes it."""
    codec = Codec(reference().mapping)
    found = events_of(codec, all_frames or frames())
    shift = ((all_frames or frames())[0][0] - START_NS) * 1e-9
    rows = [
        (time + shift, values[codec.groups[group].roles.index(role)])
        for time, group, values in found
        if role in codec.groups[group].roles
    ]
    rows = [row for row in rows if row[1] is not None]
    return np.array([t for t, _ in rows]), np.array([v for _, v in rows])


def true(name, times, delay=0.0):
    truth = ride()[1]
    return np.interp(times - delay, truth["time"], truth[name])


def test_nothing_is_dropped_and_the_estimate_is_valid():
    run = estimated()
    reasons = {reason for _, reason in run.faults}
    assert reasons <= {NOT_AVAILABLE}
    assert {name for name, _ in run.faults} <= {"GPS_Motion.GPS_Course"}  # while standing
    assert not run.pipeline.codec.lost
    assert not run.pipeline.codec.unknown
    assert all(e.state is State.VALID for e in run.between(10.0, SECONDS))


def test_the_estimate_is_the_truth():
    run, truth = estimated(), ride()[1]
    last = run.estimates[-1]
    assert abs(last.soc - truth["soc"][-1]) < 3 * last.soc_sd
    shift = (frames()[0][0] - START_NS) * 1e-9
    errors = [e.speed - float(true("speed", e.time + shift)) for e in run.between(20.0, SECONDS)]
    assert abs(np.mean(errors)) < 0.05
    assert np.abs(errors).max() < 0.1
    assert last.consumption_factor == pytest.approx(1.0, abs=0.1)
    energy = sum(e.pack_voltage * e.pack_current * WINDOW for e in run.estimates if e.pack_current is not None)
    assert energy == pytest.approx(ride()[0].energy, rel=0.01)


def test_lean_and_grade_are_found():
    truth = ride()[1]
    run = estimated()
    shift = (frames()[0][0] - START_NS) * 1e-9
    bend = np.flatnonzero((truth["distance"] > 440) & (truth["distance"] < 490))
    leans = [e.lean for e in run.between(truth["time"][bend[0]] - shift, truth["time"][bend[-1]] - shift)]
    assert np.mean(leans) == pytest.approx(truth["lean"][bend].mean(), abs=0.03)
    assert np.mean(leans) < -0.1  # to the left
    hill = np.flatnonzero((truth["distance"] > 850) & (truth["distance"] < 990))
    grades = [e.grade for e in run.between(truth["time"][hill[0]] - shift, truth["time"][hill[-1]] - shift)]
    assert np.mean(grades) == pytest.approx(0.03, abs=0.008)


def test_each_message_has_its_rate():
    counts = Counter(frame[1] for frame in frames())
    for message in reference().mapping.database.messages:
        expected = 0 if message.name == "DYNO_Roller" else SECONDS / reference().mapping.periods[message.name]
        assert abs(counts[message.frame_id] - expected) <= 1, message.name
    times = [frame[0] for frame in frames()]
    assert times == sorted(times)
    assert START_NS <= times[0] < START_NS + 10_000_000


@pytest.mark.parametrize(
    ("role", "name", "factor", "delay", "sd"),
    [
        ("pack_current", "pack_current", 1.011, 0.10, 0.061),
        ("pack_voltage", "pack_voltage", 1.0, 0.10, 0.0105),
        ("gps_speed", "way", 1.0, 0.4, 0.1),
        ("motor_speed", "wheel_speed", 1.0, 0.0, 0.3 * 2 * pi / 60),
    ],
)
def test_noise_and_delay_are_as_declared(role, name, factor, delay, sd):
    times, values = column(role)
    truth = ride()[1]
    steps = np.clip(((times - delay) / truth.dt + 1e-3).astype(int), 0, truth.count - 1)
    errors = values - factor * truth[name][steps]
    assert errors.std() == pytest.approx(sd, rel=0.1)
    wrong = np.clip(((times - delay + 0.3) / truth.dt).astype(int), 0, truth.count - 1)
    assert (values - factor * truth[name][wrong]).std() > 1.1 * errors.std()


def test_the_same_seed_gives_the_same_bytes():
    assert frames(1) == frames(1)
    assert frames(1) != frames(2)


def test_lost_frames_show_in_the_counters_and_change_no_other():
    dropouts = Dropouts(frames=0.01, gps_gap_every=0.0)
    sent = simulate_frames(reference(), ride()[1], 1, dropouts=dropouts)
    left = frames(1, dropouts)
    assert set(left) < set(frames(1))
    run = ridden(left)
    dropped = {s.message: s.dropped for s in sent}
    for name in ("INV_Motion", "BMS_Pack"):
        assert dropped[name] > 0
        assert abs(run.pipeline.codec.lost[name] - dropped[name]) <= 2  # at the ends no counter tells
    assert not {reason for _, reason in run.faults} - {NOT_AVAILABLE}


def test_a_step_that_is_kept_takes_a_few_numbers():
    scooter, seconds = Scooter(reference(), soc=0.8), 20.0
    tracemalloc.start()
    run = drive(scooter, along([10.0] * 500), seconds, keep_steps=True)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert run.steps
    assert len(run.steps["time"]) == round(seconds / scooter.dt) + 1
    assert most < 2 * 8 * len(run.steps) * seconds / scooter.dt  # bytes


def test_on_a_dynamometer_the_roller_turns_and_the_body_stands():
    scooter = Scooter(reference(), Dynamometer(180.0, 5.0, 0.3, 0.27), soc=0.8)
    run = drive(scooter, along([10.0] * 500), 20.0, keep_steps=True)
    sent = {s.message: s for s in simulate_frames(reference(), Truth(run, scooter), dropouts=NONE)}
    codec = Codec(reference().mapping)

    def decoded(name):
        return [codec.values(name, int(word).to_bytes(8, "little")) for word in sent[name].words]

    assert decoded("DYNO_Roller")[-1]["DYNO_RollerSpeed"] == pytest.approx(scooter.speed, abs=0.05)
    assert abs(np.mean([values["IMU_AccelX"] for values in decoded("IMU_Acceleration")])) < 0.01
    assert {values["GPS_Fix"] for values in decoded("GPS_Motion")} == {0}


@pytest.mark.parametrize("suffix", [".blf", ".log", ".asc"])
def test_a_written_log_reads_back(tmp_path, suffix):
    sent = simulate_frames(reference(), ride()[1], 1, dropouts=NONE)
    file = tmp_path / f"ride{suffix}"
    assert write_frames(file, sent) == len(frames())
    back = [frame for batch in read_frames(file) for frame in batch]
    assert [frame[1:3] for frame in back] == [frame[1:3] for frame in frames()]
    if suffix != ".asc":
        assert [frame[0] for frame in back] == pytest.approx([frame[0] for frame in frames()], rel=0, abs=1000)


def test_estimate_reads_what_simulate_wrote(tmp_path, capsys):
    file = tmp_path / "ece15.blf"
    common = ["--output", str(tmp_path), "--no-plot"]
    assert main(["simulate", "ece15", "--no-series", "--soc", "0.7", "--frames", str(file), "--json", *common]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["files"] == [str(file)]
    assert main(["estimate", str(file), "--json", "-", *common]) == 0
    text = capsys.readouterr().out
    (found,) = json.loads(text)["rides"]
    assert found["distance_km"] == pytest.approx(told["distance_km"], rel=0.01)
    assert found["energy_wh"] == pytest.approx(told["energy_wh"], rel=0.05)
    assert abs(found["soc_end"] - told["soc_end"]) < 3 * found["soc_end_sd"]


def test_a_vehicle_whose_bus_cannot_carry_them_is_refused(tmp_path):
    for name in ("vehicle.dbc", "hbm.dbc"):
        (tmp_path / name).write_text(
            (ROOT / "dbc" / name).read_text().replace('BA_ "GenMsgCycleTime" BO_ 512 100;\n', "")
        )
    file = tmp_path / "slow.toml"
    file.write_text((ROOT / "gz_onboard" / "vehicles" / "reference.toml").read_text())
    with pytest.raises(InputError, match="BMS_Pack: its DBC file gives no GenMsgCycleTime"):
        simulate_frames(read_vehicle(str(file)), ride()[1])


def test_frames_of_another_bus_are_refused_before_anything_is_computed_or_written(tmp_path, capsys):
    other = str(ROOT / "tests" / "vehicles" / "tlmoto" / "tlmoto.toml")
    frames, written = tmp_path / "ride.blf", tmp_path / "written"
    assert main(["simulate", "ece15", "--vehicle", other, "--frames", str(frames), "--output", str(written)]) == 2
    assert "--frames simulates the reference scooter's sensors, and none of their signals" in capsys.readouterr().err
    assert not frames.exists()
    assert not written.exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["--frames", "ride.blff"], ".blf"),
        (["--frames", "ride.parquet"], "frames are written as"),
        (["--frames", "ride.bfl"], "frames are written as .blf .log .asc .trc .csv .mf4 (did you mean '.blf'?)"),
        (["--frames", "ride.blf", "--seed", "-1"], "--seed"),
        (["--frames", "ride.blf", "--frame-loss", "2"], "--frame-loss"),
        (["--frame-loss", "0.2"], "--frame-loss 0.2: is for --frames FILE"),
    ],
)
def test_what_cannot_be_put_out_is_refused(arguments, word, capsys):
    assert main(["simulate", "ece15", *arguments]) != 0
    assert word in capsys.readouterr().err
