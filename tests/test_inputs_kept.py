"""No command overwrites what it reads: status 2 before any work, and every file as it was."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from gz_onboard.cli import main
from tests.support import LOGS, ROOT

CALIBRATE = ["calibrate", "motor", "motor_dyno.csv.gz", "--vehicle", "mine.toml"]
DISCOVER = ["discover", "ride.blf", "--quiet", "--vehicle", "mine.toml"]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copy(LOGS / "coastdown.blf", tmp_path / "ride.blf")
    shutil.copy(LOGS / "coastdown.blf", tmp_path / "other.estimate.mcap")
    shutil.copy(LOGS / "rides.json", tmp_path)
    shutil.copy(LOGS / "calibration" / "motor_dyno.csv.gz", tmp_path)
    shutil.copy(ROOT / "gz_onboard" / "vehicles" / "reference.toml", tmp_path / "mine.toml")
    shutil.copy(LOGS / "calibration" / "motor_emf_ramp.csv.gz", tmp_path / "ramp.csv.gz")
    (tmp_path / "cycle.csv").write_text("time_s,speed_kmh\n0,0\n1,1\n2,0\n")
    (tmp_path / "calibration.toml").write_text('schema = 1\n[motor]\ndata = "motor_dyno.csv.gz"\n')
    os.link(tmp_path / "ride.blf", tmp_path / "linked.json")
    (tmp_path / "points.html").symlink_to("ride.blf")
    shutil.copy(LOGS / "rides.json", tmp_path / "state.json")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "arguments",
    [
        ["export", "ride.blf", "./ride.blf"],
        ["estimate", "other.estimate.mcap"],
        ["estimate", "ride.blf", "--json=rides.json"],
        ["estimate", "ride.blf", "--json=linked.json"],
        ["report", "ride.blf", "-o", "points.html"],
        ["estimate", "ride.blf", "--vehicle", "mine.toml", "--json=mine.toml"],
        [*CALIBRATE, "--output", "mine.toml"],
        [*CALIBRATE, "--report", "motor_dyno.csv.gz"],
        [*CALIBRATE, "--json=motor_dyno.csv.gz"],
        [*CALIBRATE, "--with", "emf=ramp.csv.gz", "--json=ramp.csv.gz"],
        ["calibrate", "all", ".", "--output", "calibration.toml"],
        ["calibrate", "all", "calibration.toml", "--json=motor_dyno.csv.gz"],
        [*DISCOVER, "--report", "ride.blf"],
        [*DISCOVER, "--report", "points.html"],
        [*DISCOVER, "--json", "rides.json"],
        ["validate", "ride.blf", "--no-plot", "--markdown", "ride.blf"],
        ["simulate", "cycle.csv", "--frames", "cycle.csv", "--output", "new"],
        ["simulate", "cycle.csv", "--json=cycle.csv", "--output", "new"],
        ["learned", "--state", "state.json", "--json", "state.json"],
    ],
    ids=" ".join,
)
def test_no_input_is_overwritten(folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str]):
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    assert main(arguments) == 2
    assert "would overwrite the input" in capsys.readouterr().err
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


@pytest.mark.parametrize(
    "arguments",
    [
        ["estimate", "ride.blf", "--output", "new", "--table", "new.csv", "--json=./new.csv"],
        [*CALIBRATE, "--output", "new.toml", "--json=new.toml"],
        [*DISCOVER, "--report", "new", "--json=new"],
        ["validate", "ride.blf", "--no-plot", "--markdown", "new", "--json=new"],
        ["simulate", "cycle.csv", "--output", "new", "--json=new/cycle.simulation.parquet"],
        ["simulate", "cycle.csv", "--output", "new", "--frames", "new.csv", "--json=new.csv"],
    ],
    ids=" ".join,
)
def test_no_output_is_written_over_another(folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str]):
    before = {file.name for file in folder.iterdir()}
    assert main(arguments) == 2
    assert "which is written too" in capsys.readouterr().err
    assert {file.name for file in folder.iterdir()} == before
