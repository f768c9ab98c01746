"""Whether the hills of a route are those that are ridden: a file of another road, or in feet, has others."""

from __future__ import annotations

from math import exp

LENGTH = 1500.0  # m over which heights are compared: a receiver's altitude drifts by some metres on it
SEEN = 700.0  # m of that, before which nothing is said
APART, ALIKE = 0.02, 0.01  # of the way: differing by more they are of two roads, by less of one again
LEAP = 100.0  # m from one look to the next, or beside what was ridden: along the route it was placed anew


class RouteHeights:
    """Compares the height that a route gains with that which the vehicle gains on it, over the latest `LENGTH`."""

    def __init__(self) -> None:
        self.contradict = False
        self._before: tuple[float, float] | None = None  # m along the route, m of altitude
        self._way = self._apart = 0.0  # m, fading

    def look(self, along: float, ridden: float, climb: float, altitude: float | None) -> None:
        """The vehicle is at `along` [m] of the route, `ridden` [m] since the last look.

        climb: that the route gains between the two [m]; altitude: measured [m], None if it is not known.
        """
        before, self._before = self._before, None if altitude is None else (along, altitude)
        if before is None or altitude is None:
            return
        way = along - before[0]
        if not 0 < way < LEAP or abs(way - ridden) > LEAP or abs(altitude - before[1]) > way:
            return
        kept = exp(-way / LENGTH)
        self._way, self._apart = kept * self._way + way, kept * self._apart + climb - (altitude - before[1])
        if self._way > SEEN:
            self.contradict = abs(self._apart) > (ALIKE if self.contradict else APART) * self._way
