"""The road ahead: hills, arrival, where the battery ends, what is learned, and leaving the route."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gz_onboard.estimator.explanation import RangeExplainer
from gz_onboard.estimator.forecast import Forecast, Forecaster
from gz_onboard.estimator.load_model import Conditions
from gz_onboard.estimator.motion import Motion
from gz_onboard.estimator.route import RouteForecaster
from gz_onboard.events import Cause, Explanation, RouteState
from gz_onboard.model.drawable import Drawable
from gz_onboard.routes.route import Route
from tests.events import ShownSignals
from tests.support import reference

AIR = Conditions(20.0, 300.0)
FREE = Forecast(
    range=40e3, p10=34e3, p90=47e3, left=Drawable(4e6, 6e6, 0.03), energy_sd=8e4, energy_sd_up=8e4,
    consumption=100.0, consumption_sd=12.0,
    recent=None, mostly_prior=False, power=800.0, form_factor_squared=2.5, cells=25.0, known_from=5000.0,
)  # fmt: skip


def way(length=20e3, grade=lambda x: 0.0, limit=lambda x: 11.0, **more):
    """A straight road northward with a point each 20 m."""
    at = [20.0 * i for i in range(int(length / 20) + 1)]
    zero = (0.0,) * len(at)
    route = Route(
        "way", tuple(at), tuple(map(grade, at)), zero, zero, tuple(map(limit, at)),
        tuple(47 + x / 111_200 for x in at), (8.0,) * len(at),
    )  # fmt: skip
    return replace(route, **more)


class Rider:
    """Rides along a route by the second, without a receiver, and asks for forecasts."""

    def __init__(self, route=None):
        vehicle = reference()
        self.signals = ShownSignals()
        self.motion = Motion(self.signals, 0.25, 1.0)
        self.motion.altitude = 300.0
        self.forecaster = Forecaster(vehicle.model, vehicle.pack, vehicle.riding)
        self.forecast = RouteForecaster(self.forecaster, self.motion, self.signals)
        self.now, self.route = 0.0, route
        if route:
            self.forecast.follow(self.forecast.prepare(route))

    def ask(self, free=FREE, soc=0.7):
        return self.forecast.forecast(self.now, free, (soc, 0.01), 0.0, AIR)

    def slope(self):
        """Of the route, where it is."""
        along = self.forecast.outlook.route_along or 0.0
        return np.interp(along, self.route.distance, self.route.grade) if self.route else 0.0

    def ride(self, seconds, power, speed=11.0, slope=None):
        self.motion.speed, self.motion.acceleration = speed, 0.0
        for _ in range(seconds):
            self.now += 1
            self.motion.distance += speed
            self.motion.altitude = (self.motion.altitude or 0.0) + speed * (self.slope() if slope is None else slope)
            self.forecast.ride(1.0, speed, power)
            self.ask()

    def settled(self, free=FREE, soc=0.7):
        """The forecast and the answer once the route is modelled."""
        for _ in range(50):
            found = self.ask(free, soc)
        return found, self.forecast.outlook


def test_without_a_route_nothing_changes():
    rider = Rider()
    assert rider.ask() is FREE
    assert rider.forecast.outlook.route_state == RouteState.NONE
    assert rider.forecast.report() == {}


def test_a_route_shows_at_once_and_so_does_its_end():
    """Before the first metre, and again when it is taken back: nothing of it waits for riding."""
    rider = Rider(way(60e3))
    for _ in range(50):
        found = rider.ask()
        shown = rider.forecaster.shown(found, drawn=0.0)
    assert found.range > 1.1 * FREE.range
    assert shown.range == pytest.approx(found.range)
    rider.forecast.follow(None)
    assert rider.forecaster.shown(rider.ask(), drawn=0.0).range == pytest.approx(FREE.range)


def given_on_the_way(route: Route) -> Explanation:
    """The change of the range with the route, in causes."""
    rider = Rider()
    free = rider.forecaster.forecast(0.7, 0.01, 20.0, 1.0, AIR.ambient, AIR.altitude)
    explainer = RangeExplainer(rider.forecaster)
    for now, road in enumerate((None, rider.forecast.prepare(route))):
        rider.forecast.follow(road)
        found, _ = rider.settled(free)
        explainer.take(100.0 * now, found, 0.7, AIR, 0.0, rider.forecast.hills)
    (change,) = explainer.changes
    assert sum(change.causes.values()) == pytest.approx(change.range - change.reference, abs=1e-6)
    return change


@pytest.mark.parametrize("grade", [0.06, -0.03])
def test_hills_ahead_are_called_that(grade):
    level = given_on_the_way(way(20e3))
    hilly = given_on_the_way(way(20e3, grade=lambda x: grade if x > 10e3 else 0.0))
    hills = hilly.causes[Cause.CLIMB] - level.causes[Cause.CLIMB]
    assert abs(hills) > 5e3
    assert hills == pytest.approx(hilly.range - level.range, rel=0.01)
    assert hilly.causes[Cause.RIDING] == pytest.approx(level.causes[Cause.RIDING], rel=0.01)


def test_where_the_battery_ends():
    found, answer = Rider(way(60e3)).settled()
    assert found.range == answer.battery_ends_after < 60e3
    ends_at = answer.battery_ends_latitude, answer.battery_ends_longitude
    assert ends_at == pytest.approx((47 + answer.battery_ends_after / 111_200, 8.0))
    assert answer.arrival_soc == 0.0


def test_a_climb_costs_its_height_and_a_fall_gives_less_back():
    level, up, down = (Rider(way(20e3, lambda x, g=g: g)).settled()[1].route_energy for g in (0.0, 0.02, -0.02))
    weight = 185.0 * 9.80665 * 400.0
    assert weight < up - level < 1.5 * weight
    assert 0.5 * weight < level - down < up - level  # the motor loses more, the more it gives


def test_faster_roads_stops_and_headwind_cost_more():
    slow = Rider(way(limit=lambda x: 8.0)).settled()[1].route_energy
    assert Rider(way(limit=lambda x: 14.0)).settled()[1].route_energy > 1.2 * slow
    stops = tuple(20.0 if i % 20 == 10 else 0.0 for i in range(1001))
    assert Rider(way(limit=lambda x: 8.0, stop=stops)).settled()[1].route_energy > 1.05 * slow
    assert Rider(way(limit=lambda x: 8.0, headwind=(4.0,) * 1001)).settled()[1].route_energy > 1.15 * slow


def test_the_cost_is_learned():
    rider = Rider(way(30e3))
    rider.settled()
    costs = rider.forecast.costs
    assert costs
    usual = costs.level[-1] / 30e3 * 11.0  # W
    rider.ride(700, 1.4 * usual)
    assert rider.forecast.cost == pytest.approx(1.4, abs=0.1)


def test_off_the_route_it_is_as_without_one_and_comes_back():
    rider = Rider(way(5e3))
    rider.signals = rider.forecast._signals = ShownSignals("latitude", "longitude")
    rider.settled()

    def at(east, north):
        rider.now += 1
        rider.motion.distance += 10.0
        rider.motion.speed, rider.motion.heading = 10.0, 0.0
        for role, value in (("latitude", 47 + north / 111_200), ("longitude", 8 + east / 75_800)):
            rider.signals[role].value, rider.signals[role].time = value, rider.now
        return rider.ask()

    for k in range(1, 50):
        assert at(0.0, 10.0 * k) is not FREE
    assert [at(200.0, 500 + 10.0 * k) is FREE for k in range(20)][-1]
    assert rider.forecast.outlook.route_state == RouteState.OFF
    assert rider.forecast.outlook.route_energy is None
    assert [at(0.0, 700 + 10.0 * k) is FREE for k in range(20)][-1] is False
    assert rider.forecast.outlook.route_along == pytest.approx(890, abs=5)


@pytest.mark.parametrize("slope", [-0.05, 0.05])
def test_a_route_with_other_hills_than_are_ridden_is_left_and_taken_up_again(slope):
    """Heights of another road: for a kilometre it is believed, then the range is that without it."""
    rider, states = Rider(way(20e3, grade=lambda x: slope if x < 6e3 else 0.0)), []
    rider.settled()
    for seconds, ridden in ((60, 0.0), (60, 0.0), (900, None)):
        rider.ride(seconds, 1000.0, slope=ridden)
        states.append(rider.forecast.outlook.route_state)
        assert (rider.ask() is FREE) == (states[-1] == RouteState.OFF)
    assert states == [RouteState.ON, RouteState.OFF, RouteState.ON]


def test_an_empty_battery_has_no_range():
    found, answer = Rider(way(5e3)).settled(FREE._replace(left=Drawable(0.0, 6e6, 0.02), energy_sd=3e4), soc=0.02)
    assert found.range == found.p10 == 0.0 < found.p90 < 2e3
    assert (answer.arrival_soc, answer.battery_ends_after) == (0.0, 0.0)


def test_the_charge_at_arrival_is_that_which_will_be_shown_there():
    """Of a pack that gives up at 20 % of charge, as in the cold, more than that is shown while energy is left."""
    cold = FREE._replace(left=Drawable(4e6, 8.5e6, 0.2))
    answer = Rider(way(48e3)).settled(cold)[1]
    assert 0 < answer.route_energy < 4e6
    assert answer.arrival_soc == pytest.approx(0.7 - 0.5 * answer.route_energy / 4e6, abs=0.02)
    assert answer.arrival_soc_p10 == 0.0 < 0.2 < answer.arrival_soc < answer.arrival_soc_p90
