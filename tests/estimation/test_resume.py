"""``gz-onboard estimate --resume``: what is whole and of the same is kept, all else is made again."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gz_onboard.cli import main
from gz_onboard.estimation import command
from gz_onboard.vehicle import find_vehicle
from tests.short_logs import ENOUGH, short_log


def run(folder: Path, *arguments: object) -> list[dict[str, Any]]:
    """The summaries of the rides in `folder`, whose estimates are written into it."""
    said = folder / "said.json"
    given = ["--output", str(folder), "--json", str(said), "--jobs", "1", *map(str, arguments)]
    assert main(["estimate", *map(str, sorted(folder.glob("*.blf"))), *given]) == 0
    rides: list[dict[str, Any]] = json.loads(said.read_text())["rides"]
    return rides


def without_times(rides: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{key: x for key, x in ride.items() if key not in ("cpu_s", "real_time_factor")} for ride in rides]


def test_the_summary_holds_the_rides_of_before(tmp_path):
    for name in "a", "b":
        short_log(tmp_path / f"{name}.blf")
    first = run(tmp_path, "--no-plot")
    made = (tmp_path / "a.estimate.mcap").stat().st_mtime_ns
    (tmp_path / "b.estimate.mcap").unlink()
    table = tmp_path / "rides.csv"
    again = run(tmp_path, "--no-plot", "--resume", "--table", table)
    assert without_times(again) == without_times(first)
    assert [ride["cpu_s"] > 0 for ride in again] == [False, True]
    assert (tmp_path / "a.estimate.mcap").stat().st_mtime_ns == made
    with table.open() as rows:
        assert [row["file"] for row in csv.DictReader(rows)] == [ride["file"] for ride in first]
    assert [ride["cpu_s"] > 0 for ride in run(tmp_path, "--no-plot")] == [True, True]


def cut_off(log: Path, _: pytest.MonkeyPatch) -> None:
    made = log.with_suffix(".estimate.mcap")
    os.truncate(made, made.stat().st_size - 100)


def grown(log: Path, _: pytest.MonkeyPatch) -> None:
    short_log(log, 2 * ENOUGH)


def newer(_: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "__version__", "999")


def same(_: Path, __: pytest.MonkeyPatch) -> None:
    pass


@pytest.mark.parametrize(
    ("change", "options", "kept"),
    [
        (same, [], True),
        (same, ["--payload", "75"], False),
        (same, ["--signals"], False),
        (same, ["--route", "way.csv"], False),
        (same, ["--vehicle", "other.toml"], False),
        (cut_off, [], False),
        (grown, [], False),
        (newer, [], False),
    ],
)
def test_what_is_kept(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[Path, pytest.MonkeyPatch], None],
    options: list[str],
    kept: bool,
):
    log = short_log(tmp_path / "a.blf")
    (tmp_path / "way.csv").write_text("latitude_deg,longitude_deg\n47.0,8.0\n47.01,8.0\n47.02,8.0\n")
    built_in = find_vehicle("reference")
    text = built_in.read_text().replace('name = "reference-scooter"', 'name = "another"')
    (tmp_path / "other.toml").write_text(text.replace("../../dbc/", f"{built_in.parents[2]}/dbc/"))
    monkeypatch.chdir(tmp_path)
    run(tmp_path, "--no-plot")
    change(log, monkeypatch)
    (ride,) = run(tmp_path, "--no-plot", "--resume", *options)
    assert (ride["cpu_s"] == 0) == kept


def test_a_ride_whose_picture_is_missing_is_made_again(tmp_path):
    short_log(tmp_path / "a.blf")
    run(tmp_path)
    picture = tmp_path / "a.estimate.png"
    drawn = picture.read_bytes()
    assert run(tmp_path, "--resume")[0]["cpu_s"] == 0
    picture.unlink()
    assert run(tmp_path, "--resume")[0]["cpu_s"] > 0
    assert picture.read_bytes() == drawn


def test_the_picture_of_another_run_is_drawn_again(tmp_path):
    short_log(tmp_path / "a.blf")
    run(tmp_path)
    picture = tmp_path / "a.estimate.png"
    drawn = picture.read_bytes()
    run(tmp_path, "--no-plot", "--payload", "190")
    assert picture.read_bytes() == drawn
    run(tmp_path, "--payload", "190", "--resume")
    assert picture.read_bytes() != drawn
