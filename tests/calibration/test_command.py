"""``gz-onboard calibrate``."""

from __future__ import annotations

import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from gz_onboard.calibration.result import Curve, Found, Result
from gz_onboard.calibration.steps import write_calibration
from gz_onboard.cli import main
from gz_onboard.vehicle import OWN, read_vehicle

LOGS = Path(__file__).parents[2] / "replay_logs"
DATA = LOGS / "calibration"


def test_one_procedure_gives_file_report_and_json(tmp_path, capsys):
    out, page, answer = tmp_path / "new.toml", tmp_path / "r.html", tmp_path / "a.json"
    files = [str(DATA / "motor_dyno.csv.gz"), "--with", f"emf={DATA / 'motor_emf_ramp.csv.gz'}"]
    written = ["--output", str(out), "--report", str(page), "--json", str(answer)]
    assert main(["calibrate", "motor", *files, *written]) == 0
    told = capsys.readouterr().out
    found = json.loads(answer.read_text())["procedures"][0]["parameters"]
    vehicle = read_vehicle(str(out))
    for name in ("torque_constant", "voltage_constant"):
        assert name in told
        assert vehicle.parameters[name] == pytest.approx(found[name]["value"], rel=1e-5)
        assert vehicle.parameters.known[name].source == found[name]["source"]
    assert vehicle.parameters["drag_area"] == read_vehicle("reference").parameters["drag_area"]
    assert "Back-EMF" in page.read_text()
    assert page.read_text().count("<figure") == 4


def test_an_option_changes_what_is_used(capsys):
    file = str(DATA / "motor_dyno.csv.gz")
    answers = []
    for extra in ([], ["--set", "largest_current=60"]):
        assert main(["calibrate", "losses", file, "--json", "-", *extra]) == 0
        answers.append(json.loads(capsys.readouterr().out)["procedures"][0])
    assert "up to 120 A" in answers[0]["parameters"]["motor_copper_resistance"]["source"]
    assert "up to 60 A" in answers[1]["parameters"]["motor_copper_resistance"]["source"]


def test_all_of_a_folder_uses_what_came_before(tmp_path, capsys):
    for name in ("motor_dyno.csv.gz", "motor_emf_ramp.csv.gz", "cell_ocv_25C.csv.gz"):
        shutil.copy(DATA / name, tmp_path)
    manifest = 'schema = 1\n[ocv]\ndata = "cell_ocv_25C.csv.gz"\n[losses]\ndata = "motor_dyno.csv.gz"\n'
    (tmp_path / "calibration.toml").write_text(manifest + '[motor]\ndata = "motor_dyno.csv.gz"\n')
    out = tmp_path / "new.toml"
    assert main(["calibrate", "all", str(tmp_path), "--output", str(out), "--json", "-"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [p["procedure"] for p in document["procedures"]] == ["motor", "losses", "ocv"]
    groups = tomllib.loads(out.read_text())["correlation"]
    assert "torque_constant" in groups["losses"]["parameters"]  # tied to a parameter of an earlier procedure
    before = out.read_text()
    assert main(["calibrate", "all", str(tmp_path), "--output", str(out), "--json", "-"]) == 0
    assert out.read_text() == before


def test_a_folder_of_rides_is_its_logs(tmp_path, capsys):
    for name in ("coastdown_01.blf", "coastdown_02.blf", "rides.json", "motor_emf_ramp.csv.gz"):
        shutil.copy(DATA / name, tmp_path)
    answers = []
    for data in ([tmp_path], [tmp_path / "coastdown_01.blf", tmp_path / "coastdown_02.blf"]):
        assert main(["calibrate", "coastdown", *map(str, data), "--json"]) == 0
        answers.append(json.loads(capsys.readouterr().out))
    assert answers[0] == answers[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["moter", "x.csv"], r"no procedure is called 'moter' \(did you mean 'motor'\?\); there are all, "),
        (["ocv", "cell_ocv_25.csv.gz"], r"cell_ocv_25.csv.gz: no such file \(did you mean 'cell_ocv_25C.csv.gz'\?\)"),
        (["ocv", "motor_dyno.csv.gz"], "ocv: .*motor_dyno.csv.gz: no column for 'time'"),
        (["ocv", "cell_ocv_25C.csv.gz", "motor_dyno.csv.gz"], "ocv takes 1 for data"),
        (["coastdown", "coastdown_01.blf"], "coastdown needs coast-downs in both directions"),
        (["motor", "motor_dyno.csv.gz", "--with", "enf=x"], r"motor has no data 'enf' \(did you mean 'emf'\?\)"),
        (["motor", "motor_dyno.csv.gz", "--set", "largest=1"], "no option 'largest' .*; there are largest_current"),
        (["motor", "motor_dyno.csv.gz", "--set", "largest_current=x"], "must be a number .* is 'x'"),
        (
            ["motor", "motor_dyno.csv.gz", "--set", "largest_current=0.001"],
            "motor: .*motor_dyno.csv.gz: .* points up to 0.001 A",
        ),
        (["motor", "motor_dyno.csv.gz", "--output", "none/x.toml"], "there is no folder none"),
        (["motor", "motor_dyno.csv.gz", "--vehicle", "refrence"], r"no such vehicle file; .*did you mean 'reference'"),
        (["pulse", "cell_pulse_25C.csv.gz", "--with", "held_out=cell_pulse_25C.csv.gz"], "both fitted"),
        (["all", "..", ".."], "all takes one folder"),
        (["wheel", "../../dbc"], "dbc: this folder holds no log"),
        (["all", "..", "--with", "held_out=x"], "from the manifest"),
        (["all", ".."], "takes a folder with a manifest calibration.toml"),
    ],
)
def test_wrong_use_is_named(arguments, message, monkeypatch, capsys):
    monkeypatch.chdir(DATA)
    assert main(["calibrate", *arguments]) == 2
    error = capsys.readouterr().err
    assert re.search(message, error)
    assert error.count("\n") == 1


def test_only_what_a_vehicle_file_holds_is_written(tmp_path):
    one, pair = np.array([1.0]), np.array([[1.0, 0.5], [0.5, 2.0]])
    result = Result(
        "t",
        {"drag_area": Found(0.5, 0.1, "m²", "x"), "wind": Found(1, 1, "m/s", "x")},
        {"rest_shift": Curve({"soc": one}, one, one, "ohm", "x")},
        [(("wind", "drag_area"), pair)],
    )
    written = tmp_path / "v.toml"
    assert write_calibration(OWN / "reference.toml", [result], written).parameters["drag_area"] == 0.5
    assert not re.search(r"\bwind =|rest_shift", written.read_text())
