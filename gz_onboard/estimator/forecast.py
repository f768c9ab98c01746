"""How far the energy that is left will go.

What is known of the riding is kept in segments of `SEGMENT` metres: what the pack delivered, and what the forward
model says the same riding takes, as it was and less what height and speed have stored. From them:

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

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import exp, sqrt
from typing import Any

from gz_onboard.physics.battery import Battery, drawable
from gz_onboard.physics.model import Model, air_density
from gz_onboard.physics.riding import PriorRiding

SEGMENT = 250.0  # m
PRIOR_LENGTH = 3000.0  # m: the prior riding counts like that much of real riding
MEMORY = 12000.0  # m: what is further back counts for less than 1/e
ALIKE = 300.0  # m: over so much way segments are alike; those of the eight commissioning rides are not at 250 m
DRIFT = 0.055  # relative sd: the rest of the way is not the way so far; the eight rides differ by that
FACTOR_WALK = 0.01  # sd of its change over a segment: wind, tyres, traffic
SEGMENT_SD = 0.18  # relative: measured against modelled energy of one segment, of the eight commissioning rides
PRIOR_FORM = 2.5  # mean square of the power over the square of its mean, of the eight commissioning rides
PRIOR_SCATTER = 0.25  # relative sd of segments of a riding not yet known
G = 9.80665  # m/s²
DECILE = 1.2815515655446004


@dataclass(slots=True)
class Segment:
    """A piece of the way. Energies in J at the pack's terminals."""

    distance: float = 0.0  # m
    duration: float = 0.0  # s
    measured: float = 0.0
    squares: float = 0.0  # W²·s, of the measured power
    modelled: float = 0.0
    level: float = 0.0  # modelled, less what height and speed have stored: its hills and stops, but back where it began


@dataclass
class Riding:
    """What is known of the riding: state of the forecast."""

    segments: deque[Segment] = field(default_factory=lambda: deque(maxlen=200))
    current: Segment = field(default_factory=Segment)
    factor: float = 1.0
    factor_variance: float = 0.15**2
    seconds: float = 0.0  # s in the second that is being gathered
    way: float = 0.0  # m in it
    energy: float = 0.0  # J in it
    squares: float = 0.0  # W²·s in it
    climb: float = 0.0  # m in it
    speed_before: float | None = None  # m/s, at its start


@dataclass
class Past:
    """Sums over the closed segments, each weighted by how far back it is."""

    level: float = 0.0  # J
    duration: float = 0.0  # s
    distance: float = 0.0  # m
    squares: float = 0.0  # J²/m: of the consumptions, by distance
    measured: float = 0.0  # J
    power_squares: float = 0.0  # W²·s
    recent: float = 0.0  # J, measured over the last kilometre
    recent_distance: float = 0.0  # m
    whole: float = 0.0  # m, unweighted


@dataclass(frozen=True)
class Forecast:
    """Range and what it stands on; SI units."""

    range: float
    p10: float
    p90: float
    energy: float
    energy_sd: float
    consumption: float  # J/m
    consumption_sd: float
    recent: float | None  # J/m, measured over the last kilometre or so
    mostly_prior: bool


