"""The road load that is learned on board: the cause that is there is found, and no other."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from math import cos, exp, inf, pi, sin, sqrt
from typing import Any

import numpy as np
import pytest

from gz_onboard.estimator.estimator import Estimator
from gz_onboard.estimator.load_model import Conditions, LoadModel
from gz_onboard.estimator.ridden import RIDE_ENDS
from gz_onboard.estimator.road_load import NAMES, NEW_DAY, RoadLoad, Surroundings
from gz_onboard.estimator.road_slopes import PARAMETERS
from gz_onboard.estimator.spans import Second
from gz_onboard.physics.model import Model
from gz_onboard.vehicle import read_vehicle
from tests.estimator import life

VEHICLE = read_vehicle("reference")
FILED = VEHICLE.parameters
AIR = Conditions(20.0, 0.0)
HILLS, HEIGHT = 700.0, 0.02  # m, sine
GRADE_ERROR, GRADE_LENGTH = 0.004, 200.0  # sine, m: sd of the grade's error, over which it is alike


def road_load() -> RoadLoad:
    return RoadLoad(LoadModel(VEHICLE.model, VEHICLE.pack, VEHICLE.riding))


@dataclass
class Rider:
    """Rides a scooter whose parameters are other than the file's: what its sensors show, second by second."""

    changes: dict[str, float] = field(default_factory=dict)  # of the file's parameters
    power_factor: float = 1.0  # of the sensor
    steady: float | None = None  # m/s: at this speed, on the flat, without a stop
    headwind: float = 0.0  # m/s
    seed: int = 1

    def __post_init__(self) -> None:
        self.model = Model(VEHICLE.model.effects, FILED.replaced(**self.changes))
        self.rng = np.random.default_rng(self.seed)
        self.x = self.error = 0.0
        self.v = self.steady or 0.0
        self.left = 20.0

    def second(self) -> Second:
        """The next; its grade is told five seconds late, as the estimator's is."""
        wish = self.steady or (0.0 if self.left > 0 else 9.0 + 3.5 * sin(self.x / 230.0))
        before, self.left = self.v, self.left - 1
        if not self.steady and self.left < -45 - 20 * sin(self.x):  # another red light
            wish, self.left = 0.0, self.left if self.v > 1.0 else 20.0
        rate = min(max(0.5 * (wish - self.v), -1.4), 1.1)
        self.v = max(self.v + rate, 0.0) if self.steady is None else self.steady
        way = (before + self.v) / 2
        grade = 0.0 if self.steady else HEIGHT * cos(2 * pi * self.x / HILLS)
        self.x += way
        keep = exp(-way / GRADE_LENGTH)
        self.error = keep * self.error + GRADE_ERROR * sqrt(1 - keep * keep) * self.rng.normal()
        power = self._power(before, way, grade if way > 0.1 else 0.0) * (1 + 0.02 * self.rng.normal())
        lagging = 0.0 if self.steady else HEIGHT * cos(2 * pi * (self.x - way * 5.5) / HILLS)
        braked = self.v < before - 0.1 or self.v == 0.0
        return Second(1.0, way, self.power_factor * power, before, self.v, lagging + self.error, 0.0, braked)

    def _power(self, before: float, way: float, grade: float) -> float:
        q = LoadModel(self.model, VEHICLE.pack, VEHICLE.riding).quantities(way, self.v - before, AIR)
        q |= {"grade": grade, "grade_cosine": sqrt(1 - grade * grade), "headwind": self.headwind * (way > 0)}
        return float(sum(self.model.power(q).values()))


def ride(rider: Rider, seconds: int = 1800, load: RoadLoad | None = None) -> RoadLoad:
    load = load or road_load()
    for _ in range(seconds):
        load.ride(rider.second(), lambda: Surroundings(AIR, None, 0.0, 0.3 * rider.x / 100))
    return load


def off(load: RoadLoad, **true: float) -> dict[str, float]:
    """By how many sd each is off; of what is not in `true` the file's."""
    names = dict(zip(NAMES, PARAMETERS, strict=True))
    return {k: (x.value - true.get(names[k], FILED[names[k]])) / x.sd for k, x in load.learned().items()}


