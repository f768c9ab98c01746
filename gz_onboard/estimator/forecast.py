"""How far the energy that is left will go.

What is known of the riding is kept in segments of `SEGMENT` metres: what the pack delivered in motion and at stops, and
what the forward model gives for the same motion, as it was and less what height and speed have stored. From them is
learned, by segment, what is usual and how the present ride differs from it (`usual`):

- the price of a metre in motion: measured, less what height and speed have stored, over the model's of the prior
  riding in the same air;
- what stops add to it, as it is usual. Standing for longer than a stop takes energy, but teaches nothing;
- the time that a metre takes, and with it the power to be expected, and what auxiliaries are measured to take beyond
  the vehicle file's: they are watts, in no price of a metre (`auxiliaries`);
- the consumption factor, measured over modelled: what the parameters have wrong for this vehicle and season.

The range is the energy that can be drawn before the cut-off at the power to be expected, over the price to be expected
on the way that it lasts, with an interval (`interval`). What is shown of it moves calmly (`calm`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from math import hypot, inf, sqrt
from typing import Any

from gz_onboard.constants import GRAVITY, HOUR
from gz_onboard.estimator.ageing import Ageing
from gz_onboard.estimator.auxiliaries import Auxiliaries
from gz_onboard.estimator.calm import Calm, restored_calm
from gz_onboard.estimator.interval import DECILE, deciles
from gz_onboard.estimator.load_model import AHEAD, USUAL_AIR, Conditions, EffectInputs, LoadModel
from gz_onboard.estimator.motion import MOTION
from gz_onboard.estimator.pattern import MOST_BINS, STEEPEST, Pattern, restored_pattern
from gz_onboard.estimator.ridden import (
    KEPT,
    MOST_SEGMENTS,
    Past,
    Riding,
    Second,
    Segment,
    learned,
    restored,
    restored_states,
    unlearned,
)
from gz_onboard.estimator.riders import LONGEST_NAME, MOST_RIDERS, Riders, restored_riders
from gz_onboard.estimator.saved_fields import FINITE, Each, Number, Text
from gz_onboard.estimator.terrain import Terrain, restored_terrain
from gz_onboard.estimator.usual import SEGMENT, Habit, Unit, Usual, restored_unit
from gz_onboard.physics.battery import HALF_FULL, Battery
from gz_onboard.physics.cooling import pack_constants
from gz_onboard.physics.drawable import Drawable, drawable
from gz_onboard.physics.effect import MOVING
from gz_onboard.physics.effects.inertia import rotating_mass
from gz_onboard.physics.model import Model
from gz_onboard.physics.riding import PriorRiding
from gz_onboard.physics.warming import cells_ahead

PRIOR_LENGTH = 3000.0  # m: before, a forecast is said to stand on the prior; it counts so much for the form factor
HEIGHT_WALK = 0.75  # m per sqrt(m): roads climb or fall by 60 m on 6 km; where no sensor showed the grade
PRIOR_FORM_FACTOR_SQUARED = 2.5  # mean square of the power over its mean squared, of the eight commissioning rides
FORM_FACTOR_SQUARED = 1.0, 6.0  # the same, of any riding
ACCELERATION = 15.0  # m/s²: no road gives more; a second that shows more is left out
SPEEDS = -5.0, 70.0  # m/s: the same
LEAST_DISTANCE = 0.1  # m: over less a climb shows no grade
DRIVES = 0.003  # of the weight: a motor that takes less does not drive; tyres alone take three times as much
HEIGHTS_ERR = 3.0  # m: so much a climb may be wrong where it is to explain how a vehicle moves without its motor
LEAST = 0.2  # of the prior's consumption: no riding of any length consumes less
MOST_SD = 1.0  # of the logarithm of the range: beyond, it is not known at all
COLDER_AGAIN = 0.005, 0.5, 0.5, 20.0  # SOC, degC, degC, W: changed by more, what colder cells lack is asked anew

_USUAL = {quantity.name: dict.fromkeys((part.name for part in fields(Habit)), FINITE) for quantity in fields(Usual)}
FIELDS = {
    "segments": Each(Each(FINITE, len(KEPT)), MOST_SEGMENTS),
    "usual": _USUAL,
    "still": Number(0.0, 1e10),  # s
    "time_moving": Number(0.0, 1e7),  # s
    "rider": Text(LONGEST_NAME),
    "riders": Each(_USUAL, MOST_RIDERS),
    "gap": Number(-1e6, 1e6),  # m
    "forecast": Each(Number(0.0, 1e12), 2, optional=True),  # m, J
    "of": dict.fromkeys((unit.name for unit in fields(Unit)), FINITE),
    "pattern": Each(Each(FINITE, 10), MOST_BINS),
    "states": Each(FINITE, 100),
    "terrain": dict.fromkeys((part.name for part in fields(Terrain)), FINITE),
    "auxiliaries": {"mean": Number(-1e5, 1e5), "filed": FINITE},  # W
}
"""Of the saved state: what was learned of the riding."""


@dataclass(frozen=True)
class Forecast:
    """Range and what it is based on; SI units."""

    range: float
    p10: float
    p90: float
    left: Drawable
    energy_sd: float  # downwards
    energy_sd_up: float
    consumption: float  # J/m
    consumption_sd: float
    recent: float | None  # J/m, measured over the last kilometre or so
    mostly_prior: bool
    power: float  # W, mean of the riding expected
    form_factor_squared: float
    cells: float  # degC, their mean on the way that is left
    known_from: float  # m: as much riding would tell as much of the way to come

    @property
    def energy(self) -> float:
        """That is left [J]."""
        return self.left.energy


@dataclass(frozen=True, slots=True)
class Expected:
    """The riding to come."""

    consumption: float  # J/m
    power: float  # W, mean
    form_factor_squared: float  # mean square of the power over the square of its mean
    variance: float  # of the consumption over the way to come, relative
    least: float  # J/m: no riding takes less

    @property
    def load(self) -> tuple[float, float]:
        """Mean power [W] and the square of its form factor."""
        return self.power, self.form_factor_squared


class Forecaster:
    """Learns from the riding and forecasts the range."""

    def __init__(self, model: Model, battery: Battery, prior: PriorRiding) -> None:
        self.load = LoadModel(model, battery, prior)
        self.battery = battery
        price, stops = self.load.prior_prices(*USUAL_AIR)
        self.prior, self._unit = Usual.of(prior, stops / price), Unit(price + stops, prior.speed)
        self.riding = Riding(self.prior)
        self.calm, self.pattern, self.riders, self.terrain = Calm(), Pattern(), Riders(), Terrain()
        self.auxiliaries = Auxiliaries(model)
        self.ageing: Ageing | None = None  # None: the pack is known to be as its file says
        self._past = Past()
        self._colder = (inf, inf, inf, inf), 0.0  # SOC, cells and their sd [degC], power [W]; what colder ones lack [J]
        self._overpotential = model.overpotential(battery, {"vibration": prior.vibration, "time_moving": AHEAD})
        self._weight = model.mass * GRAVITY  # N
        self._moving_mass = model.mass + rotating_mass(model.parameters)  # kg, with what rotates
        self.cooling = pack_constants(model.parameters)
        p = model.parameters
        self._cutoff_sd, self._empty_sd = p.sd("cell_cutoff_voltage"), p.sd("cell_voltage_error_empty")  # V

    # --- learning ---------------------------------------------------------------------------------------------

    def ride(
        self,
        dt: float,
        speed: float,
        grade: float | None,
        power: float,
        conditions: Conditions,
        inputs: EffectInputs | None = None,
        period: float = 0.0,
        drive: float | None = None,
    ) -> bool:
        """Take in `dt` [s] of riding: speed [m/s], grade (sine), power at the pack [W].

        `inputs` are needed, and read, if the load is `extended`. `period` [s]: how often the speed comes, if seldom;
        between two of its messages it has no acceleration that means anything. drive: what the motor takes of the power
        [W]; None: all. Gives whether a segment was learned.
        """
        r = self.riding
        r.add(dt, speed, grade, power, inputs)
        r.second.driven += (power if drive is None else drive) * dt
        if not r.towed:
            self.calm.ride(abs(speed) * dt)
        if r.second.seconds < max(1.0, period):
            return False
        before = speed if r.speed_before is None else r.speed_before
        mean, acceleration = r.second.distance / r.second.seconds, (speed - before) / r.second.seconds
        if abs(acceleration) > ACCELERATION or not SPEEDS[0] < mean < SPEEDS[1]:  # a sensor errs, or the wheel spins
            self.pause()
            return False
        segment = r.current
        modelled, to_come = self._modelled(mean, acceleration, conditions, inputs)
        stored = self._weight * r.second.climb + self._moving_mass * (speed * speed - before * before) / 2
        if abs(mean) > MOVING and grade is not None:
            beside = self.auxiliaries.now * r.second.seconds
            self._coast(modelled - (to_come - stored + r.second.energy - beside) / 2)
            if r.towed:
                self.pause()
                return False
        if self.load.ledger:
            self.load.ledger.measured += r.second.energy
        segment.distance += abs(r.second.distance)
        if abs(mean) > MOVING:
            r.still = 0.0
            segment.measured += r.second.energy
            segment.beside += self.auxiliaries.now * r.second.seconds
            segment.modelled += modelled
            segment.level += to_come
        else:
            self._stand(r.second.seconds)
            if r.still <= MOTION.stop_time:
                segment.standing += r.second.energy
                segment.beside_standing += self.auxiliaries.now * r.second.seconds
        if r.still <= MOTION.stop_time:
            segment.duration += r.second.seconds
            segment.squares += r.second.squares
        segment.level -= stored
        segment.climb += r.second.climb
        self.pattern.add(r.second, mean, acceleration)
        r.second, r.speed_before = Second(), speed
        if segment.distance < SEGMENT:
            return False
        self._close(segment, conditions)
        return True

    def _coast(self, unexplained: float) -> None:
        """Take in the second: what the model asks for beyond half of a level road's and of what was measured [J]."""
        r, weight = self.riding, self._weight
        driven, before = r.second.driven > DRIVES * weight * abs(r.second.distance), r.towed
        r.coast(None if driven else unexplained, HEIGHTS_ERR * weight)
        if r.towed and not before:
            r.take_back(r.coasted)
            self._sum_past()

    def _modelled(
        self, speed: float, acceleration: float, conditions: Conditions, inputs: EffectInputs | None
    ) -> tuple[float, float]:
        """(energy of the second by the model, energy of riding it again) [J]."""
        r, second, load = self.riding, self.riding.second, self.load
        q = load.quantities(speed, acceleration, conditions)
        if abs(second.distance) > LEAST_DISTANCE:
            q["grade"] = max(min(second.climb / abs(second.distance), STEEPEST), -STEEPEST)
        if not inputs:
            energy = load.power_ridden(q, second.seconds) * second.seconds
            return energy, energy
        load.extend(q, inputs, conditions.ambient, r.time_moving)
        if second.lateral_seconds:
            q["lateral_acceleration"] = sqrt(second.lateral / second.lateral_seconds)
        if second.vibration_seconds:
            q["vibration"] = sqrt(second.vibration / second.vibration_seconds)
        then, to_come = load.power_with_memory(q, inputs.heading is not None, second.seconds)
        return then * second.seconds, to_come * second.seconds

    def shown(self, forecast: Forecast, drawn: float | None = None) -> Forecast:
        """`forecast` as it is to be shown; to be asked once for each; drawn: see `Calm.follow`.

        P10 and P90 are those of the newest forecast, since what it has just learned must be in them; they hold the
        range shown, too: where that falls towards P10, P10 stays below it.
        """
        way = self.calm.follow(forecast.range, forecast.energy, forecast.known_from, drawn)
        below = sqrt(forecast.p10 / forecast.range) if forecast.range else 0.0
        return replace(forecast, range=way, p10=min(forecast.p10, way * below), p90=max(forecast.p90, way))

    @property
    def recent_factor(self) -> float:
        """Measured over modelled energy of the last kilometre or so; 1 while that is not known."""
        return self._past.recent_factor

    @property
    def beside(self) -> float:
        """By how much auxiliaries beyond the file's raise the consumption factor, at the pace of the present riding."""
        usual = self.riding.usual
        modelled = self._unit.price * max(usual.price.now, LEAST) / self.riding.factor  # J/m
        return self.auxiliaries.mean / self.load.prior.speed * max(usual.pace.now, LEAST) / modelled

    @property
    def factor(self) -> float:
        """The consumption factor: measured over modelled energy of the present riding."""
        return self.riding.factor + self.beside

    def forget(self, distance: float) -> None:
        """Unlearn the last `distance` [m] or a little more: a sensor that it was learned from is faulty."""
        r, seen = self.riding, self.riding.usual
        self.pause()
        self.calm = Calm()  # what was shown came from that sensor too
        r.take_back(distance)
        r.usual = unlearned(r.usual, seen)
        self._sum_past()

    def ridden_by(self, rider: str) -> None:
        """`rider` rides from now on."""
        if rider == self.riders.now:
            return
        r = self.riding
        self.pause()
        r.usual = self.riders.change(rider, r.usual.rested())
        r.segments.clear()
        r.current = Segment()
        self.calm, self.pattern = Calm(), Pattern()
        self._sum_past()

    def pause(self, dt: float = 0.0) -> None:
        """`dt` [s] that teach nothing: parked, or something is not known. Leave the second that was being gathered."""
        self.riding.second, self.riding.speed_before = Second(), None
        self._stand(dt)

    def _stand(self, dt: float) -> None:
        if self.riding.stand(dt):
            self.calm.begin_ride()

    def _close(self, segment: Segment, conditions: Conditions) -> None:
        r = self.riding
        segment.learned = r.usual
        r.segments.append(segment)
        r.current = Segment()
        self._sum_past()
        price, _ = self.load.prior_prices(conditions.ambient, conditions.altitude)
        self.terrain = self.terrain.ridden(segment.distance, segment.climb, segment.unseen)
        height = self._weight * HEIGHT_WALK * sqrt(segment.unseen)
        r.usual = learned(r.usual, segment, price, self.load.prior.speed, height)

    def _sum_past(self) -> None:
        self._past = Past.of(reversed(self.riding.segments))

    # --- forecasting ------------------------------------------------------------------------------------------

    def forecast(
        self,
        soc: float,
        soc_sd: float,
        cell_temperature: float,
        temperature_sd: float,
        ambient: float,
        altitude: float,
        loss_variance: float = 0.0,
    ) -> Forecast:
        """The range from this state of the battery, with the riding known so far.

        Temperatures and their sd in degC, altitude in m; `loss_variance`: relative variance that missing sensors
        add to the consumption.
        """
        past, now = self._past, self.riding.current
        expected = self._expected(self._rough_way(soc, cell_temperature), ambient, altitude)
        consumption = expected.consumption
        ahead = cells_ahead(
            self.battery, self.cooling, (soc, cell_temperature), ambient, expected.load, self._overpotential
        )
        left = self._drawable(soc, ahead, expected)
        beside = (
            (hypot(self.battery.window.sd, left.end_sd) * left.slope) ** 2
            + self._lost_colder(soc, (ahead, temperature_sd), expected, left) ** 2
            # Where vehicles were seen to give up has the error of an empty cell's voltage in it.
            + (self._cutoff_sd**2 + max(self._empty_sd, left.end_drop_sd) ** 2) * left.by_cutoff**2
        )
        fresh = hypot(soc_sd * left.slope, self.battery.capacity_sd * left.energy)
        of_pack = self.ageing.energy_sd(left.energy, left.slope, soc_sd) if self.ageing else (fresh, fresh)
        energy_sd, upwards = (sqrt(beside + sd * sd) for sd in of_pack)
        range_ = left.energy / consumption
        variance = min(loss_variance + expected.variance, MOST_SD**2)
        sd = sqrt(variance)
        p10, p90 = deciles(left.energy, energy_sd, upwards, variance)
        return Forecast(
            range=range_,
            p10=p10 / consumption,
            p90=min(p90 / consumption, (left.energy + DECILE * upwards) / expected.least),
            left=left,
            energy_sd=energy_sd,
            energy_sd_up=upwards,
            consumption=consumption,
            consumption_sd=consumption * sd,
            recent=past.recent_price(now),
            mostly_prior=past.whole + now.distance < PRIOR_LENGTH,
            power=expected.power,
            form_factor_squared=expected.form_factor_squared,
            cells=ahead,
            known_from=self.riding.usual.price.known_from,
        )

    def _drawable(self, soc: float, temperature: float, expected: Expected) -> Drawable:
        return drawable(
            self.battery, soc, temperature, expected.power, expected.form_factor_squared, self._overpotential
        )

    def _lost_colder(self, soc: float, cells: tuple[float, float], expected: Expected, left: Drawable) -> float:
        """Energy [J] of what is `left` that colder cells would not give. cells: temperature and its sd [degC]."""
        now, before = (soc, *cells, expected.power), self._colder[0]
        if any(abs(x - then) > step for x, then, step in zip(now, before, COLDER_AGAIN, strict=True)):
            self._colder = now, left.energy - self._drawable(soc, cells[0] - cells[1], expected).energy
        return min(self._colder[1], left.energy)

    def _rough_way(self, soc: float, temperature: float) -> float:
        """How long the charge will last [m], roughly: by the battery's nominal energy and the prior's price."""
        charge = soc * self.battery.pack_capacity(temperature) * HOUR
        energy = charge * self.battery.ocv(HALF_FULL)[0] * self.battery.cells_series
        return max(energy / self._unit.price, SEGMENT)

    def _expected(self, way: float, ambient: float, altitude: float) -> Expected:
        """The riding on the next `way` [m]."""
        usual, past = self.riding.usual, self._past
        moving, stops = self.load.prior_prices(ambient, altitude)
        price, variance = usual.price.ahead(way)
        price = max(price, LEAST)
        standing, standing_variance = usual.standing.ahead(way)
        # What was ridden without a grade has the model's price times the factor, whose error is the same all the way.
        variance += (past.blind * price / self.riding.factor) ** 2 * self.riding.factor_variance
        pace, pace_variance = usual.pace.ahead(way)
        beside = self.auxiliaries.mean / self.load.prior.speed  # J/m, at the prior's pace
        known = moving * (price + max(standing, 0.0))
        consumption = max(known + beside * max(pace, LEAST), LEAST * moving)
        height_variance = self._weight**2 * self.terrain.variance(way) / (consumption * way) ** 2
        prior_power, prior_time = (moving + stops) * self.load.prior.speed, PRIOR_LENGTH / self.load.prior.speed
        # Downhill next to nothing is drawn in the mean; what is to come is not all downhill.
        energy = prior_power * prior_time + max(past.measured, self.factor * past.level)
        energy = max(energy, LEAST * prior_power * prior_time)
        squares = PRIOR_FORM_FACTOR_SQUARED * prior_power**2 * prior_time + past.power_squares
        form_factor_squared = squares * (prior_time + past.duration) / energy**2
        return Expected(
            consumption,
            consumption * self.load.prior.speed / max(pace, LEAST),
            form_factor_squared=min(max(form_factor_squared, FORM_FACTOR_SQUARED[0]), FORM_FACTOR_SQUARED[1]),
            variance=((variance + standing_variance) * moving**2 + pace_variance * beside**2) / consumption**2
            + height_variance,
            least=LEAST * moving,
        )

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, object]:
        """What is to be kept over a restart."""
        kept = self.calm.snapshot() | {"of": asdict(self._unit), "pattern": self.pattern.snapshot()}
        kept |= {"states": dict(self.load.states), "terrain": self.terrain.snapshot()}
        kept["auxiliaries"] = self.auxiliaries.snapshot()
        return self.riding.snapshot() | self.riders.snapshot() | kept

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Take what `snapshot` gave; raises KeyError, TypeError or ValueError if it is not that."""
        unit = restored_unit(saved, self._unit)
        riding, states = restored(saved, self.prior, unit), restored_states(saved["states"])
        pattern, riders = restored_pattern(saved.get("pattern", ())), restored_riders(saved, unit)
        self.calm, self.terrain = restored_calm(saved), restored_terrain(saved.get("terrain"))
        self.riding, self.load.states, self.pattern, self.riders = riding, states, pattern, riders
        self.auxiliaries.restore(saved.get("auxiliaries"))
        self._sum_past()
