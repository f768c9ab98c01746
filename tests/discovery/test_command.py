"""gz-onboard discover from the command line: what it refuses, what it says, what it writes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from gz_onboard.cli import main
from gz_onboard.discovery.judgement import Report
from gz_onboard.discovery.parameters import candidates
from gz_onboard.discovery.run import discover
from gz_onboard.errors import InputError
from gz_onboard.recording.recording import read_recording
from gz_onboard.reports.results import descriptions
from gz_onboard.vehicle import read_vehicle
from tests.support import LOGS, ROOT
from tests.test_vehicle import with_effect

KEYS = descriptions(Report)
RIDE = LOGS / "city_14C.blf"
CAR = ROOT / "tests" / "vehicles" / "car" / "car.toml"


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """What is written to stderr by a command that must be refused."""
    assert main(["discover", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    return err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "no ride is given"),
        (["nowhere.blf"], "nowhere.blf: no such log"),
        ([str(ROOT / "dbc")], "this folder holds no log"),
        ([str(ROOT / "README.md")], "it ends in '.md'"),
        ([str(RIDE), "--effects", "nowhere"], "--effects nowhere: no such folder"),
        ([str(RIDE), "--vehicle", "refrence"], "did you mean 'reference'"),
        ([str(RIDE), "--holdout", "city_14C"], "no ride is left to be fitted"),
        ([str(LOGS), "--holdout", "city_43C"], "no ride is called 'city_43C' (did you mean 'city_34C'?)"),
        ([str(RIDE), "--json", "nowhere/out.json"], "no folder nowhere"),
        ([str(RIDE), "--write-model", "new.txt"], "a vehicle file is a .toml"),
        ([str(RIDE), "--payload", "9000"], "must be 0 to 3000 kg"),
        ([str(RIDE), "--baseline", "out.toml", "--quiet"], "three are the least"),
        ([str(LOGS / "coastdown.blf"), "--quiet", "--vehicle", str(CAR)], "knows none of its"),
        ([str(LOGS / "calibration" / "dyno_02.blf"), "--quiet"], "is a ride on a roller"),
    ],
)
def test_what_cannot_be_is_refused(capsys, monkeypatch, tmp_path, arguments: list[str], words: str):
    monkeypatch.chdir(tmp_path)
    assert words in said(capsys, *arguments)
    assert not list(tmp_path.iterdir())


def test_the_model_may_have_an_effect_that_only_the_option_knows(capsys, tmp_path):
    file = with_effect(tmp_path)
    file.write_text(file.read_text().replace('effects_folder = "effects"\n', ""))
    arguments = [str(LOGS / "calibration" / "dyno_02.blf"), "--quiet", "--vehicle", str(file)]
    assert "no effect is called 'horn'" in said(capsys, *arguments)
    assert "is a ride on a roller" in said(capsys, *arguments, "--effects", str(file.parent / "effects"))


def test_the_vehicle_file_itself_is_not_overwritten(capsys):
    own = str(ROOT / "gz_onboard" / "vehicles" / "reference.toml")
    assert "would overwrite the input" in said(capsys, str(RIDE), "--write-model", own)


def test_the_list_says_of_each_what_it_is_and_what_shows_it(capsys):
    assert main(["discover", "--list"]) == 0
    entries = {part.split()[0]: part for part in capsys.readouterr().out.split("\n\n")}
    assert set(entries) == {c.name for c in candidates()}
    for c in candidates():
        assert c.equation and c.shown_by, c.name
        text = " ".join(entries[c.name].split())
        assert c.equation in text and c.shown_by in text
        assert all(f"{p.name} [{p.unit}], prior" in text for p in c.parameters)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One healthy ride, against the vehicle file alone."""
    folder = tmp_path_factory.mktemp("discover")
    files = [
        f"--{option}={folder / name}"
        for option, name in (("json", "out.json"), ("report", "out.html"), ("write-model", "new.toml"))
    ]
    assert main(["discover", str(RIDE), "--jobs", "1", "--quiet", *files]) == 0
    return folder


def test_one_healthy_ride(alone: Path):
    found = json.loads((alone / "out.json").read_text())
    assert set(found) <= {"version", *KEYS}
    assert set(KEYS) - {"constancy"} <= set(found)
    assert found["verdict"] == "none"
    assert found["causes"] == []
    assert not (alone / "new.toml").exists()  # nothing to extend it with
    assert found["gain"]["holdout"] == []
    limits = found["limits"]
    assert set(limits) == {c.name for c in candidates()}
    assert 0.02 < limits["rolling_resistance"]["energy_share"] < 1
    assert limits["payload_mass"]["change"] > 1


def test_the_report_is_one_file_with_its_pictures(alone: Path):
    page = (alone / "out.html").read_text()
    assert page.count('<svg class="drawn"') >= 3
    assert 'src="http' not in page


def test_rides_held_out_by_name_have_no_part_in_anything():
    vehicle = read_vehicle("reference")
    rides = [read_recording(LOGS / f"city_{name}.blf", vehicle) for name in ("14C", "34C")]
    found = discover(vehicle, rides, holdout=["city_34C"])
    report = found.report
    assert [line.ride.name for line in found.search.lines] == ["city_14C"]
    assert report.gain.holdout == ("city_34C",) and report.gain.apart
    alone = discover(vehicle, rides[:1]).report
    assert [c.name for c in report.causes] == [c.name for c in alone.causes]
    assert report.ranking == alone.ranking
    with pytest.raises(InputError, match="no ride is left"):
        discover(vehicle, rides, holdout=["city_14C", "city_34C"])
    short = replace(
        rides[1], columns={role: (times[:100], values[:100]) for role, (times, values) in rides[1].columns.items()}
    )
    for use, name in (("held out", "city_34C"), ("fitted", "city_14C")):
        with pytest.raises(InputError, match=f"no ride that was to be {use} can be used: .*city_34C"):
            discover(vehicle, [rides[0], short], holdout=[name])
