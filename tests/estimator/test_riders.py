"""What is usual is learned of each rider."""

from __future__ import annotations

import json

import pytest

from gz_onboard.estimator.consumption import CONSUMPTION, Segment
from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.events import Group
from tests.estimator.life import BATTERY, VEHICLE, estimator


def forecaster() -> Forecaster:
    return Forecaster(VEHICLE.model, BATTERY, VEHICLE.riding)


def rides(f: Forecaster, price: float, km: int = 40) -> None:
    """At `price` times what the model says of the prior riding, and a rest after it."""
    learner, habits = f.learner, f.learner.state.habits
    for _ in range(int(km * 1000 / CONSUMPTION.segment_m)):
        habits = habits._replace(price=habits.price.learned(price - habits.price.now, CONSUMPTION.segment_m))
    sums = Segment(distance=CONSUMPTION.segment_m, duration=20.0)
    learner.state = learner.state._replace(habits=habits, sums=sums)


def test_each_rider_has_a_price_and_it_is_kept():
    f = forecaster()
    for _ in range(6):
        for name, price in (("anna", 0.9), ("ben", 1.3)):
            f.ridden_by(name)
            rides(f, price)
    f.ridden_by("anna")
    assert f.learner.state.habits.price.level == pytest.approx(0.9, abs=0.05)
    assert not f.learner.state.sums.distance, "riding of another rider tells nothing"
    restored = forecaster()
    restored.restore(json.loads(json.dumps(f.snapshot())))
    assert restored.learner.rider == "anna"
    restored.ridden_by("ben")
    assert restored.learner.state.habits.price.level == pytest.approx(1.3, abs=0.05)


def test_who_never_rode_is_taken_for_the_one_before_but_less_surely():
    f = forecaster()
    f.ridden_by("anna")
    rides(f, 1.2)
    known = f.learner.state.habits.next_ride()
    f.ridden_by("ben")
    price = f.learner.state.habits.price
    assert price.level == pytest.approx(known.price.level)
    assert price.level_variance == pytest.approx(known.price.level_variance + CONSUMPTION.level_sd**2)
    assert f.learner.state.habits.factor == known.factor, "errors of the parameters are the vehicle's"


def test_riders_do_not_fill_the_state():
    f = forecaster()
    for number in range(3 * CONSUMPTION.max_riders):
        f.ridden_by(str(number))
    assert len(f.learner.other_riders) <= CONSUMPTION.max_riders
    forecaster().restore(json.loads(json.dumps(f.snapshot())))


def test_a_signal_names_the_rider_while_the_vehicle_stands():
    e = estimator([Group("Key", ("rider",), 1.0), Group("Wheel", ("vehicle_speed",), 0.1)])
    e.handle((0.0, 1, (10.0,)))
    for step in range(20):
        now = 0.1 * step
        e.handle((now, 0, (7.0,)))
        e.handle((now + 0.05, 1, (10.0,)))
    assert e.forecaster.learner.rider == ""
    for step in range(50):
        now = 3.0 + 0.1 * step
        e.handle((now, 0, (7.0,)))
        e.handle((now + 0.05, 1, (0.0,)))
    assert e.forecaster.learner.rider == "7"
