"""How rough the road is in the simulation: of the vehicle's file, as given, or as a recorded ride shows it."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gz_onboard.cli import main
from gz_onboard.discovery.grid import vibration as of_samples
from gz_onboard.model.effect import load_effect
from gz_onboard.recording.recording import read_recording
from gz_onboard.simulation.parts import straight
from gz_onboard.simulation.recorded import Recorded, along_road, read_recorded
from gz_onboard.simulation.run import drive
from gz_onboard.simulation.scooter import STEP, Scooter
from gz_onboard.vehicle import OWN, Vehicle, read_vehicle
from tests.support import LOGS, joined, without_cell_effects

BASE = without_cell_effects(read_vehicle("reference"))
RIDE = LOGS / "coastdown.blf"
NEWTONS = 8.0  # N per m/s²
EFFECT = """\"\"\"What a rough road takes, in proportion to the vibration, made up for a test.\"\"\"
from gz_onboard.model.effect import Parameter, Port
PORT = Port.{port}
PARAMETERS = (Parameter("{name}_size", "1", {value}, 1.0, 0.0, 50.0, "made up for a test"),)
def term(vibration, *, {name}_size):
    return {name}_size * vibration
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("rough")
    for name, port, value in (
        ("rough_road", "WHEEL_FORCE", NEWTONS),
        ("rough_power", "DC_POWER", 20.0),
        ("loose_contact", "CELL_VOLTAGE", 0.01),
        ("rough_tyre", "TYRE", NEWTONS),
    ):
        (folder / f"{name}.py").write_text(EFFECT.format(port=port, value=value, name=name))
    return folder


def extended(folder: Path, *names: str) -> Vehicle:
    effects = [load_effect(name, folder) for name in names]
    return BASE.changed(joined(BASE.parameters, effects), (*BASE.model.effects, *effects))


def stop_and_go(scooter: Scooter) -> tuple[float, float, float]:
    t = scooter.time % 32
    return (0.5 if t < 20 and scooter.speed < 10 else 0.0), (0.4 if t > 22 else 0.0), math.nan


def ride(vehicle: Vehicle, road: Any = None, **options: Any) -> tuple[Any, Scooter]:
    scooter = Scooter(vehicle, road or straight(), soc=0.8, **options)
    return drive(scooter, stop_and_go, 64.0), scooter


def test_it_is_what_the_file_expects_while_moving_and_nothing_at_rest(folder: Path):
    vehicle = extended(folder, "rough_road", "rough_power")
    run, _ = ride(vehicle)
    moving = run.series["speed"] > 0.5
    assert 0.5 < moving.mean() < 0.95  # it stands too
    assert run.ledger["rough_road"] / run.distance == pytest.approx(NEWTONS * vehicle.riding.vibration, rel=0.01)
    assert run.ledger["rough_power"] == pytest.approx(20 * vehicle.riding.vibration * 64 * moving.mean(), rel=0.02)
    assert abs(run.closure) < 1e-4
    assert ride(BASE)[1].vibration == 0.0


def test_a_rough_road_takes_more(folder: Path):
    vehicle = extended(folder, "rough_road")
    smooth, middle, rough = (ride(vehicle, vibration=v)[0] for v in (0.3, lambda x: 0.3 if x < 200 else 2.5, 2.5))
    per_metre = [run.energy / run.distance for run in (smooth, middle, rough)]
    assert per_metre[0] < per_metre[1] < per_metre[2]
    assert per_metre[2] - per_metre[0] > NEWTONS * 2.2 * 0.9


# --- recorded rides -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def recorded(folder: Path) -> Recorded:
    return read_recorded(RIDE, extended(folder, "rough_road"))


def test_of_a_recorded_ride_it_is_what_the_accelerometer_shows(recorded: Recorded):
    found = recorded.signals["vibration"]
    samples = read_recording(RIDE, BASE)
    began = samples.columns["motor_speed"][0][0]
    shown = of_samples(*samples.columns["accel_z"], began + STEP * np.arange(len(found)))
    settled = slice(700, None)
    assert found[settled] == pytest.approx(shown[settled], abs=0.15)
    assert np.mean(np.abs(found - shown)[settled]) < 0.02
    assert shown[settled].std() > 0.05
    middle = recorded.signals["distance"][-1] / 2
    at = int(np.searchsorted(recorded.signals["distance"], middle))
    assert recorded.vibration is not None
    assert along_road(recorded.vibration)(middle) == pytest.approx(found[at], abs=0.2)


# --- from a vehicle's file ----------------------------------------------------------------------------------------


def test_a_vehicle_file_says_how_rough_roads_are(tmp_path: Path, folder: Path, capsys: pytest.CaptureFixture[str]):
    text = (OWN / "reference.toml").read_text(encoding="utf-8")
    listed = text.replace('"slow_relaxation",\n]', '"slow_relaxation", "rough_road",\n]\neffects_folder = "."')
    shutil.copy(folder / "rough_road.py", tmp_path)
    assert listed.count("[forecast]\n") == listed.count("rough_road") == 1
    cycle, file, summary = tmp_path / "cycle.csv", tmp_path / "rough.toml", tmp_path / "summary.json"
    cycle.write_text("time_s,speed_mps\n0,0\n10,8\n20,8\n30,8\n40,8\n50,0\n")

    def consumption(vibration: float, what: Path) -> float:
        file.write_text(listed.replace("[forecast]\n", f"[forecast]\nvibration = {vibration}\n"), encoding="utf-8")
        command = ["simulate", str(what), "--vehicle", str(file), "--no-series", "--no-plot", "--json", str(summary)]
        assert main(command) == 0
        assert "rough road" in capsys.readouterr().out
        return float(json.loads(summary.read_text())["consumption_wh_km"])

    more = consumption(2.5, cycle) - consumption(0.5, cycle)
    assert NEWTONS * 2.0 < 3.6 * more < NEWTONS * 2.0 * 1.25  # and what the motor loses for it
    assert abs(consumption(2.5, RIDE) - consumption(0.5, RIDE)) < 0.2 * more  # there it was measured, after six seconds
    file.write_text(listed.replace("[forecast]\n", "[forecast]\nvibration = -1\n"), encoding="utf-8")
    assert main(["simulate", str(cycle), "--vehicle", str(file)]) == 2
    assert "vibration" in capsys.readouterr().err
