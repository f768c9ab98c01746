"""Consumption of the riding: energy and time per metre, learned for each rider.

The riding is gathered by the second, and the seconds in segments of 250 m. Of each segment the pack's energy is
compared with the forward model's, which gives four quantities (`Habits`). The first three are relative to the prior
riding of the vehicle file in the same air, so that cold air or a high pass is not taken for a habit:

- price: energy per metre in motion, less the energy that height and speed have stored;
- stops: energy per metre at stops, in units of that price; one long wait must not look like expensive riding;
- pace: time per metre, stops included;
- factor: measured over modelled energy of the same motion, the error of the parameters.

Each is one Kalman filter of a slow level and a faster deviation (`LearnedQuantity`). The expected price, and the
variance of its mean over the way ahead, follow from the filters' states. The power of auxiliaries is measured once,
here, where a sensor shows it, and is kept out of all four: it is watts, and no price of a metre.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, inf, sqrt
from typing import Any, NamedTuple

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.load_model import USUAL_AIR, Conditions, LoadModel
from gz_onboard.estimator.motion import MOTION
from gz_onboard.estimator.saved_state import FINITE, Each, Number, Text
from gz_onboard.model.battery import Battery
from gz_onboard.model.effect import MOVING
from gz_onboard.model.effects.inertia import rotating_mass
from gz_onboard.model.model import Model
from gz_onboard.model.riding import PriorRiding


@dataclass(frozen=True)
class ConsumptionConfig:
    """How fast the riding is learned. Variances and sd of `Habits` are relative, as these are."""

    # Gathering
    segment_m: float = 250.0  # one update of the filters; in town, neighbours of this length are hardly alike
    memory_m: float = 12_000.0  # sums of the riding fade to 1/e over this
    recent_m: float = 1000.0  # the same for the recent consumption
    prior_m: float = 3000.0  # riding that the prior riding counts for in the sums
    history_segments: int = 40  # 10 km that a fault found later can be unlearned of
    acceleration_limit: float = 15.0  # m/s²: no road gives more; a second that shows more is left out
    ride_ends_s: float = 600.0  # standstill after which another ride begins
    tyres_cool_s: float = 3600.0  # standstill after which tyres are cold
    # Towing
    driving_force: float = 0.003  # of the weight: a motor that takes less does not drive; tyres take thrice that
    height_error_m: float = 3.0  # error of a climb that may explain how a vehicle moves without its motor
    # Filters
    fade_m: float = 50_000.0  # correlation length of a ride's deviation: 25 to 100 km err alike on 15 full discharges
    walk_per_sqrt_m: float = 2.2e-4  # random walk of the level: a tenth in 200 km (tyres, clothes, seasons)
    ride_share: float = 0.1  # weight of one ride in the variance from ride to ride: about the last ten count
    min_sd: float = 0.005  # no riding is more even
    outlier_sd: float = 4.0  # a segment that differs by more is a faulty sensor or a wait for a ferry, and is clipped
    most: float = 10.0  # of any quantity; all are about 1, and a heated van in a jam takes 5 times the modelled energy
    max_variance: float = 4.0
    doubt: float = 1.25  # sd over the change that a faulty sensor taught: price and stops may err alike
    # Priors: sd of the level, from ride to ride, and of a segment
    level_sd: float = 0.15  # price of riders and roads of one kind of vehicle
    price_scatter: float = 0.2 / PriorRiding.drift  # sd of a segment's price over that of rides
    stops_sd: tuple[float, float, float] = (0.03, 0.01, 0.06)  # a wait of half a minute is 0.05 of the price
    pace_sd: tuple[float, float, float] = (0.25, 0.1, 0.4)
    factor_sd: tuple[float, float] = (0.03, 0.18)  # wind, tyres, luggage; a segment's, of eight commissioning rides
    # Forecast of the riding
    min_price: float = 0.2  # of the prior riding: no riding of any length consumes less
    form_factor_squared: float = 2.5  # mean square of the power over its mean squared, of eight commissioning rides
    form_factor_squared_limits: tuple[float, float] = (1.0, 6.0)  # the same, of any riding
    height_walk: float = 0.75  # m per sqrt(m): roads climb or fall by 60 m on 6 km, where no sensor shows the grade
    # Terrain
    stretch_m: float = 4000.0  # over which a net climb is one sample
    terrain_rate: float = 0.05  # m² per m, of the altitudes of 32 trips of a car, 0 to 0.24 each
    terrain_weight: float = 2.0  # stretches that this prior counts for
    terrain_memory: float = 50.0  # stretches
    # Auxiliaries
    auxiliary_mean_s: float = 180.0  # thermostats switch within this
    # Riders
    max_riders: int = 50
    max_name_letters: int = 40


CONSUMPTION = ConsumptionConfig()


class LearnedQuantity(NamedTuple):
    """A quantity of the riding: Kalman filter of a slow level and a faster deviation of the present ride from it.

    The level is a random walk over metres, the deviation a first-order Gauss-Markov process (Ornstein-Uhlenbeck) that
    begins with each ride, and a segment shows their sum with white scatter. The variance of the deviation is learned by
    a step of expectation and maximisation with each ride (Shumway & Stoffer 1982).
    """

    level: float
    level_variance: float
    ride_variance: float  # of the deviation, from ride to ride
    scatter: float  # variance of one segment
    deviation: float
    deviation_variance: float
    covariance: float = 0.0  # of level and deviation

    @property
    def now(self) -> float:
        """Of the present riding."""
        return self.level + self.deviation

    @property
    def variance(self) -> float:
        """Of `now`."""
        return self.level_variance + 2 * self.covariance + self.deviation_variance

    @property
    def known_from(self) -> float:
        """Riding [m] whose mean alone would have the variance of `now`."""
        return self.scatter * CONSUMPTION.segment_m / max(self.variance, 1e-6)

    def learned(self, residual: float, distance: float, noise: float = 0.0) -> LearnedQuantity:
        """State after `distance` [m] that differed from `now` by `residual`; noise: a variance besides the scatter."""
        c = CONSUMPTION
        fade = exp(-distance / c.fade_m)
        walk = (c.walk_per_sqrt_m * self.level) ** 2 * distance
        level = min(self.level_variance + walk, max(self.level_variance, c.max_variance))
        both = fade * self.covariance
        own = fade * fade * self.deviation_variance + (1 - fade * fade) * self.ride_variance
        scatter = self.scatter * c.segment_m / distance
        total = level + 2 * both + own + scatter + noise
        most = c.outlier_sd * sqrt(total)
        residual = min(max(residual + (1 - fade) * self.deviation, -most), most)
        gain, own_gain = (level + both) / total, (both + own) / total
        return LearnedQuantity(
            min(max(self.level + gain * residual, 0.0), c.most),
            level - gain * (level + both),
            self.ride_variance,
            self.scatter,
            min(max(fade * self.deviation + own_gain * residual, -c.most), c.most),
            own - own_gain * (both + own),
            both - gain * (both + own),
        )

    def scaled(self, by: float) -> LearnedQuantity:
        """The same quantity in a unit that is `by` times smaller."""
        return LearnedQuantity(*(x * by**power for x, power in zip(self, (1, 2, 2, 2, 1, 2, 2), strict=True)))

    def ahead(self, distance: float) -> tuple[float, float]:
        """(mean over the next `distance` [m], its variance): of a Gauss-Markov process given now, and its scatter."""
        lengths = max(distance, 1.0) / CONSUMPTION.fade_m
        share = (1 - exp(-lengths)) / lengths
        unknown = 2 * (1 - share) / lengths - share * share  # of the ride's variance
        variance = self.level_variance + 2 * share * self.covariance + share * share * self.deviation_variance
        variance += unknown * self.ride_variance + self.scatter * min(CONSUMPTION.segment_m / max(distance, 1.0), 1.0)
        return self.level + share * self.deviation, variance

    def next_ride(self) -> LearnedQuantity:
        """State before another ride; the deviation of this one teaches how unlike rides are."""
        c = CONSUMPTION
        seen = self.deviation**2 + self.deviation_variance
        ride_variance = self.ride_variance + c.ride_share * (seen - self.ride_variance)
        ride_variance = min(max(ride_variance, c.min_sd**2), c.max_variance)
        return LearnedQuantity(self.level, self.level_variance, ride_variance, self.scatter, 0.0, ride_variance)

    def doubted(self, seen: float) -> LearnedQuantity:
        """State with a wider deviation, as it may be `seen` all the same, which a sensor in doubt has shown."""
        more = self.deviation_variance + (CONSUMPTION.doubt * (seen - self.now)) ** 2
        return self._replace(deviation_variance=min(more, max(self.deviation_variance, CONSUMPTION.max_variance)))


class Habits(NamedTuple):
    """Riding of one rider. All but the factor are in units of the prior riding."""

    price: LearnedQuantity
    stops: LearnedQuantity
    pace: LearnedQuantity
    factor: LearnedQuantity

    @classmethod
    def before(cls, prior: PriorRiding, stops: float) -> Habits:
        """Before anything is ridden; stops: of the prior riding."""
        c = CONSUMPTION
        price_sd = sqrt(prior.factor_sd**2 + c.level_sd**2), prior.drift, max(c.price_scatter * prior.drift, c.min_sd)
        levels = prior.factor, stops, 1.0, prior.factor
        sds = price_sd, c.stops_sd, c.pace_sd, (prior.factor_sd, *c.factor_sd)
        return cls(
            *(
                LearnedQuantity(level, sd * sd, ride * ride, segment * segment, 0.0, ride * ride)
                for level, (sd, ride, segment) in zip(levels, sds, strict=True)
            )
        )

    def next_ride(self) -> Habits:
        """Before another ride."""
        return Habits(*(quantity.next_ride() for quantity in self))


class Segment(NamedTuple):
    """Sums over some riding; energies in J at the pack's terminals, without auxiliaries beyond the file's."""

    distance: float = 0.0  # m
    duration: float = 0.0  # s
    measured: float = 0.0  # J, in motion
    stops: float = 0.0  # J, measured at stops
    auxiliary: float = 0.0  # J, of auxiliaries beyond the file's
    squares: float = 0.0  # W²·s, of the measured power
    modelled: float = 0.0  # J, in motion
    level: float = 0.0  # J, modelled, less what height and speed have stored
    unseen: float = 0.0  # m of which no sensor showed the grade
    climb: float = 0.0  # m, of the rest
    prior: float = 0.0  # J, that the prior riding takes for the same way in the same air
    speed_squares: float = 0.0  # m³/s²: squared speed over the distance, for the explanation, as are
    grade_squares: float = 0.0  # m: squared grade
    lateral_squares: float = 0.0  # m³/s⁴: squared lateral acceleration

    @property
    def energy(self) -> float:
        """All that was measured, with those auxiliaries [J]."""
        return self.measured + self.stops + self.auxiliary

    def followed_by(self, segment: Segment, memory: float = inf) -> Segment:
        """These sums, weighted down over a `memory` [m], with those of a `segment` that came after."""
        fade = exp(-segment.distance / memory)
        return Segment(*(fade * old + new for old, new in zip(self, segment, strict=True)))


@dataclass(slots=True)
class Second:
    """Sums until the model is asked."""

    start_speed: float | None = None  # m/s
    seconds: float = 0.0
    distance: float = 0.0  # m, negative backwards
    unseen: float = 0.0  # m without a known grade
    energy: float = 0.0  # J
    motor: float = 0.0  # J of it into the motor
    squares: float = 0.0  # W²·s
    climb: float = 0.0  # m


class Terrain(NamedTuple):
    """How far roads climb or fall in the end, where no route tells the hills ahead.

    A hill gives its energy back, but for losses, which are part of the price of a metre. The height at which a way
    ends is unknown and grows as a random walk. Its rate is the mean square of the net climbs over stretches of 4 km,
    with a prior.
    """

    squares: float = 0.0  # m²: net climbs squared, over the stretches that count
    stretches: float = 0.0
    way: float = 0.0  # m, of the present stretch
    climb: float = 0.0  # m
    unseen: float = 0.0  # m

    @property
    def rate(self) -> float:
        """Variance of the height [m²] per metre of the way."""
        weight, stretch = CONSUMPTION.terrain_weight, CONSUMPTION.stretch_m
        prior = weight * CONSUMPTION.terrain_rate * stretch
        return (prior + self.squares) / ((weight + self.stretches) * stretch)

    def ridden(self, way: float, climb: float, unseen: float) -> Terrain:
        """After `way` [m] that climbed by `climb` [m], except for `unseen` [m] of it without a known grade."""
        stretch = CONSUMPTION.stretch_m
        way, climb, unseen = self.way + way, self.climb + climb, self.unseen + unseen
        if way < stretch:
            return Terrain(self.squares, self.stretches, way, climb, unseen)
        if unseen > way / 5 or abs(climb) > MOTION.max_grade * way:
            return Terrain(self.squares, self.stretches)
        keep = 1 - 1 / CONSUMPTION.terrain_memory
        return Terrain(keep * self.squares + climb * climb * stretch / way, keep * self.stretches + 1)

    def variance(self, way: float) -> float:
        """Of the height [m²] at which the next `way` [m] ends; on a short one the slope stays the same."""
        return self.rate * way * min(way / CONSUMPTION.stretch_m, 1.0)


@dataclass(slots=True)
class AuxiliaryPower:
    """Power of auxiliaries [W] beyond the vehicle file's, as their own sensors show it; 0 if none does.

    At standstill the pack's power shows nothing: a motor that holds the vehicle on a hill looks like a heater.
    """

    modelled: float  # the vehicle file's
    now: float = 0.0
    mean: float = 0.0
    seen: float = 0.0  # s that the mean is of

    def step(self, dt: float, total: float | None, loads: float | None = None) -> None:
        """Take in `dt` [s] of the power of all auxiliaries [W]; without it, that of heater and air conditioner alone.

        None: not measured.
        """
        beyond = loads if total is None else total - self.modelled
        if beyond is None:
            self.now = self.mean
            return
        self.now = beyond
        self.seen = min(self.seen + dt, CONSUMPTION.auxiliary_mean_s)
        if self.seen > 0:
            self.mean += min(dt / self.seen, 1.0) * (beyond - self.mean)

    def forget(self) -> None:
        """Drop the values of a faulty sensor."""
        self.now = self.mean = self.seen = 0.0


class RidingState(NamedTuple):
    """State of the learner at the end of a segment."""

    habits: Habits
    sums: Segment = Segment()  # faded over `memory_m`
    recent: Segment = Segment()  # faded over `recent_m`
    terrain: Terrain = Terrain()


class ExpectedRiding(NamedTuple):
    """The riding to come, and how much of it was ridden."""

    consumption: float  # J/m
    power: float  # W, mean
    form_factor_squared: float  # mean square of the power over the square of its mean
    variance: float  # of the consumption over the way to come, relative
    least: float  # J/m: no riding takes less
    recent: float | None  # J/m: over about the last kilometre, stops included; None: too short a way
    mostly_prior: bool  # less was ridden than the prior riding counts for


class ConsumptionLearner:
    """Learns the consumption of one vehicle. `state` is replaced as a whole at the end of each segment."""

    def __init__(self, model: Model, battery: Battery, prior: PriorRiding) -> None:
        self.load = LoadModel(model, battery, prior)
        moving, stops = self.load.prior_prices(*USUAL_AIR)
        self.prior_price = moving + stops  # J/m: with the prior's speed, the unit of saved habits
        self.prior = Habits.before(prior, stops / moving)
        self.state = RidingState(self.prior)
        modelled = any(p.name == "auxiliary_power" for effect in model.effects for p in effect.parameters)
        self.auxiliaries = AuxiliaryPower(model.parameters["auxiliary_power"] if modelled else 0.0)
        self.rider, self.other_riders = "", dict[str, Habits]()  # "": not known
        self.distance = 0.0  # m ridden, without towed metres
        self.rides = 0  # that have ended
        self.still = 0.0  # s since the last motion
        self.towed = False
        self._coasted = self._unexplained = 0.0  # m without the motor, and J that nothing explains on them
        self._segment, self._second = Segment(), Second()
        self._history = deque[tuple[float, RidingState]](maxlen=CONSUMPTION.history_segments)
        self._weight = model.mass * GRAVITY  # N
        self._moving_mass = model.mass + rotating_mass(model.parameters)  # kg

    # --- results ------------------------------------------------------------------------------------------------

    @property
    def factor(self) -> float:
        """Measured over modelled energy of the present riding, without auxiliaries beyond the file's."""
        return min(max(self.state.habits.factor.now, 1 / CONSUMPTION.most), CONSUMPTION.most)

    @property
    def auxiliary_factor(self) -> float:
        """Increase of the consumption factor by auxiliaries beyond the file's, at the pace of the present riding."""
        least, speed = CONSUMPTION.min_price, self.load.prior.speed
        modelled = self.prior_price * max(self.state.habits.price.now, least) / self.factor  # J/m
        return self.auxiliaries.mean / speed * max(self.state.habits.pace.now, least) / modelled

    @property
    def consumption_factor(self) -> float:
        """Measured over modelled energy of the present riding."""
        return self.factor + self.auxiliary_factor

    def expected(self, way: float, ambient: float, altitude: float) -> ExpectedRiding:
        """The riding on the next `way` [m]; ambient in degC, altitude in m."""
        c, habits, sums, speed = CONSUMPTION, self.state.habits, self.state.sums, self.load.prior.speed
        unit, standing = self.load.prior_prices(ambient, altitude)
        price, price_variance = habits.price.ahead(way)
        stops, stops_variance = habits.stops.ahead(way)
        pace, pace_variance = habits.pace.ahead(way)
        price, pace = max(price, c.min_price), max(pace, c.min_price)
        extra = self.auxiliaries.mean / speed  # J/m, at the prior's pace
        consumption = max(unit * (price + max(stops, 0.0)) + extra * pace, c.min_price * unit)
        # Where no grade was seen the price is the model's times the factor, whose error is the same all the way.
        unseen = sums.unseen / sums.distance if sums.distance else 0.0
        price_variance += (unseen * price / self.factor) ** 2 * habits.factor.variance
        height_variance = self._weight**2 * self.state.terrain.variance(way) / (consumption * way) ** 2
        prior_power, prior_time = (unit + standing) * speed, c.prior_m / speed
        # Downhill next to nothing is drawn in the mean; the way to come is not all downhill.
        energy = prior_power * prior_time + max(sums.energy, self.consumption_factor * sums.level)
        energy = max(energy, c.min_price * prior_power * prior_time)
        squares = c.form_factor_squared * prior_power**2 * prior_time + sums.squares
        low, high = c.form_factor_squared_limits
        variance = ((price_variance + stops_variance) * unit**2 + pace_variance * extra**2) / consumption**2
        recent, now = self.state.recent, self._segment
        ridden, lately = sums.distance + now.distance, recent.distance + now.distance
        return ExpectedRiding(
            consumption,
            consumption * speed / pace,
            min(max(squares * (prior_time + sums.duration) / energy**2, low), high),
            variance + height_variance,
            c.min_price * unit,
            None if ridden < c.recent_m / 2 else (recent.energy + now.energy) / lately,
            ridden < c.prior_m,
        )

    # --- learning -----------------------------------------------------------------------------------------------

    def ride(
        self,
        dt: float,
        speed: float,
        grade: float | None,
        power: float,
        conditions: Conditions,
        period: float = 0.0,
        motor_power: float | None = None,
    ) -> None:
        """Take in `dt` [s] of riding at `speed` [m/s], `grade` (sine) and `power` [W] of the pack.

        period: of the speed's messages [s], as between two of them there is no acceleration; motor_power: into the
        motor [W], None for all.
        """
        self._gather(dt, speed, grade, power, power if motor_power is None else motor_power)
        second, c = self._second, CONSUMPTION
        if second.seconds < max(1.0, period):
            return
        start = speed if second.start_speed is None else second.start_speed
        mean, acceleration = second.distance / second.seconds, (speed - start) / second.seconds
        if abs(acceleration) > c.acceleration_limit:  # a sensor errs, or the wheel spins
            self.pause()
            return
        way, moving = abs(second.distance), abs(mean) > MOVING
        slope = max(min(second.climb / way, MOTION.max_grade), -MOTION.max_grade) if moving else 0.0
        q = self.load.quantities(mean, acceleration, conditions, slope, self.load.time_moving)
        modelled, repeated = (second.seconds * power for power in self.load.power_ridden(q, second.seconds))
        stored = self._weight * second.climb + self._moving_mass * (speed * speed - start * start) / 2
        auxiliary = self.auxiliaries.now * second.seconds
        measured = second.energy - auxiliary
        if moving and grade is not None:
            self._watch_towing(modelled - (repeated - stored + measured) / 2)
            if self.towed:
                self.pause()
                return
        if self.load.ledger:
            self.load.ledger.measured += second.energy
        if moving:
            self.still = 0.0
        else:
            self._stand(second.seconds)
        short = self.still <= MOTION.stop_time  # a longer stop takes energy, but teaches nothing
        self._second = Second(start_speed=speed)
        self._segment = self._segment.followed_by(
            Segment(
                distance=way,
                duration=second.seconds if short else 0.0,
                measured=measured if moving else 0.0,
                stops=measured if short and not moving else 0.0,
                auxiliary=auxiliary if short else 0.0,
                squares=second.squares if short else 0.0,
                modelled=modelled if moving else 0.0,
                level=(repeated if moving else 0.0) - stored,
                unseen=second.unseen,
                climb=second.climb,
                speed_squares=mean * mean * way,
                grade_squares=slope * slope * way,
                lateral_squares=q.get("lateral_acceleration", 0.0) ** 2 * way,
            )
        )
        if self._segment.distance >= c.segment_m:
            self._close(conditions)

    def _gather(self, dt: float, speed: float, grade: float | None, power: float, motor: float) -> None:
        second, way = self._second, abs(speed) * dt
        if second.start_speed is None:
            second.start_speed = speed
        second.seconds += dt
        second.distance += speed * dt
        second.energy += power * dt
        second.motor += motor * dt
        second.squares += power * power * dt
        if grade is None:
            second.unseen += way
        else:
            second.climb += grade * speed * dt
        self.load.time_moving += dt if speed > MOVING else 0.0
        self.distance += 0.0 if self.towed else way

    def _watch_towing(self, unexplained: float) -> None:
        """Unlearn the metres that something else has paid for: road and bus leave too much energy unexplained.

        unexplained: of the second [J], modelled energy beyond half of a level road's and of the measured energy.
        """
        distance, limit = abs(self._second.distance), CONSUMPTION.height_error_m * self._weight
        if self._second.motor > CONSUMPTION.driving_force * self._weight * distance:
            self._unexplained = 0.0
        else:
            self._unexplained = min(max(self._unexplained + unexplained, 0.0), 2 * limit)
        self._coasted = self._coasted + distance if self._unexplained else 0.0
        before, self.towed = self.towed, self._unexplained > limit
        if self.towed and not before:
            self._revert(self._coasted)

    def _close(self, conditions: Conditions) -> None:
        """Learn from the segment that has ended."""
        c, state, speed = CONSUMPTION, self.state, self.load.prior.speed
        way, habits = self._segment.distance, state.habits
        moving, stops = self.load.prior_prices(conditions.ambient, conditions.altitude)
        unit, segment = moving * way, self._segment._replace(prior=(moving + stops) * way)
        unseen, factor = segment.unseen / way, habits.factor.now
        paid = (1 - unseen) * (segment.measured - segment.modelled) + (1 - unseen + unseen * factor) * segment.level
        # The factor's residual is weighted by the energy to expect, not by the segment's modelled one: its errors (of
        # the grade) would draw the factor to 0. Hills that no sensor showed have stored an unknown energy.
        weight = factor / (max(habits.price.now, c.min_price) * unit)
        height = self._weight * c.height_walk * sqrt(segment.unseen)  # J
        learned = Habits(
            habits.price.learned(paid / unit - habits.price.now, way),
            habits.stops.learned(segment.stops / unit - habits.stops.now, way),
            habits.pace.learned(segment.duration * speed / way - habits.pace.now, way),
            habits.factor.learned(weight * (segment.measured - factor * segment.modelled), way, (height * weight) ** 2),
        )
        self._history.append((way, state))
        self.state = RidingState(
            learned,
            state.sums.followed_by(segment, c.memory_m),
            state.recent.followed_by(segment, c.recent_m),
            state.terrain.ridden(way, segment.climb, segment.unseen),
        )
        self._segment = Segment()

    def _revert(self, distance: float) -> None:
        """Go back to the state before the last `distance` [m] or a little more, as far as it is known."""
        distance -= self._segment.distance
        self._segment = Segment()
        while distance > 0 and self._history:
            way, self.state = self._history.pop()
            distance -= way

    def forget(self, distance: float) -> None:
        """Unlearn the last `distance` [m] or a little more: a sensor that it was learned from is faulty."""
        seen = self.state.habits
        self.pause()
        self._revert(distance)
        doubted = (mine.doubted(its.now) for mine, its in zip(self.state.habits, seen, strict=True))
        self.state = self.state._replace(habits=Habits(*doubted))

    def ridden_by(self, rider: str) -> None:
        """Have `rider` ride from now on.

        A new rider is taken to ride as the one before, but less surely. Errors of the parameters are the
        vehicle's, whoever rides.
        """
        self.pause()
        before = self.state.habits.next_ride()
        self.other_riders[self.rider] = before
        habits = self.other_riders.pop(rider, None)
        if habits is None:
            price, pace = (
                x._replace(level_variance=x.level_variance + CONSUMPTION.level_sd**2)
                for x in (before.price, before.pace)
            )
            habits = before._replace(price=price, pace=pace)
            if len(self.other_riders) > CONSUMPTION.max_riders:
                del self.other_riders[next(iter(self.other_riders))]
        self.rider, self._segment = rider, Segment()
        self._history.clear()
        self.state = RidingState(habits._replace(factor=before.factor), terrain=self.state.terrain)

    def pause(self, dt: float = 0.0) -> None:
        """Take in `dt` [s] that teach nothing: parked, or something is not known. Drop the unfinished second."""
        self._second = Second()
        self._stand(dt)

    def _stand(self, dt: float) -> None:
        riding, self.still = self.still < CONSUMPTION.ride_ends_s, self.still + dt
        if riding and self.still >= CONSUMPTION.ride_ends_s:
            self.rides += 1
            self.state = self.state._replace(habits=self.state.habits.next_ride())
        if self.still >= CONSUMPTION.tyres_cool_s:
            self.load.time_moving = 0.0

    # --- saving -------------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """State to be kept over a restart."""
        return {
            "unit": {"price": self.prior_price, "speed": self.load.prior.speed},
            "state": {
                "habits": _saved(self.state.habits),
                "sums": self.state.sums._asdict(),
                "recent": self.state.recent._asdict(),
                "terrain": self.state.terrain._asdict(),
            },
            "rider": self.rider,
            "riders": {name: _saved(habits) for name, habits in self.other_riders.items()},
            "auxiliary_power": self.auxiliaries.mean,
            "effects": dict(self.load.states),
            "still": self.still,
            "time_moving": self.load.time_moving,
        }

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Take a `snapshot`, which was checked against `FIELDS`; ValueError for habits that no riding teaches.

        Habits are converted to the units of this vehicle file, which may have been calibrated since.
        """
        unit, state = saved["unit"], saved["state"]
        scales = unit["price"] / self.prior_price, self.load.prior.speed / unit["speed"]
        sums, recent, terrain = Segment(**state["sums"]), Segment(**state["recent"]), Terrain(**state["terrain"])
        self.state = RidingState(_restored(state["habits"], *scales), sums, recent, terrain)
        self.rider = saved["rider"]
        self.other_riders = {name: _restored(habits, *scales) for name, habits in saved["riders"].items()}
        mean = saved["auxiliary_power"]
        self.auxiliaries = AuxiliaryPower(self.auxiliaries.modelled, mean, mean)
        self.load.states = dict(saved["effects"])
        self.still, self.load.time_moving = saved["still"], saved["time_moving"]
        self._segment, self._second = Segment(), Second()
        self._history.clear()


def _saved(habits: Habits) -> dict[str, dict[str, float]]:
    return {name: quantity._asdict() for name, quantity in habits._asdict().items()}


def _restored(saved: Mapping[str, Mapping[str, float]], price: float, pace: float) -> Habits:
    """Habits as saved, in units that are `price` and `pace` times smaller; ValueError for some that no riding has."""
    scales = {"price": price, "stops": price, "pace": pace, "factor": price}
    habits = Habits(**{name: LearnedQuantity(**quantity).scaled(scales[name]) for name, quantity in saved.items()})
    for q in habits:
        possible = q.level >= 0 and all(abs(x) <= CONSUMPTION.most for x in q)
        possible &= min(q.ride_variance, q.level_variance, q.deviation_variance) >= 0 < q.scatter
        if not possible or q.covariance**2 > q.level_variance * q.deviation_variance * (1 + 1e-9):
            raise ValueError("is damaged: state.riding holds implausible habits")
    return habits


_HABITS = {name: dict.fromkeys(LearnedQuantity._fields, FINITE) for name in Habits._fields}
_POSITIVE, _ANY = Number(0.0, 1e12), Number(-1e12, 1e12)
_SIGNED = "measured", "stops", "auxiliary", "modelled", "level", "climb"
_SUMS = dict.fromkeys(Segment._fields, _POSITIVE) | dict.fromkeys(_SIGNED, _ANY)
FIELDS = {  # of the saved state
    "unit": dict.fromkeys(("price", "speed"), Number(1e-6, 1e6)),
    "state": {
        "habits": _HABITS,
        "sums": _SUMS,
        "recent": _SUMS,
        "terrain": dict.fromkeys(Terrain._fields, _POSITIVE) | {"climb": _ANY},
    },
    "rider": Text(CONSUMPTION.max_name_letters),
    "riders": Each(_HABITS, CONSUMPTION.max_riders),
    "auxiliary_power": Number(-1e5, 1e5),  # W
    "effects": Each(FINITE, 100),
    "still": Number(0.0, 1e10),  # s
    "time_moving": Number(0.0, 1e7),  # s
}
