"""``gz-onboard estimate --resume``: what is whole and of the same is kept, all else is made again."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from gz_onboard.cli import main
from gz_onboard.estimation import command
from gz_onboard.vehicle import find_vehicle
from tests.short_logs import ENOUGH, short_log
from tests.support import HEARS_CTRL_C


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


def test_a_picture_that_is_missing_or_cut_off_is_drawn_again(tmp_path):
    short_log(tmp_path / "a.blf")
    run(tmp_path)
    picture = tmp_path / "a.estimate.png"
    drawn = picture.read_bytes()
    for left in (drawn[:1000], None):
        picture.unlink()
        if left:
            picture.write_bytes(left)
        (ride,) = run(tmp_path, "--resume")
        assert ride["cpu_s"] == 0
        assert picture.read_bytes() == drawn


def test_a_run_that_was_interrupted_goes_on(tmp_path):
    """Ctrl-C once the first ride is written: the rest is made by the next run, and the first is kept."""
    for i in range(4):
        short_log(tmp_path / f"{i}.blf", 12_000)
    command = [*HEARS_CTRL_C, sys.executable, "-m", "gz_onboard", "estimate", str(tmp_path), "--output", str(tmp_path)]
    process = subprocess.Popen(
        [*command, "--no-plot", "--jobs", "1"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    while process.poll() is None and not (tmp_path / "0.estimate.mcap").exists():
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=100)
    assert not list(tmp_path.glob("*.part"))
    made = [file.name for file in tmp_path.glob("*.estimate.mcap")]
    if len(made) < 4:  # else it was faster than the signal
        assert process.returncode == 130
        assert "--resume" in err
    rides = run(tmp_path, "--no-plot", "--resume")
    assert len(rides) == 4
    assert [Path(ride["log"]).name for ride in rides if not ride["cpu_s"]] == sorted(made)
