"""Range along a known road: energy to the end of a route, charge left there, or where the battery ends before.

The forward model is ridden along the route at the speed that limits and bends allow, once, and again when the air has
changed. The cost of the way is kept in two parts: that of the level road, which is corrected by the cost of the part
already ridden (measured over modelled energy, a scalar Kalman filter), and that of height, which is not. Until some
of the route is ridden the correction is the consumption factor of the riding in general.

The range is the distance along the route that the energy left goes, and beyond its end at the consumption expected
without a route.

With a receiver and a route that has positions it is followed by both: the distance ridden says where the vehicle should
be by now, and the nearest place of the route around there corrects that. So roads that the route takes twice, loops and
turning back do not make it jump. After some way off the route, or against its direction, the vehicle has left it. Then
all of the route is searched for the place that it is at, in the route's direction; of several, the one nearest to where
the distance ridden since would have led. Without either, it is where the distance ridden since the route was given
says.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import cos, exp, inf, pi, radians, sqrt
from typing import TYPE_CHECKING, Any, NamedTuple

from gz_onboard.constants import DECILE, METRES_PER_DEGREE
from gz_onboard.estimator.forecast import Forecast, Forecaster, deciles
from gz_onboard.estimator.load_model import Conditions, LoadModel
from gz_onboard.estimator.motion import Motion
from gz_onboard.estimator.signals import FIX_2D, Signals
from gz_onboard.events import Estimate, RouteState
from gz_onboard.model.drawable import soc_left
from gz_onboard.model.effect import MOVING
from gz_onboard.model.effects.inertia import rotating_mass
from gz_onboard.model.functions import sqrt as root
from gz_onboard.routes.route import Route, speed_profile

if TYPE_CHECKING:
    from gz_onboard.arrays import Array


@dataclass(frozen=True)
class RouteConfig:
    """How a route is followed and its cost is learned."""

    # Position; m unless stated
    off: float = 50.0  # from the route: a receiver in a town and a map are off by 20 m together
    leaving: float = 60.0  # ridden off the route before that is believed: receivers err for seconds
    joining: float = 30.0  # from the route, to be taken as on it again
    staying: float = 40.0  # ridden on it before that is believed
    staying_far: float = 300.0  # the same, where it would be a leap along the route
    leap: float = 500.0  # along the route, besides the distance ridden off it
    around: float = 130.0  # to both sides of where it should be: 80, and 5 % of a tunnel of 1 km
    longitudinal: float = 5.0  # a metre along the route counts so much less than one across
    gain: float = 0.3  # share of the difference along the route that one fix corrects
    against: float = 2.0  # rad between the course and the route's heading: ridden the other way
    compared: float = 1500.0  # over which heights are compared: a receiver's altitude drifts by some metres on it
    min_compared: float = 700.0  # of that, before which nothing is said
    heights_apart: float = 0.02  # of the way: differing by more they are of two roads
    heights_alike: float = 0.01  # by less of one again
    step: float = 100.0  # longer ones, or farther from the distance ridden: along the route it was placed elsewhere

    # Cost
    segment_m: float = 250.0  # of the route from which the cost is learned
    segment_sd: float = 0.25  # relative, of a segment's measured over modelled energy; recorded full discharges
    cost_walk_sd: float = 0.003  # of the change of the cost over a segment: wind, traffic
    initial_sd: float = 0.1  # relative, of the cost over the consumption factor; eight commissioning rides
    cost_limits: tuple[float, float] = (0.2, 5.0)  # beyond, another road is ridden
    ahead_sd: float = 0.015  # relative, of the cost of the rest, beyond the scatter of its segments
    detour_share: float = 0.1  # of a segment: ridden so much more or less, it teaches nothing
    evened_share: float = 0.6  # of the differences in cost along the route; slow roads have stops that no map shows
    min_course_speed: float = 3.0  # m/s: slower, the heading is noise
    ambient_step: float = 2.0  # K: at such a change the route is modelled again
    altitude_step: float = 200.0  # m: the same


CONFIG = RouteConfig()


class RoutePosition:
    """Follows the vehicle along a route. `along`: how far along it is [m], while it is `on` it."""

    def __init__(self, route: Route) -> None:
        """Import numpy."""
        import numpy as np

        self._np, self.along, self.on = np, 0.0, True
        self._placed = False  # a fix has been seen
        self._away = 0.0  # m ridden off the route, or against it
        self._candidate: float | None = None  # m: where it may be on the route again
        self._stayed = 0.0  # m ridden there
        self._distance = np.array(route.distance)
        self._latitude = np.array(route.latitude)
        self._longitude = np.unwrap(np.array(route.longitude), period=360.0)

    def at(self, along: float) -> tuple[float | None, float | None]:
        """Latitude and longitude [deg] at a distance along the route [m]; None if the route has no positions."""
        if not len(self._latitude):
            return None, None
        interp = self._np.interp
        longitude = float(interp(along, self._distance, self._longitude))
        return float(interp(along, self._distance, self._latitude)), (longitude + 180.0) % 360.0 - 180.0

    def update(self, moved: float, fix: tuple[float, float] | None, course: float | None) -> None:
        """Move by `moved` [m]; fix: latitude and longitude [deg], if known; course [rad], if it is moving."""
        self.along += moved
        if fix is None or not len(self._latitude):
            self._away += 0.0 if self.on else moved
        elif self.on and self._placed:
            self._follow(moved, fix, course)
        else:
            self._search(moved, fix, course)
        if self.on and self.along >= self._distance[-1]:
            self.along, self.on = float(self._distance[-1]), False

    def _follow(self, moved: float, fix: tuple[float, float], course: float | None) -> None:
        config = CONFIG
        along, off, turned = self._places(fix, course, config.around)
        on = False
        if len(along):
            best = (off**2 + ((along - self.along) / config.longitudinal) ** 2).argmin()
            if off[best] < config.off:
                self.along += config.gain * float(along[best] - self.along)
                on = bool(turned[best] < config.against)
        self._away = 0.0 if on else self._away + moved
        if self._away > config.leaving:
            self.on, self._candidate = False, None

    def _search(self, moved: float, fix: tuple[float, float], course: float | None) -> None:
        """Look for the vehicle on all of the route."""
        config, first = CONFIG, not self._placed
        self._away, self._placed, self.on = self._away + moved, True, False
        along, off, turned = self._places(fix, course, inf)
        along = along[(off < config.joining) & (turned < pi / 2)]
        if not len(along):
            self._candidate = None
            return
        expected = self.along if self._candidate is None else self._candidate + moved
        place = float(along[abs(along - expected).argmin()])
        stays = self._candidate is not None and abs(place - expected) <= config.around
        self._candidate, self._stayed = place, self._stayed + moved if stays else 0.0
        far = abs(place - self.along)
        if (first and far < config.around) or self._stayed >= (
            config.staying_far if far > config.leap + self._away else config.staying
        ):
            self.along, self.on, self._away = place, True, 0.0

    def _places(self, fix: tuple[float, float], course: float | None, around: float) -> tuple[Array, Array, Array]:
        """Of each piece of the route within `around` [m]: the place nearest to `fix`.

        Gives its distance along the route [m], how far it is from the fix [m], and the angle [rad] between the course
        and the route there, 0 without a course.
        """
        np = self._np
        low, high = np.searchsorted(self._distance, (self.along - around, self.along + around))
        some = slice(max(int(low) - 1, 0), int(high) + 1)
        x = (self._longitude[some] - fix[1] + 180.0) % 360.0 - 180.0
        x, y = x * METRES_PER_DEGREE * cos(radians(fix[0])), (self._latitude[some] - fix[0]) * METRES_PER_DEGREE
        dx, dy, length = np.diff(x), np.diff(y), np.diff(self._distance[some])
        share = np.clip(-(x[:-1] * dx + y[:-1] * dy) / (dx**2 + dy**2), 0.0, 1.0)
        off = np.hypot(x[:-1] + share * dx, y[:-1] + share * dy)
        turned = 0.0 * off if course is None else np.abs((course - np.arctan2(dx, dy) + pi) % (2 * pi) - pi)
        return self._distance[some][:-1] + share * length, off, turned


class HeightCheck:
    """Whether the hills of a route are those ridden: a file of another road, or in feet, has others.

    Compares the height that the route gains with that which the vehicle gains on it, over the latest kilometre or so.
    """

    def __init__(self) -> None:
        self.contradicts = False
        self._before: tuple[float, float] | None = None  # m along the route, m of altitude
        self._way = self._apart = 0.0  # m, fading

    def update(self, along: float, ridden: float, climb: float, altitude: float | None) -> None:
        """The vehicle is at `along` [m] of the route, `ridden` [m] since the last update.

        climb: that the route gains between the two [m]; altitude: measured [m], None if it is not known.
        """
        config, before = CONFIG, self._before
        self._before = None if altitude is None else (along, altitude)
        if before is None or altitude is None:
            return
        way, gained = along - before[0], altitude - before[1]
        if not 0 < way < config.step or abs(way - ridden) > config.step or abs(gained) > way:
            return
        kept = exp(-way / config.compared)
        self._way, self._apart = kept * self._way + way, kept * self._apart + climb - gained
        if self._way > config.min_compared:
            limit = config.heights_alike if self.contradicts else config.heights_apart
            self.contradicts = abs(self._apart) > limit * self._way


class RouteCosts(NamedTuple):
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
        self.distance, self.speed = map(np.array, profile)
        middles = (self.distance[1:] + self.distance[:-1]) / 2
        known = {"grade": route.grade, "curvature": route.curvature, "heading": route.heading}
        known |= {"headwind": route.headwind or (0.0,) * len(route.distance)}
        self._pieces = {name: np.interp(middles, route.distance, values) for name, values in known.items()}
        self.length = float(self.distance[-1])  # m
        self.climb = np.concatenate(([0.0], np.cumsum(self._pieces["grade"] * np.diff(self.distance))))
        self._stops = np.zeros(len(middles))  # s
        if route.stop:
            ends = np.searchsorted(self.distance, np.array(route.distance))
            np.add.at(self._stops, np.minimum(ends, len(middles) - 1), np.array(route.stop))

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
        way = np.concatenate(([start], self.distance[first:]))
        used = np.concatenate(([0.0], total[first:] - np.interp(start, self.distance, total)))
        beyond = np.flatnonzero(used >= energy)
        if not len(beyond):
            return None
        i = beyond[0]
        share = (energy - used[i - 1]) / (used[i] - used[i - 1])
        return float(way[i - 1] + share * (way[i] - way[i - 1])) - start

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


# Fields of an estimate about the route: the position on it and the way ahead.
REPORTED = tuple(f.name for f in fields(Estimate) if f.name.startswith(("route_", "arrival_", "battery_ends_")))


class RouteForecaster:
    """Follows the vehicle along a route and forecasts on it. Without a route it costs nothing.

    `outlook`: an estimate of which only the fields `REPORTED` count. `cost`: measured over modelled energy of the level
    road, with `variance`. `hills`: the energy [J] that heights take on the part [m] of the range that lies on
    the route.
    """

    def __init__(self, forecaster: Forecaster, motion: Motion, signals: Signals) -> None:
        model = forecaster.load.model
        self.outlook, self.hills, self.cost, self.variance = Estimate(0.0), (0.0, 0.0), 1.0, 0.0
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
        self.outlook = Estimate(0.0, route_state=RouteState.OFF if route else RouteState.NONE)
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
        if on is not (self.outlook.route_state is RouteState.ON):  # the display has another basis now
            self._forecaster.smoother.show_next(on_route=on)
        if not on:
            self._segment, self.outlook, self.hills = None, Estimate(0.0, route_state=RouteState.OFF), (0.0, 0.0)
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
                self.variance = learner.state.habits.factor.variance + (config.initial_sd * learner.factor) ** 2
            self.costs = costs = route.costs(self._forecaster.load, air, self._forecaster.load.time_moving)
        self._learn(route, costs)
        return self._ahead(route, costs, free, soc, loss_variance)

    def report(self) -> dict[str, Any]:
        """Return the fields of an estimate about the route; none without one."""
        return {name: getattr(self.outlook, name) for name in REPORTED} if self._route else {}

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
        latitude, longitude = (None, None) if ends is None else route.position.at(here + ends)
        arrival, arrival_p10, arrival_p90 = self._arrival(free, soc, needed, needed_sd)
        self.outlook = Estimate(
            0.0,
            route_state=RouteState.ON,
            route_along=here,
            route_left=left,
            route_energy=needed,
            route_energy_sd=needed_sd,
            arrival_soc=arrival,
            arrival_soc_p10=arrival_p10,
            arrival_soc_p90=arrival_p90,
            battery_ends_after=ends,
            battery_ends_latitude=latitude,
            battery_ends_longitude=longitude,
        )
        self.hills = route.between(costs.height, here, here + within), within
        expected = free.energy / range_ if range_ > 0 and free.energy > 0 else free.consumption
        known_from = config.segment_m * config.segment_sd**2 / self.variance  # riding that would tell as much
        return free._replace(
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
