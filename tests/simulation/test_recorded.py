"""Recorded rides into the simulation: the rides that come with the project, and others where they are at hand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from gz_onboard.cli import main
from gz_onboard.errors import InputError
from gz_onboard.simulation.recorded import _signals, fit_dynamometer, read_recorded, rest_soc
from gz_onboard.vehicle import read_vehicle

LOGS = Path(__file__).parents[2] / "replay_logs"
VEHICLE = read_vehicle("reference")


@pytest.fixture(scope="module")
def city():
    return read_recorded(LOGS / "city_14C.blf", VEHICLE)


def test_signals_stand_on_one_grid(city):
    lengths = {len(values) for values in city.signals.values()}
    assert len(lengths) == 1
    assert {"throttle", "brake", "speed", "pack_voltage", "motor_torque", "soc"} <= set(city.signals)
    assert city.signals["throttle"].max() <= 1
    assert city.signals["throttle"].min() >= 0
    assert city.distance == pytest.approx(city.signals["speed"].sum() * city.dt, rel=1e-6)
    assert not city.on_dynamometer


def test_the_sensors_known_errors_are_taken_off(city):
    """Energy, speed and SOC of a ride are those of what flowed and turned, not of what was shown."""
    errors = {"pack_current_offset": 2.0, "pack_current_gain": 1.2, "pack_voltage_offset": 1.5}
    wrong = VEHICLE.changed(VEHICLE.parameters.replaced(**errors, speed_sensor_scale=1.1))
    right = VEHICLE.changed(
        VEHICLE.parameters.replaced(**dict.fromkeys(errors, 0.0) | {"pack_current_gain": 1.0}, speed_sensor_scale=1.0)
    )
    shown, ride = (read_recorded(LOGS / "city_14C.blf", vehicle) for vehicle in (right, wrong))
    volts, amperes = shown.signals["pack_voltage"] - 1.5, (shown.signals["pack_current"] - 2.0) / 1.2
    assert ride.signals["pack_voltage"] == pytest.approx(volts)
    assert ride.signals["pack_current"] == pytest.approx(amperes)
    assert ride.energy() == pytest.approx(float((volts * amperes).sum() * ride.dt))
    assert ride.signals["motor_speed"] == pytest.approx(shown.signals["motor_speed"] / 1.1)
    assert ride.distance == pytest.approx(shown.distance / 1.1)
    drawn = amperes.sum() * ride.dt / 3600 / wrong.pack.pack_capacity(ride.first("cell_temperature", 20.0))
    soc = ride.signals["soc"]
    assert soc[0] - soc[-1] == pytest.approx(drawn, rel=0.01)


def test_a_brake_known_by_its_switch_alone_is_pulled_as_far_on_any_vehicle():
    time = np.arange(0.0, 3.0, 0.1)
    columns = {"vehicle_speed": (time, 0.0 * time + 5.0), "brake_switch": (time, (time > 1.0).astype(float))}
    small = VEHICLE.changed(VEHICLE.parameters.replaced(brake_torque_limit=10.0))
    pulled = [_signals(Path("ride.blf"), columns, vehicle)["brake"] for vehicle in (VEHICLE, small)]
    assert pulled[0].max() == pulled[1].max() == pytest.approx(90.0 / 1148.6, rel=1e-4)  # N of the reference


def test_soc_counts_down_from_rest(city):
    soc = city.signals["soc"]
    assert soc[0] == pytest.approx(rest_soc(city, VEHICLE), abs=1e-4)
    assert 0 < soc[0] - soc[-1] < 0.5


def test_no_dynamometer_is_said(city):
    with pytest.raises(InputError, match="no roller"):
        fit_dynamometer(city)


@pytest.mark.parametrize("mode", [(), ("--predictive",)])
def test_a_recorded_ride_is_simulated(tmp_path, capsys, mode):
    log = LOGS / "city_14C.blf"
    plain = ["--no-plot", "--no-series"] if mode else []
    assert main(["simulate", str(log), *mode, *plain, "--json", "--output", str(tmp_path)]) == 0
    found = json.loads(capsys.readouterr().out)
    measured = found["measured"]
    assert found["energy_wh"] == pytest.approx(measured["energy_wh"], rel=0.15)
    assert found["soc_start"] < 1
    if mode:
        assert found["kind"] == "ride (predictive)"
        assert measured["rms_speed_km_h"] < 1.5
        assert found["distance_km"] == pytest.approx(measured["distance_km"], rel=0.01)
    assert measured["rms_pack_voltage_v"] < 1.0
    assert [Path(f).suffix for f in found["files"]] == ([] if mode else [".parquet", ".png", ".png", ".png", ".html"])
