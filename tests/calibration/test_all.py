"""The vehicle file that the daemon ships with is what calibration gives from the data in the repository."""

from __future__ import annotations

import json
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
    """If not: gz-onboard calibrate all replay_logs/calibration --output gz_onboard/vehicles/reference.toml"""
    shipped, again = (OWN / "reference.toml").read_text(), made[0].read_text()
    texts, numbers, comments = [], [], []
    for text in (again, shipped):
        values = leaves(tomllib.loads(text))
        texts.append({path: NUMBER.sub("0", value) for path, value in values.items() if isinstance(value, str)})
        numbers.append({path: value for path, value in values.items() if not isinstance(value, str)})
        comments.append([line for line in text.splitlines() if line.startswith("#")])
    assert texts[0] == texts[1]  # sources hold numbers too
    assert numbers[0] == pytest.approx(numbers[1], rel=0.001, abs=1e-5)
    assert comments[0] == comments[1]


def leaves(value: Any, path: tuple[str, ...] = ()) -> dict[tuple[str, ...], Any]:
    """The values of a file by their path."""
    if isinstance(value, dict | list):
        pairs = value.items() if isinstance(value, dict) else enumerate(value)
        return {key: leaf for k, x in pairs for key, leaf in leaves(x, (*path, str(k))).items()}
    return {path: value}


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
