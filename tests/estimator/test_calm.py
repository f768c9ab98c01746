"""The range that is shown: calm, and near the forecast."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.estimator.calm import CALM, STEP, Calm, restored_calm
from gz_onboard.estimator.usual import Habit, Usual, restored_usual
from gz_onboard.physics.riding import PriorRiding

KNOWN = 1e6  # m: much was ridden


def shown(raw, ridden, known=KNOWN, calm=None):
    """What is shown of the forecasts `raw` [m], `ridden` [m] before each."""
    calm = calm or Calm()
    found = []
    for forecast, way in zip(raw, ridden, strict=True):
        calm.ride(way)
        found.append(calm.follow(forecast, 90.0 * forecast, known))
    return np.array(found)


def test_a_forecast_that_holds_is_shown_as_it_is():
    ridden = np.full(3000, 10.0)
    raw = 50_000 - np.cumsum(ridden)
    assert shown(raw, ridden) == pytest.approx(raw, abs=1e-6)


def test_noise_of_the_forecast_hardly_shows():
    """Errors of 3 % that stay alike over a kilometre: of them less than a third of a km remains per km."""
    rng = np.random.default_rng(0)
    ridden = np.full(3000, 10.0)
    error = np.interp(np.arange(3000), np.arange(0, 3001, 100), rng.normal(0, 0.03, 31))
    left = 50_000 - np.cumsum(ridden)
    total = (shown(left * (1 + error), ridden) + np.cumsum(ridden))[::100]
    assert np.percentile(np.abs(np.diff(total)), 90) < 300


def test_a_real_change_is_followed_within_three_lengths():
    ridden = np.full(4000, 10.0)
    at = np.cumsum(ridden)
    raw = np.where(at < 5000, 60_000 - at, 58_000 - at)  # 2 km are lost at 5 km
    error = (shown(raw, ridden) - raw)[1:]
    assert error[at[1:] >= 5000 + CALM][0] < 2000 * 0.37
    assert np.all(error[at[1:] > 5000 + 3 * CALM] < 100)


def test_a_better_forecast_does_not_let_the_range_rise():
    """10 km more within one: who rides sees no rise, and in the end all of it; while little is known it shows soon."""
    ridden = np.full(4000, 10.0)
    at = np.cumsum(ridden)
    raw = np.interp(at, [5000, 6000], [50_000, 60_000]) - at
    settled = shown(raw, ridden)
    assert np.diff(settled).max() <= 0
    assert settled[-1] == pytest.approx(raw[-1], rel=0.01)
    assert shown(raw, ridden, known=1000.0)[at >= 9000][0] == pytest.approx(raw[at >= 9000][0], rel=0.01)


def test_of_a_long_range_more_is_gained():
    ridden = np.full(4000, 10.0)
    at = np.cumsum(ridden)
    found = shown(np.interp(at, [5000, 10_000], [350_000, 500_000]) - at, ridden)
    assert np.diff((found + at)[(at > 12_000) & (at < 14_000)]) == pytest.approx(10 * 1.25e-5 * 487_000, rel=0.01)


def test_what_lower_power_gives_of_energy_is_followed_as_any_change():
    """A twentieth more energy and range at once, from one second to the next, and no kilometre gains more than one."""
    ridden = np.full(1000, 10.0)
    raw = np.where(np.arange(1000) < 500, 40_000.0, 42_200.0) - np.cumsum(ridden)
    found = shown(raw, ridden)
    assert np.abs(np.diff((found + np.cumsum(ridden))[::100])).max() < 810
    assert found[-1] > raw[-1] - 1200


def test_what_is_drawn_or_charged_at_standstill_shows_at_once():
    """And fifty metres near empty are fifty of a full charge, in place of a third of it."""
    calm = Calm(-2000.0)
    assert shown([40_000.0, 38_000.0, 60_000.0], np.zeros(3), calm=calm) == pytest.approx([38_000, 36_000, 58_000])
    calm = Calm(50.0)
    assert shown([150.0, 60_000.0], np.zeros(2), calm=calm) == pytest.approx([200, 60_050])


def standing(raws, drawn=0.0):
    """What is shown at standstill of the forecasts `raws` [m], with `drawn` of the energy taken before each."""
    calm, energy, found = Calm(), 1e6, []
    for raw in raws:
        calm.ride(0.0)
        found.append(calm.follow(raw, energy, KNOWN, drawn * energy))
        energy *= 1 - drawn
    return found, calm


def test_what_a_rest_shows_waits_for_the_riding_to_come():
    """Of a forecast that falls by 4 % at standstill only what was drawn shows; riding closes the gap."""
    found, calm = standing(np.linspace(40_000, 38_400, 100), 1e-4)
    assert found[-1] == pytest.approx(40_000 * (1 - 1e-4) ** 99)
    later = shown(38_400 - np.arange(10.0, 12_010, 10), np.full(1200, 10.0), calm=calm)
    assert later[-1] == pytest.approx(38_400 - 12_000, rel=0.01)
    assert np.abs(np.diff(later)).max() < 15


def test_a_rest_that_shows_much_is_followed_at_once():
    found, calm = standing(np.linspace(40_000, 25_000, 100))
    assert found[-1] == pytest.approx(25_000 * (1 + STEP))
    assert calm.follow(40_000.0, 1e6, KNOWN, 0.0) == pytest.approx(40_000 * (1 - STEP))


def test_a_restart_keeps_what_was_shown():
    calm = Calm()
    ridden = np.full(500, 10.0)
    before = shown(42_000 + 800 * np.sin(np.arange(500) / 50) - np.cumsum(ridden), ridden, calm=calm)[-1]
    raw = 42_000 + 800 * np.sin(499 / 50) - 5000
    assert restored_calm(calm.snapshot()).follow(raw, 90.0 * raw, KNOWN) == pytest.approx(before)


@pytest.mark.parametrize("energy", [4e6, 3.96e6, 4.04e6, 6e6])
def test_over_a_restart_the_range_moves_as_the_energy_does(energy):
    """A night that changes what a kilometre is to cost by 3 % shows in the first kilometres, a charge at once."""
    calm = Calm()
    before = calm.follow(40_000.0, 4e6, KNOWN)
    calm = restored_calm(calm.snapshot())
    calm.begin_ride()
    raw = 0.97 * 40_000.0 * energy / 4e6
    found = calm.follow(raw, energy, KNOWN)
    assert found == pytest.approx(raw if energy == 6e6 else before * energy / 4e6)
    for _ in range(500):
        calm.ride(10.0)
        raw -= 10.0
        found = calm.follow(raw, energy, 1000.0)
    assert found == pytest.approx(raw, rel=0.001)


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("gap", [15_000.0, -8000.0])
def test_of_a_pack_found_nearly_empty_no_gap_of_a_full_one_is_shown(gap, restarted):
    """Held back over a long way, or swapped for one with a seventh of the energy: the gap was not to this forecast."""
    calm = Calm(gap)
    calm.follow(40_000.0, 4e6, KNOWN)
    if restarted:
        calm = restored_calm(calm.snapshot())
    else:
        calm.show_next()
    assert abs(calm.follow(6000.0, 6e5, KNOWN) / 6000 - 1) < (0.4 if restarted else 1e-6)


def test_it_is_right_when_empty():
    ridden = np.full(2000, 10.0)
    left = 20_000 - np.cumsum(ridden)
    found = shown(left, ridden, calm=Calm(4000.0))
    assert np.all(np.abs(found - left)[left < 1000] < 50)
    assert found[-1] < 1


def test_nothing_known_is_followed_at_once():
    ridden = np.full(200, 10.0)
    raw = np.where(np.arange(200) < 50, 50_000.0, 48_000.0) - np.cumsum(ridden)
    assert shown(raw, ridden, known=0.0)[150] == pytest.approx(raw[150], rel=0.002)


def test_a_habit_knows_how_well_it_knows():
    """Rides drawn from its own model: the errors of what it expects have the variance that it states."""
    rng = np.random.default_rng(1)
    normalised = []
    for _ in range(150):
        usual = rng.normal(1.0, 0.15)
        habit = Habit(1.0, 0.15**2, 0.06**2, 0.2**2)
        for _ in range(6):
            level = usual + rng.normal(0, 0.06)
            for _ in range(20):
                habit = habit.learned(level + rng.normal(0, 0.2) - habit.now, 250.0)
            habit = habit.rested()
        normalised.append((habit.usual - usual) / np.sqrt(habit.usual_variance))
    assert 0.8 < np.std(normalised) < 1.25
    assert abs(np.mean(normalised)) < 0.25


def test_a_habit_learns_its_scatter_and_how_unlike_rides_are():
    rng = np.random.default_rng(2)
    habit = Habit(1.0, 0.15**2, 0.05**2, 0.2**2)
    for _ in range(60):
        level = 0.9 + rng.normal(0, 0.12)
        for _ in range(24):
            habit = habit.learned(level + rng.normal(0, 0.1) - habit.now, 250.0)
        habit = habit.rested()
    assert habit.usual == pytest.approx(0.9, abs=0.06)
    assert np.sqrt(habit.scatter) == pytest.approx(0.1, rel=0.2)
    assert np.sqrt(habit.between) == pytest.approx(0.12, rel=0.35)


def test_where_neighbours_are_alike_they_teach_less():
    """Stretches of motorway and town: what is expected of the rest of a ride is as uncertain as it says."""
    rng = np.random.default_rng(5)
    habit, alike, normalised = Habit(1.0, 0.15**2, 0.2**2, 0.5**2), 0.6, []
    for ride in range(200):
        level, scatter, ridden = 1 + rng.normal(0, 0.1), rng.normal(0, 0.5), []
        for _ in range(80):
            scatter = alike * scatter + rng.normal(0, 0.5 * np.sqrt(1 - alike**2))
            ridden.append(level + scatter)
        for price in ridden[:40]:
            habit = habit.learned(price - habit.now, 250.0)
        mean, variance = habit.ahead(250.0 * 40)
        if ride >= 20:
            normalised.append((np.mean(ridden[40:]) - mean) / np.sqrt(variance))
        for price in ridden[40:]:
            habit = habit.learned(price - habit.now, 250.0)
        habit = habit.rested()
    assert 0.45 < habit.likeness < 0.75
    assert 0.8 < np.std(normalised) < 1.25


def test_where_neighbours_are_not_alike_none_is_learned():
    rng = np.random.default_rng(6)
    habit, found = Habit(1.0, 0.15**2, 0.055**2, 0.2**2), []
    for _ in range(40):
        for _ in range(60):
            habit = habit.learned(1.0 + rng.normal(0, 0.2) - habit.now, 250.0)
        found.append(habit.likeness)
        habit = habit.rested()
    assert np.mean(found) < 0.15


def test_a_state_without_likeness_is_restored():
    saved = Usual.of(PriorRiding(), 0.02).snapshot()
    older = {name: {k: x for k, x in habit.items() if k not in ("likeness", "beside")} for name, habit in saved.items()}
    assert restored_usual(older).snapshot() == saved


def test_who_drives_unlike_from_ride_to_ride_does_so_on_the_way():
    town, car = (Usual.of(PriorRiding(drift=drift), 0.02).price for drift in (0.055, 0.22))
    assert car.scatter == pytest.approx(16 * town.scatter)


def test_far_ahead_the_usual_counts_and_near_the_present():
    habit = Habit(1.0, 0.001, 0.01, 0.01, present=0.2, present_variance=0.001)
    near, far = habit.ahead(1000.0), habit.ahead(1e7)
    assert near[0] == pytest.approx(1.2, abs=0.01)
    assert far[0] == pytest.approx(1.0, abs=0.01)
    assert far[1] == pytest.approx(0.001, rel=0.5)


@pytest.mark.parametrize(("before", "most"), [(5, 15.0), (20, 15.0), (40, 15.0)])
def test_a_fifth_more_consumption_is_followed_within_the_stated_distance(before, most):
    """A headwind that stays: 63 % of it is in the range shown after at most so many km, in the mean over rides."""
    rng = np.random.default_rng(3)
    found = []
    for _ in range(80):
        habit, calm = Habit(1.0, 0.17**2, 0.055**2, 0.2**2), Calm()
        for k in range(4 * 70):
            habit = habit.learned((1.0 if k < 4 * before else 1.2) + rng.normal(0, 0.17) - habit.now, 250.0)
            left = 100_000 - 250.0 * k  # as though it lasted for long
            calm.ride(250.0 if k else 0.0)
            found.append(calm.follow(left / habit.ahead(left)[0], 90.0 * left, habit.known_from) / left)
    price = 1 / np.mean(np.reshape(found, (80, -1)), axis=0)
    late = price[4 * before :]
    reached = np.argmax(late > 1 + 0.63 * 0.2) / 4
    assert 0 < reached < most


def test_scatter_raises_no_alarm():
    """Of 100 rides of 50 km that do not change few are taken to have changed."""
    rng = np.random.default_rng(4)
    alarms = 0
    for _ in range(100):
        habit = Habit(1.0, 0.05**2, 0.055**2, 0.17**2)
        for _ in range(200):
            before = habit.variance
            habit = habit.learned(1.0 + rng.normal(0, 0.17) - habit.now, 250.0)
            alarms += habit.variance > 1.5 * before
    assert alarms < 8


ANY = st.floats(-1e9, 1e9)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(ANY, st.floats(1.0, 1e5), st.floats(0.0, 1e12)), min_size=1, max_size=60), st.integers(1, 40))
def test_whatever_was_learned_can_be_restored(segments, repeats):
    habit = Habit(1.0, 0.15**2, 0.055**2, 0.2**2)
    for i, (residual, distance, noise) in enumerate(segments * repeats):
        habit = habit.learned(residual, distance, noise)
        if i % 7 == 6:
            habit = habit.rested()
    prior = Usual.of(PriorRiding(), 0.02)
    usual = Usual(habit, prior.standing, prior.pace, habit)
    assert restored_usual(usual.snapshot()) == usual
    assert habit.ahead(10_000.0)[1] >= 0
    assert habit.variance >= 0


def test_a_worse_forecast_is_told_in_time():
    """8 km less within one, of 60: no kilometre takes off two, and it is told half way; 5 km, of 11: sooner."""
    ridden = np.full(4000, 10.0)
    at = np.cumsum(ridden)
    raw = np.interp(at, [3000, 4000], [60_000, 52_000]) - at
    found = shown(raw, ridden)
    assert np.diff((found + at)[::100]).min() > -910
    assert np.all((found / raw)[raw < 35_000] < 1.03)
    raw = np.interp(at, [3000, 4000], [15_000, 10_000]) - at
    near = shown(np.maximum(raw, 1.0), ridden)
    assert near[at >= 6000][0] < 1.4 * 4000
    assert np.all((near / np.maximum(raw, 1.0))[(raw < 3000) & (raw > 100)] < 1.25)


def test_what_was_held_back_on_one_ride_shows_in_the_first_kilometres_of_the_next():
    """The forecast grows by a half as the ride ends: five kilometres later most of that is shown, not 4 km."""
    found = []
    for begun in (False, True):
        calm = Calm()
        for k in range(1000):
            if begun and k == 500:
                calm.begin_ride()
            calm.ride(10.0)
            left = (40_000 if k < 500 else 60_000) - 10 * k
            found.append(calm.follow(left, 4e6, 3000.0))
    assert found[999] < 42_000
    assert found[1999] > 45_000


@pytest.mark.parametrize("ridden", [0.0, 10.0])
def test_what_the_rider_changes_shows_at_once(ridden):
    """A route makes the range a fifth longer, at standstill or under way: no part of it waits for riding."""
    found = []
    for told in (False, True):
        calm = Calm()
        calm.follow(50_000.0, 4e6, KNOWN)
        calm.ride(ridden)
        if told:
            calm.show_next()
        found.append(calm.follow(60_000.0, 4e6, KNOWN, drawn=0.0))
    assert found[0] < 58_000
    assert found[1] == 60_000


def test_a_first_guess_that_was_too_good_is_left_as_soon_as_the_riding_is_known():
    """A third too long at first: ten kilometres on it is within a tenth, not 8 km less."""
    ridden = np.full(1000, 10.0)
    at = np.cumsum(ridden)
    known = np.maximum(at, 250.0)
    calm, found = Calm(), []
    for way, so_far in zip(at, known, strict=True):
        calm.ride(10.0)
        raw = (60_000 if way < 1000 else 45_000) - way
        found.append(calm.follow(raw, 4e6, so_far) / raw)
    assert found[150] > 1.1
    assert found[-1] < 1.1
