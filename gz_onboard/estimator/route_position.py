"""Where on a route the vehicle is, and whether the route's hills are those that are ridden.

With a receiver and a route that has positions it is followed by both: the distance ridden says where the vehicle should
be by now, and the nearest place of the route around there corrects that. So roads that the route takes twice, loops and
turning back do not make it jump. After some way off the route, or against its direction, the vehicle has left it. Then
all of the route is searched for the place that it is at, in the route's direction; of several, the one nearest to where
the distance ridden since would have led.

Without either, it is where the distance ridden since the route was given says.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, exp, inf, pi, radians
from typing import TYPE_CHECKING

from gz_onboard.routes.route import Route

if TYPE_CHECKING:
    from gz_onboard.arrays import Array

METRES_PER_DEGREE = 111_200.0  # of latitude; 0.3 % off at most, over some hundred metres


@dataclass(frozen=True)
class PositionConfig:
    """Constants of following a route and comparing its heights; m unless stated."""

    off: float = 50.0  # from the route: a receiver in a town and a map are off by 20 m together
    leaving: float = 60.0  # ridden off the route before that is believed: receivers err for seconds
    joining: float = 30.0  # from the route, to be taken as on it again
    staying: float = 40.0  # ridden on it before that is believed
    staying_far: float = 300.0  # the same, where it would be a leap along the route
    leap: float = 500.0  # along the route, beside what was ridden off it
    around: float = 130.0  # to both sides of where it should be: 80, and 5 % of a tunnel of 1 km
    longitudinal: float = 5.0  # a metre along the route counts so much less than one beside it
    gain: float = 0.3  # share of the difference along the route that one fix corrects
    against: float = 2.0  # rad between the course and the route's heading: ridden the other way
    compared: float = 1500.0  # over which heights are compared: a receiver's altitude drifts by some metres on it
    min_compared: float = 700.0  # of that, before which nothing is said
    heights_apart: float = 0.02  # of the way: differing by more they are of two roads
    heights_alike: float = 0.01  # by less of one again
    step: float = 100.0  # longer ones, or farther from the distance ridden: along the route it was placed elsewhere


CONFIG = PositionConfig()


class RoutePosition:
    """Follows the vehicle along a route. `along`: how far along it is [m], while it is `on` it."""

    def __init__(self, route: Route) -> None:
        """Import numpy."""
        import numpy as np

        self._np, self.along, self.on = np, 0.0, True
        self._placed = False  # a fix has been seen
        self._away = 0.0  # m ridden off the route, or against it
        self._candidate: float | None = None  # m: where it may be on the route again
        self._stayed = 0.0  # m ridden there
        self._distance = np.array(route.distance)
        self._latitude = np.array(route.latitude)
        self._longitude = np.unwrap(np.array(route.longitude), period=360.0)

    def at(self, along: float) -> tuple[float | None, float | None]:
        """Latitude and longitude [deg] at a distance along the route [m]; None if the route has no positions."""
        if not len(self._latitude):
            return None, None
        interp = self._np.interp
        longitude = float(interp(along, self._distance, self._longitude))
        return float(interp(along, self._distance, self._latitude)), (longitude + 180.0) % 360.0 - 180.0

    def update(self, moved: float, fix: tuple[float, float] | None, course: float | None) -> None:
        """Move by `moved` [m]; fix: latitude and longitude [deg], if known; course [rad], if it is moving."""
        self.along += moved
        if fix is None or not len(self._latitude):
            self._away += 0.0 if self.on else moved
        elif self.on and self._placed:
            self._follow(moved, fix, course)
        else:
            self._search(moved, fix, course)
        if self.on and self.along >= self._distance[-1]:
            self.along, self.on = float(self._distance[-1]), False

    def _follow(self, moved: float, fix: tuple[float, float], course: float | None) -> None:
        config = CONFIG
        along, off, turned = self._places(fix, course, config.around)
        on = False
        if len(along):
            best = (off**2 + ((along - self.along) / config.longitudinal) ** 2).argmin()
            if off[best] < config.off:
                self.along += config.gain * float(along[best] - self.along)
                on = bool(turned[best] < config.against)
        self._away = 0.0 if on else self._away + moved
        if self._away > config.leaving:
            self.on, self._candidate = False, None

    def _search(self, moved: float, fix: tuple[float, float], course: float | None) -> None:
        """Look for the vehicle on all of the route."""
        config, first = CONFIG, not self._placed
        self._away, self._placed, self.on = self._away + moved, True, False
        along, off, turned = self._places(fix, course, inf)
        along = along[(off < config.joining) & (turned < pi / 2)]
        if not len(along):
            self._candidate = None
            return
        expected = self.along if self._candidate is None else self._candidate + moved
        place = float(along[abs(along - expected).argmin()])
        stays = self._candidate is not None and abs(place - expected) <= config.around
        self._candidate, self._stayed = place, self._stayed + moved if stays else 0.0
        far = abs(place - self.along)
        if (first and far < config.around) or self._stayed >= (
            config.staying_far if far > config.leap + self._away else config.staying
        ):
            self.along, self.on, self._away = place, True, 0.0

    def _places(self, fix: tuple[float, float], course: float | None, around: float) -> tuple[Array, Array, Array]:
        """Of each piece of the route within `around` [m]: the place nearest to `fix`.

        Gives its distance along the route [m], how far it is from the fix [m], and the angle [rad] between the course
        and the route there, 0 without a course.
        """
        np = self._np
        low, high = np.searchsorted(self._distance, (self.along - around, self.along + around))
        some = slice(max(int(low) - 1, 0), int(high) + 1)
        x = (self._longitude[some] - fix[1] + 180.0) % 360.0 - 180.0
        x, y = x * METRES_PER_DEGREE * cos(radians(fix[0])), (self._latitude[some] - fix[0]) * METRES_PER_DEGREE
        dx, dy, length = np.diff(x), np.diff(y), np.diff(self._distance[some])
        share = np.clip(-(x[:-1] * dx + y[:-1] * dy) / (dx**2 + dy**2), 0.0, 1.0)
        off = np.hypot(x[:-1] + share * dx, y[:-1] + share * dy)
        turned = 0.0 * off if course is None else np.abs((course - np.arctan2(dx, dy) + pi) % (2 * pi) - pi)
        return self._distance[some][:-1] + share * length, off, turned


class HeightCheck:
    """Whether the hills of a route are those ridden: a file of another road, or in feet, has others.

    Compares the height that the route gains with that which the vehicle gains on it, over the latest kilometre or so.
    """

    def __init__(self) -> None:
        self.contradicts = False
        self._before: tuple[float, float] | None = None  # m along the route, m of altitude
        self._way = self._apart = 0.0  # m, fading

    def update(self, along: float, ridden: float, climb: float, altitude: float | None) -> None:
        """The vehicle is at `along` [m] of the route, `ridden` [m] since the last update.

        climb: that the route gains between the two [m]; altitude: measured [m], None if it is not known.
        """
        config, before = CONFIG, self._before
        self._before = None if altitude is None else (along, altitude)
        if before is None or altitude is None:
            return
        way, gained = along - before[0], altitude - before[1]
        if not 0 < way < config.step or abs(way - ridden) > config.step or abs(gained) > way:
            return
        kept = exp(-way / config.compared)
        self._way, self._apart = kept * self._way + way, kept * self._apart + climb - gained
        if self._way > config.min_compared:
            limit = config.heights_alike if self.contradicts else config.heights_apart
            self.contradicts = abs(self._apart) > limit * self._way
