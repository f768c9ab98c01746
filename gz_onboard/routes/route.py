"""A route: grade, curvature and speed limit over distance, how it is read from a file, and the speed it allows.

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
from collections.abc import Mapping
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
    altitude: tuple[float, float] = (-500.0, 9000.0)
    profile_step: float = 5.0  # at most, between points of a speed profile
    near_zero: float = 20.0  # a road at sea level has heights within; on any other a height of 0 is a missing one
    distance_ratio: tuple[float, float] = (0.5, 1.2)  # of the positions' length over distance_m


CONFIG = RouteFileConfig()
SPEED_LIMITS = {f"speed_limit_{unit}": METRES_PER_SECOND[unit] for unit in ("mps", "kmh")}
LIMITS = {  # of a column: least, most, unit
    "latitude_deg": (-89.0, 89.0, "deg"),
    "longitude_deg": (-180.0, 360.0, "deg"),
    "altitude_m": (*CONFIG.altitude, "m"),
    "curvature_1pm": (-1.0, 1.0, "1/m"),
    "speed_limit_mps": (0.1, 100.0, "m/s"),
    "speed_limit_kmh": (0.36, 360.0, "km/h"),
    "stop_s": (0.0, 3600.0, "s"),
    "headwind_mps": (-40.0, 40.0, "m/s"),
}
ROUTE_COLUMNS = "distance_m", *LIMITS


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
    import numpy as np

    if len(columns.places) > CONFIG.max_points:
        raise InputError(f"{columns.source}: has {len(columns.places)} points, must have at most {CONFIG.max_points}")
    columns = _with_filled_heights(columns)
    values = columns.values
    for column, limits in LIMITS.items():
        if column in values:
            columns.check(column, *limits)
    speed_limits = [column for column in SPEED_LIMITS if column in values]
    if len(speed_limits) > 1:
        raise InputError(f"{columns.source}: has {' and '.join(speed_limits)}; must have one speed limit")
    speed_limit = (math.inf,) * len(columns.places)
    for column in speed_limits:
        speed_limit = tuple(limit * SPEED_LIMITS[column] for limit in values[column])
    distance, track = _distance(columns)
    gaps = np.diff(distance)
    if gaps.max() > CONFIG.max_gap:
        far = f"is {gaps.max() / 1000:.1f} km from the point before: that is no road"
        raise columns.error(int(gaps.argmax()) + 1, far)
    if distance[-1] > CONFIG.max_length:
        length = f"is {distance[-1] / 1000:.0f} km long, must be at most {CONFIG.max_length / 1000:.0f} km"
        raise InputError(f"{columns.source}: {length}; are distances in m?")
    heading, curvature = _course(values, distance, track)
    grade = np.zeros(len(distance))
    if "altitude_m" in values:
        grade = _slopes(distance, np.array(values["altitude_m"]), distance, CONFIG.grade_length)
    steepest = int(np.abs(grade).argmax())
    if abs(grade[steepest]) > CONFIG.max_grade:
        steep = f"altitude_m: a grade of {100 * grade[steepest]:.0f} % is no road's"
        raise columns.error(steepest, f"{steep}; are heights and distances in m?")
    return Route(
        name,
        tuple(distance.tolist()),
        tuple(grade.tolist()),
        tuple(curvature.tolist()),
        tuple(heading.tolist()),
        speed_limit,
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
    import numpy as np

    heights = np.array(columns.values.get("altitude_m", ()))
    missing = ~((heights >= CONFIG.altitude[0]) & (heights <= CONFIG.altitude[1]))
    others = np.abs(heights[~missing & (heights != 0)])
    if others.size and others.min() > CONFIG.near_zero:
        missing |= heights == 0
    count = int(missing.sum())
    if not 0 < 2 * count < len(heights):
        return columns
    filled = np.interp(np.arange(len(heights)), np.flatnonzero(~missing), heights[~missing])
    _LOG.warning(
        "%s: %d of %d heights are missing, the first here: filled from neighbours",
        columns.places[int(missing.argmax())],
        count,
        len(heights),
    )
    return replace(columns, values=columns.values | {"altitude_m": tuple(filled.tolist())})


def _distance(columns: Columns) -> tuple[Array, Array | None]:
    """Distance [m] of each point from the first, (n,), and where it is [m] east and north of it, (n, 2), if known."""
    import numpy as np

    track, lengths = None, np.zeros(0)
    position = [name for name in ("latitude_deg", "longitude_deg") if name in columns.values]
    if len(position) == 1:
        raise InputError(f"{columns.source}: has {position[0]} alone; latitude_deg and longitude_deg go together")
    if position:
        points = zip(*(columns.values[name] for name in position), strict=True)
        steps = [east_north(start, end) for start, end in pairwise(points)]
        lengths = np.array([math.hypot(*step) for step in steps])
        if lengths.min() < CONFIG.min_move:
            raise columns.error(int(lengths.argmin()) + 1, "latitude_deg, longitude_deg: the same position as before")
        track = np.concatenate(([(0.0, 0.0)], np.cumsum(steps, axis=0)))
    given = columns.values.get("distance_m")
    if given is None:
        if track is None:
            raise InputError(f"{columns.source}: needs column distance_m, or latitude_deg and longitude_deg")
        return np.concatenate(([0.0], np.cumsum(lengths))), track
    columns.check_increasing("distance_m", "m", CONFIG.min_step)
    distance = np.array(given) - given[0]
    way, (low, high) = lengths.sum(), CONFIG.distance_ratio
    if position and not low < way / distance[-1] < high:
        wrong = f"distance_m covers {distance[-1]:.0f} m, latitude_deg and longitude_deg {way:.0f} m"
        raise InputError(f"{columns.source}: {wrong}; is distance_m in m?")
    return distance, track


def _course(values: Mapping[str, tuple[float, ...]], distance: Array, track: Array | None) -> tuple[Array, Array]:
    """Heading [rad] and curvature [1/m] at each point, (n,), from the track or from the given curvature."""
    import numpy as np

    curvature = np.array(values.get("curvature_1pm", (0.0,) * len(distance)))
    if track is None:
        turned = np.cumsum(np.diff(distance) * (curvature[1:] + curvature[:-1]) / 2)
        return np.concatenate(([0.0], -turned)), curvature
    ends = [0]
    for i, along in enumerate(distance):
        if along - distance[ends[-1]] >= CONFIG.min_chord:
            ends.append(i)
    ends = ends if len(ends) > 1 else [0, len(distance) - 1]
    east, north = np.diff(track[ends], axis=0).T
    headings, middles = np.unwrap(np.arctan2(east, north)), (distance[ends][1:] + distance[ends][:-1]) / 2
    if "curvature_1pm" not in values and len(middles) > 1:
        curvature = -_slopes(middles, headings, distance, CONFIG.curve_length)
    return np.interp(distance, middles, headings), curvature


def _slopes(x: Array, y: Array, at: Array, length: float) -> Array:
    """Slope dy/dx, at each `at`, of the least-squares line through the points within `length` around it.

    At the ends the length is kept and lies to one side, so that noise is smoothed there as elsewhere; where points
    are sparse the nearest on both sides are taken.
    """
    import numpy as np

    length = min(length, x[-1] - x[0])
    start = np.clip(at - length / 2, x[0], x[-1] - length)
    slack = 1e-9 * max(1.0, x[-1])  # a grid's own points must not drop out by rounding
    before = np.clip(np.searchsorted(x, at, side="right") - 1, 0, len(x) - 2)
    first = np.minimum(np.searchsorted(x, start - slack), before)
    last = np.maximum(np.searchsorted(x, start + length + slack, side="right"), before + 2)
    slopes = []
    for i, j in zip(first.tolist(), last.tolist(), strict=True):
        dx = x[i:j] - x[i:j].mean()
        slopes.append(float(dx @ y[i:j] / (dx @ dx)))
    return np.array(slopes)


def speed_profile(
    route: Route,
    *,
    lateral_acceleration: float = 2.5,
    acceleration: float = 1.2,
    deceleration: float = 1.5,
    top_speed: float = math.inf,
) -> tuple[list[float], list[float]]:
    """Distances [m] and speeds [m/s] of the fastest ride of `route`, from standstill to standstill.

    At the route's stops it comes to a halt, for no time. Speed stays within the speed limit, `top_speed` [m/s] and
    √(lateral_acceleration/|curvature|), everywhere and not only at points; it rises and falls with at most
    `acceleration` and `deceleration` (all in m/s²), constant between points. Points are the route's and others between
    them.
    """
    import numpy as np

    # Two intervals at least between two points: one would be standstill throughout.
    pieces = np.maximum(np.ceil(np.diff(route.distance) / CONFIG.profile_step).astype(int), 2)
    points = np.concatenate(([0], np.cumsum(pieces)))  # those of the route among all
    every = np.arange(points[-1] + 1)
    distance = np.interp(every, points, route.distance)
    curvature = np.abs(np.interp(every, points, route.curvature))
    with np.errstate(divide="ignore"):
        in_bends = lateral_acceleration / np.maximum(curvature[:-1], curvature[1:])
    limit = np.minimum(in_bends, np.repeat(np.minimum(route.speed_limit[:-1], top_speed) ** 2, pieces))
    allowed = np.concatenate(([0.0], np.minimum(limit[:-1], limit[1:]), [0.0]))
    if route.stop:
        allowed[points[np.array(route.stop) > 0]] = 0.0
    square, lengths = allowed.tolist(), np.diff(distance).tolist()  # the square of the speed
    for i, length in enumerate(lengths):
        square[i + 1] = min(square[i + 1], square[i] + 2 * acceleration * length)
    for i, length in reversed(list(enumerate(lengths))):
        square[i] = min(square[i], square[i + 1] + 2 * deceleration * length)
    return distance.tolist(), np.sqrt(square).tolist()
