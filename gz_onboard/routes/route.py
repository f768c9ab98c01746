"""A route as distance, altitude, curvature, speed limit, and what else is known of the road.

Altitude of a map or a receiver is off by a metre or so from point to point, and a bare difference over 20 m would
turn that into grades of 5 %. Grade is therefore the slope of the straight line fitted (least squares) to the altitudes
within `GRADE_LENGTH` around a point: with 1 m of independent noise on a 20 m grid its error is 0.5 % (one sigma). A
hill of wavelength λ shows 3 (sin x − x cos x)/x³ of its grade, x = π GRADE_LENGTH/λ: 94 % at 800 m, 77 % at 400 m.
Curvature is found likewise, from the headings of the chords within `CURVE_LENGTH`; a bend shorter than the distance
between points shows as a longer and gentler one.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from pathlib import Path

from gz_onboard.errors import InputError
from gz_onboard.routes.columns import UNITS, Columns
from gz_onboard.routes.gpx import read_road

_LOG = logging.getLogger(__name__)

GRADE_LENGTH = 200.0  # [m]
CURVE_LENGTH = 40.0  # [m]
_CHORD = 10.0  # [m]: shorter chords have no heading worth the name
_STEEPEST = 0.5  # sine; no road is steeper, a wrong unit is
_STEP, _LEAP = 0.3, 5.0  # of the way, and m: by more the height of the next point does not differ
_CLOSEST = 0.01  # [m] between positions
_SHORTEST = 0.001  # [m] between distances: none is too short to be ridden in a time above 0
_LIMITS = {f"speed_limit_{unit}": UNITS[unit] for unit in ("mps", "kmh")}
_KNOWN = ("distance_m", "latitude_deg", "longitude_deg", "altitude_m", "curvature_1pm", *_LIMITS)
_AHEAD = {"stop_s": (0.0, 3600.0, "s"), "headwind_mps": (-40.0, 40.0, "m/s"), "temperature_degc": (-50.0, 60.0, "degC")}
KNOWN_AHEAD = (*_KNOWN, *_AHEAD)
"""Columns of a route that is still to be ridden."""
MOST_POINTS = 50_000  # of a route on board: 1000 km at 20 m
LONGEST_AHEAD = 1e6  # m of a route on board: reading it and making it ready takes 70 MB
LONGEST_HOLE = 5000.0  # m: what is farther apart are places on the way, not the road


@dataclass(frozen=True)
class Route:
    """Tuples of one length (two at least) over `distance` [m], which begins with 0 and increases.

    `heading` is not reduced to one turn, so that it can be interpolated. A speed limit holds up to the next point.
    """

    name: str
    distance: tuple[float, ...]
    grade: tuple[float, ...]  # sine of the road's angle, positive uphill
    curvature: tuple[float, ...]  # 1/m, positive to the left
    heading: tuple[float, ...]  # rad clockwise from north
    speed_limit: tuple[float, ...]  # m/s, infinite if none is given
    latitude: tuple[float, ...] = ()  # deg; nothing if the file has no positions
    longitude: tuple[float, ...] = ()
    stop: tuple[float, ...] = ()  # s of standing at a point, 0 where none is expected; nothing if not given
    headwind: tuple[float, ...] = ()  # m/s along the route, positive from ahead; nothing if not given
    temperature: tuple[float, ...] = ()  # degC of the air; nothing if not given
    grade_known: bool = True  # False: without altitudes, all is taken as level

    @property
    def length(self) -> float:
        """Length of the route [m]."""
        return self.distance[-1]


def read_route(file: Path | str) -> Route:
    """The route in a GPX or CSV `file`.

    Columns of CSV: altitude_m; distance_m along the road or latitude_deg and longitude_deg, or all three; optionally
    curvature_1pm (otherwise from the positions, 0 without these) and speed_limit_mps or speed_limit_kmh. Altitude
    is smoothed over `GRADE_LENGTH`, the heading for curvature over `CURVE_LENGTH`.

    Raises InputError, naming file and line, for what read_columns refuses, missing columns, a distance that does
    not increase, positions that do not move or do not fit the distance, and values that no road has.
    """
    file = Path(file)
    name = file.stem if file.suffix.lower() in (".csv", ".gpx") else file.name
    return route_of(read_road(file, _KNOWN), name.removesuffix(".route"))


def route_ahead_of(columns: Columns, name: str) -> Route:
    """The route in `columns` (of `KNOWN_AHEAD`) for the road ahead: altitude may be missing.

    Raises InputError as `read_route`, and for more than `MOST_POINTS` or `LONGEST_AHEAD`, or points over `LONGEST_HOLE`
    apart.
    """
    if len(columns) > MOST_POINTS:
        raise InputError(
            f"{columns.file}: has {len(columns)} points, must have at most {MOST_POINTS}; one each 20 m is enough"
        )
    route = route_of(columns, name, altitude_needed=False)
    if route.length > LONGEST_AHEAD:
        told = f"is {route.length / 1000:.0f} km long, must be at most {LONGEST_AHEAD / 1000:.0f} km"
        raise InputError(f"{columns.file}: {told}; are distances in m?")
    for row, (before, after) in enumerate(pairwise(route.distance), start=1):
        if after - before > LONGEST_HOLE:
            raise columns.error(row, f"is {(after - before) / 1000:.1f} km from the point before: that is no road")
    for extra, (low, high, unit) in _AHEAD.items():
        if extra in columns.values:
            columns.check(extra, low, high, unit)
    stop, headwind, temperature = (columns.values.get(extra, ()) for extra in _AHEAD)
    return replace(route, stop=stop, headwind=headwind, temperature=temperature)


def route_of(columns: Columns, name: str, altitude_needed: bool = True) -> Route:
    """The route in `columns`, as `read_route`; without altitudes it is level, if they are not needed."""
    columns = without_holes(columns)
    values = columns.values
    if "altitude_m" in values:
        columns.check("altitude_m", -500.0, 9000.0, "m")
    elif altitude_needed:
        raise InputError(f"{columns.file}: column altitude_m is missing")
    positions = _positions(columns)
    distance = _distance(columns, positions)
    if positions:
        _check_moving(columns, positions, distance)
    heading, curvature = _course(columns, positions, distance)
    level = (0.0,) * len(distance)
    grade = _slopes(distance, values["altitude_m"], distance, GRADE_LENGTH) if "altitude_m" in values else level
    for row, sine in enumerate(grade):
        if abs(sine) > _STEEPEST:
            raise columns.error(
                row, f"altitude_m: a grade of {100 * sine:.0f} % is no road's; are heights and distances in m?"
            )
    return Route(
        name,
        distance,
        grade,
        curvature,
        heading,
        _speed_limits(columns),
        values.get("latitude_deg", ()),
        values.get("longitude_deg", ()),
        grade_known="altitude_m" in values,
    )


def without_holes(columns: Columns) -> Columns:
    """With the heights that are missing, or that leap alone, taken from their neighbours; a warning says which."""
    heights = columns.values.get("altitude_m", ())
    distance = _distance(columns, _positions(columns)) if heights else ()
    holes = _holes(distance, heights)
    if not holes:
        return columns
    import numpy as np

    there = [row for row in range(len(heights)) if row not in holes]
    filled = np.interp(distance, [distance[row] for row in there], [heights[row] for row in there])
    said = f"{len(holes)} of {len(heights)} heights are missing or leap, the first here: filled from their neighbours"
    _LOG.warning("%s:%d: %s", columns.file, columns.lines[min(holes)], said)
    return replace(columns, values=columns.values | {"altitude_m": tuple(filled.tolist())})


def _holes(distance: tuple[float, ...], heights: tuple[float, ...]) -> set[int]:
    """The rows whose height is not a number, is beside a step that no road has, alone, or is 0 there."""
    missing = {row for row, height in enumerate(heights) if math.isnan(height)}
    runs = _runs(distance, heights, missing)
    lone = {row for run in runs if len(run) == 1 or not any(heights[r] for r in run) for row in run}
    agree = len(runs) > 1 and len(_runs(distance, heights, missing | lone)) == 1
    return missing | lone if agree and 2 * len(lone) < len(heights) else missing


def _runs(distance: tuple[float, ...], heights: tuple[float, ...], without: set[int]) -> list[list[int]]:
    """Rows from one step to the next that no road has."""
    runs: list[list[int]] = []
    for row, height in enumerate(heights):
        if row in without:
            continue
        last = runs[-1][-1] if runs else row
        if not runs or abs(height - heights[last]) > _STEP * (distance[row] - distance[last]) + _LEAP:
            runs.append([])
        runs[-1].append(row)
    return runs


def _distance(columns: Columns, positions: list[tuple[float, float]]) -> tuple[float, ...]:
    """Of each point from the first [m]."""
    given = columns.values.get("distance_m")
    if given:
        columns.increasing("distance_m", "m")
        for row, (before, after) in enumerate(pairwise(given), start=1):
            if after - before < _SHORTEST:
                raise columns.error(row, f"distance_m: {after:g} m is less than {_SHORTEST:g} m from the point before")
        return tuple(d - given[0] for d in given)
    if positions:
        return _lengths(positions)
    raise InputError(f"{columns.file}: needs column distance_m, or latitude_deg and longitude_deg")


def _positions(columns: Columns) -> list[tuple[float, float]]:
    """East and north [m] of each point from the first, on the WGS 84 ellipsoid; empty if not given."""
    given = [name for name in ("latitude_deg", "longitude_deg") if name in columns.values]
    if len(given) == 1:
        raise InputError(f"{columns.file}: has {given[0]} alone; latitude_deg and longitude_deg go together")
    if not given:
        return []
    columns.check("latitude_deg", -89.0, 89.0, "deg")
    columns.check("longitude_deg", -180.0, 360.0, "deg")
    a, e2 = 6378137.0, 6.69437999014e-3
    points = [(0.0, 0.0)]
    coordinates = zip(columns.values["latitude_deg"], columns.values["longitude_deg"], strict=True)
    for (lat0, lon0), (lat1, lon1) in pairwise(coordinates):
        middle = math.radians((lat0 + lat1) / 2)
        w2 = 1 - e2 * math.sin(middle) ** 2
        turned = (lon1 - lon0 + 180) % 360 - 180  # a step over the date line is a short one
        east = math.radians(turned) * a / math.sqrt(w2) * math.cos(middle)
        north = math.radians(lat1 - lat0) * a * (1 - e2) / w2**1.5
        points.append((points[-1][0] + east, points[-1][1] + north))
    return points


def _lengths(positions: list[tuple[float, float]]) -> tuple[float, ...]:
    return tuple(accumulate((math.dist(p, q) for p, q in pairwise(positions)), initial=0.0))


def _check_moving(columns: Columns, positions: list[tuple[float, float]], distance: tuple[float, ...]) -> None:
    for row, (p, q) in enumerate(pairwise(positions), start=1):
        if math.dist(p, q) < _CLOSEST:
            raise columns.error(row, "latitude_deg, longitude_deg: the same position as on the line before")
    chords = _lengths(positions)[-1]
    if not 0.5 < chords / distance[-1] < 1.2:
        raise InputError(
            f"{columns.file}: distance_m covers {distance[-1]:.0f} m, latitude_deg and longitude_deg {chords:.0f} m; "
            "is distance_m in m?"
        )


def _course(
    columns: Columns, positions: list[tuple[float, float]], distance: tuple[float, ...]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Heading [rad] and curvature [1/m] at each point; what is not given follows from what is."""
    middles: list[float] = []
    headings: list[float] = []
    last = 0
    for i in range(1, len(positions)):
        if distance[i] - distance[last] >= _CHORD or (i == len(positions) - 1 and not middles):
            east, north = positions[i][0] - positions[last][0], positions[i][1] - positions[last][1]
            heading = math.atan2(east, north)
            if headings:
                heading += math.tau * round((headings[-1] - heading) / math.tau)
            middles.append((distance[last] + distance[i]) / 2)
            headings.append(heading)
            last = i
    if "curvature_1pm" in columns.values:
        columns.check("curvature_1pm", -1.0, 1.0, "1/m")
        curvature = columns.values["curvature_1pm"]
    elif len(middles) > 1:
        curvature = tuple(-slope for slope in _slopes(tuple(middles), tuple(headings), distance, CURVE_LENGTH))
    else:
        curvature = (0.0,) * len(distance)
    if middles:
        import numpy as np

        return tuple(np.interp(distance, middles, headings).tolist()), curvature
    turns = ((d1 - d0) * (k0 + k1) / 2 for (d0, k0), (d1, k1) in pairwise(zip(distance, curvature, strict=True)))
    return tuple(-turn for turn in accumulate(turns, initial=0.0)), curvature


