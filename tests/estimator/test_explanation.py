"""The split of the range among causes: it adds up, and names the cause that was put in."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.estimator.explanation import RangeExplainer
from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.estimator.load_model import Conditions
from gz_onboard.events import Cause, Explanation
from gz_onboard.model.effect import load_effect
from gz_onboard.model.model import Model
from gz_onboard.vehicle import Vehicle, read_vehicle

VEHICLE = read_vehicle("reference")
MILD = Conditions(20.0, 0.0)


def forecaster(vehicle: Vehicle = VEHICLE) -> Forecaster:
    return Forecaster(vehicle.model, vehicle.pack, vehicle.riding)


def ride(
    f: Forecaster, kilometres: float, *, speed: float = 10.0, stop_every: float = 500.0, hills: float = 0.0,
    factor: float = 1.0, air: Conditions = MILD,
) -> float:  # fmt: skip
    """Riding at `speed` [m/s] with stops of 10 s, and `hills` up and down again [sine]; gives the metres ridden."""
    x = v = stood = 0.0
    while x < kilometres * 1000:
        left = stop_every - x % stop_every
        a = 1.0 if v < speed else 0.0
        if left < v * v / 2.4 + 1:
            a = -min(1.2, v)
        if v < 0.3 and a < 0:
            a, v, stood = 0.0, 0.0, stood + 1.0
            if stood > 10.0:
                x, stood = x + 2.0, 0.0
        grade = hills if x % 1000.0 < 500.0 else -hills
        q = f.load.quantities(v, a, air) | {"grade": grade}
        f.learner.ride(1.0, v, grade, factor * f.load.power(q), air)
        x += v
        v = min(max(v + a, 0.0), speed)
    return x


def explained(f: Forecaster, *, soc: float = 0.7, cells: float = 20.0, air: Conditions = MILD) -> Explanation:
    explainer = RangeExplainer(f)
    result = f.forecast(soc, 0.01, cells, 1.0, air.ambient, air.altitude)
    explainer.take(0.0, result, soc, air, 0.0)
    why = explainer.latest
    assert why is not None
    assert why.range == pytest.approx(result.range)
    return why


def check_sum(why: Explanation) -> None:
    assert sum(why.causes.values()) == pytest.approx(why.range - why.reference, abs=1e-6)
    assert set(why.causes) == set(Cause) - {Cause.NONE}


RIDINGS = st.fixed_dictionaries(
    {
        "kilometres": st.floats(0.0, 2.0),
        "speed": st.floats(2.0, 14.0),
        "stop_every": st.floats(100.0, 5000.0),
        "hills": st.floats(0.0, 0.08),
        "factor": st.floats(0.6, 1.8),
    }
)
STATES = st.tuples(st.floats(-0.05, 1.05), st.floats(-20.0, 45.0), st.floats(-20.0, 40.0), st.floats(0.0, 3000.0))


@settings(max_examples=12, deadline=None)
@given(RIDINGS, STATES, STATES, st.one_of(st.none(), st.floats(40.0, 200.0)))
def test_the_causes_add_up(riding, first, then, payload):
    f = forecaster(VEHICLE if payload is None else read_vehicle("reference", payload))
    explainer, distance = RangeExplainer(f), 0.0
    for time, (soc, cells, ambient, altitude) in enumerate((first, then)):
        air = Conditions(ambient, altitude)
        result = f.forecast(soc, 0.01, cells, 1.0, ambient, altitude)
        explainer.take(1000.0 * time, result, soc, air, distance)
        distance += ride(f, **riding)
    why = explainer.latest
    assert why is not None
    check_sum(why)
    for change in explainer.changes:
        check_sum(change)
        assert abs(change.range - change.reference) > 1000.0


# --- the right name ---------------------------------------------------------------------------------------------------


def named(why: Explanation) -> Cause:
    """The largest cause beside the charge, if it is larger than all others together."""
    (cause, size), *others = why.largest()
    assert abs(size) > sum(abs(other) for _, other in others), why.causes
    return cause


def against(f: Forecaster, usual: Forecaster, **state: float) -> Explanation:
    """The range of `f` against that of `usual`, which differs in one thing."""
    results = []
    for each in (usual, f):
        explainer = RangeExplainer(each)
        ambient, soc, cells = state.get("ambient", 20.0), state.get("soc", 0.7), state.get("cells", 20.0)
        if each is usual:
            ambient = cells = 20.0
        result = each.forecast(soc, 0.01, cells, 1.0, ambient, 0.0)
        results.append(explainer.state(0.0, result, soc, Conditions(ambient, 0.0), 0.0))
    return RangeExplainer(f).explain(*results)


def ridden(**riding: float) -> Forecaster:
    f = forecaster()
    ride(f, 6.0, **riding)  # type: ignore[arg-type]
    return f


def test_before_riding_nothing_but_the_usual_hills_takes_from_the_rated_range():
    why = explained(forecaster(), soc=1.0)
    assert 45e3 < why.reference < 65e3
    assert named(why) is Cause.CLIMB
    assert why.causes[Cause.CLIMB] == pytest.approx(why.range - why.reference, rel=0.05)


@pytest.mark.parametrize(
    ("riding", "cause", "sign"),
    [
        ({"speed": 13.0}, Cause.SPEED, -1),
        ({"speed": 7.0}, Cause.SPEED, 1),
        ({"stop_every": 150.0}, Cause.STOPS, -1),
        ({"stop_every": 5000.0}, Cause.STOPS, 1),
        ({"hills": 0.08}, Cause.CLIMB, -1),
        ({"factor": 1.3}, Cause.UNEXPLAINED, -1),
    ],
)
def test_what_is_ridden_otherwise_is_named(riding, cause, sign):
    usual = ridden(speed=10.0, stop_every=500.0)
    why = against(ridden(**{"speed": 10.0, "stop_every": 500.0} | riding), usual)
    check_sum(why)
    assert named(why) is cause
    assert why.causes[cause] * sign > 1000.0


def test_cold_is_named_cells_and_air_alike():
    f = ridden()
    both, cells, air = (
        against(f, ridden(), **cold) for cold in ({"ambient": -5.0, "cells": -5.0}, {"cells": -5.0}, {"ambient": -5.0})
    )
    assert [named(why) for why in (both, cells, air)] == [Cause.TEMPERATURE] * 3
    assert both.causes[Cause.TEMPERATURE] < cells.causes[Cause.TEMPERATURE] < air.causes[Cause.TEMPERATURE] < -500.0


def test_the_wind_of_a_model_that_knows_one_is_named():
    model = VEHICLE.model
    windy = Model((*model.effects, load_effect("headwind")), model.parameters.replaced(wind_north=7.0))
    f = forecaster(replace(VEHICLE, model=windy))
    why = explained(f)
    check_sum(why)
    assert why.reference == pytest.approx(explained(forecaster()).reference, rel=2e-3)
    assert why.causes[Cause.WIND] < -1000.0


def test_cells_that_have_aged_are_named():
    usual, aged = ridden(), ridden()
    pack = aged.battery
    aged.new_battery = replace(pack, capacity=0.8 * pack.capacity, r0=pack.r0.scaled(1.5), r1=pack.r1.scaled(1.5))
    why = against(aged, usual)
    check_sum(why)
    assert named(why) is Cause.AGE
    assert why.causes[Cause.AGE] == pytest.approx(-0.2 * why.reference, rel=0.2)


# --- over time --------------------------------------------------------------------------------------------------------


def test_a_charge_is_one_change_explained_when_it_is_over():
    f = forecaster()
    explainer = RangeExplainer(f)
    way = [(0.9, 0.0), (0.5, 1000.0), *((0.5 + 0.1 * i, 1000.0) for i in range(1, 5)), (0.89, 1000.0), (0.4, 2000.0)]
    for i, (soc, ridden) in enumerate(way):
        forecast = f.forecast(soc, 0.01, 20.0, 1.0, 20.0, 0.0)
        explainer.take(100.0 * i, forecast, soc, MILD, ridden, charging=1 < i < 6)
    used, charged, used_again = explainer.changes
    assert [is_change for is_change, _ in explainer.news()].count(True) == 3
    assert used.causes[Cause.CHARGE] < 0 < charged.causes[Cause.CHARGE]
    assert charged.reference == pytest.approx(used.range - 1000.0)
    assert charged.range == pytest.approx(used_again.reference)
    assert charged.time == 600.0
    for change in explainer.changes:
        check_sum(change)