# --- what is there is found ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"payload_mass": 115.0}, "mass"),
        ({"payload_mass": 55.0}, "mass"),
        ({"drag_area": 0.75}, "drag"),
        ({"rolling_resistance_constant": 0.018}, "rolling"),
        ({"auxiliary_power": 105.0}, "auxiliaries"),
    ],
    ids=["heavy", "light", "big", "soft tyre", "lights"],
)
def test_what_is_other_than_filed_is_found_and_nothing_else(changes: dict[str, float], cause: str):
    load = ride(Rider(changes))
    assert max(map(abs, off(load, **changes).values())) < 2
    moved = off(load)
    assert abs(moved[cause]) > 1.5
    assert abs(moved[cause]) == max(map(abs, moved.values()))
    assert load.learned()[cause].share > 0.4
    assert all(abs(z) < 2 for name, z in moved.items() if name != cause)


def test_nothing_moves_on_a_ride_as_filed():
    load = ride(Rider())
    assert max(map(abs, off(load).values())) < 2
    assert load.learned()["mass"].share > 0.6


def test_at_one_speed_on_the_flat_nothing_is_told_of_the_mass():
    """Rolling and drag: what both take together, by their covariance; neither by itself."""
    load = ride(Rider({"payload_mass": 115.0}, steady=11.0))
    learned = load.learned()
    assert learned["mass"].share < 0.05
    assert abs(learned["mass"].value - FILED["payload_mass"]) < 3.0
    assert max(learned["rolling"].share, learned["drag"].share) < 0.5
    assert load.correlations()["rolling", "drag"] < -0.4
    assert max(abs(z) for name, z in off(load).items() if name != "mass") < 2


def test_a_head_wind_that_stays_is_not_taken_for_weight():
    load = ride(Rider(headwind=3.0))
    assert abs(off(load)["mass"]) < 2
    calm = ride(Rider())
    assert load.learned()["drag"].value > calm.learned()["drag"].value


def test_a_load_that_is_switched_on_is_seen_at_the_next_stops():
    load = ride(Rider(), 900)
    lit = ride(Rider({"auxiliary_power": 105.0}, seed=2), 900, load)
    assert lit.learned()["auxiliaries"].value == pytest.approx(105.0, abs=12.0)
    assert abs(off(lit)["mass"]) < 2


# --- rides and days --------------------------------------------------------------------------------------------------


def test_a_new_day_has_another_rider_unless_he_is_known():
    load = ride(Rider({"payload_mass": 115.0}))
    found = load.learned()["mass"]
    load.rest(1800.0)
    assert load.learned()["mass"].value == found.value
    assert found.sd < load.learned()["mass"].sd < 9
    load.rest(NEW_DAY)
    assert load.learned()["mass"].value == FILED["payload_mass"]
    assert load.learned()["mass"].share == 0
    assert load.learned()["drag"].share > 0.2


def test_who_is_known_has_his_mass_again():
    load = road_load()
    load.ridden_by("anna")
    ride(Rider({"payload_mass": 60.0}), load=load)
    load.ridden_by("ben")
    assert load.learned()["mass"].share == 0
    ride(Rider({"payload_mass": 110.0}), load=load)
    load.rest(NEW_DAY)
    load.ridden_by("anna")
    assert load.learned()["mass"].value == pytest.approx(60.0, abs=10.0)


# --- doubts ----------------------------------------------------------------------------------------------------------


def test_what_a_faulty_sensor_taught_is_forgotten():
    load = ride(Rider({"payload_mass": 110.0}), 1200)
    load.rest(700.0)
    before = load.learned()
    ride(Rider({"payload_mass": 110.0}, power_factor=1.3), 100, load)
    assert load.learned() != before
    load.unlearn()
    assert load.learned() == before


def test_residuals_beyond_their_noise_teach_little():
    quiet = ride(Rider(), 900)
    rider = Rider()
    load, bad = road_load(), np.random.default_rng(3)
    for _ in range(900):
        second = rider.second()
        second.energy *= 1 + 0.5 * bad.normal()
        load.ride(second, lambda: Surroundings(AIR, None, 0.0, 0.0))
    assert all(load.learned()[name].share < quiet.learned()[name].share - 0.07 for name in ("mass", "drag"))
    assert abs(off(load)["mass"]) < 2


def live(e: Estimator, gain: float, seconds: float) -> None:
    """A ride whose pack current is shown `gain` times too large; the inverter's is right."""
    scooter = life.Scooter(seed=4)
    for time, group, values in scooter.live(seconds, 10.0):
        if group == life.PACK:
            voltage, current, own = values
            assert current is not None
            e.handle((time, group, (voltage, gain * current, own)))
        else:
            e.handle((time, group, values))


def test_a_current_sensor_that_is_off_is_refused():
    e = life.estimator()
    live(e, 1.06, 500.0)
    assert not e.road_load.learning
    mass = e.road_load.learned()["mass"]
    assert abs(mass.value - life.VEHICLE.parameters["payload_mass"]) < 2 * mass.sd


