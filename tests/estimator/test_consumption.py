"""The filters of the learner: how well they know what they know."""

from __future__ import annotations

import json
from math import sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.estimator.consumption import CONSUMPTION, Habits, LearnedQuantity, Terrain
from gz_onboard.estimator.forecast import Forecaster, RangeSmoother
from gz_onboard.estimator.load_model import Conditions
from gz_onboard.model.riding import PriorRiding
from gz_onboard.vehicle import read_vehicle

VEHICLE = read_vehicle("reference", 75.0)


def quantity_of(level_sd, ride_sd, segment_sd):
    """A quantity near 1 of which nothing is learned yet."""
    return LearnedQuantity(1.0, level_sd**2, ride_sd**2, segment_sd**2, deviation=0.0, deviation_variance=ride_sd**2)


def test_a_quantity_knows_how_well_it_knows():
    """Rides drawn from its own model: the errors of what it expects have the variance that it states."""
    rng = np.random.default_rng(1)
    normalised = []
    for _ in range(150):
        usual = rng.normal(1.0, 0.15)
        quantity = quantity_of(0.15, 0.06, 0.2)
        for _ in range(6):
            level = usual + rng.normal(0, 0.06)
            for _ in range(20):
                quantity = quantity.learned(level + rng.normal(0, 0.2) - quantity.now, 250.0)
            quantity = quantity.next_ride()
        normalised.append((quantity.level - usual) / np.sqrt(quantity.level_variance))
    assert 0.8 < np.std(normalised) < 1.25
    assert abs(np.mean(normalised)) < 0.25


@pytest.mark.parametrize(("before", "most"), [(5, 16.0), (20, 16.0), (40, 16.0)])
def test_a_fifth_more_consumption_is_followed_within_the_stated_distance(before, most):
    """A headwind that stays: 63 % of it is in the range shown after at most so many km, in the mean over rides."""
    rng = np.random.default_rng(3)
    found = []
    for _ in range(80):
        quantity, smoother = quantity_of(0.17, 0.055, 0.2), RangeSmoother()
        for k in range(4 * 70):
            quantity = quantity.learned((1.0 if k < 4 * before else 1.2) + rng.normal(0, 0.17) - quantity.now, 250.0)
            left = 100_000 - 250.0 * k  # as though it lasted for long
            ridden = 250.0 if k else 0.0
            found.append(
                smoother.follow(left / quantity.ahead(left)[0], 90.0 * left, quantity.known_from, ridden) / left
            )
    price = 1 / np.mean(np.reshape(found, (80, -1)), axis=0)
    late = price[4 * before :]
    reached = np.argmax(late > 1 + 0.63 * 0.2) / 4
    assert 0 < reached < most


ANY = st.floats(-1e9, 1e9)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(ANY, st.floats(1.0, 1e5), st.floats(0.0, 1e12)), min_size=1, max_size=60), st.integers(1, 40))
def test_whatever_was_learned_can_be_restored(segments, repeats):
    quantity = quantity_of(0.15, 0.055, 0.2)
    for i, (residual, distance, noise) in enumerate(segments * repeats):
        quantity = quantity.learned(residual, distance, noise)
        if i % 7 == 6:
            quantity = quantity.next_ride()
    prior = Habits.before(PriorRiding(), 0.02)
    learner = Forecaster(VEHICLE.model, VEHICLE.pack, VEHICLE.riding).learner
    learner.state = learner.state._replace(habits=Habits(quantity, prior.stops, prior.pace, quantity))
    again = Forecaster(VEHICLE.model, VEHICLE.pack, VEHICLE.riding).learner
    again.restore(json.loads(json.dumps(learner.snapshot())))
    assert again.state.habits == learner.state.habits
    assert quantity.ahead(10_000.0)[1] >= 0
    assert quantity.variance >= 0


AIR = Conditions(20.0, 0.0)


def steady(learner, metres, power, speed=10.0, grade=0.0):
    """Riding at constant `power` [W]."""
    for _ in range(round(metres / speed)):
        learner.ride(1.0, speed, grade, power, AIR)


def fresh():
    return Forecaster(VEHICLE.model, VEHICLE.pack, VEHICLE.riding).learner


def test_recent_consumption_is_that_of_about_the_last_kilometre():
    learner = fresh()
    steady(learner, 390, 500.0)
    assert learner.expected(30e3, 20.0, 0.0).recent is None
    steady(learner, 5000, 500.0)
    assert learner.expected(30e3, 20.0, 0.0).recent == pytest.approx(50.0)
    steady(learner, 1000, 900.0)
    assert learner.expected(30e3, 20.0, 0.0).recent == pytest.approx(50 + 40 * (1 - np.exp(-1)), rel=0.03)


def test_a_second_of_a_speed_that_no_road_gives_is_not_learned():
    """A lone speed sensor that reads 55 m/s for a second in each minute at 10 m/s."""
    clean, spiked = fresh(), fresh()
    for _ in range(20):
        for learner, last in ((clean, 10.0), (spiked, 55.0)):
            steady(learner, 590, 600.0)
            learner.ride(1.0, last, 0.0, 600.0, AIR)
    assert spiked.factor == pytest.approx(clean.factor, rel=0.01)


def test_a_segment_that_no_riding_explains_counts_for_little():
    """A ferry queue that costs a hundred times the price moves it by a tenth."""
    quantity = quantity_of(0.05, 0.055, 0.2)
    assert 0.07 < quantity.learned(100.0, 250.0).now - 1 < 0.15


# --- terrain ------------------------------------------------------------------------------------------------------

RATE, STRETCH, SEGMENT = CONSUMPTION.terrain_rate, CONSUMPTION.stretch_m, CONSUMPTION.segment_m


def climbed(climbs: list[float]) -> Terrain:
    """After stretches that climb by so many metres each."""
    terrain = Terrain()
    for climb in climbs:
        for _ in range(int(STRETCH / SEGMENT)):
            terrain = terrain.ridden(SEGMENT, climb * SEGMENT / STRETCH, 0.0)
    return terrain


def test_level_roads_are_learned_as_such():
    assert climbed([1.0, -1.0] * 10).rate < RATE / 5


def test_mountains_are_learned_within_some_stretches():
    found = climbed([150.0, -100.0, 120.0])
    assert found.rate == pytest.approx((150**2 + 100**2 + 120**2) / 3 / STRETCH, rel=0.5)
    assert found.rate > 30 * RATE


def test_on_a_short_way_a_slope_goes_on():
    assert sqrt(Terrain().variance(200.0)) == pytest.approx(2 * sqrt(Terrain().variance(100.0)))
    assert Terrain().variance(2 * STRETCH) == pytest.approx(2 * Terrain().variance(STRETCH))
