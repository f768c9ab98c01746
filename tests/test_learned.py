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
from gz_onboard.daemon.learned import BATTERY
from gz_onboard.errors import BAD_INPUT, OK
from gz_onboard.estimator.ekf import ScalarFilter
from gz_onboard.estimator.snapshot import unlike
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
    learned = estimator.soc.ageing.snapshot()
    learned["capacity"] |= {"inverse": 1 / CAPACITY, "variance": 0.01**2}
    learned["resistance"] |= {"factor": RESISTANCE, "time": 1800.0}
    estimator.soc.ageing.restore(learned)
    estimator.soc.filter = ScalarFilter(estimator.battery, 0.6, 0.0, (1e-4, 0.0, 1e-4))
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
    assert "capacity     0.799 ± 0.0" in text
    assert "91 % learned" in text
    assert text.startswith("per cent learned: how much of what was uncertain")


def test_it_shows_each_rider(saved: Path, capsys: pytest.CaptureFixture[str]):
    vehicle = read_vehicle("reference")
    snapshot, _ = state.load(saved, time.time()) or ({}, None)
    estimator = Pipeline(vehicle).estimator
    estimator.restore(snapshot, vehicle.key, 0.0)
    learner = estimator.forecaster.learner
    price = replace(learner.habits.price, level=1.2, level_variance=0.01**2)
    learner.state = replace(learner.state, habits=replace(learner.habits, price=price))
    estimator.forecaster.ridden_by("anna")
    estimator.soc.filter = ScalarFilter(estimator.battery, 0.6, 0.0, (1e-4, 0.0, 1e-4))
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
    unnamed = text.index("\nrides of which nobody said who rode:\n")
    assert text.index("\nrider anna:\n") < unnamed
    assert main(["learned", "--state", str(saved), "--reset", "riding"]) == OK
    text = capsys.readouterr().out
    assert text.startswith(f"reset in {saved}: riding of all riders\n")
    assert "anna" not in text
    assert "price        1.000 ± 0.1" in text
    assert "nothing learned: energy of a kilometre" in text


def test_it_forgets_one_and_keeps_the_rest(saved: Path, capsys: pytest.CaptureFixture[str]):
    before, _ = state.load(saved, time.time()) or ({}, None)
    shown(saved, capsys, "--reset", "capacity")
    learned = shown(saved, capsys)
    assert learned["capacity"]["factor"] == pytest.approx(0.88, abs=0.05)  # what the resistance makes likely
    assert learned["capacity"]["percent_learned"] < 50
    assert main(["learned", "--state", str(saved), "--reset", "capacity"]) == OK
    assert "stays: `--reset battery` forgets both\n" in capsys.readouterr().out
    assert learned["resistance"]["factor"] == pytest.approx(RESISTANCE, rel=0.03)
    after, age = state.load(saved, time.time()) or ({}, None)
    assert {**after, "learned": before["learned"]} == before
    assert age == pytest.approx(3600, abs=10)
    vehicle = read_vehicle("reference")
    Pipeline(vehicle).estimator.restore(after, vehicle.key, age)
    learned = shown(saved, capsys, "--reset", "battery")  # the JSON is nothing but JSON
    assert (learned["capacity"]["factor"], learned["capacity"]["percent_learned"]) == (1.0, 0)
    assert learned["resistance"]["factor"] == 1.0
    after, _ = state.load(saved, time.time()) or ({}, None)
    assert set(before["learned"]) - set(after["learned"]) <= set(BATTERY)
    assert shown(saved, capsys, "--reset", "all")["resistance"]["factor"] == 1.0


def test_it_shows_and_forgets_the_weakest_group(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    vehicle = with_cell_voltages(tmp_path)
    assert not set(NAMES) & set(shown(saved, capsys))  # a vehicle without the signal
    estimator = Pipeline(vehicle).estimator
    snapshot, _ = state.load(saved, time.time()) or ({}, None)
    estimator.restore(snapshot, vehicle.key, 0.0)
    estimator.soc.filter = ScalarFilter(estimator.battery, 0.6, 0.0, (1e-4, 0.0, 1e-4))
    estimator.weakest.known.joint.means[:2] = [0.04, 1 / 0.9 - 1]
    changed = estimator.snapshot(vehicle.key)
    assert changed
    state.write(saved, state.encode(changed, time.time()))
    options = "--vehicle", str(vehicle.file)
    learned = shown(saved, capsys, *options)
    assert learned["weak_charge"]["factor"] == pytest.approx(0.96)
    assert learned["weak_capacity"]["factor"] == pytest.approx(0.9)
    assert main(["learned", "--state", str(saved), *options, "--reset", "weakest"]) == OK
    assert "weak_capacity 1.000 ± 0.080  nothing learned: of that group" in capsys.readouterr().out
    learned = shown(saved, capsys, *options)
    assert learned["weak_charge"]["factor"] == 1.0
    assert learned["capacity"]["factor"] == pytest.approx(CAPACITY, abs=0.01)


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
    assert "is of 'car'" in capsys.readouterr().err
    wrong = {**snapshot, "learned": {"capacity": {"of": "much"}}}
    state.write(saved, state.encode(wrong, time.time()))
    assert main(["learned", "--state", str(saved)]) == BAD_INPUT
    assert f"{saved}: is damaged: its capacity or resistance holds implausible numbers; " in capsys.readouterr().err
    state.write(saved, state.encode({**snapshot, "riding": {}}, time.time()))
    assert main(["learned", "--state", str(saved)]) == BAD_INPUT
    said = capsys.readouterr().err
    assert f"{saved}: is damaged: its riding lacks " in said and "; --reset riding begins that anew" in said
    assert main(["learned", "--state", str(saved), "--reset", "riding"]) == OK
    assert main(["learned", "--state", str(saved)]) == OK
    capsys.readouterr()
    text = state.encode(snapshot, time.time())
    nothing: list[Any] = [[1], 7, None]
    for none in nothing:
        saved.write_bytes(state.encode(none, time.time()))
        assert main(["learned", "--state", str(saved)]) == BAD_INPUT
        assert f"{saved}: is damaged: its state is not as it was saved" in capsys.readouterr().err
    saved.write_bytes(text)
    saved.write_bytes(saved.read_bytes()[:-9])
    assert main(["learned", "--state", str(saved)]) == BAD_INPUT
    assert "; to begin anew, give `gz-onboard estimate --state` a new name; " in capsys.readouterr().err


def _key(*effects: str) -> str:
    return "|".join(["scooter", "14s12p", *effects])


@pytest.mark.parametrize(
    ("other", "said"),
    [
        (7, "is of 7, this is 'scooter'"),
        ("car|96s2p|drag", "is of 'car', this is 'scooter'"),
        ("scooter|13s12p|drag|mass", "is of 'scooter' with '13s12p', this vehicle file has '14s12p'"),
        (_key("drag"), "is of a vehicle file of 'scooter' without the effect mass, which this one has"),
        (_key("drag", "mass", *"abcd"), "of 'scooter' with the effects a, b, c and 1 more, which this one has not"),
        (_key("mass", "drag"), "of 'scooter' with its effects in another order"),
    ],
)
def test_it_names_what_differs_and_no_more(other: object, said: str):
    assert unlike(other, _key("drag", "mass")).endswith(said)
