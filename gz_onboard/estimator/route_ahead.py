"""The road ahead: what the rest of a route costs, what is left at its end, or where the battery ends before.

The model is ridden along the route once, and again when the air has changed. What was ridden of it corrects it: the
cost, measured over modelled energy of the level road, see `route_rider`. Who rides slower than limits and bends allow
shows it there too: a speed that is low for a while may be a climb's, and is no pace of the rider's to go on with.

The range is the distance along the route that the energy left goes, beyond the end of the route at the consumption that
is expected without one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import sqrt
from typing import Any, NamedTuple

from gz_onboard.estimator.forecast import Forecast, Forecaster
from gz_onboard.estimator.interval import DECILE, deciles
from gz_onboard.estimator.load_model import Conditions
from gz_onboard.estimator.road import RoadState
from gz_onboard.estimator.route_energy import Costs, RouteEnergy
from gz_onboard.estimator.route_heights import RouteHeights
from gz_onboard.estimator.route_position import RoutePosition
from gz_onboard.estimator.route_rider import SEGMENT_SD, RouteRider, restored
from gz_onboard.estimator.signals import FIX_2D, Signals
from gz_onboard.events import Estimate, RouteState
from gz_onboard.physics.drawable import soc_left
from gz_onboard.physics.effects.inertia import rotating_mass
from gz_onboard.routes.route import Route

SEGMENT = 250.0  # m of the route from which the cost is learned
AHEAD_SD = 0.015  # relative, of the cost of what is left, beyond what its segments scatter
UNLIKE = 0.1  # of a segment: what was ridden is not what is modelled
COURSE_FROM = 3.0  # m/s: slower, the heading is noise
CHANGED = Conditions(2.0, 200.0)  # degC, m: by so much and the route is modelled anew


class Pack(NamedTuple):
    """What a route must know of the pack."""

    soc: float
    soc_sd: float
    loss_variance: float  # that missing sensors add to the consumption, see `Forecaster.forecast`


@dataclass(frozen=True, slots=True)
class Road:
    """A route made ready for the estimator; that takes up to some seconds."""

    route: Route
    energy: RouteEnergy
    position: RoutePosition


@dataclass(frozen=True, slots=True)
class Answer:
    """What is known of the route; SI units. None: not known, or the battery does not end on the route."""

    state: RouteState = RouteState.NONE
    along: float | None = None
    left: float | None = None
    energy: float | None = None  # to the end of the route
    energy_sd: float | None = None
    soc: float | None = None  # at the end of the route, with P10 and P90; 0 if the battery ends before
    soc_p10: float | None = None
    soc_p90: float | None = None
    ends_after: float | None = None  # from here
    ends_at: tuple[float, float] | None = None  # latitude, longitude [deg]
    hills: tuple[float, float] = 0.0, 0.0  # J that they take, on so many m: what of the range lies on the route


class RoadAhead:
    """Follows the vehicle along a route and forecasts on it. Without a route it costs nothing."""

    def __init__(self, forecaster: Forecaster, motion: RoadState, signals: Signals) -> None:
        model = forecaster.load.model
        self.rider, self.answer = RouteRider(), Answer()
        self._forecaster, self._motion, self._signals = forecaster, motion, signals
        self._moving_mass = model.mass + rotating_mass(model.parameters)
        self._road: Road | None = None
        self._last: Route | None = None  # that was followed, also if it was taken back since
        self._costs: Costs | None = None
        self._modelling: Iterator[Costs | None] | None = None
        self._modelled: Conditions | None = None
        self._segment: tuple[float, float] | None = None  # m along the route, m/s: its start
        self._energy = self._ridden = self._distance = 0.0  # J, m of the segment; m of the vehicle at the last forecast
        self._new = False  # whether nothing was forecast on this route yet
        self._heights = RouteHeights()

    def ready(self, route: Route) -> Road:
        """`route` made ready, in any thread. The fastest of the prior riding stands in for limits."""
        top_speed = max(speed for _, speed, _ in self._forecaster.load.prior.points)
        return Road(route, RouteEnergy(route, top_speed), RoutePosition(route))

    def follow(self, road: Road | None) -> None:
        """Have `road` from now on, or none."""
        if road:
            if self._last and road.route != self._last:
                self.rider.begin_route(*self._factor)
            self._last = road.route
        self._road, self._costs, self._modelling, self._segment = road, None, None, None
        self._distance, self._new, self._heights = self._motion.distance, True, RouteHeights()
        self._forecaster.smoother.show_next()
        self.answer = Answer(RouteState.OFF if road else RouteState.NONE)

    # --- learning ---------------------------------------------------------------------------------------------

    def ride(self, dt: float, speed: float, power: float) -> None:
        """Take in `dt` [s] of riding at `speed` [m/s] and `power` [W] of the pack."""
        if self._segment and not self._forecaster.learner.towed:
            self._ridden += abs(speed) * dt
            self._energy += (power - self._forecaster.learner.auxiliaries.now) * dt

    def _learn(self, road: Road, costs: Costs) -> None:
        """Learn the cost if a segment ends here."""
        speed, along = self._motion.speed or 0.0, road.position.along
        start, before = self._segment or (along, speed)
        way = along - start
        if self._segment and 0 <= way < SEGMENT:
            return
        self._segment, energy, ridden = (along, speed), self._energy, self._ridden
        self._energy = self._ridden = 0.0
        if way < SEGMENT or abs(ridden - way) > UNLIKE * way:
            return
        energies = road.energy
        level, height, allowed = (
            energies.between(x, start, along) for x in (costs.level, costs.height, energies.speed**2)
        )
        usual = way * float(costs.level[-1]) / energies.length
        if usual > 0:
            level -= self._moving_mass * allowed / 2
            energy -= height + self._moving_mass * (speed**2 - before**2) / 2
            self.rider.learn_cost(energy / usual, level / usual, self._cost)

    @property
    def _cost(self) -> tuple[float, float]:
        return self.rider.expected_cost(*self._factor)

    @property
    def _factor(self) -> tuple[float, float]:
        learner = self._forecaster.learner
        return learner.factor, learner.habits.factor.variance

    @property
    def _known_from(self) -> float:
        """As much of the route [m] as would tell as much of the cost."""
        return SEGMENT * SEGMENT_SD**2 / self._cost[1]

    # --- forecasting ------------------------------------------------------------------------------------------

    def forecast(self, now: float, free: Forecast, pack: Pack, conditions: Conditions) -> Forecast:
        """The forecast with the route out of `free`, that without; to be made each second or so. Time in s."""
        road = self._road
        if road is None:
            return free
        self._move(now, road)
        self._model(road, conditions)
        if not road.position.on or self._heights.contradict or self._costs is None:
            if self.answer.state is RouteState.ON:  # left: what lay ahead on it is no part of the range
                self._new = True
                self._forecaster.smoother.show_next()
            self._segment, self.answer = None, Answer(RouteState.OFF)
            return free
        self._learn(road, self._costs)
        if self._new:
            self._new = False
            self._forecaster.smoother.show_next(on_route=True)
        return self._ahead(road, self._costs, free, pack)

    def _move(self, now: float, road: Road) -> None:
        signals, motion = self._signals, self._motion
        moved, self._distance = motion.distance - self._distance, motion.distance
        latitude, longitude = signals.latitude.get(now), signals.longitude.get(now)
        fix = None
        if latitude is not None and longitude is not None and not signals.fix_below(now, FIX_2D):
            fix = latitude, longitude
        before = road.position.along
        road.position.update(moved, fix, motion.heading if (motion.speed or 0.0) > COURSE_FROM else None)
        if road.route.grade_known and road.position.on:
            here, climb = road.position.along, road.energy.climb
            self._heights.look(here, moved, road.energy.between(climb, before, here), motion.altitude)

    def _model(self, road: Road, conditions: Conditions) -> None:
        """Model a part of the route if that is due."""
        if self._modelling is None:
            then = self._modelled
            if (
                then
                and self._costs
                and abs(conditions.ambient - then.ambient) < CHANGED.ambient
                and abs(conditions.altitude - then.altitude) < CHANGED.altitude
            ):
                return
            moving = self._forecaster.learner.time_moving
            self._modelling = road.energy.modelled(self._forecaster.load, conditions, moving)
            self._modelled = conditions
        costs = next(self._modelling)
        if costs:
            self._costs, self._modelling = costs, None

    def _ahead(self, road: Road, costs: Costs, free: Forecast, pack: Pack) -> Forecast:
        here, end = road.position.along, road.energy.length
        cost, variance = self._cost
        cost += self._forecaster.learner.auxiliary_factor
        variance = variance / cost**2 + AHEAD_SD**2 + pack.loss_variance
        level = cost * road.energy.between(costs.level, here, end)
        needed = level + road.energy.between(costs.height, here, end)

        def reach(energy: float) -> float:
            found = road.energy.reach(cost * costs.level + costs.height, here, max(energy, 0.0))
            return end - here + (energy - needed) / free.consumption if found is None else found

        def sd(way: float) -> float:
            return sqrt(variance + SEGMENT_SD**2 * SEGMENT / max(way, SEGMENT))

        range_ = reach(free.energy)
        within = min(range_, end - here)
        on_route = within / range_ if range_ > 0 else 1.0
        spread = on_route * sd(range_) + (1 - on_route) * free.consumption_sd / free.consumption
        low, high = deciles(free.energy, free.energy_sd, free.energy_sd_up, spread**2)
        arrival = self._arrival(free, pack, needed, level * sd(end - here))
        ends = range_ if range_ < end - here else None
        self.answer = Answer(
            RouteState.ON,
            here,
            end - here,
            needed,
            level * sd(end - here),
            *arrival,
            ends,
            None if ends is None else road.position.at(here + ends),
            (road.energy.between(costs.height, here, here + within), within),
        )
        expected = free.energy / range_ if range_ > 0 and free.energy > 0 else free.consumption
        known = on_route * self._known_from + (1 - on_route) * free.known_from
        return replace(
            free,
            range=range_,
            p10=reach(low),
            p90=reach(high),
            consumption=expected,
            consumption_sd=expected * spread,
            known_from=known,
        )

    def _arrival(self, free: Forecast, pack: Pack, needed: float, needed_sd: float) -> tuple[float, float, float]:
        """State of charge at the end of the route, P10 and P90, as shown; 0 where the battery ends before.

        What is not known of the energy, beside the state of charge, counts for the part that the way takes.
        """
        if free.energy <= 0:
            return 0.0, 0.0, 0.0
        window, left, share = self._forecaster.battery.window, free.left, 1 - needed / free.energy
        per_energy, known = (pack.soc - left.end) / free.energy, pack.soc_sd**2
        taken = min(needed / free.energy, 1.0)
        down, up = (
            DECILE * sqrt((needed_sd * per_energy) ** 2 + known + taken**2 * max((of * per_energy) ** 2 - known, 0.0))
            for of in (free.energy_sd, free.energy_sd_up)
        )
        arrival = soc_left(left, pack.soc, share) if share > 0 else left.end + share * free.energy * per_energy
        median, p10, p90 = (
            min(max(window.shown(x, 0.0)[0], 0.0), 1.0) if x > left.end else 0.0
            for x in (arrival, arrival - down, arrival + up)
        )
        return median, p10, p90

    # --- results ----------------------------------------------------------------------------------------------

    def report(self, estimate: Estimate) -> None:
        """Put what is known of the route into `estimate`."""
        a = self.answer
        if a.state is RouteState.NONE:
            return
        estimate.route_state, estimate.route_along, estimate.route_left = a.state, a.along, a.left
        estimate.route_energy, estimate.route_energy_sd = a.energy, a.energy_sd
        estimate.arrival_soc, estimate.arrival_soc_p10, estimate.arrival_soc_p90 = a.soc, a.soc_p10, a.soc_p90
        estimate.battery_ends_after = a.ends_after
        estimate.battery_ends_latitude, estimate.battery_ends_longitude = a.ends_at or (None, None)

    def restore(self, saved: Any) -> None:
        """Take what `rider.snapshot` gave, or begin anew; call it after the forecaster's."""
        self.rider = restored(saved)
        self.rider.check(*self._factor)
