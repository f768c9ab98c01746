"""The forward model with learned parameters of the road load, and how its power goes with each of them."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin

from gz_onboard.estimator.load_model import Quantities
from gz_onboard.physics.effect import ROAD_LOAD
from gz_onboard.physics.model import Bound, Model, total

MASS, ROLLING, DRAG, AUXILIARIES, GAIN, NOSE, GRADE, FORCE, NORTH, EAST = range(10)
"""What a joint filter knows: four parameters, and what else makes the power another than the model's.

GAIN: of current and motor, relative. NOSE: share of the acceleration by which the accelerometer shows too much, as a
nose that rises. GRADE: share by which the road is steeper than its grade. FORCE: against the motion [N]. NORTH, EAST:
where a wind blows from [m/s].
"""
PARAMETERS = "payload_mass", "rolling_resistance_constant", "drag_area", "auxiliary_power"
STEP = 0.1  # of a parameter, relative, and m/s of wind: to differentiate by
ONE = 1.0  # kg, likewise


class RoadSlopes:
    """The model of one vehicle with other values of `PARAMETERS`; a force acts on the power by the losses behind it."""

    def __init__(self, filed: Model, values: Sequence[float], scales: Sequence[float]) -> None:
        """`scales`: of the values: neither is 0."""
        self.values = list(values)
        now = dict(zip(PARAMETERS, values, strict=True))
        effects, p = filed.effects, filed.parameters
        own = p.replaced(**now)
        self.model = Model(effects, own)
        self._steps = {i: STEP * scales[i] for i in (ROLLING, DRAG)}
        if values[DRAG] + self._steps[DRAG] > p.declared[PARAMETERS[DRAG]].high:
            self._steps[DRAG] *= -1
        more = {i: {**own, PARAMETERS[i]: values[i] + step} for i, step in self._steps.items()}
        self._dragged = Model(effects, own.replaced(**{PARAMETERS[DRAG]: more[DRAG][PARAMETERS[DRAG]]}))
        on_road = [effect for effect in effects if effect.port in ROAD_LOAD]
        self._pairs = {
            i: [(Bound(e, p), Bound(e, own)) for e in on_road if PARAMETERS[i] in e.keywords] for i, p in more.items()
        }
        self._heavy = [Bound(e, own) for e in on_road if "mass" in e.reads]
        self._windy = [Bound(e, own) for e in on_road if "headwind" in e.reads]

    def power(self, q: Quantities) -> float:
        """At the pack [W], all effects settled."""
        return float(sum(self.model.power(q).values()))

    def of(
        self, q: Quantities, level: Quantities, power: float, slow_acceleration: float, heading: float
    ) -> list[float]:
        """The derivatives of the `power` [W] at `q`.

        level: `q` without its grade. slow_acceleration [m/s²]: as the grade's low pass has it. heading [rad].
        """
        forces = {
            i: (total([b for b, _ in pairs], q) - total([a for _, a in pairs], q)) / self._steps[i]
            for i, pairs in self._pairs.items()
        }
        more = float(sum(self._dragged.power(q).values())) - power
        drag = forces[DRAG] * self._steps[DRAG]
        per_force = more / drag if drag else q["speed"]
        here, flat = total(self._heavy, q), total(self._heavy, level)
        mass = (total(self._heavy, {**level, "mass": q["mass"] + ONE}) - flat) / ONE
        wind = (total(self._windy, {**q, "headwind": q["headwind"] + STEP}) - total(self._windy, q)) / STEP
        slopes = [0.0] * 10
        slopes[MASS] = per_force * mass
        slopes[ROLLING], slopes[DRAG] = per_force * forces[ROLLING], per_force * forces[DRAG]
        slopes[AUXILIARIES] = 1.0
        slopes[GAIN] = power
        slopes[NOSE] = -per_force * q["mass"] * slow_acceleration
        slopes[GRADE], slopes[FORCE] = per_force * (here - flat), per_force
        slopes[NORTH], slopes[EAST] = per_force * wind * cos(heading), per_force * wind * sin(heading)
        return slopes
