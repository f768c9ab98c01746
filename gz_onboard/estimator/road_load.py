"""What the road costs this vehicle on this ride: mass, rolling resistance, drag area and auxiliary power, jointly.

The residual of a span of three seconds is the power measured less the forward model's. It is explained by a joint
Kalman filter along the derivatives of the model's power with respect to each parameter. Mass shows by accelerations,
where force goes with them and slower disturbances do not (Fathy, Kang & Stein 2008); drag by how the force goes with
speed, rolling resistance by what is left (Bae, Ryu & Gerdes 2001); each has a memory of its own (Vahidi, Stefanopoulou
& Peng 2005). Climbs tell nothing of the mass: the grade's own error would make it too small.

What errs the same way for long is a quantity of its own beside them, so that many spans do not make it small: gain of
current and motor, nose that rises when pulling away, how far the grade is to be believed, a wind over the land, and a
force that lasts for some hundred metres (grade, gusts, bends). Where two causes look alike, their covariance says so.
What the model itself has wrong (`LEAST`) is added to each sd. If the residuals are larger than all that allows, the
noise is as large as they are, and little is learned: wheels on gravel, an effect that the model lacks.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import exp, hypot, inf, sqrt
from typing import Any, NamedTuple

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.joint import Joint
from gz_onboard.estimator.load_model import Conditions, EffectInputs, LoadModel, Road
from gz_onboard.estimator.pattern import STEEPEST
from gz_onboard.estimator.ridden import RIDE_ENDS
from gz_onboard.estimator.riders import MOST_RIDERS
from gz_onboard.estimator.road_slopes import (
    AUXILIARIES,
    DRAG,
    EAST,
    FORCE,
    GAIN,
    MASS,
    NORTH,
    PARAMETERS,
    ROLLING,
    RoadSlopes,
)
from gz_onboard.estimator.spans import Second, Span, Spans
from gz_onboard.physics.effect import MOVING

NAMES = "mass", "rolling", "drag", "auxiliaries"
# Relative sd by which vehicles and riders differ beside what the file says: none of the payload, whose sd is that;
# tyres and their pressure; riders and their clothes; lights.
DIFFER = 0.0, 0.25, 0.15, 0.33
LEAST = 0.03, 0.08, 0.05, 0.05  # relative sd, of the mass that of all: no ride tells more, for what the model has wrong
RESTED = 0.1, 0.03, 0.2  # of rolling, drag and auxiliaries: relative sd from ride to ride; of the first, by 10 K less
LUGGAGE = 5.0  # kg, sd: what a rider puts on or off at a halt
NEW_DAY = 3 * 3600.0  # s: after so long a rider who is not known is another
MOST_STILL = 100 * NEW_DAY  # that is counted
WEAR, WEAR_LENGTH = (0.05, 0.03), 20_000.0  # relative sd of rolling and drag while riding, over so many metres
SWITCHING, SWITCHING_TIME = 5.0, 600.0  # W and s: auxiliaries, likewise
GAIN_SD, NOSE_SD, GRADE_SD, WIND_SD = 0.012, 0.04, 0.3, 1.5  # 1, 1, 1, m/s
SLOW_SHARE, SLOW_LENGTH = 0.0055, 200.0  # of the weight, m: force that lasts; 10 N of a scooter
WHITE, SHAPE = 0.028, 0.08  # W per N of weight, and of the power: what scatters from span to span
DRAWN = 0.08  # W per N of weight: of less the brakes or the rest of the way may be the cause
SLOWEST = 2.0  # m/s
BENDING = 1.0  # m/s²: in bends tyres and wheels do what is not modelled
STANDING, STANDING_SD, STANDING_TIME = 0.05, 3.0, 60.0  # m/s; W and s: brake lights, offset of the current
SWITCHED, CONFIRMED = 12.0, 3  # W beyond what is known, at so many spans at standstill: a load was switched
MOST = 3.0  # sd of a residual that are believed
NOISE_SHARE, NOISE_MOST = 0.01, 16.0  # of a span in the mean of squared residuals; most that one says
RELATED_EVERY = 30  # spans after which the model is linearised anew
KEPT_EVERY, KEPT = 500.0, 4  # m, and how often: what was learned is kept to go back to
SAME = 1e-6  # relative: the vehicle file says the same as when it was learned


@dataclass(frozen=True)
class RoadParameter:
    """One parameter as learned; filed: what the vehicle file says of it, or was `entered`."""

    value: float
    sd: float
    filed: float
    unit: str
    share: float  # 1 - sd²/prior sd²: 0 nothing is learned
    entered: bool = False


class Surroundings(NamedTuple):
    """What the model reads beside the motion."""

    air: Conditions
    inputs: EffectInputs | None
    time_moving: float  # s
    heading: float | None  # rad


class Kept(NamedTuple):
    """The contents of a snapshot, checked."""

    joint: Joint
    noise: float
    still: float  # s
    rider: str
    riders: dict[str, tuple[float, float]]


class RoadLoad:
    """Learns the road load of one vehicle. `learning`: False while something is doubted, and nothing is learned."""

    def __init__(self, load: LoadModel) -> None:
        p = load.model.parameters
        self._load, self._spans = load, Spans()
        self._filed = [p[name] for name in PARAMETERS]
        self._entered = [p.is_entered(name) for name in PARAMETERS]
        self._bounds = [(p.declared[name].low, p.declared[name].high) for name in PARAMETERS]
        self._units = [p.declared[name].unit for name in PARAMETERS]
        sds = [hypot(p.sd(name), d * x) for name, d, x in zip(PARAMETERS, DIFFER, self._filed, strict=True)]
        sds[MASS] = hypot(sds[MASS], p.sd("vehicle_mass"))
        self.cable = p["cable_resistance"]  # ohm, before which the pack's power is measured
        self._empty = p["vehicle_mass"]  # kg
        weight = load.model.mass * GRAVITY
        gain = hypot(GAIN_SD, p.sd("pack_current_gain") / p["pack_current_gain"])
        self._force, self._white, self._drawn = SLOW_SHARE * weight, WHITE * weight, DRAWN * weight
        self._scales = [max(x, p.declared[name].prior_sd) for name, x in zip(PARAMETERS, self._filed, strict=True)]
        self._prior = [x * x for x in (*sds, gain, NOSE_SD, GRADE_SD, self._force, WIND_SD, WIND_SD)]
        self.joint = Joint([0.0] * len(self._prior), self._prior)
        self._noise = 1.0  # mean square of the residuals over what is expected, at least 1
        self._still, self._switched = 0.0, 0  # s; spans
        self._ridden = 0.0  # m since it was kept
        self._kept = deque([self.joint.copy()], KEPT)
        self.rider = ""
        self.riders: dict[str, tuple[float, float]] = {}  # mean and variance of the mass, by name
        self.learning = True
        self._relate()

    # --- what others ask --------------------------------------------------------------------------------------

    def learned(self) -> dict[str, RoadParameter]:
        """All four, by `NAMES`."""
        found = {}
        for i, (name, value) in enumerate(zip(NAMES, self._within(), strict=True)):
            sd, prior = self._sd(i), self._prior[i]
            share = max(1 - sd * sd / prior, 0.0) if prior else 0.0
            sd, unit = sd if share else sqrt(prior), self._units[i]
            found[name] = RoadParameter(value, sd, self._filed[i], unit, share, self._entered[i])
        return found

    def believed(self, share: float = 1.0) -> Road:
        """As learned; `share`: of what was learned, the rest as filed."""
        payload, rolling, drag, _ = self._within(share)
        return Road(self._empty + payload, rolling, drag)

    @property
    def more_auxiliaries(self) -> float:
        """What auxiliaries take beyond the file's [W]."""
        return self.joint.means[AUXILIARIES]

    def correlations(self) -> dict[tuple[str, str], float]:
        """Of each two of `NAMES`: near 1 or -1, and the two cannot be told apart."""
        pairs = combinations(enumerate(NAMES), 2)
        return {(one, other): self.joint.correlation(i, j) for (i, one), (j, other) in pairs}

    def _within(self, share: float = 1.0) -> list[float]:
        """The values of `PARAMETERS`, within what any vehicle has."""
        found = zip(self._filed, self.joint.means, self._bounds, strict=False)
        return [min(max(x + share * d, low), high) for x, d, (low, high) in found]

    def _sd(self, i: int) -> float:
        whole = self._empty + self._filed[MASS] if i == MASS else self._filed[i]
        return hypot(sqrt(self.joint.variance(i)), LEAST[i] * whole)

    # --- learning ---------------------------------------------------------------------------------------------

    def ride(self, second: Second, around: Callable[[], Surroundings]) -> None:
        """A second whose power and speed are known and not doubted; around: is asked once for each span."""
        self.learning = True
        if second.distance > MOVING * second.seconds:
            self._still = 0.0
        else:
            self.rest(second.seconds)
        span = self._spans.add(second)
        if span:
            self._learn(span, around())

    def pause(self, dt: float = 0.0) -> None:
        """`dt` [s] that teach nothing, without motion; 0: something is not known."""
        self.learning = False
        self._spans.pause()
        if dt:
            self.rest(dt)

    def rest(self, dt: float) -> None:
        """`dt` [s] without motion: what comes after long enough is another ride, or another day."""
        before, self._still = self._still, min(self._still + dt, MOST_STILL)
        joint, prior = self.joint, self._prior
        if before < RIDE_ENDS <= self._still:
            joint.widen(MASS, LUGGAGE**2, prior[MASS])
            for i, share in zip((ROLLING, DRAG, AUXILIARIES), RESTED, strict=True):
                joint.widen(i, (share * self._filed[i]) ** 2, prior[i])
            for i in (FORCE, NORTH, EAST):
                joint.begin(i, 0.0, prior[i])
        if before < NEW_DAY <= self._still and not self.rider:
            joint.begin(MASS, 0.0, prior[MASS])
        if any(before < end <= self._still for end in (RIDE_ENDS, NEW_DAY)):
            self._keep(anew=True)

    def ridden_by(self, rider: str) -> None:
        """`rider` rides from now on: with the mass that he had, if he is known."""
        if rider == self.rider:
            return
        if self.joint.variance(MASS) < self._prior[MASS]:
            self.riders[self.rider] = self.joint.means[MASS], self.joint.variance(MASS)
        mean, variance = self.riders.pop(rider, (0.0, self._prior[MASS]))
        while len(self.riders) > MOST_RIDERS:  # the one who was first known
            del self.riders[next(iter(self.riders))]
        self.joint.begin(MASS, *self._of_today(mean, variance))
        self.rider = rider
        self._keep(anew=True)

    def _of_today(self, mean: float, variance: float) -> tuple[float, float]:
        """A mass as it was known before, with other luggage; what is filed or entered if that is better known."""
        variance += LUGGAGE**2
        return (mean, variance) if variance < self._prior[MASS] else (0.0, self._prior[MASS])

    def unlearn(self) -> None:
        """A sensor is found faulty: go back by `KEPT_EVERY` times `KEPT` metres or so."""
        self._spans.pause()
        self.joint = self._kept[0]
        self._keep(anew=True)

    def _keep(self, *, anew: bool = False) -> None:
        if anew:
            self._kept.clear()
        self._kept.append(self.joint.copy())
        self._ridden = 0.0
        self._relate()

    def _relate(self) -> None:
        """Linearise the model about what is known now."""
        values = self._within()
        self.joint.means[: len(NAMES)] = [x - filed for x, filed in zip(values, self._filed, strict=True)]
        self._slopes, self._since = RoadSlopes(self._load.model, values, self._scales), 0

    def _learn(self, span: Span, around: Surroundings) -> None:
        self._pass(span)
        model, joint = self._slopes, self.joint
        level = self._load.quantities(span.speed, span.acceleration, around.air)
        level["mass"] = model.model.mass
        if around.inputs:
            self._load.extend(level, around.inputs, around.air.ambient, around.time_moving)
        if abs(span.speed) < STANDING:
            self._stand(span, span.power - model.power(level))
            return
        if span.grade is None or span.braked or span.speed < SLOWEST or span.lateral > BENDING:
            return
        grade = min(max(span.grade, -STEEPEST), STEEPEST)
        q = level | {"grade": grade, "grade_cosine": sqrt(1 - grade * grade)}
        power = model.power(q)
        if power < self._drawn or span.power < 0:
            return
        slopes = model.of(q, level, power, span.slow_acceleration, around.heading or 0.0)
        residual = span.power - power - self._off(slopes)
        squared = joint.update(slopes, residual, self._noise * (self._white**2 + (SHAPE * power) ** 2), MOST)
        seen = self._noise * min(squared, NOISE_MOST)
        self._noise = max(self._noise + NOISE_SHARE * (seen - self._noise), 1.0)
        self._since += 1
        self._ridden += span.distance
        if self._ridden >= KEPT_EVERY:
            self._keep()
        elif self._since >= RELATED_EVERY:
            self._relate()

    def _off(self, slopes: Sequence[float]) -> float:
        """What the joint filter expects beside the power of the model as last related [W]."""
        related = zip(self._slopes.values, self._filed, strict=True)
        at = [value - filed for value, filed in related]
        means = self.joint.means
        off = sum(h * (x - before) for h, x, before in zip(slopes, means, at, strict=False))
        return off + sum(h * x for h, x in zip(slopes[GAIN:], means[GAIN:], strict=True))

    def _stand(self, span: Span, residual: float) -> None:
        """What flows at standstill is the auxiliaries'; `residual` [W] of what it would be as last related."""
        i, joint = AUXILIARIES, self.joint
        off = residual - (joint.means[i] + self._filed[i] - self._slopes.values[i])
        known = 2 * sqrt(joint.variance(i))
        self._switched = self._switched + 1 if abs(off) > SWITCHED + known else 0
        if self._switched >= CONFIRMED:
            joint.widen(i, off * off, inf)
            self._switched = 0
        slopes = [float(j == i) for j in range(len(self._prior))]
        noise = STANDING_SD**2 * 2 * STANDING_TIME / span.seconds
        joint.update(slopes, off, noise, MOST)

    def _pass(self, span: Span) -> None:
        """What may have changed over a span."""
        joint, prior, way = self.joint, self._prior, abs(span.distance)
        if way:
            joint.fade(FORCE, exp(-way / SLOW_LENGTH), prior[FORCE])
            for i, share in zip((ROLLING, DRAG), WEAR, strict=True):
                joint.widen(i, (share * self._filed[i]) ** 2 * way / WEAR_LENGTH, prior[i])
        joint.widen(AUXILIARIES, SWITCHING**2 * span.seconds / SWITCHING_TIME, prior[AUXILIARIES])

    # --- saving -----------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """What is to be kept over a restart; of: what the vehicle file says; entered: whether the payload was."""
        riders = {name: list(mass) for name, mass in self.riders.items()}
        rest = {"noise": self._noise, "still": self._still, "rider": self.rider, "riders": riders}
        rest["entered"] = self._entered[MASS]
        return {"of": list(self._filed), **self.joint.snapshot(), **rest}

    def read(self, saved: Mapping[str, Any] | None) -> Kept | None:
        """The contents of a snapshot; None if there is none, or it is of another vehicle file.

        The payload is the day's: if another was entered, what was learned of the rest stays, and masses stay what they
        were. KeyError, TypeError, AttributeError or ValueError if it holds what cannot be.
        """
        if saved is None:
            return None
        of = self._of(saved["of"])
        if not all(_same(x, y) for x, y in zip(of[MASS + 1 :], self._filed[MASS + 1 :], strict=True)):
            return None
        joint = self.joint.restored(saved["means"], saved["rows"])
        noise, still = float(saved["noise"]), float(saved["still"])
        more = 0.0 if _same(of[MASS], self._filed[MASS]) else of[MASS] - self._filed[MASS]
        masses = saved["riders"].items()
        riders = {str(name): (float(mean) + more, float(variance)) for name, (mean, variance) in masses}
        possible = all(abs(mean) < inf and 0 <= variance < inf for mean, variance in riders.values())
        if not (possible and abs(more) < inf and 1 <= noise < inf and 0 <= still <= MOST_STILL):
            raise ValueError("holds an implausible road load")
        rider, mass = str(saved["rider"]), (joint.means[MASS] + more, joint.variance(MASS))
        if more or mass[1] > self._prior[MASS]:
            riders[rider] = mass  # if another rides today, whose payload was entered
            joint.begin(MASS, *self._of_today(*mass))
        return Kept(joint, noise, still, rider, riders)

    @staticmethod
    def payload_of(saved: Mapping[str, Any] | None, filed: float) -> float | None:
        """The payload [kg] that was entered when a snapshot was saved; None if none was. Raises as `read`.

        filed: the vehicle file's; older snapshots do not say whether one like it was entered.
        """
        if saved is None:
            return None
        payload = float(saved["of"][MASS])
        return payload if saved.get("entered", payload != filed) else None

    def take(self, kept: Kept | None) -> None:
        """Go on from what `read` gave."""
        if kept is None:
            return
        self.joint, self._noise, self._still, self.rider, self.riders = kept
        self.joint.begin(FORCE, 0.0, self._prior[FORCE])
        self._keep(anew=True)

    def _of(self, of: Any) -> list[float]:
        """What the vehicle file said, and was entered, when it was saved. ValueError if it cannot be."""
        filed = [float(x) for x in of]
        if len(filed) != len(self._filed):
            raise ValueError("holds a road load of another form")
        return filed


def _same(one: float, other: float) -> bool:
    return abs(one - other) <= SAME * max(abs(other), SAME)
