"""The vehicle file that the daemon ships with is what calibration gives from the data in the repository."""

from __future__ import annotations

import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from gz_onboard.cli import main
from gz_onboard.vehicle import OWN, read_vehicle

ROOT = Path(__file__).parents[2]
DATA = ROOT / "replay_logs" / "calibration"
NUMBER = re.compile(r"[-+−]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """(vehicle file, answer in JSON) of the whole calibration, half a minute."""
    folder = tmp_path_factory.mktemp("calibration")
    out, answer = folder / "reference.toml", folder / "answer.json"
    written = ["--output", str(out), "--json", str(answer), "--report", str(folder / "report.html")]
    assert main(["calibrate", "all", str(DATA), *written]) == 0
    return out, json.loads(answer.read_text())


def test_its_page_is_small_and_shows_no_picture_twice(made):
    text = made[0].with_name("report.html").read_text()
    pictures = re.findall(r"<figure>.*?</figure>", text, re.S)
    assert len(pictures) == len(set(pictures)) > 70
    assert len(text.encode()) < 500_000


def test_it_is_the_file_that_is_shipped(made):
    out, _ = made
    shipped = tomllib.loads((OWN / "reference.toml").read_text())
    again = tomllib.loads(out.read_text())
    found = list(differences(shipped, again, ()))
    assert not found, "\n".join(
        [*found, "run: gz-onboard calibrate all replay_logs/calibration --out gz_onboard/vehicles/reference.toml"]
    )
    comments = [
        [line for line in f.read_text().splitlines() if line.startswith("#")] for f in (OWN / "reference.toml", out)
    ]
    assert comments[0] == comments[1]


def differences(a: Any, b: Any, path: tuple[str, ...]) -> Any:
    """Where two files say different things. A hundredth of an sd, or a last digit, is nothing."""
    if isinstance(a, dict) and isinstance(b, dict):
        for key in {*a, *b}:
            if key not in a or key not in b:
                yield f"{'.'.join((*path, key))}: only in one"
            elif key == "value" and isinstance(a[key], float):
                if not abs(a[key] - b[key]) <= 0.01 * a.get("sd", 0.0) + 1e-3 * abs(a[key]):
                    yield f"{'.'.join(path)}: {a[key]} against {b[key]}"
            else:
                yield from differences(a[key], b[key], (*path, key))
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            yield from differences(x, y, (*path, str(i)))
    elif isinstance(a, float) and isinstance(b, float):
        if not math.isclose(a, b, rel_tol=0.01, abs_tol=0.005):
            yield f"{'.'.join(path)}: {a} against {b}"
    elif isinstance(a, str) and isinstance(b, str):
        if NUMBER.sub("0", a) != NUMBER.sub("0", b):  # sources hold numbers too
            yield f"{'.'.join(path)}: {a!r} against {b!r}"
    elif a != b:
        yield f"{'.'.join(path)}: {a!r} against {b!r}"


def test_differences_are_seen():
    same = {"p": {"value": 1.0, "sd": 0.1, "source": "3 runs"}, "t": {"value": [1.0, 2.0]}}
    other = {"p": {"value": 1.01, "sd": 0.1, "source": "3 rides"}, "t": {"value": [1.0, 2.1]}, "x": 1}
    assert not list(differences(same, same, ()))
    assert len(list(differences(same, other, ()))) == 4


def test_what_is_not_measured_stays(made):
    out, _ = made
    base, new = read_vehicle(str(DATA / "scooter.toml")), read_vehicle(str(out))
    assert new.mapping.sources == base.mapping.sources
    assert (new.riding, new.derating) == (base.riding, base.derating)
    assert new.model.effects[:-2] == base.model.effects
    found = [effect.name for effect in new.model.effects[-2:]]
    assert found == ["charge_transfer", "slow_relaxation"]  # that pulses of several currents show, and their rests
    for name in ("vehicle_mass", "payload_mass", "wheelbase", "cell_cutoff_voltage"):
        assert new.parameters.known[name] == base.parameters.known[name]
    assert {
        v.status for v in map(new.parameters.known.get, ("drag_area", "torque_constant", "cell_capacity")) if v
    } == {"measured"}


def test_thesis_table_of_the_docs_is_what_comes_out(made):
    _, answer = made
    page = (ROOT / "docs" / "results" / "calibration.md").read_text()
    lines = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line.startswith("|")
    ]
    table = {line[0]: line for line in lines}
    assert len(answer["thesis"]) == 18
    for row in answer["thesis"]:
        shown = table[row["what"]]
        assert shown[1] == row["thesis"]
        for said, now in zip(
            NUMBER.findall(shown[2] + shown[3]), NUMBER.findall(row["ours"] + row["rms"]), strict=True
        ):
            assert float(said) == pytest.approx(float(now), rel=0.06)
        assert shown[5] == row["better"]


def test_thesis_rows_are_beaten_where_said(made):
    _, answer = made
    missed = {row["what"] for row in answer["thesis"] if row["better"] == "no"}
    assert not missed & {"back-EMF constant", "torque constant", "motor map", "coast-down speed, wind unknown"}
