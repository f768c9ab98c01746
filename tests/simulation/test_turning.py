"""Turning chassis: steady turns against equations written apart, tyre and lean geometry, and rides in bends."""

from __future__ import annotations

import json
from dataclasses import replace
from math import asin, atan, cos, degrees, radians, sin

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.cli import main
from gz_onboard.errors import InputError
from gz_onboard.model.effect import load_effect
from gz_onboard.model.effects import cornering_drag
from gz_onboard.model.model import Model
from gz_onboard.model.parameters import read_parameters
from gz_onboard.simulation.parts import road_table
from gz_onboard.simulation.run import drive, follow
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.simulation.turning import (
    HARDEST,
    MODELS,
    Chassis,
    TwoWheeler,
    chassis,
    front_camber,
    ground_steer,
    lean_of,
    side_force,
)
from gz_onboard.toml import Table
from gz_onboard.vehicle import find_vehicle, read_vehicle
from tests.simulation.turning_equations import front_wheel, steady_turn

VEHICLE = read_vehicle("reference", 80.0)
P = VEHICLE.parameters
ANGLES = st.floats(-0.7, 0.7)
CASES = [(12.0, 5.0), (12.0, 30.0), (8.0, 20.0), (5.0, 10.0), (5.0, 30.0)]


@pytest.mark.parametrize(("speed", "roll"), CASES)
@pytest.mark.parametrize("leans", [False, True])
def test_steady_turn_is_the_equilibrium_of_the_equations(speed, roll, leans):
    expected = steady_turn(P, speed, radians(roll), upright=not leans)
    turn = TwoWheeler(P, leans).steady(speed, -expected.yaw_rate)
    for ours, theirs in zip(
        (*turn.slip, *turn.side, turn.steer),
        (expected.slip_front, expected.slip_rear, expected.side_front, expected.side_rear, expected.handlebar),
        strict=True,
    ):
        assert -ours == pytest.approx(theirs, rel=1e-7, abs=1e-9)
    assert turn.load == pytest.approx((expected.load_front, expected.load_rear), rel=1e-8)
    assert turn.drive == pytest.approx(expected.drive, rel=1e-8)
    assert turn.sideslip + turn.twisting == pytest.approx(expected.losses, rel=1e-8)
    if leans:
        assert turn.lean == pytest.approx(radians(roll), rel=1e-8)


@pytest.mark.parametrize(("speed", "roll"), CASES)
def test_gyroscopes_and_the_smaller_circle_of_the_mass_would_change_little(speed, roll):
    ours, full = (steady_turn(P, speed, radians(roll), full=full) for full in (False, True))
    assert full.yaw_rate == pytest.approx(ours.yaw_rate, rel=0.05 if speed < 6 else 0.02)
    assert full.losses == pytest.approx(ours.losses, rel=0.02)


@pytest.mark.parametrize("lateral", [0.3, 0.7, 1.4])
def test_planar_loss_is_the_closed_form(lateral):
    """P = u·(m·a_y)²·(s_f²/C_αf + s_r²/C_αr), the slip of small angles, for each axle with the load it has."""
    machine, share = TwoWheeler(P, False), P["cg_to_rear"] / P["wheelbase"]
    turn = machine.steady(10.0, lateral / 10.0)
    stiff = [P[f"cornering_stiffness_{axle}"] * load for axle, load in zip(("front", "rear"), turn.load, strict=True)]
    expected = 10.0 * (machine.mass * lateral) ** 2 * (share**2 / stiff[0] + (1 - share) ** 2 / stiff[1])
    assert turn.sideslip == pytest.approx(expected, rel=0.002 + 0.002 * lateral**2)
    compliance = share / P["cornering_stiffness_front"] + (1 - share) / P["cornering_stiffness_rear"]
    drag = cornering_drag.term(10.0, machine.mass, lateral, cornering_compliance=compliance)
    assert drag * 10.0 == pytest.approx(expected, rel=0.01)  # the effect has the static loads


@given(slip=st.floats(-1.5, 1.5), camber=ANGLES)
def test_side_force_is_odd_linear_at_first_and_within_grip(slip, camber):
    force = side_force(slip, camber, 15.0, 0.85, 1.2)
    assert abs(force) <= 1.2
    assert side_force(-slip, -camber, 15.0, 0.85, 1.2) == -force
    small = side_force(slip / 1e4, camber / 1e4, 15.0, 0.85, 1.2)
    assert small == pytest.approx((15.0 * slip + 0.85 * camber) / 1e4, rel=1e-4, abs=1e-12)


def test_published_leans():
    """10 m/s on a circle of 10 m: 45.6 degrees as a thin disc (a worked example of many texts)."""
    ideal = atan(10**2 / (9.80665 * 10))
    assert degrees(ideal) == pytest.approx(45.6, abs=0.05)
    # Cossalter 2006, sec. 4.1: Δφ = asin(t·sin φ_i/(h - t)).
    assert lean_of(ideal, 0.1, 0.6) - ideal == pytest.approx(asin(0.1 * sin(ideal) / 0.5), rel=1e-12)


