"""``gz-onboard learned`` on states as the daemon saves them."""

from __future__ import annotations

import fcntl
import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gz_onboard import state
from gz_onboard.cli import main
from gz_onboard.errors import BAD_INPUT, OK
from gz_onboard.estimator.battery_filter import with_soc
from gz_onboard.estimator.weakest import NAMES
from gz_onboard.pipeline import Pipeline
from gz_onboard.vehicle import read_vehicle
from tests.support import with_cell_voltages

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


def test_it_shows_each_rider(saved: Path, capsys: pytest.CaptureFixture[str]):
    vehicle = read_vehicle("reference")
    snapshot, _ = state.load(saved, time.time()) or ({}, None)
    estimator = Pipeline(vehicle).estimator
    estimator.restore(snapshot, vehicle.key, 0.0)
    learner = estimator.forecaster.learner
    price = learner.state.habits.price._replace(level=1.2, level_variance=0.01**2)
    learner.state = learner.state._replace(habits=learner.state.habits._replace(price=price))
    estimator.forecaster.ridden_by("anna")
    estimator.pack.state, estimator.pack.is_started = with_soc(estimator.pack.state, 0.6, 1e-4), True
    changed = estimator.snapshot(vehicle.key)
    assert changed
    state.write(saved, state.encode(changed, time.time()))
    assert main(["learned", "--state", str(saved), "--json"]) == OK
    riders = json.loads(capsys.readouterr().out)["riders"]
    assert list(riders) == ["anna", ""]
    assert riders[""]["price"]["factor"] == pytest.approx(1.2 / vehicle.riding.factor)
    assert riders[""]["price"]["percent_learned"] > 80
    assert riders["anna"]["price"]["percent_learned"] < 30
    assert main(["learned", "--state", str(saved)]) == OK
    text = capsys.readouterr().out
    unnamed = text.index("\nrides without a known rider:\n")
    assert text.index("\nrider anna:\n") < unnamed
    assert main(["learned", "--state", str(saved), "--reset", "riding"]) == OK
    text = capsys.readouterr().out
    assert text.startswith(f"reset in {saved}: riding\n")
    assert "anna" not in text
    assert "price           1.000 ± 0.1" in text
    assert "nothing learned: energy per kilometre" in text


def test_it_resets_the_battery_and_keeps_the_rest(saved: Path, capsys: pytest.CaptureFixture[str]):
    before, _ = state.load(saved, time.time()) or ({}, None)
    learned = shown(saved, capsys, "--reset", "battery")  # the JSON is nothing but JSON
    assert (learned["capacity"]["factor"], learned["capacity"]["percent_learned"]) == (1.0, 0)
    assert learned["resistance"]["factor"] == 1.0
    after, age = state.load(saved, time.time()) or ({}, None)
    assert {**after, "learned": before["learned"]} == before
    assert age == pytest.approx(3600, abs=10)
    assert shown(saved, capsys, "--reset", "all")["resistance"]["factor"] == 1.0


def test_it_shows_and_forgets_the_weakest_group(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    vehicle = with_cell_voltages(tmp_path)
    assert not set(NAMES) & set(shown(saved, capsys))  # a vehicle without the signal
    estimator = Pipeline(vehicle).estimator
    snapshot, _ = state.load(saved, time.time()) or ({}, None)
    estimator.restore(snapshot, vehicle.key, 0.0)
    estimator.pack.state, estimator.pack.is_started = with_soc(estimator.pack.state, 0.6, 1e-4), True
    estimator.pack.weakest.known = replace(estimator.pack.weakest.known, means=(0.04, 1 / 0.9 - 1, 0.0, 0.0))
    changed = estimator.snapshot(vehicle.key)
    assert changed
    state.write(saved, state.encode(changed, time.time()))
    options = "--vehicle", str(vehicle.file)
    learned = shown(saved, capsys, *options)
    assert learned["weak_charge"]["factor"] == pytest.approx(0.96)
    assert learned["weak_capacity"]["factor"] == pytest.approx(0.9)
    assert main(["learned", "--state", str(saved), *options, "--reset", "battery"]) == OK
    assert "weak_capacity   1.000 ± 0.080  nothing learned: capacity of the weakest group" in capsys.readouterr().out
    learned = shown(saved, capsys, *options)
    assert learned["weak_charge"]["factor"] == 1.0


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
    capsys.readouterr()
    text = state.encode(snapshot, time.time())
    nothing: list[Any] = [[1], 7, None]
    for none in nothing:
        saved.write_bytes(state.encode(none, time.time()))
        assert main(["learned", "--state", str(saved)]) == BAD_INPUT
        assert f"{saved}: is of version " in capsys.readouterr().err
    saved.write_bytes(text[:-9])
    assert main(["learned", "--state", str(saved)]) == BAD_INPUT
    assert "its checksum is wrong; choose another state file" in capsys.readouterr().err
