"""The comparative study: what it must show, and what its command writes."""

from __future__ import annotations

import json
from itertools import pairwise

import pytest

from gz_onboard.simulation.turning.study import CHASSIS_MODELS, ROLLS, main


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study") / "new"
    assert main(["--output", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def rows(output):
    written = json.loads((output / "turning.json").read_text())
    assert len(written) == len(ROLLS) * len(CHASSIS_MODELS)
    return {(row["model"], row["roll"]): row for row in written}


@pytest.mark.parametrize("model", ["planar", "leaning"])
def test_loss_grows_with_roll(rows, model):
    for less, more in pairwise(ROLLS):
        assert rows[model, more]["lost"] > rows[model, less]["lost"]
        assert rows[model, more]["distance"] < rows[model, less]["distance"]
        assert rows["straight", more]["lost"] == rows["straight", less]["lost"]


def test_lean_shows_in_loads_radius_and_slip(rows):
    planar, leaning = rows["planar", 30.0], rows["leaning", 30.0]
    assert planar["rolling_radius"] == rows["straight", 0.0]["rolling_radius"]
    assert 0.005 < planar["rolling_radius"] - leaning["rolling_radius"] < 0.008
    assert leaning["plane_load_rear"] > 1.1 * leaning["load_rear"]
    assert leaning["slip_rear"] < 0.4 * planar["slip_rear"]
    assert leaning["load_front"] + leaning["load_rear"] == pytest.approx(planar["load_front"] + planar["load_rear"])


def test_command_writes_table_and_plots(output, rows):
    table = (output / "turning.md").read_text().splitlines()
    assert len(table) == 2 + len(rows)
    assert f"| {rows['leaning', 30.0]['lost']:.0f} J |" in table[-1]
    for name in ("turning_energy.png", "turning_tyres.png"):
        picture = (output / name).read_bytes()
        assert picture.startswith(b"\x89PNG")
        assert 10_000 < len(picture) < 150_000
