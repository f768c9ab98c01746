"""What a kilometre costs by the forward model, in parts.

    SPEED     keeping the speeds ridden, on a level and straight road without wind
    STOPS     what accelerating, braking and standing add to that
    CLIMB     what hills like those ridden add to it, up and down again
    TURNING   what bends add to it
    WIND      what a steady wind over the land adds to it, in the mean over all headings, if the model knows one

What height and speed store is given back and is no cost. All in J/m of the distance, stops included.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from itertools import groupby
from math import sqrt

from gz_onboard.estimator.load_model import AHEAD, HEADINGS, Conditions, EffectInputs, LoadModel, Quantities
from gz_onboard.estimator.pattern import Point, cruise_of
from gz_onboard.events import Cause
from gz_onboard.physics.battery import HALF_FULL
from gz_onboard.physics.model import Model

Parts = dict[Cause, float]
PARTS = Cause.SPEED, Cause.STOPS, Cause.CLIMB, Cause.TURNING, Cause.WIND
MOST_KEPT = 32  # airs and masses for which the prior riding is kept


class Composition:
    """The parts of the consumption of one vehicle."""

    def __init__(self, load: LoadModel) -> None:
        model = load.model
        self._load, self._model = load, model
        calm = tuple(effect for effect in model.effects if "heading" not in effect.reads)  # only a wind asks for it
        self._calm = model if calm == model.effects else Model(calm, model.parameters)
        self._told = [Cause.STOPS, Cause.CLIMB]
        if "lateral_acceleration" in model.reads:
            self._told.append(Cause.TURNING)
        if self._calm is not model:
            self._told.append(Cause.WIND)
        self._stores = {effect.name for effect in model.effects if effect.stores_energy}
        self.prior = lru_cache(MOST_KEPT)(self._of_prior)
        self._usual = tuple(
            Point(share, share * speed, speed, acceleration, cruise=cruise_of(speed) if speed else -1, returns=False)
            for share, speed, acceleration in sorted(load.prior.points, key=lambda point: point[1])
        )

    def _of_prior(self, air: Conditions, mass: float) -> Parts:
        """Of the prior riding in this `air` with this `mass` [kg]."""
        parts = self.of(self._usual, air, mass)
        # What is not level: the file has it as one number.
        return parts | {Cause.CLIMB: (self._load.prior.unevenness - 1) * sum(parts.values())}

    def of(self, points: Sequence[Point], air: Conditions, mass: float) -> Parts:
        """Of riding these `points` in this `air` with this `mass` [kg]."""
        distance = sum(p.distance for p in points)
        cruises = _cruises(points)
        parts: Parts = dict.fromkeys(PARTS, 0.0)
        parts[Cause.SPEED] = steady = sum(self._energy(p, Cause.SPEED, air, mass) for p in cruises) / distance
        for part in self._told:
            if part is Cause.CLIMB and not any(p.grade for p in cruises):
                continue
            each = points if part is Cause.STOPS else cruises
            parts[part] = sum(self._energy(p, part, air, mass) for p in each) / distance - steady
        return parts

    def _energy(self, p: Point, part: Cause, air: Conditions, mass: float) -> float:
        """What the riding of a point takes [J] at a steady speed and with what belongs to `part`."""
        q = self._load.quantities(p.speed, p.acceleration if part is Cause.STOPS else 0.0, air)
        q["mass"] = mass
        if self._load.extended:
            lateral = p.lateral if part is Cause.TURNING else 0.0
            self._load.extend(q, EffectInputs(lateral, None, HALF_FULL, air.ambient, 0.0), air.ambient, AHEAD)
        if part is Cause.WIND:
            every = [sum(self._model.power(q | {"heading": heading}).values()) for heading in HEADINGS]
            return p.time * float(sum(every)) / len(every)
        grades = (p.grade, -p.grade) if part is Cause.CLIMB else (p.slope,) if part is Cause.STOPS else (0.0,)
        return p.time * sum(self._power(q | _graded(grade), p.returns) for grade in grades) / len(grades)

    def _power(self, q: Quantities, returns: bool) -> float:
        """The power [W] without wind; `returns`: less what is stored."""
        ledger = self._calm.power(q)
        return float(sum(power for name, power in ledger.items() if not (returns and name in self._stores)))


def _graded(grade: float) -> Quantities:
    return {"grade": grade, "grade_cosine": sqrt(1 - grade * grade)}


def _cruises(points: Sequence[Point]) -> list[Point]:
    """What moves, at its speed: one point of those that differ in acceleration only."""
    cruises = []
    for cruise, same in groupby(points, lambda p: p.cruise):
        if cruise < 0:
            continue
        each = list(same)
        distance = sum(p.distance for p in each)
        speed, grade = (
            sqrt(sum(x * x * d for x, d in values) / distance)
            for values in ([(p.speed, p.distance) for p in each], [(p.grade, p.distance) for p in each])
        )
        squares = [(p.lateral**2, p.time) for p in each if p.lateral is not None]
        lateral = sqrt(sum(x * t for x, t in squares) / sum(t for _, t in squares)) if squares else None
        cruises.append(Point(distance / speed, distance, speed, 0.0, grade, lateral=lateral))
    return cruises
