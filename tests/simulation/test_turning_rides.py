"""The turning models as a part of the scooter: steady turns, the ledger, what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from math import cos, radians

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.cli import main
from gz_onboard.constants import GRAVITY
from gz_onboard.errors import InputError
from gz_onboard.model.effect import load_effect
from gz_onboard.model.model import Model
from gz_onboard.model.parameters import read_parameters
from gz_onboard.simulation.parts.chassis import HARDEST, MODELS, chassis, steady_turn
from gz_onboard.simulation.run import drive, follow, road_table
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.simulation.turning.leaning import Leaning
from gz_onboard.simulation.turning.machine import Machine, RoadConditions
from gz_onboard.simulation.turning.planar import Planar
from gz_onboard.toml import Table
from gz_onboard.vehicle import find_vehicle, read_vehicle
from tests.simulation.turning.reference import held

VEHICLE = read_vehicle("reference", 80.0)
P = VEHICLE.parameters
TURNING = ("planar", "leaning")


@pytest.mark.parametrize("kind", [Planar, Leaning])
@pytest.mark.parametrize(("speed", "roll"), [(10.0, 5.0), (8.0, 25.0)])
def test_a_steady_turn_is_where_the_ridden_one_settles(kind, speed, roll):
    model = kind(Machine.of(P))
    ridden = held(model, radians(-roll), speed)
    state, steer = steady_turn(model, speed, ridden.seen["yaw_rate"])
    seen = model.rates(state, steer, None, RoadConditions()).seen
    for name in ("drive", "load_front", "slip_front", "slip_rear", "lean", "rolling_radius"):
        assert seen[name] == pytest.approx(ridden.seen[name], rel=1e-5)


@pytest.mark.parametrize("name", TURNING)
@pytest.mark.parametrize(("speed", "lateral"), [(10.0, 3.1), (7.3, 1.7), (11.0, -2.2)])
def test_the_scooter_rides_the_turn_of_the_model(name, speed, lateral):
    model = {"planar": Planar, "leaning": Leaning}[name](Machine.of(P))
    state, steer = steady_turn(model, speed, abs(lateral) / speed)
    seen = model.rates(state, steer, None, RoadConditions()).seen
    drag, _ = model.machine.resistance(speed, RoadConditions())
    expected = seen["drive"] - drag - model.machine.rolling(speed) * model.machine.mass * GRAVITY
    scooter = Scooter(VEHICLE, lambda _: (0.0, lateral / speed**2, 0.0), soc=0.8, speed=speed, chassis=chassis(name, P))
    run = drive(scooter, follow([speed] * 3000, 0.01), 30.0)
    assert scooter.speed == pytest.approx(speed, abs=0.05)
    before = scooter.ledger["turning"]
    way = scooter.distance
    for _ in range(100):
        scooter.step(scooter.throttle, 0.0)
    force = (scooter.ledger["turning"] - before) / (scooter.distance - way)
    assert force == pytest.approx(expected, rel=0.02)
    assert scooter.lean == pytest.approx(-seen["lean"] if lateral < 0 else seen["lean"], rel=0.02, abs=1e-9)
    assert scooter.front_load == pytest.approx(seen["load_front"], abs=6.0)
    rolled = scooter.speed / scooter.wheel_speed
    assert rolled == pytest.approx(seen["rolling_radius"], rel=0.006)  # slip beside
    assert abs(run.closure) < 1e-6


@pytest.mark.parametrize("name", TURNING)
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


def test_straight_on_all_are_alike():
    def ridden(name):
        return drive(Scooter(VEHICLE, soc=0.8, chassis=chassis(name, P)), follow([8.0] * 2000, 0.01), 20.0)

    assert ridden("planar").energy == ridden("leaning").energy == ridden("straight").energy
    assert "turning" not in ridden("leaning").ledger


def test_leaning_loses_more_than_planar_and_rolls_on_its_crown():
    bend = chassis("leaning", P), chassis("planar", P)
    for _ in range(400):
        leaning, planar = (part.turn(10.0, 0.03, 0.01) for part in bend)
    assert leaning.resistance > planar.resistance > 0
    assert planar.lean == 0
    assert leaning.lean < 0  # to the left, as the bend
    assert leaning.radius == pytest.approx(
        1 - P["tyre_crown_radius"] / P["wheel_radius"] * (1 - cos(leaning.lean)), rel=1e-4
    )


def test_beyond_the_models_edge_it_is_told_and_not_extrapolated():
    part = chassis("leaning", P)
    for _ in range(500):
        edge = part.turn(10.0, HARDEST / 100, 0.01)
    assert part.beyond == 0
    for _ in range(500):
        more = part.turn(10.0, 2 * HARDEST / 100, 0.01)
    assert part.beyond > 4
    assert more == pytest.approx(edge, rel=1e-3)


def test_never_counted_twice():
    effects = (*VEHICLE.model.effects, load_effect("cornering_drag"))
    parameters = read_parameters(Table.read(find_vehicle("reference")), effects)
    twice = replace(VEHICLE, parameters=parameters, model=Model(effects, parameters))
    Scooter(twice)
    with pytest.raises(InputError, match=r"reference\.toml: .*cornering_drag.*leaning.*twice"):
        Scooter(twice, chassis=chassis("leaning", parameters))


def test_unknown_chassis():
    with pytest.raises(InputError, match="did you mean 'leaning'"):
        chassis("leanign", P)


def test_simulate_takes_it(tmp_path, capsys):
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
