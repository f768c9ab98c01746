"""docs/how-to/own-effect.md is true: its files work as they stand there, its commands give what it shows."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.model.effect import load_effect
from gz_onboard.model.model import Bound
from gz_onboard.vehicle import OWN, read_vehicle

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "how-to" / "own-effect.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", TEXT, re.M | re.S)


def blocks(kind: str) -> list[str]:
    return [text for name, text in BLOCKS if name == kind]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a reader of the page has."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "effects").mkdir()
    for name, text in zip(("top_box", "heated_grips"), blocks("python"), strict=True):
        (folder / "effects" / f"{name}.py").write_text(text, encoding="utf-8")
    model, box, grips = blocks("toml")
    write_vehicle(folder / "boxed.toml", model, box)
    write_vehicle(folder / "gripped.toml", model.replace('"top_box"', '"heated_grips"'), grips)
    return folder


def write_vehicle(file: Path, model: str, parameter: str) -> None:
    """The reference scooter's file with the page's tables."""
    text = (OWN / "reference.toml").read_text(encoding="utf-8")
    text, models = re.subn(r"^\[model\]\neffects = \[.*?^\]\n", lambda _: model, text, flags=re.M | re.S)
    text, parameters = re.subn(r"^\[parameters\]\n", lambda _: parameter, text, flags=re.M)
    assert models == parameters == 1
    file.write_text(text, encoding="utf-8")


def test_its_commands_give_what_it_shows(folder: Path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "utf-8"}
    ours = f'gz-onboard() {{ {shlex.quote(sys.executable)} -m gz_onboard "$@"; }}\n'
    commands = 0
    for block in blocks("console"):
        for step in re.split(r"^\$ ", block, flags=re.M)[1:]:
            command, _, shown = step.partition("\n")
            run = subprocess.run(
                ["bash", "-c", ours + command], cwd=folder, env=environment, capture_output=True, text=True, check=False
            )
            assert run.stdout.strip() == shown.strip(), run.stderr
            commands += 1
    assert commands >= 5
    found = read_vehicle(str(folder / "found.toml"))
    assert "heated_grips" in found.key
    low, high = (25.0 + sign * 3 * found.parameters.sd("heated_grips_power") for sign in (-1, 1))
    assert low < found.parameters["heated_grips_power"] < high


@pytest.mark.parametrize("name", ["top_box", "heated_grips"])
def test_its_effects_keep_to_the_contract(folder: Path, name: str):
    effect = load_effect(name, folder / "effects")
    values = Bound(effect, {**read_vehicle("reference").parameters, **{p.name: p.prior for p in effect.parameters}})
    rows = [
        {"speed": v, "headwind": 1.0, "air_density": 1.2, "time_moving": 60.0 * v, "ambient_temperature": 10.0}
        for v in (0.0, 3.0, 12.0)
    ]
    arrays = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    assert values(arrays) == pytest.approx([values(row) for row in rows])
    assert values(rows[2]) > 0


def test_the_onboard_model_has_it(folder: Path):
    base, boxed = (read_vehicle(name) for name in ("reference", str(folder / "boxed.toml")))
    assert boxed.parameters["top_box_drag_area"] == 0.06
    assert boxed.key != base.key
    expected = [Forecaster(v.model, v.pack, v.riding).forecast(0.8, 0.01, 20.0, 1.0, 20.0, 0.0) for v in (base, boxed)]
    assert expected[1].range < 0.99 * expected[0].range