# --- saving ----------------------------------------------------------------------------------------------------------


def again(load: RoadLoad, saved: Any) -> RoadLoad:
    load.take(load.read(saved))
    return load


def test_it_goes_on_from_what_was_saved():
    load = ride(Rider({"drag_area": 0.7}))
    saved = json.loads(json.dumps(load.snapshot()))
    restored = again(road_load(), saved)
    assert restored.learned() == load.learned()
    assert restored.snapshot().keys() == saved.keys()


def test_what_was_learned_of_another_file_is_forgotten():
    saved = ride(Rider({"payload_mass": 115.0}), 600).snapshot()
    saved["of"][1] *= 1.1
    assert again(road_load(), saved).learned() == road_load().learned()
    assert again(road_load(), None).learned() == road_load().learned()


def entered(payload: float) -> RoadLoad:
    vehicle = read_vehicle("reference", payload=payload)
    return RoadLoad(LoadModel(vehicle.model, vehicle.pack, vehicle.riding))


def test_what_was_learned_outlives_the_payload_of_its_day():
    load = ride(Rider({"payload_mass": 110.0, "drag_area": 0.7}), load=entered(110.0))
    saved = json.loads(json.dumps(load.snapshot()))
    tomorrow = again(road_load(), saved).learned()
    assert [tomorrow[name] for name in NAMES[1:]] == [load.learned()[name] for name in NAMES[1:]]
    assert tomorrow["mass"].value == pytest.approx(110.0, abs=5.0)  # nothing else is known of it
    other = again(entered(60.0), saved).learned()
    assert (other["mass"].value, other["mass"].share, other["mass"].entered) == (60.0, 0.0, True)
    assert other["drag"] == load.learned()["drag"]


def test_a_payload_that_is_entered_is_that_of_who_rides_and_nobody_else_s():
    load = road_load()
    load.ridden_by("anna")
    ride(Rider({"payload_mass": 60.0}), load=load)
    known = load.learned()["mass"].value
    today = again(entered(110.0), load.snapshot())
    assert today.learned()["mass"].value == 110.0
    today.ridden_by("ben")
    assert today.learned()["mass"].value == 110.0
    tomorrow = again(road_load(), today.snapshot())
    tomorrow.ridden_by("anna")
    assert tomorrow.learned()["mass"].value == pytest.approx(known)


def test_a_payload_as_filed_that_is_entered_is_known_better_than_what_was_learned():
    load = ride(Rider({"payload_mass": 115.0}))
    assert load.learned()["mass"].value > 100
    assert again(entered(FILED["payload_mass"]), load.snapshot()).learned()["mass"].value == FILED["payload_mass"]


@pytest.mark.parametrize(
    "change",
    [
        {"means": [0.0]},
        {"rows": [inf] * 55},
        {"rows": [-1.0] * 55},
        {"noise": 0.0},
        {"still": -1.0},
        {"of": [1.0]},
        {"of": [inf, *road_load().snapshot()["of"][1:]]},
        {"riders": {"a": [1.0]}},
        {"riders": {"a": [0.0, -1.0]}},
        {"means": None},
    ],
    ids=str,
)
def test_a_damaged_snapshot_is_refused(change: dict[str, Any]):
    with pytest.raises((ValueError, TypeError, KeyError, AttributeError)):
        road_load().read(road_load().snapshot() | change)


def test_the_estimator_keeps_it_over_a_restart_and_takes_none_of_a_damaged_state():
    e = life.estimator()
    scooter = life.Scooter()
    life.follow(e, scooter.live(120.0, 10.0), scooter)
    ride(Rider({"drag_area": 0.7}), load=e.road_load)
    saved = json.loads(json.dumps(e.snapshot("key")))
    restored = life.estimator()
    restored.restore(saved, "key", 60.0)
    assert restored.road_load.learned() == e.road_load.learned()
    later = life.estimator()
    later.restore(saved, "key", None)
    assert later.road_load.learned()["mass"].share == 0
    assert later.road_load.learned()["drag"].share > 0.2
    assert later.forecaster.riding.still >= RIDE_ENDS > restored.forecaster.riding.still
    saved["learned"]["road"]["means"] = [0.0]
    refusing = life.estimator()
    with pytest.raises(ValueError, match="its road holds implausible numbers"):
        refusing.restore(saved, "key", 60.0)
    assert refusing.road_load.learned() == life.estimator().road_load.learned()
    del saved["learned"]["road"]  # of an earlier version
    refusing.restore(saved, "key", 60.0)
    assert refusing.road_load.learned()["drag"].share == 0
