"""The forecast, on ridings whose truth is known."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.constants import DECILE
from gz_onboard.estimator import forecast as forecast_module
from gz_onboard.estimator.forecast import Forecaster, deciles
from gz_onboard.estimator.load_model import Conditions
from gz_onboard.model.cooling import LumpedCooling
from gz_onboard.model.drawable import cells_ahead, pack_constants
from gz_onboard.model.effect import load_effect
from gz_onboard.model.model import Model
from gz_onboard.vehicle import read_vehicle

VEHICLE = read_vehicle("reference", 75.0)
AIR = Conditions(20.0, 0.0)


def forecaster():
    return Forecaster(VEHICLE.model, VEHICLE.pack, VEHICLE.riding)


def ride(f, kilometres, *, factor=1.0, seed=0, grade=lambda x: 0.0, stop_every=600.0, dt=0.1):
    """Town riding that takes `factor` times what the model says; gives the energy and way really used."""
    rng = np.random.default_rng(seed)
    x = v = energy = 0.0
    target = 10.0
    while x < kilometres * 1000:
        if x % stop_every > stop_every - 60:
            target = 0.3
        elif v < 0.5:
            target = rng.uniform(6, 13)
        a = float(np.clip(0.5 * (target - v), -1.2, 0.9))
        q = f.load.quantities(v, a, AIR)
        q["grade"] = grade(x)
        power = factor * sum(f.load.model.power(q).values())
        energy += power * dt
        f.learner.ride(dt, v, grade(x), power, AIR)
        x += v * dt
        v += a * dt
    return energy, x


def forecast(f, soc=0.7):
    return f.forecast(soc, 0.01, 25.0, 1.0, 20.0, 0.0)


def test_before_riding_it_stands_on_the_prior():
    result = forecast(forecaster())
    assert result.mostly_prior
    assert result.p10 < result.range < result.p90
    assert 20 < result.consumption / 3.6 < 40
    assert result.recent is None


@pytest.mark.parametrize("factor", [0.85, 1.0, 1.2])
def test_learns_what_the_model_has_wrong(factor):
    f = forecaster()
    energy, way = ride(f, 25, factor=factor)
    result = forecast(f)
    assert f.learner.factor == pytest.approx(factor, rel=0.04)
    assert result.consumption == pytest.approx(energy / way, rel=0.06)
    assert not result.mostly_prior


def test_what_speed_stores_is_no_consumption():
    """Neither is what the wheels store: in a vehicle without losses, all of an acceleration can be had again."""
    model = Model((load_effect("inertia"),), VEHICLE.parameters)
    f = Forecaster(model, VEHICLE.pack, VEHICLE.riding)
    dt, spent = 0.02, 0.0
    for step in range(1, 501):
        v = 1.0 * step * dt
        power = sum(model.power(f.load.quantities(v, 1.0, AIR)).values())
        spent += power * dt
        f.learner.ride(dt, v, 0.0, power, AIR)
    assert f.learner._segment.level == pytest.approx(0.0, abs=0.003 * spent)


def test_a_climb_is_not_taken_for_consumption():
    """Kilometres uphill: measured consumption doubles, what is to be expected stays."""
    level, climbing = forecaster(), forecaster()
    ride(level, 8)
    energy, way = ride(climbing, 8, grade=lambda x: 0.035)
    assert energy / way > 1.5 * forecast(level).consumption
    assert forecast(climbing).consumption == pytest.approx(forecast(level).consumption, rel=0.25)


def roll(f, kilometres, grade, seed=0, drift=0.0, drive=0.0):
    """Roll at 8 m/s with the motor off, or as if with `drive` [W]; `drift`: sd of the error of the grade shown."""
    rng, error = np.random.default_rng(seed), 0.0
    for i in range(round(kilometres * 1000 / 0.8)):
        if i % 600 == 0:  # for half a kilometre
            error = drift * rng.standard_normal()
        f.learner.ride(0.1, 8.0, grade + error, 45.0, AIR, motor_power=drive)


@pytest.mark.parametrize("tows", [1, 3])
def test_metres_that_something_else_paid_for_teach_nothing(tows):
    f, never_towed = forecaster(), forecaster()
    for each in f, never_towed:
        ride(each, 8)
    for _ in range(tows):
        roll(f, 3, grade=0.0)
        for each in f, never_towed:
            ride(each, 2, seed=1)
    towed, usual = forecast(f), forecast(never_towed)
    assert towed.range == pytest.approx(usual.range, rel=0.01)
    assert towed.p10 == pytest.approx(usual.p10, rel=0.02)
    assert towed.p90 == pytest.approx(usual.p90, rel=0.02)
    assert f.learner.factor == pytest.approx(never_towed.learner.factor, rel=0.01)


def test_empty_is_zero_with_an_upper_bound():
    result = forecast(forecaster(), soc=0.0)
    assert result.range == 0.0
    assert result.p10 == 0.0
    assert 0 < result.p90 < 3000


def test_coverage_of_the_interval():
    """An 80 % interval holds about 80 % of the time: riders, winds and traffic drawn at random, of another code.

    The factor differs by rider (6 %) and walks with the day; the way ahead differs from the way behind.
    """
    rng = np.random.default_rng(5)
    inside = []
    for seed in range(40):
        f = forecaster()
        rider = rng.normal(1.0, 0.06)
        stops = rng.uniform(250, 900)
        ride(f, 6, factor=rider, seed=seed, stop_every=stops, dt=0.5)
        result = f.forecast(0.8, 0.01, 25.0, 1.0, 20.0, 0.0)
        other = forecaster()
        energy, way = ride(
            other,
            10,
            factor=rider * rng.normal(1.0, 0.05),
            seed=1000 + seed,
            stop_every=float(np.clip(stops * rng.normal(1, 0.2), 200, 1200)),
            dt=0.5,
        )
        true = result.energy / (energy / way)
        inside.append(result.p10 <= true <= result.p90)
    assert 0.65 <= np.mean(inside) <= 0.98


def test_what_a_liar_taught_is_unlearned():
    """A kilometre with a sensor that doubles the consumption, taken back: as it was before, but for half a segment."""
    f = forecaster()
    ride(f, 5, seed=1)
    before = f.learner.factor
    ride(f, 1, factor=2.5, seed=2)
    assert f.learner.factor > 1.05 * before
    f.forget(1000.0)
    assert f.learner.factor == pytest.approx(before, rel=0.02)
    assert forecast(f).consumption == pytest.approx(before * forecast(f).consumption / f.learner.factor, rel=0.02)


def test_another_ride_begins_with_what_is_usual():
    """Rides by turns cheap and dear: after ten, each start expects their mean, however the last one was."""
    f, expected = forecaster(), []
    for i in range(14):
        expected.append(forecast(f).consumption)
        ride(f, 6, factor=(0.85, 1.15)[i % 2], seed=i, dt=0.5)
        f.learner.pause(3600.0)
    even = forecaster()
    ride(even, 40, seed=99, dt=0.5)
    mean = forecast(even).consumption
    assert max(abs(x / mean - 1) for x in expected[8:]) < 0.06


def test_the_interval_encloses_the_newest_forecast_and_the_displayed_range():
    f = forecaster()
    f.shown(forecast(f))
    f.learner.distance += 10.0
    better = forecast(f)._replace(
        range=1.5 * forecast(f).range, p10=1.4 * forecast(f).range, p90=1.6 * forecast(f).range
    )
    shown = f.shown(better)
    assert shown.range < 1.4 * forecast(f).range
    assert 0.9 * shown.range < shown.p10 < shown.range < shown.p90 == better.p90
    worse = better._replace(range=0.5 * better.range, p10=0.4 * better.range, p90=0.6 * better.range)
    f.learner.distance += 10.0
    shown = f.shown(worse)
    assert shown.range > worse.p90
    assert (shown.p10, shown.p90) == (worse.p10, shown.range)


@pytest.mark.parametrize("effects", [False, True])
@pytest.mark.parametrize(("start", "ambient"), [(-15.0, -15.0), (5.0, 5.0), (25.0, 25.0), (30.0, -10.0)])
def test_the_cells_warm_on_the_way_as_their_equation_says(start, ambient, effects):
    """Against small steps: each loses what its temperature makes it lose, the air takes its share."""
    lost = VEHICLE.model.overpotential(VEHICLE.pack, {"vibration": 0.0, "time_moving": 3600.0}) if effects else None
    cooling = LumpedCooling(VEHICLE.model.parameters, "pack", start)
    power, load = 800.0, (800.0, 2.5)
    pack, charge, temperatures = VEHICLE.pack, 0.8, []
    while charge > 0:
        current = pack.settled_current(power, 0.4, cooling.temperature, 2.5, lost)
        assert current is not None
        loss = pack.cells_series * pack.ocv(0.4, cooling.temperature)[0] * current - power
        temperatures.append(cooling.temperature)
        cooling.step(20.0, loss + pack.reversible_heat(current, charge, cooling.temperature), ambient)
        charge -= 20.0 * current / 3600 / pack.pack_capacity(cooling.temperature)
    found = cells_ahead(pack, pack_constants(VEHICLE.model.parameters), (0.8, start), ambient, load, lost)
    assert found == pytest.approx(np.mean(temperatures), abs=2.5)


def test_a_forecast_each_second_equals_one_from_nothing(monkeypatch):
    """The discharge is computed again only now and then: SOC, cells, air and load move on in between."""
    f, errors, energies, computed = forecaster(), [], [], []

    def counted(*inputs):
        computed.append(inputs)
        return cells_ahead(*inputs)

    monkeypatch.setattr(forecast_module, "cells_ahead", counted)
    for second in range(0, 1800, 3):
        at = 0.7 - second * 1e-4, 0.01, 15.0 + second * 2e-3, 1.0, 12.0 + second * 1e-3, 0.0
        now, anew = f.forecast(*at), forecaster().forecast(*at)
        errors.append(now.energy / anew.energy - 1)
        energies.append(now.energy)
    assert np.abs(errors).max() < 1e-3
    assert np.diff(energies).max() < 2e-4 * energies[0]
    assert len(computed) - len(errors) < len(errors) / 5


# --- P10 and P90 of energy and consumption together


def test_each_alone_is_its_own_distribution():
    assert deciles(4e6, 3e5, 2e5, 0.0) == pytest.approx((4e6 - DECILE * 3e5, 4e6 + DECILE * 2e5))
    assert deciles(4e6, 0.0, 0.0, 0.01) == pytest.approx((4e6 * exp(-DECILE * 0.1), 4e6 * exp(DECILE * 0.1)))
    assert deciles(0.0, 3e5, 2e5, 0.01) == deciles(-1e4, 3e5, 2e5, 0.01) == (0.0, DECILE * 2e5)


@given(st.floats(1.0, 1e7), st.floats(1e3, 1e6), st.floats(1e3, 1e6), st.floats(0, 1))
def test_nothing_jumps_as_the_battery_empties(energy, down, up, variance):
    """A thousandth less energy moves both by little, of what is left or of its error; and P10 <= energy <= P90."""
    p10, p90 = deciles(energy, down, up, variance)
    assert p10 <= energy <= p90
    less = deciles(0.999 * energy, down, up, variance)
    assert p10 - less[0] == pytest.approx(0, abs=0.02 * (energy + down))
    assert p90 - less[1] == pytest.approx(0, abs=0.01 * p90)
