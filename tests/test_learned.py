"""``gz-onboard learned`` on states as the daemon saves them."""

from __future__ import annotations

import fcntl
import json
import os
import time
from pathlib import Path

import pytest

from gz_onboard import state
from gz_onboard.cli import main
from gz_onboard.errors import BAD_INPUT, OK
from gz_onboard.estimator.battery_filter import with_soc
from gz_onboard.pipeline import Pipeline
from gz_onboard.vehicle import read_vehicle

CAPACITY, RESISTANCE = 0.8, 1.5


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """A state of a pack that has aged, an hour old."""
    vehicle = read_vehicle("reference")
    estimator = Pipeline(vehicle).estimator
    known = with_soc(estimator.pack.age.unknown, 0.6, 1e-4)
    covariance = (*known.covariance[:4], 1e-4, 0.0, 0.0, 0.01**2, 0.0, 0.05**2)
    known = known._replace(inverse_capacity=1 / CAPACITY, resistance=RESISTANCE, covariance=covariance)
    estimator.pack.age.restart(known)
    estimator.pack.state, estimator.pack.is_started = known, True
    snapshot = estimator.snapshot(vehicle.key)
    assert snapshot
    file = tmp_path / "reference.json"
    state.write(file, state.encode(snapshot, time.time() - 3600))
    return file


def shown(file: Path, capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, dict[str, float]]:
    assert main(["learned", "--state", str(file), "--json", *options]) == OK
    document = json.loads(capsys.readouterr().out)
    assert document["version"] == 4
    learned: dict[str, dict[str, float]] = document["learned"]
    return learned


def test_it_shows_what_was_learned(saved: Path, capsys: pytest.CaptureFixture[str]):
    learned = shown(saved, capsys)
    assert learned["capacity"]["factor"] == pytest.approx(CAPACITY, abs=0.01)
    assert learned["resistance"]["factor"] == pytest.approx(RESISTANCE, rel=0.03)
    assert main(["learned", "--state", str(saved)]) == OK
    text = capsys.readouterr().out
    assert "capacity        0.799 ± 0.0" in text
    assert "91 % learned" in text
    assert text.startswith("per cent learned: share of the initial uncertainty")


def test_it_resets_the_battery_and_keeps_the_rest(saved: Path, capsys: pytest.CaptureFixture[str]):
    before, _ = state.load(saved, time.time()) or ({}, None)
    learned = shown(saved, capsys, "--reset", "battery")  # the JSON is nothing but JSON
    assert (learned["capacity"]["factor"], learned["capacity"]["percent_learned"]) == (1.0, 0)
    assert learned["resistance"]["factor"] == 1.0
    after, age = state.load(saved, time.time()) or ({}, None)
    assert {**after, "learned": before["learned"]} == before
    assert age == pytest.approx(3600, abs=10)
    assert shown(saved, capsys, "--reset", "all")["resistance"]["factor"] == 1.0


def test_it_resets_nothing_under_a_daemon_that_runs(saved: Path, capsys: pytest.CaptureFixture[str]):
    descriptor = os.open(saved.parent, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    assert main(["learned", "--state", str(saved), "--reset", "all"]) == BAD_INPUT
    os.close(descriptor)
    assert f"{saved}: the running daemon would overwrite it; stop it first" in capsys.readouterr().err
    assert shown(saved, capsys)["capacity"]["factor"] == pytest.approx(CAPACITY, abs=0.01)


def test_it_names_a_state_that_is_missing_damaged_or_another_s(saved: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["learned", "--state", str(saved.parent / "none.json")]) == BAD_INPUT
    assert "none.json: no saved state" in capsys.readouterr().err
    snapshot, _ = state.load(saved, time.time()) or ({}, None)
    state.write(saved, state.encode({**snapshot, "key": "car"}, time.time()))
    assert main(["learned", "--state", str(saved)]) == BAD_INPUT
    assert "is of another vehicle, battery or list of effects: ['car'] saved" in capsys.readouterr().err
    wrong = {**snapshot, "learned": {"capacity": {"of": "much"}}}
    state.write(saved, state.encode(wrong, time.time()))
    assert main(["learned", "--state", str(saved)]) == BAD_INPUT
    assert f"{saved}: is damaged: state.learned has ['capacity'], not " in capsys.readouterr().err
    assert main(["learned", "--state", str(saved), "--reset", "battery"]) == OK
