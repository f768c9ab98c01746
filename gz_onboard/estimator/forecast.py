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

Effects of an extended model read more than speed, acceleration and grade, which is all that is known of the way to
come. What is modelled of the way ridden has the heading, the lateral acceleration and the vibration (the root mean
square over each second) and the time moving as they were. What is expected of the way to come has
- of the heading nothing: the mean over all of them, so that a steady wind costs what it costs on a round trip;
- the lateral acceleration and the vibration that the same piece of way had; before anything is ridden, or without IMU,
  the prior's;
- the time moving of half an hour on, as a range lasts an hour or so: tyres are warm then;
- of memory nothing: effects are settled. Those in the cells take their voltage at the mean current.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import exp, isfinite, pi, sqrt
from typing import Any

from gz_onboard.constants import GRAVITY
from gz_onboard.physics.battery import Battery
from gz_onboard.physics.drawable import drawable
from gz_onboard.physics.effect import MOVING
from gz_onboard.physics.model import Model, air_density, stepping
from gz_onboard.physics.riding import PriorRiding

SEGMENT = 250.0  # m
PRIOR_LENGTH = 3000.0  # m: the prior riding counts like that much of real riding
MEMORY = 12000.0  # m: what is further back counts for less than 1/e
ALIKE = 300.0  # m: over so much way segments are alike; those of the eight commissioning rides are not at 250 m
DRIFT = 0.055  # relative sd: the rest of the way is not the way so far; the eight rides differ by that
FACTOR_WALK = 0.01  # sd of its change over a segment: wind, tyres, traffic
SEGMENT_SD = 0.18  # relative: measured against modelled energy of one segment, of the eight commissioning rides
HEIGHT_WALK = 0.75  # m per sqrt(m): roads climb or fall by 60 m on 6 km; of a way whose grade no sensor told
PRIOR_FORM = 2.5  # mean square of the power over the square of its mean, of the eight commissioning rides
PRIOR_SCATTER = 0.25  # relative sd of segments of a riding not yet known
AHEAD = 1800.0  # s: half of what a range lasts
HEADINGS = tuple(
    pi / 4 * i for i in range(8)
)  # rad: of a wind slower than the scooter their mean is that of all, exactly
BASE = {
    "speed",
    "acceleration",
    "grade",
    "grade_cosine",
    "headwind",
    "mass",
    "air_density",
    "motor_temperature",
    "motor_speed",
    "motor_current",
    "torque",
}
"""Quantities that need nothing beyond speed, grade and air."""
ACCELERATION = 15.0  # m/s²: no road gives more; a second that shows more is left out
SPEEDS = -5.0, 70.0  # m/s: the same
LEAST = 0.2  # of the prior's consumption: no way of any length takes less
MOST_SD = 3.0  # of the logarithm of the range: beyond, it is not known at all
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
    unseen: float = 0.0  # m of which no sensor told the grade
    learned: tuple[float, float] | None = None  # the factor and its variance before it; None after a restart


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
    lateral: float = 0.0  # m²/s³ in it: the square of the lateral acceleration
    lateral_seconds: float = 0.0  # s in it for which that is known
    shaken: float = 0.0  # m²/s³ in it: the square of the vibration
    shaken_seconds: float = 0.0  # s in it for which that is known
    time_moving: float = 0.0  # s since the start
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
    recent_modelled: float = 0.0  # J
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


