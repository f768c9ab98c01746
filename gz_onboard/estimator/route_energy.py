"""What riding along a route costs by the model, from its start to each point.

The speed is the profile's that limits and bends allow. The cost of the way is in two parts,
since only the first is to be corrected by what is learned: that of the level road, and what its height adds. Roads
with low limits have more stops, which no map shows: of the differences along the route in the cost of the level road
`EVEN` are taken as made up for by stops.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from typing import TYPE_CHECKING, Any

from gz_onboard.estimator.load_model import Conditions, EffectInputs, LoadModel
from gz_onboard.physics.battery import HALF_FULL
from gz_onboard.physics.effect import MOVING
from gz_onboard.physics.functions import sqrt
from gz_onboard.routes.profile import speed_profile
from gz_onboard.routes.route import Route

if TYPE_CHECKING:
    from gz_onboard.arrays import Array

EVEN = 0.6  # share: least error of the energy left on ten full discharges, of 0, 0.3, 0.6 and 0.8
PART = 5000  # pieces of the route that are modelled at a time: a millisecond or so, on a board five
SLOWEST = 0.5  # m/s, in the mean over a piece


@dataclass(frozen=True)
class Costs:
    """Energies from the start of the route to each of its points [J], shape (n,)."""

    level: Array
    height: Array


class RouteEnergy:
    """One route in pieces. `distance` [m] of their ends, `speed` [m/s] that limits allow there, `climb` [m]; (n,)."""

    def __init__(self, route: Route, top_speed: float) -> None:
        """top_speed: of a rider where the route has no limit [m/s]. Imports numpy and takes up to a second."""
        import numpy as np

        self._np = np
        unlimited = min(route.speed_limit) == inf
        profile = speed_profile(route, top_speed=top_speed if unlimited else inf)
        self.distance, self.speed = np.array(profile.distance), np.array(profile.speed)
        middles = (self.distance[1:] + self.distance[:-1]) / 2
        known = {"grade": route.grade, "curvature": route.curvature, "heading": route.heading}
        known |= {"headwind": route.headwind or (0.0,) * len(route.distance)}
        self._pieces = {name: np.interp(middles, route.distance, values) for name, values in known.items()}
        self.climb = np.concatenate(([0.0], np.cumsum(self._pieces["grade"] * np.diff(self.distance))))  # m
        self._ambient = np.interp(middles, route.distance, route.temperature) if route.temperature else None
        self._stops = np.zeros(len(middles))
        if route.stop:
            ends = np.searchsorted(self.distance, np.array(route.distance))
            np.add.at(self._stops, np.minimum(ends, len(middles) - 1), np.array(route.stop))

    @property
    def length(self) -> float:
        """Of the route [m]."""
        return float(self.distance[-1])

    def between(self, values: Array, start: float, end: float) -> float:
        """How much of `values` (n,), at `distance`, lies between two distances [m]."""
        first, last = self._np.interp((start, end), self.distance, values)
        return float(last - first)

    def reach(self, energy: Array, start: float, given: float) -> float | None:
        """How far [m] from the distance `start` [m] `given` [J] go, by `energy` (n,) from the start of the route.

        None if to its end.
        """
        np = self._np
        if given <= 0:
            return 0.0
        target = float(np.interp(start, self.distance, energy)) + given
        first = int(np.searchsorted(self.distance, start, side="right"))
        beyond = energy[first:] >= target
        if not beyond.any():
            return None
        i = first + int(beyond.argmax())
        here, step = (start, self.distance[i] - start) if i == first else (self.distance[i - 1], 0.0)
        step = step or self.distance[i] - here
        before = target - given if i == first else energy[i - 1]
        share = (target - before) / (energy[i] - before) if energy[i] > before else 0.0
        return float(here + share * step - start)

    def modelled(self, load: LoadModel, conditions: Conditions, time_moving: float) -> Iterator[Costs | None]:
        """Model the route, a part at each call of `next`: None, and at last its costs.

        time_moving: of the ride so far [s].
        """
        np, count = self._np, len(self.distance) - 1
        level, height, time = (np.zeros(count + 1) for _ in range(3))
        for begin in range(0, count, PART):
            part, ends = slice(begin, begin + PART), slice(begin + 1, min(begin + PART, count) + 1)
            speed, length = self.speed[begin : ends.stop], np.diff(self.distance[begin : ends.stop])
            mean = np.maximum((speed[1:] + speed[:-1]) / 2, SLOWEST)
            times = length / mean
            motion = (
                mean,
                (speed[1:] ** 2 - speed[:-1] ** 2) / (2 * length),
                time_moving + time[begin] + np.cumsum(times),
            )
            flat, whole = (self._power(load, conditions, part, motion, hills) for hills in (False, True))
            stops = self._stops[part]
            standing = self._power(load, conditions, part, (0.0 * mean, 0.0 * mean, motion[2]), False)
            level[ends] = level[begin] + np.cumsum(flat * times + standing * stops)
            height[ends] = height[begin] + np.cumsum((whole - flat) * times)
            time[ends] = time[begin] + np.cumsum(times + stops)
            yield None
        yield Costs((1 - EVEN) * level + EVEN * level[-1] * self.distance / self.length, height)

    def _power(
        self, load: LoadModel, conditions: Conditions, part: slice, motion: tuple[Any, Any, Any], hills: bool
    ) -> Array:
        """At the pack [W], of each piece of `part`; motion: speed [m/s], acceleration [m/s²], time moving [s]."""
        speed, acceleration, moving = motion
        ambient = conditions.ambient if self._ambient is None else float(self._ambient[part].mean())
        q: dict[str, Any] = load.quantities(speed, acceleration, Conditions(ambient, conditions.altitude))
        if hills:
            grade = self._pieces["grade"][part]
            q |= {"grade": grade, "grade_cosine": sqrt(1 - grade * grade)}
        q["headwind"] = self._pieces["headwind"][part]
        if load.extended:
            lateral: Any = speed * speed * self._pieces["curvature"][part]
            heading: Any = self._pieces["heading"][part]
            vibration: Any = load.prior.vibration * (speed > MOVING)
            load.extend(q, EffectInputs(lateral, heading, HALF_FULL, ambient, 0.0, vibration), ambient, moving)
        power: Array = self._np.zeros(len(speed)) + sum(load.model.power(q).values())
        return power
