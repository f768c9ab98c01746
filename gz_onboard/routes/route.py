"""A route as distance, grade, curvature, speed limit, and whatever else is known of the road.

Altitude of a map or a receiver is off by a metre or so from point to point, and a bare difference over 20 m would
turn that into grades of 5 %. Grade is therefore the slope of the straight line fitted (least squares) to the altitudes
within a length L around a point (`RouteFileConfig.grade_length`): with 1 m of independent noise on a 20 m grid its
error is 0.5 % (one sigma). A hill of wavelength λ shows 3 (sin x − x cos x)/x³ of its grade, x = π L/λ: 94 % at 800 m,
77 % at 400 m. Curvature is found likewise, from the headings of chords; a bend shorter than the distance between points
shows as a longer and gentler one.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.errors import InputError
from gz_onboard.routes.columns import METRES_PER_SECOND, Columns, east_north, read_columns, read_gpx

if TYPE_CHECKING:
    from gz_onboard.arrays import Array

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class RouteFileConfig:
    """Constants of reading a route; m unless stated."""

    grade_length: float = 200.0  # over which altitudes are fitted
    curve_length: float = 40.0  # over which headings are fitted
    min_chord: float = 10.0  # shorter chords have no usable heading
    max_grade: float = 0.5  # sine; no road is steeper, a wrong unit is
    min_step: float = 0.001  # between points: longer than any rounding
    min_move: float = 0.01  # between positions
    max_points: int = 50_000  # 1000 km at 20 m
    max_length: float = 1e6  # reading a longer route takes more than 70 MB
    max_gap: float = 5000.0  # points farther apart are places on the way, not the road
    min_altitude: float = -500.0
    max_altitude: float = 9000.0
    near_zero: float = 20.0  # a road at sea level has heights within; on any other a height of 0 is a missing one
    min_distance_ratio: float = 0.5  # of the positions' length over distance_m
    max_distance_ratio: float = 1.2


CONFIG = RouteFileConfig()
_LIMITS = {f"speed_limit_{unit}": METRES_PER_SECOND[unit] for unit in ("mps", "kmh")}
ROUTE_COLUMNS = (
    "distance_m",
    "latitude_deg",
    "longitude_deg",
    "altitude_m",
    "curvature_1pm",
    *_LIMITS,
    "stop_s",
    "headwind_mps",
)


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
    grade_known: bool = True  # False: without altitudes, all is taken as level

    @property
    def length(self) -> float:
        """Length of the route [m]."""
        return self.distance[-1]


def read_route(file: Path | str) -> Route:
    """The route in a GPX or CSV `file`. Raises InputError as `read_route_columns` and `route_of` do."""
    return route_of(read_route_columns(Path(file)), route_name(Path(file)))


def route_name(file: Path) -> str:
    """The name of the route in `file`: the file's name without its endings."""
    return file.name.removesuffix(".gz").removesuffix(".gpx").removesuffix(".csv").removesuffix(".route")


def read_route_columns(file: Path) -> Columns:
    """The columns of the route in a GPX `file`, or in a CSV file out of `ROUTE_COLUMNS`, with no height missing.

    Raises InputError naming file, and line or point.
    """
    columns = read_gpx(file) if file.suffix.lower() == ".gpx" else read_columns(file, ROUTE_COLUMNS)
    return _with_filled_heights(columns)


