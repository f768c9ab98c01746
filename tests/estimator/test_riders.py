"""What is usual is learned of each rider."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.estimator.ridden import Segment
from gz_onboard.estimator.riders import LONGEST_NAME, MOST_RIDERS
from gz_onboard.estimator.usual import LEVEL_SD, SEGMENT
from gz_onboard.events import Group
from tests.estimator.life import BATTERY, VEHICLE, estimator


def forecaster() -> Forecaster:
    return Forecaster(VEHICLE.model, BATTERY.own(), VEHICLE.riding)


def rides(f: Forecaster, price: float, km: int = 40) -> None:
    """At `price` times what the model says of the prior riding, and a rest after it."""
    r = f.riding
    for _ in range(int(km * 1000 / SEGMENT)):
        r.usual = replace(r.usual, price=r.usual.price.learned(price - r.usual.price.now, SEGMENT))
    r.segments.append(Segment(distance=SEGMENT, duration=20.0))


def test_each_rider_has_a_price_and_it_is_kept():
    f = forecaster()
    for _ in range(6):
        for name, price in (("anna", 0.9), ("ben", 1.3)):
            f.ridden_by(name)
            rides(f, price)
    f.ridden_by("anna")
    assert f.riding.usual.price.usual == pytest.approx(0.9, abs=0.05)
    assert not f.riding.segments, "what another rode is no likeness"
    restored = forecaster()
    restored.restore(json.loads(json.dumps(f.snapshot())))
    assert restored.riders.now == "anna"
    restored.ridden_by("ben")
    assert restored.riding.usual.price.usual == pytest.approx(1.3, abs=0.05)


def test_who_never_rode_is_taken_for_the_one_before_but_less_surely():
    f = forecaster()
    f.ridden_by("anna")
    rides(f, 1.2)
    known = f.riding.usual.rested()
    f.ridden_by("ben")
    price = f.riding.usual.price
    assert price.usual == pytest.approx(known.price.usual)
    assert price.usual_variance == pytest.approx(known.price.usual_variance + LEVEL_SD**2)
    assert f.riding.usual.factor == known.factor, "what the parameters have wrong is the vehicle's"


def test_the_same_rider_again_changes_nothing():
    f = forecaster()
    f.ridden_by("anna")
    rides(f, 1.2)
    before = f.snapshot()
    f.ridden_by("anna")
    assert f.snapshot() == before


def test_riders_do_not_fill_the_state():
    f = forecaster()
    for number in range(3 * MOST_RIDERS):
        f.ridden_by(str(number))
    assert len(f.riders.others) <= MOST_RIDERS
    forecaster().restore(json.loads(json.dumps(f.snapshot())))


@pytest.mark.parametrize(
    "damage",
    [
        {"rider": 3},
        {"rider": "x" * (LONGEST_NAME + 1)},
        {"riders": {"anna": {}}},
        {"riders": {"ben": 1}},
        {"riders": 7},
    ],
)
def test_damaged_riders_are_refused_whole(damage):
    f = forecaster()
    f.ridden_by("anna")
    saved = f.snapshot()
    before = forecaster()
    unchanged = before.snapshot()
    with pytest.raises((KeyError, TypeError, ValueError, AttributeError)):
        before.restore({**saved, **damage})
    assert before.snapshot() == unchanged


def test_a_signal_names_the_rider_while_the_vehicle_stands():
    e = estimator([Group("Key", ("rider",), 1.0), Group("Wheel", ("vehicle_speed",), 0.1)])
    e.handle((0.0, 1, (10.0,)))
    for step in range(20):
        now = 0.1 * step
        e.handle((now, 0, (7.0,)))
        e.handle((now + 0.05, 1, (10.0,)))
    assert e.forecaster.riders.now == ""
    for step in range(50):
        now = 3.0 + 0.1 * step
        e.handle((now, 0, (7.0,)))
        e.handle((now + 0.05, 1, (0.0,)))
    assert e.forecaster.riders.now == "7"
