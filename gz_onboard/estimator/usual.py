"""What is usual for this vehicle and its rider, and how the present ride differs from it.

Each quantity (`Habit`) is a level that is usual, known with some uncertainty and hardly changing, plus a deviation of
the present riding, which fades over `FADES` and begins anew with each ride: a first-order Gauss-Markov process. A
Kalman filter learns both from segments. Their scatter, and how unlike each other rides are, are learned too: the
expectation and maximisation of Shumway & Stoffer 1982, a little at each step instead of over all data again. So is how
alike neighbours are (a car's motorway, a hill): their mean is known less well by as much. What is left after a ride is
the prior of the next.

All are relative to what the model gives for the prior riding in the same air, so that cold air or a high pass is not
taken for a habit.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields, replace
from math import exp, inf, sqrt
from typing import Any

from gz_onboard.physics.riding import PriorRiding

SEGMENT = 250.0  # m: of a scooter in town neighbours of this length are hardly alike
FADES = 200_000.0  # m: over which a ride loses its likeness to its begin; full discharges of 50 to 70 km did not
SEASON = 500_000.0  # m: over which what is usual changes by `SEASON_CHANGE` (tyres, clothes, ways)
SEASON_CHANGE = 0.1  # sd, relative
SCATTER_LENGTH = 20_000.0  # m of riding from which the scatter is known
RIDE_SHARE = 0.1  # of what one ride says of how unlike rides are: the last ten or so count
LEAST_SD = 0.005  # no riding is more even
OUTLIER = 4.0  # sd: what one segment shows beyond is a faulty sensor, or a wait for a ferry, and is not learned
RUN_LENGTH = 4000.0  # m, over which residuals are averaged to see whether the riding changed
RUN_MOST = 0.7  # sd of one segment: 3.9 sd of that mean; none of 24 rides of healthy scooters of the plant had it
MOST, MOST_VARIANCE = 10.0, 4.0  # everything is about 1; a heated van in a jam takes 5 times what the model says
LEVEL_SD = 0.15  # of what riders and roads of one kind of vehicle cost
PRIOR_SCATTER = 0.2 / PriorRiding.drift  # sd of a segment's price, over that of rides
MOST_LIKENESS = 0.8  # correlation
FACTOR_BETWEEN = 0.03  # sd of the factor between rides: wind, tyres, luggage
FACTOR_SCATTER = 0.18  # sd of a segment's measured less modelled energy, of the eight commissioning rides
STANDING_SD, STANDING_BETWEEN, STANDING_SCATTER = 0.03, 0.01, 0.06  # of the price: a wait of half a minute is 0.05
PACE_SD, PACE_BETWEEN, PACE_SCATTER = 0.25, 0.1, 0.4  # of the time per metre


@dataclass(frozen=True, slots=True)
class Habit:
    """One quantity: what is usual, and by how much the present riding differs. Variances in its square."""

    usual: float
    usual_variance: float
    between: float  # variance from ride to ride
    scatter: float  # variance of one segment
    present: float = 0.0
    present_variance: float = -1.0  # below 0: as between rides
    covariance: float = 0.0
    run: float = 0.0  # mean of the latest residuals, each over its sd
    likeness: float = 0.0  # correlation of the scatter of neighbouring segments
    beside: float = 0.0  # of the latest residual over its sd, less that mean; 0: of another ride

    def __post_init__(self) -> None:
        if self.present_variance < 0:
            object.__setattr__(self, "present_variance", self.between)

    @property
    def now(self) -> float:
        """Of the present riding."""
        return self.usual + self.present

    @property
    def variance(self) -> float:
        """Of `now`."""
        return self.usual_variance + 2 * self.covariance + self.present_variance

    @property
    def known_from(self) -> float:
        """As much riding [m] as would tell as much of `now`."""
        return self._own(1.0) / max(self.variance, LEAST_SD**2 / 100)

    def _own(self, distance: float) -> float:
        """Variance that the scatter gives a mean over `distance` [m], of a first-order autoregressive process."""
        return self.scatter * (1 + self.likeness) / (1 - self.likeness) * SEGMENT / distance

    def learned(self, residual: float, distance: float, noise: float = 0.0) -> Habit:
        """After `distance` [m] that differed from `now` by `residual`; `noise`: a variance beside the scatter."""
        fade = exp(-distance / FADES)
        season = SEASON_CHANGE**2 * self.usual**2 * distance / SEASON
        uu = min(self.usual_variance + season, max(self.usual_variance, MOST_VARIANCE))
        up, pp = fade * self.covariance, fade * fade * self.present_variance + (1 - fade * fade) * self.between
        alone, own = self.scatter * SEGMENT / distance, self._own(distance)
        total = uu + 2 * up + pp + own + noise
        most = OUTLIER * sqrt(total)
        residual = min(max(residual + (1 - fade) * self.present, -most), most)
        told = noise < own  # what else errs may err alike for long
        share = min(distance / RUN_LENGTH, 1.0) if told else 0.0
        run = self.run + share * (residual / sqrt(total) - self.run)
        if abs(run) > RUN_MOST:  # by about so much the riding changed, or what is usual is another than was thought
            more = max(min(max(self.between, run * run * total), MOST_VARIANCE) - pp, 0.0)
            of_usual = uu / (uu + self.between)
            uu, pp, run = uu + of_usual * more, pp + (1 - of_usual) * more, 0.0
            total = uu + 2 * up + pp + own + noise
        gain_usual, gain_present = (uu + up) / total, (up + pp) / total
        # of the segment's own scatter: its mean square given the residual
        whole = total - own + alone
        seen = (alone * residual / whole) ** 2 + alone * (1 - alone / whole)
        seen *= distance / SEGMENT
        share = min(distance / SCATTER_LENGTH, 1.0)
        # Less the mean of the latest, as a level that changed is no likeness; what is not scatter may be its error too.
        beside = residual / sqrt(total) - self.run
        scattered = share * (own / total) ** 2 if told and self.beside else 0.0
        likeness = self.likeness + scattered * (beside * self.beside * total / alone - self.likeness)
        return Habit(
            min(max(self.usual + gain_usual * residual, -MOST), MOST),
            uu - gain_usual * (uu + up),
            self.between,
            min(max(self.scatter + share * (seen - self.scatter), LEAST_SD**2), MOST_VARIANCE),
            min(max(fade * self.present + gain_present * residual, -MOST), MOST),
            pp - gain_present * (up + pp),
            up - gain_usual * (up + pp),
            run,
            min(max(likeness, 0.0), MOST_LIKENESS),
            beside,
        )

    def scaled(self, by: float) -> Habit:
        """The same in a unit that is so many times smaller."""
        square = by * by
        return replace(
            self,
            usual=by * self.usual,
            present=by * self.present,
            usual_variance=square * self.usual_variance,
            present_variance=square * self.present_variance,
            covariance=square * self.covariance,
            between=square * self.between,
            scatter=square * self.scatter,
        )

    def rested(self) -> Habit:
        """Before another ride: what this one was teaches how unlike rides are."""
        seen = self.present**2 + self.present_variance
        between = min(max(self.between + RIDE_SHARE * (seen - self.between), LEAST_SD**2), MOST_VARIANCE)
        return Habit(self.usual, self.usual_variance, between, self.scatter, likeness=self.likeness)

    def ahead(self, distance: float) -> tuple[float, float]:
        """(mean over the next `distance` [m], its variance).

        The mean of a Gauss-Markov process over a time, given its value now, and what scatters along the way.
        """
        lengths = max(distance, 1.0) / FADES
        share = (1 - exp(-lengths)) / lengths
        whole = 2 * (1 - share) / lengths  # variance of the mean where nothing is known, over the variance between
        variance = self.usual_variance + 2 * share * self.covariance + share * share * self.present_variance
        variance += (whole - share * share) * self.between + self._own(max(distance, SEGMENT))
        return self.usual + share * self.present, variance


@dataclass(frozen=True, slots=True)
class Usual:
    """All habits. All but the factor are in units of the prior riding's."""

    price: Habit  # energy per metre in motion, less what height and speed have stored
    standing: Habit  # energy at stops per metre, in units of that price
    pace: Habit  # time per metre, stops included
    factor: Habit  # measured over modelled energy of the same motion

    @classmethod
    def of(cls, prior: PriorRiding, standing: float) -> Usual:
        """Before anything is ridden; `standing`: the prior riding's."""
        level, scatter = prior.factor_sd**2 + LEVEL_SD**2, max(PRIOR_SCATTER * prior.drift, LEAST_SD) ** 2
        price = Habit(prior.factor, level, prior.drift**2, scatter)
        return cls(
            price,
            Habit(standing, STANDING_SD**2, STANDING_BETWEEN**2, STANDING_SCATTER**2),
            Habit(1.0, PACE_SD**2, PACE_BETWEEN**2, PACE_SCATTER**2),
            Habit(prior.factor, prior.factor_sd**2, FACTOR_BETWEEN**2, FACTOR_SCATTER**2),
        )

    def rested(self) -> Usual:
        """Before another ride."""
        return Usual(self.price.rested(), self.standing.rested(), self.pace.rested(), self.factor.rested())

    def snapshot(self) -> dict[str, dict[str, float]]:
        """What is to be kept over a restart."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Unit:
    """What habits are relative to: price [J/m] and speed [m/s] of the prior riding by the vehicle file."""

    price: float = 1.0
    speed: float = 1.0


def restored_unit(saved: Mapping[str, Any], now: Unit) -> Unit:
    """The unit of saved habits over that of `now`; 1 for older versions, which did not say.

    TypeError or ValueError if it cannot be.
    """
    if "of" not in saved:
        return Unit()
    unit = Unit(float(saved["of"]["price"]) / now.price, float(saved["of"]["speed"]) / now.speed)
    if not (0 < unit.price < inf and 0 < unit.speed < inf):
        raise ValueError("implausible unit of habits")
    return unit


def restored_usual(saved: Mapping[str, Any], unit: Unit = Unit()) -> Usual:
    """What `Usual.snapshot` gave; KeyError, TypeError or ValueError if it is not that.

    unit: of it over today's. A vehicle file that was calibrated anew changes that, and not what was ridden.
    """
    usual = Usual(*(_restored_habit(saved[f.name]) for f in fields(Usual)))
    if unit == Unit():
        return usual
    scales = {"price": unit.price, "standing": unit.price, "pace": 1 / unit.speed, "factor": unit.price}
    return Usual(*(_restored_habit(asdict(getattr(usual, name).scaled(by))) for name, by in scales.items()))


def _restored_habit(saved: Mapping[str, Any]) -> Habit:
    # What older versions saved lacks what has a default.
    names = [f.name for f in fields(Habit) if f.name in saved or f.default is MISSING]
    habit = Habit(**{name: float(saved[name]) for name in names})
    numbers = [getattr(habit, f.name) for f in fields(Habit)]
    least = min(habit.between, habit.scatter, habit.present_variance, habit.usual_variance)
    possible = habit.covariance**2 <= habit.usual_variance * habit.present_variance * (1 + 1e-9)
    possible &= 0 <= habit.likeness <= MOST_LIKENESS
    if not (all(abs(x) <= MOST for x in numbers) and least >= 0 < habit.scatter and possible):
        raise ValueError("implausible habits")
    return habit