def _speed_limits(columns: Columns) -> tuple[float, ...]:
    given = [name for name in _LIMITS if name in columns.values]
    if len(given) > 1:
        raise InputError(f"{columns.file}: has {' and '.join(given)}; must have one speed limit")
    if not given:
        return (math.inf,) * len(columns)
    name, factor = given[0], _LIMITS[given[0]]
    columns.check(name, 0.1 / factor, 100.0 / factor, name.removeprefix("speed_limit_"))
    return tuple(value * factor for value in columns.values[name])


def _slopes(x: tuple[float, ...], y: tuple[float, ...], at: tuple[float, ...], length: float) -> tuple[float, ...]:
    """Slope dy/dx, at each `at`, of the least-squares line through the points within `length` around it.

    At the ends the length is kept and lies to one side, so that noise is smoothed there as elsewhere; where points
    are sparse the nearest on both sides are taken.
    """
    import numpy as np

    xs, ys, where = np.asarray(x), np.asarray(y), np.asarray(at)
    length = min(length, x[-1] - x[0])
    start = np.clip(where - length / 2, x[0], x[-1] - length)
    slack = 1e-9 * max(1.0, x[-1])  # a grid's own points are not to drop out by rounding
    first = np.searchsorted(xs, start - slack)
    last = np.searchsorted(xs, start + length + slack, side="right")
    before = np.clip(np.searchsorted(xs, where, side="right") - 1, 0, len(x) - 2)
    first, last = np.minimum(first, before), np.maximum(last, before + 2)
    slopes = []
    for i, j in zip(first.tolist(), last.tolist(), strict=True):
        dx = xs[i:j] - xs[i:j].mean()
        slopes.append(float(dx @ ys[i:j] / (dx @ dx)))
    return tuple(slopes)