@given(handlebar=ANGLES, lean=ANGLES, caster=st.floats(0.1, 0.8))
def test_front_wheel_is_a_turned_and_rolled_wheel(handlebar, lean, caster):
    """Our lean is positive right and our steer positive left; the reference has both positive right."""
    steer, camber = front_wheel(-handlebar, lean, caster)
    assert ground_steer(handlebar, lean, caster) == pytest.approx(-steer, abs=1e-12)
    assert front_camber(handlebar, lean, caster) == pytest.approx(-camber, abs=1e-12)
    p = {**dict(P), "caster_angle": caster}
    ours = TwoWheeler(p, True).handlebar(ground_steer(handlebar, lean, caster), lean)
    assert ours == pytest.approx(handlebar, abs=1e-12)


# --- rides ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["planar", "leaning"])
@pytest.mark.parametrize(("speed", "lateral"), [(10.0, 3.1), (7.3, 1.7), (11.0, -2.2)])
def test_the_scooter_rides_the_steady_turn(name, speed, lateral):
    machine = TwoWheeler(P, name == "leaning")
    turn, straight = machine.steady(speed, lateral / speed), machine.steady(speed, 1e-9)
    scooter = Scooter(VEHICLE, lambda _: (0.0, lateral / speed**2, 0.0), soc=0.8, speed=speed, chassis=chassis(name, P))
    run = drive(scooter, follow([speed] * 3000, 0.01), 30.0)
    assert scooter.speed == pytest.approx(speed, abs=0.05)
    before, way = scooter.ledger["turning"], scooter.distance
    for _ in range(100):
        scooter.step(scooter.throttle, 0.0)
    force = (scooter.ledger["turning"] - before) / (scooter.distance - way)
    assert force == pytest.approx(turn.drive - straight.drive, rel=0.02)
    assert scooter.lean == pytest.approx(turn.lean, rel=0.02, abs=1e-9)
    assert scooter.front_load == pytest.approx(turn.load[0], abs=6.0)
    radius = P["wheel_radius"] - P["tyre_crown_radius"] * (1 - cos(turn.lean))
    assert scooter.speed / scooter.wheel_speed == pytest.approx(radius, rel=0.006)  # and some slip
    assert abs(run.closure) < 1e-6


@pytest.mark.parametrize("name", ["planar", "leaning"])
@settings(max_examples=8, deadline=None)
@given(
    bends=st.lists(st.floats(-0.15, 0.15), min_size=2, max_size=8),
    speed=st.floats(2.0, 11.0),
    grade=st.floats(-0.05, 0.05),
)
def test_the_ledger_closes_through_bends(name, bends, speed, grade):
    road = road_table([15.0 * i for i in range(len(bends))], [grade] * len(bends), bends)
    run = drive(Scooter(VEHICLE, road, soc=0.8, chassis=chassis(name, P)), follow([speed] * 1500, 0.01), 15.0)
    assert abs(run.closure) < 1e-4
    assert run.ledger.get("turning", 0.0) >= 0.0


def test_straight_on_all_chassis_are_alike():
    def ridden(name):
        return drive(Scooter(VEHICLE, soc=0.8, chassis=chassis(name, P)), follow([8.0] * 2000, 0.01), 20.0)

    assert ridden("planar").energy == ridden("leaning").energy == ridden("straight").energy
    assert "turning" not in ridden("leaning").ledger


def test_beyond_the_table_its_edge_is_taken_and_the_time_reported():
    part = Chassis("leaning", P)
    for _ in range(500):
        edge = part.turn(10.0, HARDEST / 100, 0.01)
    assert part.beyond == 0
    for _ in range(500):
        more = part.turn(10.0, 2 * HARDEST / 100, 0.01)
    assert part.beyond > 4
    assert more == pytest.approx(edge, rel=1e-3)


def test_a_turning_loss_is_never_counted_twice():
    effects = (*VEHICLE.model.effects, load_effect("cornering_drag"))
    parameters = read_parameters(Table.read(find_vehicle("reference")), effects)
    twice = replace(VEHICLE, parameters=parameters, model=Model(effects, parameters))
    Scooter(twice)
    with pytest.raises(InputError, match=r"reference\.toml: .*cornering_drag.*leaning.*twice"):
        Scooter(twice, chassis=chassis("leaning", parameters))


def test_simulate_takes_a_chassis(tmp_path, capsys):
    file = tmp_path / "bends.route.csv"
    rows = [f"{10 * i},100,{0.04 if 10 < i < 30 else 0.0},8.0\n" for i in range(60)]
    file.write_text("distance_m,altitude_m,curvature_1pm,speed_limit_mps\n" + "".join(rows))
    found = {}
    for name in MODELS:
        arguments = [file, "--chassis", name, "--json", "--no-plot", "--no-series", "--output", tmp_path]
        assert main(["simulate", *map(str, arguments)]) == 0
        found[name] = json.loads(capsys.readouterr().out)
        assert found[name]["chassis"] == name
    assert "turning" not in found["straight"]["ledger_wh"]
    assert found["leaning"]["ledger_wh"]["turning"] > found["planar"]["ledger_wh"]["turning"] > 0.05
    assert found["leaning"]["energy_wh"] > found["straight"]["energy_wh"] + 0.05
    assert main(["simulate", "ece15", "--chassis", "planar", "--output", str(tmp_path)]) == 2
    assert "no bends" in capsys.readouterr().err
