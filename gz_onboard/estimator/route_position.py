"""Where on a route the vehicle is.

With a receiver and a route that has positions, it is followed by both: the distance ridden says where it ought to be
by now, and the nearest place of the route around there draws it nearer. So roads that the route takes twice, loops
and turning back do not make it jump. `FAR` off for `LEAVING` on, or riding against the route for so long, and it is
off the route. Then all of the route is searched for the place that it is at, in the route's direction; of several,
that which is nearest to where the distance ridden since would have led.

Without either, it is where the distance ridden since the route was given says.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise
from math import atan2, cos, hypot, pi, radians

from gz_onboard.routes.route import Route

FAR = 50.0  # m from the route: a receiver in a town and a map are off by 20 m together
LEAVING = 60.0  # m off the route before that is believed: receivers err for seconds
JOINING = 30.0  # m from the route, to be taken as on it again
STAYING, STAYING_AFAR = 40.0, 300.0  # m on it, before that is believed; where it would be a leap along the route
LEAP = 500.0  # m, and what was ridden off the route: what is farther along is a leap
AROUND, PER_METRE = 80.0, 0.05  # m to both sides of where it ought to be, and more for each since it was last seen
LONGITUDINAL = 5.0  # so much less a metre along the route counts than one beside it
GAIN = 0.3  # share of the difference along the route that one fix mends
AGAINST = 2.0  # rad between the course and the route's heading: ridden the other way
DEGREE = 111_200.0  # m of latitude; 0.3 % off at most, over some hundred metres
CELL = 200.0  # m: of the grid in which pieces of the route are looked up


@dataclass(frozen=True, slots=True)
class Place:
    """A place on the route: its distance along it [m], how far it is [m], and the route's heading there [rad]."""

    along: float
    off: float
    heading: float


class RoutePosition:
    """Follows the vehicle along `route`. `along`: how far along it is [m]; `on`: whether it is on the route."""

    def __init__(self, route: Route) -> None:
        self._route = route
        self.along, self.on = 0.0, True
        self._placed = False  # a fix has been seen
        self._blind = 0.0  # m ridden since the last fix on the route
        self._away = 0.0  # m ridden off the route, or against it
        self._back: tuple[float, float] | None = None  # where it may be on the route again, and for how many m
        self._cells: dict[tuple[int, int], list[int]] = defaultdict(list)
        if route.latitude:
            self._scale = DEGREE * cos(radians(route.latitude[0])), DEGREE
            self._index()

    def _index(self) -> None:
        points = list(zip(self._route.longitude, self._route.latitude, strict=True))
        for i, ((x0, y0), (x1, y1)) in enumerate(pairwise(points)):
            steps = 1 + int(hypot(_turned(x1 - x0) * self._scale[0], (y1 - y0) * self._scale[1]) / CELL)
            for k in range(steps + 1):
                cell = self._cell(x0 + _turned(x1 - x0) * k / steps, y0 + (y1 - y0) * k / steps)
                if not self._cells[cell] or self._cells[cell][-1] != i:
                    self._cells[cell].append(i)

    def _cell(self, longitude: float, latitude: float) -> tuple[int, int]:
        return int(longitude % 360 * self._scale[0] // CELL), int(latitude * self._scale[1] // CELL)

    def at(self, along: float) -> tuple[float, float] | None:
        """Latitude and longitude [deg] so far along the route [m]; None if the route has no positions."""
        route = self._route
        if not route.latitude:
            return None
        i = min(max(bisect_right(route.distance, along), 1), len(route.distance) - 1)
        share = (along - route.distance[i - 1]) / (route.distance[i] - route.distance[i - 1])
        y, x = route.latitude[i - 1], route.longitude[i - 1]
        turned = _turned(x + share * _turned(route.longitude[i] - x))
        return y + share * (route.latitude[i] - y), turned

    def update(self, moved: float, fix: tuple[float, float] | None, course: float | None) -> None:
        """Go on by `moved` [m]; fix: latitude and longitude [deg], if known; course [rad], if it is moving."""
        if fix is None or not self._cells:
            self._count(moved)
        elif self.on and self._placed:
            self._follow(moved, fix, course)
        else:
            self._find(moved, fix, course)
        if self.along >= self._route.length:
            self.along, self.on = self._route.length, False

    def _count(self, moved: float) -> None:
        if self.on:
            self.along += moved
            self._blind += moved
        else:
            self._away += moved

    def _follow(self, moved: float, fix: tuple[float, float], course: float | None) -> None:
        self.along += moved
        self._blind += moved
        around = AROUND + PER_METRE * self._blind
        distance = self._route.distance
        low = max(bisect_right(distance, self.along - around) - 1, 0)
        high = min(bisect_right(distance, self.along + around), len(distance) - 1)
        places = [self._nearest(i, fix) for i in range(low, high)]
        best = min(
            places, key=lambda p: p.off**2 + ((p.along - self.along) / LONGITUDINAL) ** 2, default=Place(0, FAR, 0)
        )
        against = course is not None and abs(_turn(course - best.heading)) > AGAINST
        if best.off < FAR:
            self.along += GAIN * (best.along - self.along)
            self._blind = 0.0
        if best.off < FAR and not against:
            self._away = 0.0
            return
        self._away += moved
        if self._away > LEAVING:
            self.on, self._back = False, None

    def _find(self, moved: float, fix: tuple[float, float], course: float | None) -> None:
        """Search all of the route for where `fix` is."""
        self._away += moved
        left = self.along + self._away
        expected, stayed = (self._back[0] + moved, self._back[1] + moved) if self._back else (left, 0.0)
        x, y = self._cell(fix[1], fix[0])
        near = {i for dx in (-1, 0, 1) for dy in (-1, 0, 1) for i in self._cells.get((x + dx, y + dy), ())}
        places = [place for i in near if (place := self._nearest(i, fix)).off < JOINING]
        if course is not None:
            places = [place for place in places if abs(_turn(course - place.heading)) < pi / 2]
        first, self._placed, self.on = not self._placed, True, False
        if not places:
            self._back = None
            return
        place = min(places, key=lambda p: abs(p.along - expected))
        if abs(place.along - expected) > AROUND:
            stayed = 0.0
        self._back = place.along, stayed
        leap = abs(place.along - left) > LEAP + self._away
        if stayed >= (STAYING_AFAR if leap else STAYING) or (first and abs(place.along - left) < AROUND):
            self.along, self.on, self._away, self._blind, self._back = place.along, True, 0.0, 0.0, None

    def _nearest(self, i: int, fix: tuple[float, float]) -> Place:
        """The place nearest to `fix` between the points `i` and `i` + 1."""
        route = self._route
        wide = DEGREE * cos(radians(fix[0]))
        x0, x1 = (_turned(route.longitude[j] - fix[1]) * wide for j in (i, i + 1))
        y0, y1 = ((route.latitude[j] - fix[0]) * DEGREE for j in (i, i + 1))
        dx, dy = x1 - x0, y1 - y0
        share = min(max(-(x0 * dx + y0 * dy) / (dx * dx + dy * dy), 0.0), 1.0)
        along = route.distance[i] + share * (route.distance[i + 1] - route.distance[i])
        return Place(along, hypot(x0 + share * dx, y0 + share * dy), atan2(dx, dy))


def _turned(degrees: float) -> float:
    """A difference of longitudes, the short way round."""
    return (degrees + 180.0) % 360.0 - 180.0


def _turn(angle: float) -> float:
    """A difference of directions, the short way round [rad]."""
    return (angle + pi) % (2 * pi) - pi