def route_of(columns: Columns, name: str) -> Route:
    """The route in `columns`: distance_m along the road or latitude_deg and longitude_deg, or all three; and more.

    Optional are altitude_m (without it the route is level), curvature_1pm (otherwise from the positions, 0 without
    these), speed_limit_mps or speed_limit_kmh, stop_s and headwind_mps. Altitude and the heading for curvature are
    smoothed, see `RouteFileConfig`.

    Raises InputError naming the place for a distance that does not increase, positions that do not move or do not fit
    the distance, points too far apart or too many, and values that no road has.
    """
    if len(columns) > CONFIG.max_points:
        raise InputError(f"{columns.source}: has {len(columns)} points, must have at most {CONFIG.max_points}")
    columns = _with_filled_heights(columns)
    values = columns.values
    for column, (low, high, unit) in {
        "altitude_m": (CONFIG.min_altitude, CONFIG.max_altitude, "m"),
        "curvature_1pm": (-1.0, 1.0, "1/m"),
        "stop_s": (0.0, 3600.0, "s"),
        "headwind_mps": (-40.0, 40.0, "m/s"),
    }.items():
        if column in values:
            columns.check(column, low, high, unit)
    steps = _steps(columns)
    distance = _distance(columns, steps)
    for row, (before, after) in enumerate(pairwise(distance), start=1):
        if after - before > CONFIG.max_gap:
            raise columns.error(row, f"is {(after - before) / 1000:.1f} km from the point before: that is no road")
    if distance[-1] > CONFIG.max_length:
        length = f"is {distance[-1] / 1000:.0f} km long, must be at most {CONFIG.max_length / 1000:.0f} km"
        raise InputError(f"{columns.source}: {length}; are distances in m?")
    heading, curvature = _course(columns, steps, distance)
    grade = (0.0,) * len(distance)
    if "altitude_m" in values:
        grade = _slopes(distance, values["altitude_m"], distance, CONFIG.grade_length)
    for row, sine in enumerate(grade):
        if abs(sine) > CONFIG.max_grade:
            wrong = f"altitude_m: a grade of {100 * sine:.0f} % is no road's; are heights and distances in m?"
            raise columns.error(row, wrong)
    return Route(
        name,
        distance,
        grade,
        curvature,
        heading,
        _speed_limits(columns),
        values.get("latitude_deg", ()),
        values.get("longitude_deg", ()),
        values.get("stop_s", ()),
        values.get("headwind_mps", ()),
        grade_known="altitude_m" in values,
    )


def _with_filled_heights(columns: Columns) -> Columns:
    """Interpolate missing heights; a warning says how many.

    Missing are NaN, heights that no road has, and 0 on a road that is nowhere near sea level.
    """
    if "altitude_m" not in columns.values:
        return columns
    import numpy as np

    heights = np.array(columns.values["altitude_m"])
    missing = ~((heights >= CONFIG.min_altitude) & (heights <= CONFIG.max_altitude))
    others = np.abs(heights[~missing & (heights != 0)])
    if others.size and others.min() > CONFIG.near_zero:
        missing |= heights == 0
    count = int(missing.sum())
    if not 0 < 2 * count < len(heights):
        return columns
    rows = np.arange(len(heights))
    filled = np.interp(rows, rows[~missing], heights[~missing])
    place = columns.places[int(missing.argmax())]
    _LOG.warning("%s: %d of %d heights are missing, the first here: filled from neighbours", place, count, len(heights))
    return replace(columns, values=columns.values | {"altitude_m": tuple(filled.tolist())})


def _steps(columns: Columns) -> list[tuple[float, float]]:
    """East and north [m] of each point from the one before; nothing without positions."""
    given = [name for name in ("latitude_deg", "longitude_deg") if name in columns.values]
    if not given:
        return []
    if len(given) == 1:
        raise InputError(f"{columns.source}: has {given[0]} alone; latitude_deg and longitude_deg go together")
    columns.check("latitude_deg", -89.0, 89.0, "deg")
    columns.check("longitude_deg", -180.0, 360.0, "deg")
    points = zip(columns.values["latitude_deg"], columns.values["longitude_deg"], strict=True)
    steps = [east_north(start, end) for start, end in pairwise(points)]
    for row, step in enumerate(steps, start=1):
        if math.hypot(*step) < CONFIG.min_move:
            raise columns.error(row, "latitude_deg, longitude_deg: the same position as before")
    return steps