@dataclass(frozen=True, slots=True)
class Turn:
    """What effects beyond the base's may read at one time; None where it is not known."""

    lateral_acceleration: float | None  # m/s²
    heading: float | None  # rad, clockwise from north
    soc: float
    cell_temperature: float  # degC
    current: float  # A of the pack
    vibration: float | None = None  # m/s²


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
        self.extended = not model.reads <= BASE or any(e.decay for e in model.effects)
        self._by_heading = "heading" in model.reads
        self._overpotential = model.overpotential(battery, {"vibration": prior.vibration, "time_moving": AHEAD})
        self._states: dict[str, float] = {}  # of effects with memory between road and pack
        self._capacity_sd = parameters.sd("cell_capacity") / parameters["cell_capacity"]

    # --- learning ---------------------------------------------------------------------------------------------

    def ride(
        self,
        dt: float,
        speed: float,
        grade: float | None,
        power: float,
        ambient: float,
        altitude: float,
        motor_temperature: float,
        turn: Turn | None = None,
        period: float = 0.0,
    ) -> bool:
        """Take in `dt` [s] of riding: speed [m/s], grade (sine), power at the pack [W], ambient and motor [degC].

        `turn` is needed, and read, if the model is `extended`. `period` [s]: how often the speed comes, if seldom;
        between two of its messages it has no acceleration that means anything. Gives whether a segment was learned.
        """
        r = self.riding
        if r.speed_before is None:
            r.speed_before = speed
        r.seconds += dt
        r.way += speed * dt
        r.energy += power * dt
        r.squares += power * power * dt
        r.climb += (grade or 0.0) * speed * dt
        r.current.unseen += abs(speed) * dt if grade is None else 0.0
        if turn:
            if turn.lateral_acceleration is not None:
                r.lateral += turn.lateral_acceleration**2 * dt
                r.lateral_seconds += dt
            if turn.vibration is not None:
                r.shaken += turn.vibration**2 * dt
                r.shaken_seconds += dt
            if speed > MOVING:
                r.time_moving += dt
        if r.seconds < max(1.0, period):
            return False
        mean = r.way / r.seconds
        acceleration = (speed - r.speed_before) / r.seconds
        if abs(acceleration) > ACCELERATION or not SPEEDS[0] < mean < SPEEDS[1]:  # a sensor errs, or the wheel spins
            self.pause()
            return False
        q = self.quantities(mean, acceleration, ambient, altitude, motor_temperature)
        if abs(r.way) > 0.1:
            q["grade"] = max(min(r.climb / abs(r.way), 0.3), -0.3)
        segment = r.current
        segment.distance += abs(r.way)
        segment.duration += r.seconds
        segment.measured += r.energy
        segment.squares += r.squares
        if turn:
            self.add(q, turn, ambient)
            if r.lateral_seconds:
                q["lateral_acceleration"] = sqrt(r.lateral / r.lateral_seconds)
            if r.shaken_seconds:
                q["vibration"] = sqrt(r.shaken / r.shaken_seconds)
            energy, to_come = (power * r.seconds for power in self._with_memory(q, turn.heading is not None, r.seconds))
        else:
            energy = to_come = sum(self.model.power(q).values()) * r.seconds
        segment.modelled += energy
        stored = GRAVITY * r.climb + (speed * speed - r.speed_before * r.speed_before) / 2
        segment.level += to_come - self.model.mass * stored
        self._next_second()
        r.speed_before = speed
        if segment.distance < SEGMENT:
            return False
        self._close(segment)
        return True

    @property
    def recent_factor(self) -> float:
        """Measured over modelled energy of the last kilometre or so; 1 while that is not known."""
        past = self._past
        return past.recent / past.recent_modelled if past.recent_distance >= 1000 and past.recent_modelled > 0 else 1.0

    def forget(self, way: float) -> None:
        """Unlearn the last `way` [m] or a little more: a sensor that it was learned from has lied."""
        r = self.riding
        self.pause()
        way -= r.current.distance
        r.current = Segment()
        while way > 0 and r.segments and (before := r.segments[-1].learned):
            way -= r.segments.pop().distance
            r.factor, r.factor_variance = before
        self._sum_past()

    def pause(self) -> None:
        """Something was not known for a while: leave the second that was being gathered."""
        self._next_second()
        self.riding.speed_before = None

    def _next_second(self) -> None:
        r = self.riding
        r.seconds = r.way = r.energy = r.squares = r.climb = 0.0
        r.lateral = r.lateral_seconds = r.shaken = r.shaken_seconds = 0.0

    def quantities(
        self, speed: float, acceleration: float, ambient: float, altitude: float, motor: float
    ) -> dict[str, Any]:
        """What the model reads, on a level road without wind; temperatures in degC."""
        return {
            "speed": speed,
            "acceleration": acceleration,
            "grade": 0.0,
            "grade_cosine": 1.0,
            "headwind": 0.0,
            "mass": self.model.mass,
            "air_density": air_density(ambient, altitude),
            "motor_temperature": motor,
            "lateral_acceleration": 0.0,
        }

    def add(self, q: dict[str, Any], turn: Turn, ambient: float) -> None:
        """Add to `q` what an extended model may read beside; `ambient` in degC."""
        lateral = turn.lateral_acceleration
        if lateral is None:
            lateral = self.prior.lateral_acceleration if q["speed"] > MOVING else 0.0
        q["lateral_acceleration"] = lateral
        q["vibration"] = self.typical_vibration(q["speed"]) if turn.vibration is None else turn.vibration
        q["heading"] = turn.heading or 0.0
        q["time_moving"] = self.riding.time_moving
        self._add_cells(q, turn.soc, turn.cell_temperature, turn.current, ambient)

    def typical_vibration(self, speed: float) -> float:
        """The prior riding's [m/s²] at `speed` [m/s]: what is taken where it is not known."""
        return self.prior.vibration if speed > MOVING else 0.0

    def _add_cells(self, q: dict[str, Any], soc: float, temperature: float, current: float, ambient: float) -> None:
        q |= {
            "ambient_temperature": ambient,
            "soc": soc,
            "cell_temperature": temperature,
            "cell_current": current / self.battery.cells_parallel,
            "cell_capacity": self.battery.cell_capacity(temperature),
        }

    def _with_memory(self, q: dict[str, Any], heading_known: bool, dt: float) -> tuple[float, float]:
        """The power [W] as it was, over the last `dt` [s], and as it is to be expected of riding the same again."""
        q_then = q | {"time_moving": q["time_moving"] + AHEAD}
        to_come = self._over_headings(q_then)
        if self._by_heading and not heading_known:
            return self._over_headings(q), to_come
        return float(sum(self.model.power(q, stepping(self._states, dt)).values())), to_come

    def _over_headings(self, q: dict[str, Any]) -> float:
        """The power [W] with all settled, in the mean over the headings if the model reads them."""
        if not self._by_heading:
            return float(sum(self.model.power(q).values()))
        powers = (sum(self.model.power(q | {"heading": heading}).values()) for heading in HEADINGS)
        return float(sum(powers)) / len(HEADINGS)

    def _close(self, segment: Segment) -> None:
        r = self.riding
        segment.learned = r.factor, r.factor_variance
        r.segments.append(segment)
        r.current = Segment()
        self._sum_past()
        # A Kalman filter on the factor. Its error is one of energy (a hill or a gust not seen), so a segment that
        # takes little tells little.
        r.factor_variance += FACTOR_WALK**2
        if segment.modelled > 0:
            noise = SEGMENT_SD * self._past.level / self._past.distance * segment.distance
            height = self.model.mass * GRAVITY * HEIGHT_WALK * sqrt(segment.unseen)
            variance = (noise * noise + height * height) / segment.modelled**2
            gain = r.factor_variance / (r.factor_variance + variance)
            r.factor += gain * (segment.measured / segment.modelled - r.factor)
            r.factor = min(max(r.factor, 0.3), 3.0)
            r.factor_variance *= 1 - gain

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
        prior_power, prior_speed = self.prior_ride(ambient, altitude)
        prior = prior_power / prior_speed
        fade = exp(-now.distance / MEMORY)
        way = PRIOR_LENGTH + fade * past.distance + now.distance
        modelled = max((PRIOR_LENGTH * prior + fade * past.level + now.level) / way, LEAST * prior)
        speed = way / (PRIOR_LENGTH / prior_speed + fade * past.duration + now.duration)
        consumption = r.factor * modelled
        power = consumption * speed

        # Downhill next to nothing is drawn in the mean; what is to come is not all downhill.
        prior_time = PRIOR_LENGTH / prior_speed
        mean = max(
            prior_power * prior_time + max(past.measured, r.factor * past.level), LEAST * prior_power * prior_time
        )
        form = (PRIOR_FORM * prior_power**2 * prior_time + past.power_squares) * (prior_time + past.duration) / mean**2
        form = min(max(form, 1.0), 6.0)

        left = drawable(self.battery, soc, cell_temperature, power, form, self._overpotential)
        colder = drawable(self.battery, soc, cell_temperature - temperature_sd, power, form, self._overpotential)
        energy_sd = sqrt(
            (soc_sd * left.slope) ** 2 + (left.energy - colder.energy) ** 2 + (self._capacity_sd * left.energy) ** 2
        )
        range_ = left.energy / consumption
        squares = (PRIOR_LENGTH * prior**2 * (1 + PRIOR_SCATTER**2) + fade * past.squares) / (
            PRIOR_LENGTH + fade * past.distance
        )
        mean = max((PRIOR_LENGTH * prior + fade * past.level) / (PRIOR_LENGTH + fade * past.distance), LEAST * prior)
        scatter = max(squares / mean**2 - 1, 0.1**2)
        variance = (
            loss_variance
            + scatter * ALIKE * (1 / max(range_, ALIKE) + 1 / max(way, ALIKE))
            + DRIFT**2
            + r.factor_variance / r.factor**2
        )
        variance = min(variance, MOST_SD**2)
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
                past.recent_modelled += segment.modelled
                past.recent_distance += segment.distance
        self._past = past

    def prior_ride(self, ambient: float, altitude: float) -> tuple[float, float]:
        """(power [W], speed [m/s]) of the prior riding at `ambient` [degC] and `altitude` [m]."""
        return self._prior(round(ambient), round(altitude, -2))

    def usual_force(self) -> float:
        """Mean force [N] of the prior riding: its energy at the pack over its way."""
        power, speed = self._prior(20.0, 0.0)
        return self.prior.factor * power / speed

    def _prior(self, ambient: float, altitude: float) -> tuple[float, float]:
        if self._prior_at[0] != (ambient, altitude):
            power = 0.0
            for share, speed, acceleration in self.prior.points:
                q = self.quantities(speed, acceleration, ambient, altitude, 40.0)
                if self.extended:
                    q["time_moving"] = AHEAD
                    q["lateral_acceleration"] = self.prior.lateral_acceleration if speed > MOVING else 0.0
                    q["vibration"] = self.typical_vibration(speed)
                    self._add_cells(q, 0.5, float(ambient), 0.0, float(ambient))
                    power += share * self._over_headings(q)
                else:
                    power += share * sum(self.model.power(q).values())
            self._prior_at = (ambient, altitude), power * self.prior.unevenness
        return self._prior_at[1], self.prior.speed

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """What is to be kept over a restart."""
        r = self.riding
        rows = [[s.distance, s.duration, s.measured, s.squares, s.modelled, s.level] for s in r.segments]
        return {
            "segments": rows,
            "factor": r.factor,
            "factor_variance": r.factor_variance,
            "time_moving": r.time_moving,
            "states": dict(self._states),
        }

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Take what `snapshot` gave; raises KeyError, TypeError or ValueError if it is not that."""
        segments = [Segment(a, b, c, d, e, f) for a, b, c, d, e, f in (map(float, row) for row in saved["segments"])]
        riding = Riding(factor=float(saved["factor"]), factor_variance=float(saved["factor_variance"]))
        riding.segments.extend(segments)
        riding.time_moving = float(saved["time_moving"])
        states = {str(name): float(x) for name, x in saved["states"].items()}
        numbers = [x for s in segments for x in (s.measured, s.squares, s.modelled, s.level)]
        good = all(0 < s.distance < 1e5 and 0 < s.duration < 1e6 for s in segments) and all(
            abs(x) < 1e12 for x in numbers
        )
        if not good or not (0.3 <= riding.factor <= 3 and 0 < riding.factor_variance < 1):
            raise ValueError("implausible riding")
        if not (0 <= riding.time_moving < 1e7 and all(map(isfinite, states.values()))):
            raise ValueError("implausible states of effects")
        self._states = states
        self.riding = riding
        self._sum_past()
