"""Every command that reads a file, given a folder: it takes the logs in it, or says what to give in place of it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from gz_onboard import cli
from gz_onboard.recording.logs import ESTIMATED
from tests.short_logs import short_log
from tests.support import LOGS

RIDE = str(LOGS / "coastdown.blf")
EMPTY, FULL = "EMPTY", "FULL"  # stand for a folder without logs, and one with two
FRAMES = 600

# Those that take the logs in a folder, by what makes them do the least with one that has none.
TAKING = {
    "estimate": ["estimate", EMPTY],
    "validate": ["validate", EMPTY],
    "discover": ["discover", EMPTY],
    "export": ["export", EMPTY, "out"],
    "report": ["report", EMPTY, "-o", "ride.html"],
    "vehicle": ["vehicle", "check", "reference", EMPTY],
}
# Those for which one has no meaning, and what they say. A folder of measurements is `calibrate all`'s.
REFUSING = {
    "simulate": (["simulate", FULL], "is a folder; give one log, route or cycle in it; `validate` simulates every"),
    "replay": (["replay", FULL, "--interface", "virtual"], "is a folder; give the log in it"),
    "route": (["route", FULL], "is a folder; give the file in it"),
    "run": (["run", "--route", FULL], "is a folder; give the file in it"),
    "learned": (["learned", "--vehicle", FULL], "is a folder; give a vehicle file, which ends in .toml"),
    "dashboard": (["dashboard", "--dbc", FULL], "is a folder; give the DBC file in it"),
    "mqtt": (["mqtt", "localhost", "--dbc", FULL], "is a folder; give the DBC file in it"),
    "foxglove": (["foxglove", "--vehicle", FULL], "is a folder; give a vehicle file, which ends in .toml"),
    "calibrate": (["calibrate", "ocv", FULL], "is a folder; give the files in it"),
}
MORE = [
    (["calibrate", "all", EMPTY], "no such file; `calibrate all` takes a folder with a manifest calibration.toml"),
    (["estimate", RIDE, "--route", FULL], "is a folder; give the file in it"),
    (["estimate", RIDE, "--vehicle", FULL], "is a folder; give a vehicle file, which ends in .toml"),
    (["vehicle", "check", FULL, RIDE], "FULL: is a folder; the vehicle comes first, by name or file, then its logs"),
    (["vehicle", "check", FULL, "v.toml"], "FULL: is a folder; the vehicle comes first, by name or file, then its"),
    (["vehicle", "check", "a.blf.gz", "v.toml"], "a.blf.gz: is a log; the vehicle comes first"),
    (["vehicle", "check", "vehicles", RIDE], "is a folder; give a vehicle file, which ends in .toml"),
    (["report", RIDE, "-o", FULL], "is a folder; give the name of a file"),
    (["export", FULL, "rides.csv"], "rides.csv: is one file, and FULL a folder of logs; give a name without a suffix"),
]


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a folder with two short logs is, and one without."""
    (tmp_path / EMPTY).mkdir()
    (tmp_path / FULL).mkdir()
    for name in ("a.blf", "b.log"):
        short_log(tmp_path / FULL / name, FRAMES)
    (tmp_path / FULL / "notes.csv").write_text("time_s,note\n")
    (tmp_path / "vehicles").mkdir()
    (tmp_path / "vehicles" / "v.toml").touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("folders")
@pytest.mark.parametrize("arguments", TAKING.values(), ids=TAKING)
def test_a_folder_without_logs(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 2
    assert f"{EMPTY}: this folder holds no log" in capsys.readouterr().err


@pytest.mark.usefixtures("folders")
@pytest.mark.parametrize(
    ("arguments", "said"), [*REFUSING.values(), *MORE], ids=lambda part: " ".join(part[:2]) if part[1:2] else ""
)
def test_a_folder_that_means_nothing(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 2
    assert said in capsys.readouterr().err


def test_export_makes_a_folder_for_each_log(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    full = folders / FULL
    (full / "broken.blf").write_bytes(b"LOGG")
    shutil.copy(full / "a.blf", full / "b.blf")
    assert cli.main(["export", str(full), "out", "--vehicle", "reference", "--table-format", "csv"]) == 2
    told = capsys.readouterr()
    assert "broken.blf" in told.err
    assert {file.name for file in (folders / "out").iterdir()} == {"a", "b.blf", "b.log"}
    each = [(folders / "out" / name / "INV_Motion.csv").read_text() for name in ("a", "b.blf", "b.log")]
    assert each[0] == each[1]
    assert len(each[0].splitlines()) == len(each[2].splitlines()) > 10


def test_export_says_what_each_log_of_a_folder_holds(folders: Path, capsys: pytest.CaptureFixture[str]) -> None:
    full = folders / FULL
    assert cli.main(["estimate", str(full / "a.blf"), "--no-plot", "--quiet", "--output", str(full), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)
    assert cli.main(["export", str(full)]) == 0
    told = capsys.readouterr().out
    assert all(name in told for name in ("a.blf", f"a{ESTIMATED}", "b.log"))
    assert "notes.csv" not in told
