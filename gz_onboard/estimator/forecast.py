"""How far the energy that is left will go.

What is known of the riding is kept in segments of `SEGMENT` metres: what the pack delivered, and what the forward
model gives for the same riding, as it was and less what height and speed have stored. From them:

- the consumption factor, measured over modelled, learned slowly: one number that carries what the parameters have
  wrong for this vehicle, rider and season;
- the consumption to be expected: the model's on the riding of the last kilometres, on its hills but back at the
  height where it began, times that factor. Before anything is ridden, the model's on a prior riding; it counts like
  `PRIOR_LENGTH` metres;
- its spread: how unlike each other segments are, how long they stay alike, and how much riding drifts.

The range is the energy that can be drawn before the cut-off at the power to be expected, over that consumption,
with a log-normal distribution.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import exp, sqrt
from typing import Any

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.load_model import AHEAD, Conditions, EffectInputs, LoadModel
from gz_onboard.estimator.ridden import FACTOR, MEMORY, Past, Riding, Second, Segment, restored, restored_states
from gz_onboard.physics.battery import Battery
from gz_onboard.physics.drawable import Drawable, drawable
from gz_onboard.physics.effects.inertia import rotating_mass
from gz_onboard.physics.model import Model
from gz_onboard.physics.riding import PriorRiding

SEGMENT = 250.0  # m
PRIOR_LENGTH = 3000.0  # m: the prior riding counts like that much of real riding
ALIKE = 300.0  # m: over such a distance segments are alike; those of the eight commissioning rides are not at 250 m
FACTOR_WALK = 0.01  # sd of its change over a segment: wind, tyres, traffic
SEGMENT_SD = 0.18  # relative: measured against modelled energy of one segment, of the eight commissioning rides
HEIGHT_WALK = 0.75  # m per sqrt(m): roads climb or fall by 60 m on 6 km; where no sensor showed the grade
PRIOR_FORM_FACTOR_SQUARED = 2.5  # mean square of the power over its mean squared, of the eight commissioning rides
FORM_FACTOR_SQUARED = 1.0, 6.0  # the same, of any riding
PRIOR_SCATTER = 0.25  # relative sd of segments of a riding not yet known
LEAST_SCATTER = 0.1  # the same, of any riding
ACCELERATION = 15.0  # m/s²: no road gives more; a second that shows more is left out
SPEEDS = -5.0, 70.0  # m/s: the same
STEEPEST = 0.3  # sine: the same
LEAST_DISTANCE = 0.1  # m: over less a climb shows no grade
LEAST = 0.2  # of the prior's consumption: no riding of any length consumes less
MOST_SD = 3.0  # of the logarithm of the range: beyond, it is not known at all
SHOWN_FROM = 500.0  # m: over less the recent consumption is that of one traffic light
DECILE = 1.2815515655446004  # sd of a normal distribution: 10 % are beyond


@dataclass(frozen=True)
class Forecast:
    """Range and what it is based on; SI units."""

    range: float
    p10: float
    p90: float
    energy: float
    energy_sd: float
    consumption: float  # J/m
    consumption_sd: float
    recent: float | None  # J/m, measured over the last kilometre or so
    mostly_prior: bool


@dataclass(frozen=True, slots=True)
class Expected:
    """The riding to come."""

    consumption: float  # J/m
    power: float  # W, mean
    form_factor_squared: float  # mean square of the power over the square of its mean
    scatter: float  # relative variance of the consumption of segments
    distance: float  # m of riding that this is known from


class Forecaster:
    """Learns from the riding and forecasts the range."""

    def __init__(self, model: Model, battery: Battery, prior: PriorRiding) -> None:
        self.load = LoadModel(model, battery, prior)
        self.battery, self._drift = battery, prior.drift
        self.riding = Riding(factor=prior.factor, factor_variance=prior.factor_sd**2)
        self._past = Past()
        self._overpotential = model.overpotential(battery, {"vibration": prior.vibration, "time_moving": AHEAD})
        self._weight = model.mass * GRAVITY  # N
        self._moving_mass = model.mass + rotating_mass(model.parameters)  # kg, with what rotates
        self._capacity_sd = model.parameters.sd("cell_capacity") / model.parameters["cell_capacity"]

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
    ) -> bool:
        """Take in `dt` [s] of riding: speed [m/s], grade (sine), power at the pack [W].

        `inputs` are needed, and read, if the load is `extended`. `period` [s]: how often the speed comes, if seldom;
        between two of its messages it has no acceleration that means anything. Gives whether a segment was learned.
        """
        r = self.riding
        r.add(dt, speed, grade, power, inputs)
        if r.second.seconds < max(1.0, period):
            return False
        before = speed if r.speed_before is None else r.speed_before
        mean, acceleration = r.second.distance / r.second.seconds, (speed - before) / r.second.seconds
        if abs(acceleration) > ACCELERATION or not SPEEDS[0] < mean < SPEEDS[1]:  # a sensor errs, or the wheel spins
            self.pause()
            return False
        segment = r.current
        modelled, to_come = self._modelled(mean, acceleration, conditions, inputs)
        segment.distance += abs(r.second.distance)
        segment.duration += r.second.seconds
        segment.measured += r.second.energy
        segment.squares += r.second.squares
        segment.modelled += modelled
        stored = self._weight * r.second.climb + self._moving_mass * (speed * speed - before * before) / 2
        segment.level += to_come - stored
        r.second, r.speed_before = Second(), speed
        if segment.distance < SEGMENT:
            return False
        self._close(segment)
        return True

    def _modelled(
        self, speed: float, acceleration: float, conditions: Conditions, inputs: EffectInputs | None
    ) -> tuple[float, float]:
        """(energy of the second by the model, energy of riding it again) [J]."""
        r, second, load = self.riding, self.riding.second, self.load
        q = load.quantities(speed, acceleration, conditions)
        if abs(second.distance) > LEAST_DISTANCE:
            q["grade"] = max(min(second.climb / abs(second.distance), STEEPEST), -STEEPEST)
        if not inputs:
            energy = load.power(q) * second.seconds
            return energy, energy
        load.extend(q, inputs, conditions.ambient, r.time_moving)
        if second.lateral_seconds:
            q["lateral_acceleration"] = sqrt(second.lateral / second.lateral_seconds)
        if second.vibration_seconds:
            q["vibration"] = sqrt(second.vibration / second.vibration_seconds)
        then, to_come = load.power_with_memory(q, inputs.heading is not None, second.seconds)
        return then * second.seconds, to_come * second.seconds

    @property
    def recent_factor(self) -> float:
        """Measured over modelled energy of the last kilometre or so; 1 while that is not known."""
        return self._past.recent_factor

    def forget(self, distance: float) -> None:
        """Unlearn the last `distance` [m] or a little more: a sensor that it was learned from is faulty."""
        r = self.riding
        self.pause()
        distance -= r.current.distance
        r.current = Segment()
        while distance > 0 and r.segments and (before := r.segments[-1].learned):
            distance -= r.segments.pop().distance
            r.factor, r.factor_variance = before
        self._sum_past()

    def pause(self) -> None:
        """Something was not known for a while: leave the second that was being gathered."""
        self.riding.second, self.riding.speed_before = Second(), None

    def _close(self, segment: Segment) -> None:
        """Learn the factor: a Kalman filter. Its error is one of energy (a hill or a gust not seen), so a segment of
        little energy has a large variance.
        """
        r = self.riding
        segment.learned = r.factor, r.factor_variance
        r.segments.append(segment)
        r.current = Segment()
        self._sum_past()
        r.factor_variance += FACTOR_WALK**2
        if segment.modelled > 0:
            noise = SEGMENT_SD * self._past.level / self._past.distance * segment.distance
            height = self._weight * HEIGHT_WALK * sqrt(segment.unseen)
            variance = (noise * noise + height * height) / segment.modelled**2
            gain = r.factor_variance / (r.factor_variance + variance)
            r.factor += gain * (segment.measured / segment.modelled - r.factor)
            r.factor = min(max(r.factor, FACTOR[0]), FACTOR[1])
            r.factor_variance *= 1 - gain

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
        r, past, now = self.riding, self._past, self.riding.current
        expected = self._expected(ambient, altitude)
        consumption = expected.consumption
        left, colder = (self._drawable(soc, t, expected) for t in (cell_temperature, cell_temperature - temperature_sd))
        energy_sd = sqrt(
            (soc_sd * left.slope) ** 2
            + (self.battery.window.sd * left.slope) ** 2
            + (left.energy - colder.energy) ** 2
            + (self._capacity_sd * left.energy) ** 2
        )
        range_ = left.energy / consumption
        variance = (
            loss_variance
            + expected.scatter * ALIKE * (1 / max(range_, ALIKE) + 1 / max(expected.distance, ALIKE))
            + self._drift**2
            + r.factor_variance / r.factor**2
        )
        variance = min(variance, MOST_SD**2)
        sd = sqrt(variance)
        if left.energy > energy_sd:
            spread = sqrt(variance + (energy_sd / left.energy) ** 2)
            p10, p90 = range_ * exp(-DECILE * spread), range_ * exp(DECILE * spread)
        else:  # near empty the energy's error rules, and that is not relative
            p10, p90 = 0.0, (left.energy + DECILE * energy_sd) * exp(DECILE * sd) / consumption
        recent_distance = past.recent_distance + now.distance
        return Forecast(
            range=range_,
            p10=p10,
            p90=p90,
            energy=left.energy,
            energy_sd=energy_sd,
            consumption=consumption,
            consumption_sd=consumption * sd,
            recent=(past.recent + now.measured) / recent_distance if recent_distance >= SHOWN_FROM else None,
            mostly_prior=past.whole + now.distance < PRIOR_LENGTH,
        )

    def _drawable(self, soc: float, temperature: float, expected: Expected) -> Drawable:
        return drawable(
            self.battery, soc, temperature, expected.power, expected.form_factor_squared, self._overpotential
        )

    def _expected(self, ambient: float, altitude: float) -> Expected:
        r, past, now = self.riding, self._past, self.riding.current
        prior_power, prior_speed = self.load.prior_ride(ambient, altitude)
        prior, prior_time = prior_power / prior_speed, PRIOR_LENGTH / prior_speed
        fade = exp(-now.distance / MEMORY)
        distance = PRIOR_LENGTH + fade * past.distance + now.distance
        modelled = max((PRIOR_LENGTH * prior + fade * past.level + now.level) / distance, LEAST * prior)
        speed = distance / (prior_time + fade * past.duration + now.duration)
        consumption = r.factor * modelled
        # Downhill next to nothing is drawn in the mean; what is to come is not all downhill.
        energy = prior_power * prior_time + max(past.measured, r.factor * past.level)
        energy = max(energy, LEAST * prior_power * prior_time)
        squares = PRIOR_FORM_FACTOR_SQUARED * prior_power**2 * prior_time + past.power_squares
        form_factor_squared = squares * (prior_time + past.duration) / energy**2
        closed = PRIOR_LENGTH + fade * past.distance
        squares = (PRIOR_LENGTH * prior**2 * (1 + PRIOR_SCATTER**2) + fade * past.squares) / closed
        mean = max((PRIOR_LENGTH * prior + fade * past.level) / closed, LEAST * prior)
        return Expected(
            consumption,
            consumption * speed,
            form_factor_squared=min(max(form_factor_squared, FORM_FACTOR_SQUARED[0]), FORM_FACTOR_SQUARED[1]),
            scatter=max(squares / mean**2 - 1, LEAST_SCATTER**2),
            distance=distance,
        )

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, object]:
        """What is to be kept over a restart."""
        return self.riding.snapshot() | {"states": dict(self.load.states)}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Take what `snapshot` gave; raises KeyError, TypeError or ValueError if it is not that."""
        riding, states = restored(saved), restored_states(saved["states"])
        self.riding, self.load.states = riding, states
        self._sum_past()