def _distance(columns: Columns, steps: list[tuple[float, float]]) -> tuple[float, ...]:
    """Distance [m] of each point from the first."""
    import numpy as np

    lengths = [math.hypot(*step) for step in steps]
    given = columns.values.get("distance_m")
    if given is None and not steps:
        raise InputError(f"{columns.source}: needs column distance_m, or latitude_deg and longitude_deg")
    if given is None:
        return tuple(np.concatenate(([0.0], np.cumsum(lengths))).tolist())
    columns.check_increasing("distance_m", "m", CONFIG.min_step)
    length = given[-1] - given[0]
    if steps and not CONFIG.min_distance_ratio < sum(lengths) / length < CONFIG.max_distance_ratio:
        wrong = f"distance_m covers {length:.0f} m, latitude_deg and longitude_deg {sum(lengths):.0f} m"
        raise InputError(f"{columns.source}: {wrong}; is distance_m in m?")
    return tuple(d - given[0] for d in given)


def _course(
    columns: Columns, steps: list[tuple[float, float]], distance: tuple[float, ...]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Heading [rad] and curvature [1/m] at each point, from positions or from the given curvature."""
    import numpy as np

    at = np.array(distance)
    curvature = columns.values.get("curvature_1pm", (0.0,) * len(distance))
    if not steps:
        bends = np.array(curvature)
        turned = np.cumsum(np.diff(at) * (bends[1:] + bends[:-1]) / 2)
        return (0.0, *(-turned).tolist()), curvature
    ends = [0]
    for i, along in enumerate(distance):
        if along - distance[ends[-1]] >= CONFIG.min_chord:
            ends.append(i)
    ends = ends if len(ends) > 1 else [0, len(distance) - 1]
    east, north = np.diff(np.concatenate(([(0.0, 0.0)], np.cumsum(steps, axis=0)))[ends], axis=0).T
    headings, middles = np.unwrap(np.arctan2(east, north)), (at[ends][1:] + at[ends][:-1]) / 2
    if "curvature_1pm" not in columns.values and len(middles) > 1:
        curvature = tuple(-slope for slope in _slopes(middles, headings, at, CONFIG.curve_length))
    return tuple(np.interp(at, middles, headings).tolist()), curvature


def _speed_limits(columns: Columns) -> tuple[float, ...]:
    given = [name for name in _LIMITS if name in columns.values]
    if len(given) > 1:
        raise InputError(f"{columns.source}: has {' and '.join(given)}; must have one speed limit")
    if not given:
        return (math.inf,) * len(columns)
    name, factor = given[0], _LIMITS[given[0]]
    columns.check(name, 0.1 / factor, 100.0 / factor, name.removeprefix("speed_limit_"))
    return tuple(value * factor for value in columns.values[name])


def _slopes(
    x: tuple[float, ...] | Array, y: tuple[float, ...] | Array, at: tuple[float, ...] | Array, length: float
) -> tuple[float, ...]:
    """Slope dy/dx, at each `at`, of the least-squares line through the points within `length` around it.

    At the ends the length is kept and lies to one side, so that noise is smoothed there as elsewhere; where points
    are sparse the nearest on both sides are taken.
    """
    import numpy as np

    xs, ys, where = np.asarray(x), np.asarray(y), np.asarray(at)
    length = min(length, xs[-1] - xs[0])
    start = np.clip(where - length / 2, xs[0], xs[-1] - length)
    slack = 1e-9 * max(1.0, xs[-1])  # a grid's own points must not drop out by rounding
    before = np.clip(np.searchsorted(xs, where, side="right") - 1, 0, len(xs) - 2)
    first = np.minimum(np.searchsorted(xs, start - slack), before)
    last = np.maximum(np.searchsorted(xs, start + length + slack, side="right"), before + 2)
    slopes = []
    for i, j in zip(first.tolist(), last.tolist(), strict=True):
        dx = xs[i:j] - xs[i:j].mean()
        slopes.append(float(dx @ ys[i:j] / (dx @ dx)))
    return tuple(slopes)
