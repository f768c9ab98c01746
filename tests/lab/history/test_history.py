"""``gz-onboard history`` on recorded rides: once each, whatever log they come in."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from gz_onboard.cli import main
from gz_onboard.lab.history.store import Store
from tests.lab.short_logs import short_log


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log of 22 s of a ride."""
    return short_log(tmp_path_factory.mktemp("short") / "coastdown.blf", 12_000)


@pytest.fixture(scope="module")
def estimated(tmp_path_factory: pytest.TempPathFactory, short: Path) -> tuple[Path, dict[str, Any]]:
    """(the log of estimates of a ride, what ``estimate`` said of it)."""
    folder = tmp_path_factory.mktemp("estimated")
    said = folder / "said.json"
    given = ["--no-plot", "--output", str(folder), "--json", str(said)]
    assert main(["estimate", str(short), *given]) == 0
    return folder / "coastdown.estimate.mcap", json.loads(said.read_text())["rides"][0]


def history(file: Path, part: str, *arguments: object) -> int:
    return main(["history", part, *map(str, arguments), "--file", str(file)])


def added(capsys: pytest.CaptureFixture[str], file: Path, *arguments: object, status: int = 0) -> dict[str, list[Any]]:
    """What ``history add --json`` says."""
    assert history(file, "add", *arguments, "--json", "--jobs", "1") == status
    said: dict[str, list[Any]] = json.loads(capsys.readouterr().out)
    return said


def test_a_ride_is_as_estimate_says(tmp_path, capsys, estimated):
    log, summary = estimated
    (ride,) = added(capsys, tmp_path / "h.sqlite", log)["rides"]
    for key in ("distance_km", "duration_s", "energy_wh", "energy_recovered_wh", "consumption_wh_km"):
        assert ride[key] == pytest.approx(summary[key], rel=1e-3), key
    for key in ("soc_start", "soc_end", "range_start_km", "range_end_km", "range_end_p10_km", "range_end_p90_km"):
        assert ride[key] == pytest.approx(summary[key], rel=0.01), key
    assert ride["start_ns"] == pytest.approx(summary["start_ns"], abs=10_000_000)
    assert ride["rated_range_km"] == pytest.approx(56.9, abs=0.1)
    assert (ride["vehicle"], ride["ambient_C"]) == (summary["vehicle"], pytest.approx(12.5, abs=0.5))
    assert 0 < ride["resistance_sd"] < 0.2
    assert ride["degraded_s"] == pytest.approx(summary["states"]["DEGRADED"], abs=1.1)


def test_a_ride_is_counted_once_whatever_its_log(tmp_path, capsys, estimated, short):
    file = tmp_path / "h.sqlite"
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(estimated[0].read_bytes())
    assert len(added(capsys, file, estimated[0])["rides"]) == 1
    others = [copy, short]
    for name in "ride.log", "ride.asc":  # the times of the latter begin at its first frame
        assert main(["export", str(short), str(tmp_path / name)]) == 0
        others.append(tmp_path / name)
    capsys.readouterr()
    for log in others:
        for _ in range(2):
            said = added(capsys, file, log)
            assert (said["rides"], said["known"], said["failed"]) == ([], [str(log)], [])
    with Store(file) as store:
        assert len(store.rides()) == 1


def test_what_is_shown(tmp_path, capsys, estimated):
    file, table = tmp_path / "h.sqlite", tmp_path / "rides.csv"
    assert history(file, "add", estimated[0]) == 0
    assert history(file, "show", "--table", table, "--plot", tmp_path / "h.png") == 0
    assert "2025-06-15" in capsys.readouterr().out
    (row,) = csv.DictReader(table.open())
    assert row["start"] == "2025-06-15T15:06:40Z"
    assert (tmp_path / "h.png").stat().st_size > 10_000
    assert history(file, "show", "--json", "--month", "2025-06") == 0
    (vehicle,) = json.loads(capsys.readouterr().out)["vehicles"]
    assert [month["of"] for month in vehicle["months"]] == ["2025-06"]
    assert vehicle["total"]["distance_km"] == pytest.approx(float(row["distance_km"]))
    assert history(file, "show", "--json", "--since", "2025-07") == 0
    assert json.loads(capsys.readouterr().out)["vehicles"] == []
