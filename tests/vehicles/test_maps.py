"""Efficiency maps: the loss models of the file, within the controller's limits, and measured points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gz_onboard.cli import main
from gz_onboard.errors import InputError
from gz_onboard.model.tables import Derating
from gz_onboard.vehicle import read_vehicle
from gz_onboard.vehicle_check.maps import BOTH, INVERTER, MOTOR, efficiency_maps, fit_of, modelled, shares
from tests.support import LOGS

DYNO = LOGS / "calibration" / "motor_dyno.csv.gz"


@pytest.fixture(scope="module")
def vehicle():
    return read_vehicle("reference")


def test_shares_of_power_both_ways():
    powers = [
        np.array(p) for p in ([800.0, -1000.0, -20.0, 0.0], [1000.0, -800.0, 50.0, 10.0], [1250, -600.0, 80.0, 30.0])
    ]
    found = shares(*powers)
    np.testing.assert_allclose(found.motor, [0.8, 0.8, np.nan, np.nan])
    np.testing.assert_allclose(found.inverter, [0.8, 0.75, 0.625, 1 / 3])
    np.testing.assert_allclose(found.both, [0.64, 0.6, np.nan, np.nan])


def test_a_point_is_what_its_losses_say(vehicle):
    speed, torque, warm = (np.array([x]) for x in (40.0, 30.0, 60.0))
    p = vehicle.parameters
    iron = p["motor_iron_linear"] * 40 + p["motor_iron_quadratic"] * 1600
    current = (30 + iron / 40) / p["torque_constant"]
    resistance = p["motor_copper_resistance"] * (1 + p["motor_copper_frequency"] * 1600)
    copper = resistance * (1 + p["motor_copper_temperature_coefficient"] * 35) * current**2
    alternating = 1200 + iron + copper
    constant, linear, square = (p[f"inverter_loss_{name}"] for name in ("constant", "linear", "quadratic"))
    direct = alternating + constant + linear * current + square * current**2
    found = modelled(vehicle, speed, torque, warm)
    assert found.motor == pytest.approx(1200 / alternating, rel=1e-4)
    assert found.inverter == pytest.approx(alternating / direct, rel=1e-4)
    assert found.both == pytest.approx(found.motor * found.inverter)


def test_the_map_ends_where_the_controller_does(vehicle):
    maps = efficiency_maps(vehicle, [])
    shown = np.isfinite(maps.efficiency.both)
    x, y = np.meshgrid(maps.speed, maps.torque)
    assert not shown[(y > maps.most) | (y < maps.least)].any()
    assert shown[(y < maps.most) & (y > 5)].all()
    assert maps.speed[-1] == vehicle.derating.current_by_motor_speed.x[-1]
    limit = vehicle.parameters["torque_constant"] * vehicle.parameters["motor_current_limit"]
    assert 0.97 * limit < maps.most.max() < limit  # less the drag
    assert not shown[(x < 7) & (y < -3)].any()  # it does not regenerate that slowly


def test_measured_points_are_where_the_map_says(vehicle):
    maps = efficiency_maps(vehicle, [DYNO, LOGS / "city_34C.blf"])
    found = {(part, source): (count, rms, r2) for part, source, count, rms, r2 in fit_of(vehicle, maps)}
    assert found[MOTOR, DYNO.name][0] > 100
    motor_r2 = found[MOTOR, DYNO.name][2]
    assert motor_r2
    assert motor_r2 > 0.98
    assert found[INVERTER, DYNO.name][1] < 0.01
    count, rms, r2 = found[BOTH, "city_34C.blf"]
    assert count > 20
    assert rms < 0.03
    assert r2 is None
    worse = vehicle.parameters.replaced(inverter_loss_constant=120.0)
    other = vehicle.changed(worse)
    wrong = {(part, source): rms for part, source, _, rms, _ in fit_of(other, efficiency_maps(other, [DYNO]))}
    assert wrong[INVERTER, DYNO.name] > 0.02


def test_without_a_controller_the_measured_speeds_are_the_limit(vehicle, tmp_path):
    free = replace(vehicle, derating=Derating())
    assert efficiency_maps(free, [DYNO]).speed[-1] == pytest.approx(56.5, abs=1)
    with pytest.raises(InputError, match=r"how fast the motor turns.*give --top-speed, or a ride"):
        efficiency_maps(free, [])
    fast = efficiency_maps(free, [], top_speed=20.0)
    assert fast.speed[-1] * vehicle.parameters["wheel_radius"] == pytest.approx(20.0)
    assert np.isfinite(fast.efficiency.both[len(fast.torque) // 2, -1])


def test_the_command_draws_it(tmp_path, capsys):
    assert main(["vehicle", "maps", "reference", str(DYNO), "--output", str(tmp_path), "--format", "svg"]) == 0
    told = capsys.readouterr().out
    assert "inverter: 153 points of motor_dyno.csv.gz" in told
    picture = tmp_path / "reference-scooter.maps.svg"
    assert str(picture) in told
    text = picture.read_text()
    assert "efficiency [%]" in text
    assert text.count("motor speed [rad/s]") == 3


def test_what_has_no_points_is_told(vehicle, tmp_path, capsys):
    ride = tmp_path / "ride.csv"
    ride.write_text("time [s],speed [m/s]\n0,1\n1,1\n2,1\n")
    assert main(["vehicle", "maps", "reference", str(ride)]) == 2
    assert "ride.csv: has no motor_current" in capsys.readouterr().err
    assert main(["vehicle", "maps", "reference", str(LOGS / "coastdown.blf")]) == 2
    assert "coastdown.blf: has too little steady riding" in capsys.readouterr().err
