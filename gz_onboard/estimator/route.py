"""Range along a known road: energy to the end of a route, charge left there, or where the battery ends before.

The forward model is ridden along the route at the speed that limits and bends allow, once, and again when the air has
changed. The cost of the way is kept in two parts: that of the level road, which is corrected by the cost of the part
already ridden (measured over modelled energy, a scalar Kalman filter), and that of height, which is not. Until some
of the route is ridden the correction is the consumption factor of the riding in general.

The range is the distance along the route that the energy left goes, and beyond its end at the consumption expected
without a route.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, sqrt
from typing import TYPE_CHECKING, Any

from gz_onboard.estimator.forecast import Forecast, Forecaster
from gz_onboard.estimator.interval import DECILE, deciles
from gz_onboard.estimator.load_model import Conditions, LoadModel
from gz_onboard.estimator.motion import Motion
from gz_onboard.estimator.route_position import HeightCheck, RoutePosition
from gz_onboard.estimator.signals import FIX_2D, Signals
from gz_onboard.events import Estimate, RouteState
from gz_onboard.physics.drawable import soc_left
from gz_onboard.physics.effect import MOVING
from gz_onboard.physics.effects.inertia import rotating_mass
from gz_onboard.physics.functions import sqrt as root
from gz_onboard.routes.route import Route, speed_profile

if TYPE_CHECKING:
    from gz_onboard.arrays import Array


@dataclass(frozen=True)
class RouteConfig:
    """Constants of the forecast along a route."""

    segment_m: float = 250.0  # of the route from which the cost is learned
    segment_sd: float = 0.25  # relative, of a segment's measured over modelled energy; recorded full discharges
    cost_walk_sd: float = 0.003  # of the change of the cost over a segment: wind, traffic
    initial_sd: float = 0.1  # relative, of the cost over the consumption factor; eight commissioning rides
    cost_limits: tuple[float, float] = (0.2, 5.0)  # beyond, the route is not what is ridden
    ahead_sd: float = 0.015  # relative, of the cost of what is left, beyond what its segments scatter
    detour_share: float = 0.1  # of a segment: ridden so much more or less, it teaches nothing
    evened_share: float = 0.6  # of the differences in cost along the route; slow roads have stops that no map shows
    min_course_speed: float = 3.0  # m/s: slower, the heading is noise
    ambient_step: float = 2.0  # K: at such a change the route is modelled again
    altitude_step: float = 200.0  # m: the same


CONFIG = RouteConfig()


@dataclass(frozen=True)
class RouteCosts:
    """Modelled energies from the start of the route to each of its points [J], shape (n,)."""

    level: Array
    height: Array
    air: Conditions


class PreparedRoute:
    """A route cut into pieces, with where the vehicle is on it.

    `distance` [m] of the ends of the pieces, `speed` [m/s] that limits and bends allow there, `climb` [m] from the
    start; shape (n,).
    """

    def __init__(self, route: Route, top_speed: float) -> None:
        """Import numpy and take up to a second. top_speed: of a rider where the route has no limit [m/s]."""
        import numpy as np

        self._np, self.route, self.position = np, route, RoutePosition(route)
        profile = speed_profile(route, top_speed=top_speed if min(route.speed_limit) == inf else inf)
        self.distance, self.speed = np.array(profile.distance), np.array(profile.speed)
        middles = (self.distance[1:] + self.distance[:-1]) / 2
        known = {"grade": route.grade, "curvature": route.curvature, "heading": route.heading}
        known |= {"headwind": route.headwind or (0.0,) * len(route.distance)}
        self._pieces = {name: np.interp(middles, route.distance, values) for name, values in known.items()}
        self.climb = np.concatenate(([0.0], np.cumsum(self._pieces["grade"] * np.diff(self.distance))))
        self._stops = np.zeros(len(middles))  # s
        if route.stop:
            ends = np.searchsorted(self.distance, np.array(route.distance))
            np.add.at(self._stops, np.minimum(ends, len(middles) - 1), np.array(route.stop))

    @property
    def length(self) -> float:
        """Length of the route [m]."""
        return float(self.distance[-1])

    def between(self, values: Array, start: float, end: float) -> float:
        """How much of the running total `values` (n,) lies between two distances [m]."""
        first, last = self._np.interp((start, end), self.distance, values)
        return float(last - first)

    def reach(self, total: Array, start: float, energy: float) -> float | None:
        """How far [m] beyond `start` [m] the `energy` [J] goes, for a running `total` (n,) [J]; None: to the end."""
        np = self._np
        if energy <= 0:
            return 0.0
        first = int(np.searchsorted(self.distance, start, side="right"))
        here = np.interp(start, self.distance, total)
        way = np.concatenate(([start], self.distance[first:]))
        used = np.concatenate(([0.0], total[first:] - here))
        beyond = np.flatnonzero(used >= energy)
        if not len(beyond):
            return None
        i = beyond[0]
        share = (energy - used[i - 1]) / (used[i] - used[i - 1])
        return float(way[i - 1] + share * (way[i] - way[i - 1]) - start)

    def costs(self, load: LoadModel, air: Conditions, time_moving: float) -> RouteCosts:
        """Model the whole route in this `air`; time_moving: of the ride so far [s]. About 1 ms for each 10 km."""
        np = self._np
        length = np.diff(self.distance)
        speed = (self.speed[1:] + self.speed[:-1]) / 2
        times = length / speed
        acceleration = np.diff(self.speed**2) / (2 * length)
        moving = time_moving + np.cumsum(times)
        flat, hilly = (self._power(load, air, speed, acceleration, moving, hills) for hills in (False, True))
        energy = flat * times
        if self.route.stop:
            energy += self._power(load, air, 0.0 * speed, 0.0 * speed, moving, False) * self._stops
        level, height = (np.concatenate(([0.0], np.cumsum(x))) for x in (energy, (hilly - flat) * times))
        evened = CONFIG.evened_share * level[-1] * self.distance / self.length
        return RouteCosts((1 - CONFIG.evened_share) * level + evened, height, air)

    def _power(
        self, load: LoadModel, air: Conditions, speed: Array, acceleration: Array, moving: Array, hills: bool
    ) -> Array:
        """Power at the pack [W] on each piece, at speed [m/s], acceleration [m/s²] and time moving [s], each (n-1,)."""
        pieces = self._pieces
        bends: Any = air._replace(
            lateral_acceleration=speed * speed * pieces["curvature"],
            heading=pieces["heading"],
            vibration=load.prior.vibration * (speed > MOVING),  # type: ignore[arg-type]
        )
        q: dict[str, Any] = load.quantities(speed, acceleration, bends, time_moving=moving)  # type: ignore[arg-type]
        if hills:
            q |= {"grade": pieces["grade"], "grade_cosine": root(1 - pieces["grade"] ** 2)}
        q["headwind"] = pieces["headwind"]
        power: Array = self._np.zeros(len(speed)) + sum(load.model.power(q).values())
        return power


@dataclass(frozen=True, slots=True)
class RouteOutlook:
    """Forecast of the way ahead, by the names of `Estimate`; SI units. None: not known, or not on the route."""

    route_state: RouteState = RouteState.NONE
    route_along: float | None = None
    route_left: float | None = None
    route_energy: float | None = None  # to the end of the route
    route_energy_sd: float | None = None
    arrival_soc: float | None = None  # 0 if the battery ends before
    arrival_soc_p10: float | None = None
    arrival_soc_p90: float | None = None
    battery_ends_after: float | None = None
    battery_ends_latitude: float | None = None
    battery_ends_longitude: float | None = None


_NAMES = tuple(RouteOutlook.__dataclass_fields__)


class RouteForecaster:
    """Follows the vehicle along a route and forecasts on it. Without a route it costs nothing.

    `cost`: measured over modelled energy of the level road, with `variance`. `hills`: the energy [J] that heights take
    on the part [m] of the range that lies on the route.
    """

    def __init__(self, forecaster: Forecaster, motion: Motion, signals: Signals) -> None:
        model = forecaster.load.model
        self.outlook, self.hills, self.cost, self.variance = RouteOutlook(), (0.0, 0.0), 1.0, 0.0
        self.costs: RouteCosts | None = None
        self._forecaster, self._motion, self._signals = forecaster, motion, signals
        self._moving_mass = model.mass + rotating_mass(model.parameters)
        self._route: PreparedRoute | None = None
        self._segment: tuple[float, float] | None = None  # where it began: m along the route, m/s
        self._energy = self._ridden = 0.0  # J, m: of the segment
        self._distance = 0.0  # m of the vehicle at the last forecast
        self._heights = HeightCheck()

    def prepare(self, route: Route) -> PreparedRoute:
        """Make `route` ready, in any thread. Without limits the fastest speed of the prior riding is the limit."""
        return PreparedRoute(route, max(speed for _, speed, _ in self._forecaster.load.prior.points))

    def follow(self, route: PreparedRoute | None) -> None:
        """Have `route` from now on, or none."""
        self._route, self.costs, self._segment = route, None, None
        self._distance, self._heights = self._motion.distance, HeightCheck()
        self._forecaster.smoother.show_next()
        self.outlook = RouteOutlook(RouteState.OFF if route else RouteState.NONE)
        self.hills = 0.0, 0.0

    def ride(self, dt: float, speed: float, power: float) -> None:
        """Take in `dt` [s] of riding at `speed` [m/s] and `power` [W] of the pack."""
        if self._segment and not self._forecaster.learner.towed:
            self._ridden += abs(speed) * dt
            self._energy += (power - self._forecaster.learner.auxiliaries.now) * dt

    def forecast(
        self, now: float, free: Forecast, soc: tuple[float, float], loss_variance: float, air: Conditions
    ) -> Forecast:
        """The forecast along the route; to be made once a second.

        now: [s]. free: the forecast without a route. soc: state of charge and its sd. loss_variance: relative variance
        that missing sensors add to the consumption.
        """
        route = self._route
        if route is None:
            return free
        self._move(now, route)
        on = route.position.on and not self._heights.contradicts
        if on is not (self.outlook.route_state is RouteState.ON):  # what is shown now stands on something else
            self._forecaster.smoother.show_next(on_route=on)
        if not on:
            self._segment, self.outlook, self.hills = None, RouteOutlook(RouteState.OFF), (0.0, 0.0)
            return free
        costs, config = self.costs, CONFIG
        if (
            costs is None
            or abs(air.ambient - costs.air.ambient) > config.ambient_step
            or abs(air.altitude - costs.air.altitude) > config.altitude_step
        ):
            if costs is None:
                learner = self._forecaster.learner
                self.cost = learner.factor
                self.variance = learner.habits.factor.variance + (config.initial_sd * learner.factor) ** 2
            self.costs = costs = route.costs(self._forecaster.load, air, self._forecaster.learner.time_moving)
        self._learn(route, costs)
        return self._ahead(route, costs, free, soc, loss_variance)

    def report(self, estimate: Estimate) -> None:
        """Write the outlook into `estimate`."""
        if self._route:
            for name in _NAMES:
                setattr(estimate, name, getattr(self.outlook, name))

    def _move(self, now: float, route: PreparedRoute) -> None:
        signals, motion, before = self._signals, self._motion, route.position.along
        moved, self._distance = motion.distance - self._distance, motion.distance
        latitude, longitude = signals.latitude.get(now), signals.longitude.get(now)
        fix = None
        if latitude is not None and longitude is not None and not signals.fix_below(now, FIX_2D):
            fix = latitude, longitude
        course = motion.heading if (motion.speed or 0.0) > CONFIG.min_course_speed else None
        route.position.update(moved, fix, course)
        if route.route.grade_known and route.position.on:
            here = route.position.along
            self._heights.update(here, moved, route.between(route.climb, before, here), motion.altitude)

    def _learn(self, route: PreparedRoute, costs: RouteCosts) -> None:
        """Learn the cost if a segment ends here, by a scalar Kalman filter."""
        config, speed, along = CONFIG, self._motion.speed or 0.0, route.position.along
        start, speed_before = self._segment or (along, speed)
        way = along - start
        if self._segment and 0 <= way < config.segment_m:
            return
        energy, ridden = self._energy, self._ridden
        self._segment, self._energy, self._ridden = (along, speed), 0.0, 0.0
        if way < config.segment_m or abs(ridden - way) > config.detour_share * way:
            return
        level, height, squares = (route.between(x, start, along) for x in (costs.level, costs.height, route.speed**2))
        mean = way * float(costs.level[-1]) / route.length  # the unit of energy
        modelled = (level - self._moving_mass * squares / 2) / mean
        kinetic = self._moving_mass * (speed**2 - speed_before**2) / 2
        measured = (energy - height - kinetic) / mean
        variance = self.variance + config.cost_walk_sd**2
        gain = variance * modelled / (modelled**2 * variance + config.segment_sd**2)
        cost = self.cost + gain * (measured - self.cost * modelled)
        self.cost = min(max(cost, config.cost_limits[0]), config.cost_limits[1])
        self.variance = variance * (1 - gain * modelled)

    def _ahead(
        self, route: PreparedRoute, costs: RouteCosts, free: Forecast, soc: tuple[float, float], loss_variance: float
    ) -> Forecast:
        here, config = route.position.along, CONFIG
        left = route.length - here
        cost = self.cost + self._forecaster.learner.auxiliary_factor
        variance = self.variance / cost**2 + config.ahead_sd**2 + loss_variance
        level = cost * route.between(costs.level, here, route.length)
        needed = level + route.between(costs.height, here, route.length)

        total = cost * costs.level + costs.height

        def reach(energy: float) -> float:
            found = route.reach(total, here, energy)
            return left + (energy - needed) / free.consumption if found is None else found

        def relative_sd(way: float) -> float:
            return sqrt(variance + config.segment_sd**2 * config.segment_m / max(way, config.segment_m))

        range_ = reach(free.energy)
        within = min(range_, left)
        on_route = within / range_ if range_ > 0 else 1.0
        spread = on_route * relative_sd(range_) + (1 - on_route) * free.consumption_sd / free.consumption
        low, high = deciles(free.energy, free.energy_sd, free.energy_sd_up, spread**2)
        needed_sd = level * relative_sd(left)
        ends = range_ if range_ < left else None
        ends_at = (None, None) if ends is None else route.position.at(here + ends)
        arrival = self._arrival(free, soc, needed, needed_sd)
        self.outlook = RouteOutlook(RouteState.ON, here, left, needed, needed_sd, *arrival, ends, *ends_at)
        self.hills = route.between(costs.height, here, here + within), within
        expected = free.energy / range_ if range_ > 0 and free.energy > 0 else free.consumption
        known_from = config.segment_m * config.segment_sd**2 / self.variance  # riding that would tell as much
        return replace(
            free,
            range=range_,
            p10=reach(low),
            p90=reach(high),
            consumption=expected,
            consumption_sd=expected * spread,
            known_from=on_route * known_from + (1 - on_route) * free.known_from,
        )

    def _arrival(
        self, free: Forecast, soc: tuple[float, float], needed: float, needed_sd: float
    ) -> tuple[float, float, float]:
        """State of charge at the end of the route, P10 and P90, as shown; 0 where the battery ends before.

        The uncertainty of the energy, apart from the state of charge, counts for the part that the way takes.
        """
        if free.energy <= 0:
            return 0.0, 0.0, 0.0
        (now, sd), left, taken = soc, free.left, needed / free.energy
        per_energy = (now - left.end) / free.energy
        here = soc_left(left, now, 1 - taken) if taken < 1 else left.end - (taken - 1) * free.energy * per_energy

        def deviation(energy_sd: float) -> float:
            of_energy = max((energy_sd * per_energy) ** 2 - sd**2, 0.0)
            return DECILE * sqrt((needed_sd * per_energy) ** 2 + sd**2 + min(taken, 1.0) ** 2 * of_energy)

        def shown(soc: float) -> float:
            return self._forecaster.battery.window.shown(soc, 0.0)[0] if soc > left.end else 0.0

        return shown(here), shown(here - deviation(free.energy_sd)), shown(here + deviation(free.energy_sd_up))