class Forecaster:
    """Learns from the riding and forecasts the range."""

    def __init__(self, model: Model, battery: Battery, prior: PriorRiding) -> None:
        self.model = model
        self.battery = battery
        self.prior = prior
        self.riding = Riding(factor=prior.factor, factor_variance=prior.factor_sd**2)
        self._past = Past()
        self._prior_at: tuple[tuple[float, float], float] = (float("nan"), 0.0), 0.0
        parameters = model.parameters
        self._capacity_sd = parameters.sd("cell_capacity") / parameters["cell_capacity"]

    # --- learning ---------------------------------------------------------------------------------------------

    def ride(self, dt: float, speed: float, grade: float | None, power: float, ambient: float, altitude: float,
             motor_temperature: float) -> None:  # fmt: skip
        """Take in `dt` [s] of riding: speed [m/s], grade (sine), power at the pack [W], ambient and motor [degC]."""
        r = self.riding
        if r.speed_before is None:
            r.speed_before = speed
        r.seconds += dt
        r.way += speed * dt
        r.energy += power * dt
        r.squares += power * power * dt
        r.climb += (grade or 0.0) * speed * dt
        if r.seconds < 1.0:
            return
        mean = r.way / r.seconds
        acceleration = (speed - r.speed_before) / r.seconds
        q = self.quantities(mean, acceleration, ambient, altitude, motor_temperature)
        if abs(r.way) > 0.1:
            q["grade"] = max(min(r.climb / abs(r.way), 0.3), -0.3)
        segment = r.current
        segment.distance += abs(r.way)
        segment.duration += r.seconds
        segment.measured += r.energy
        segment.squares += r.squares
        energy = sum(self.model.power(q).values()) * r.seconds
        segment.modelled += energy
        stored = G * r.climb + (speed * speed - r.speed_before * r.speed_before) / 2
        segment.level += energy - self.model.mass * stored
        r.seconds = r.way = r.energy = r.squares = r.climb = 0.0
        r.speed_before = speed
        if segment.distance >= SEGMENT:
            self._close(segment)

    def pause(self) -> None:
        """Something was not known for a while: leave the second that was being gathered."""
        r = self.riding
        r.seconds = r.way = r.energy = r.squares = r.climb = 0.0
        r.speed_before = None

    def quantities(
        self, speed: float, acceleration: float, ambient: float, altitude: float, motor: float
    ) -> dict[str, Any]:
        """What the model reads, on a level road without wind; temperatures in degC."""
        return {
            "speed": speed, "acceleration": acceleration, "grade": 0.0, "grade_cosine": 1.0, "headwind": 0.0,
            "mass": self.model.mass, "air_density": air_density(ambient, altitude), "motor_temperature": motor,
            "lateral_acceleration": 0.0,
        }  # fmt: skip

    def _close(self, segment: Segment) -> None:
        r = self.riding
        r.segments.append(segment)
        r.current = Segment()
        self._sum_past()
        # A Kalman filter on the factor. Its error is one of energy (a hill or a gust not seen), so a segment that
        # takes little tells little.
        r.factor_variance += FACTOR_WALK**2
        if segment.modelled > 0:
            noise = SEGMENT_SD * self._past.level / self._past.distance * segment.distance / segment.modelled
            gain = r.factor_variance / (r.factor_variance + noise * noise)
            r.factor += gain * (segment.measured / segment.modelled - r.factor)
            r.factor = min(max(r.factor, 0.3), 3.0)
            r.factor_variance *= 1 - gain

    # --- forecasting ------------------------------------------------------------------------------------------

    def forecast(self, soc: float, soc_sd: float, cell_temperature: float, temperature_sd: float, ambient: float,
                 altitude: float, loss_variance: float = 0.0) -> Forecast:  # fmt: skip
        """The range from this state of the battery, with the riding known so far.

        Temperatures and their sd in degC, altitude in m; `loss_variance`: relative variance that missing sensors
        add to the consumption.
        """
        r, past, now = self.riding, self._past, self.riding.current
        prior_power, prior_speed = self._prior(round(ambient), round(altitude, -2))
        prior = prior_power / prior_speed
        fade = exp(-now.distance / MEMORY)
        way = PRIOR_LENGTH + fade * past.distance + now.distance
        modelled = (PRIOR_LENGTH * prior + fade * past.level + now.level) / way
        speed = way / (PRIOR_LENGTH / prior_speed + fade * past.duration + now.duration)
        consumption = r.factor * modelled
        power = consumption * speed

        prior_time = PRIOR_LENGTH / prior_speed
        mean = prior_power * prior_time + past.measured
        form = (PRIOR_FORM * prior_power**2 * prior_time + past.power_squares) * (prior_time + past.duration) / mean**2
        form = min(max(form, 1.0), 6.0)

        left = drawable(self.battery, soc, cell_temperature, power, form)
        colder = drawable(self.battery, soc, cell_temperature - temperature_sd, power, form)
        energy_sd = sqrt(
            (soc_sd * left.slope) ** 2 + (left.energy - colder.energy) ** 2 + (self._capacity_sd * left.energy) ** 2
        )
        range_ = left.energy / consumption
        squares = (PRIOR_LENGTH * prior**2 * (1 + PRIOR_SCATTER**2) + fade * past.squares) / (
            PRIOR_LENGTH + fade * past.distance
        )
        mean = (PRIOR_LENGTH * prior + fade * past.level) / (PRIOR_LENGTH + fade * past.distance)
        scatter = max(squares / mean**2 - 1, 0.1**2)
        variance = (
            loss_variance
            + scatter * ALIKE * (1 / max(range_, ALIKE) + 1 / max(way, ALIKE))
            + DRIFT**2
            + r.factor_variance / r.factor**2
        )
        sd = sqrt(variance)
        if left.energy > energy_sd:
            spread = sqrt(variance + (energy_sd / left.energy) ** 2)
            p10, p90 = range_ * exp(-DECILE * spread), range_ * exp(DECILE * spread)
        else:  # near empty the energy's error rules, and that is not relative
            p10, p90 = 0.0, (left.energy + DECILE * energy_sd) * exp(DECILE * sd) / consumption
        recent_way = past.recent_distance + now.distance
        return Forecast(
            range=range_,
            p10=p10,
            p90=p90,
            energy=left.energy,
            energy_sd=energy_sd,
            consumption=consumption,
            consumption_sd=consumption * sd,
            recent=(past.recent + now.measured) / recent_way if recent_way >= 500 else None,
            mostly_prior=past.whole + now.distance < PRIOR_LENGTH,
        )

    def _sum_past(self) -> None:
        """Recompute what is known of the closed segments; called when one is added."""
        past = Past()
        for segment in reversed(self.riding.segments):
            share = exp(-past.whole / MEMORY)
            past.whole += segment.distance
            past.level += share * segment.level
            past.duration += share * segment.duration
            past.measured += share * segment.measured
            past.power_squares += share * segment.squares
            past.distance += share * segment.distance
            past.squares += share * segment.level**2 / segment.distance
            if past.recent_distance < 1000:
                past.recent += segment.measured
                past.recent_distance += segment.distance
        self._past = past

    def _prior(self, ambient: float, altitude: float) -> tuple[float, float]:
        """(power [W], speed [m/s]) of the prior riding."""
        if self._prior_at[0] != (ambient, altitude):
            power = 0.0
            for share, speed, acceleration in self.prior.points:
                q = self.quantities(speed, acceleration, ambient, altitude, 40.0)
                power += share * sum(self.model.power(q).values())
            self._prior_at = (ambient, altitude), power * self.prior.unevenness
        return self._prior_at[1], self.prior.speed

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """What is to be kept over a restart."""
        r = self.riding
        rows = [[s.distance, s.duration, s.measured, s.squares, s.modelled, s.level] for s in r.segments]
        return {"segments": rows, "factor": r.factor, "factor_variance": r.factor_variance}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Take what `snapshot` gave; raises KeyError, TypeError or ValueError if it is not that."""
        segments = [Segment(*(float(x) for x in row)) for row in saved["segments"]]
        riding = Riding(factor=float(saved["factor"]), factor_variance=float(saved["factor_variance"]))
        riding.segments.extend(segments)
        numbers = [x for s in segments for x in (s.measured, s.squares, s.modelled, s.level)]
        good = all(0 < s.distance < 1e5 and 0 < s.duration < 1e6 for s in segments) and all(
            abs(x) < 1e12 for x in numbers
        )
        if not good or not (0.3 <= riding.factor <= 3 and 0 < riding.factor_variance < 1):
            raise ValueError("implausible riding")
        self.riding = riding
        self._sum_past()
