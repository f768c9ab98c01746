"""GPX files: the track or, without one, the route in it, as columns.

A recorder begins another segment after a pause, and another track after a day; a planner writes alternatives so. Those
that begin where the one before ends are one road. Others are not: nobody knows what lies between.
"""

from __future__ import annotations

from collections.abc import Collection
from itertools import pairwise
from math import cos, hypot, nan, radians
from pathlib import Path
from xml.parsers import expat

from gz_onboard.constants import EARTH_RADIUS
from gz_onboard.errors import InputError, shown, unreadable
from gz_onboard.routes.columns import LEAST_ROWS, Columns, read_columns

POINTS = ("trkpt", "rtept")  # a track is the road; a route may be the places on the way only
PARTS = ("trk", "trkseg", "rte")
JOINED = 100.0  # m from the end of a part to the begin of the next, which is the same road
Point = tuple[int, str, str, str]
"""(line, latitude, longitude, altitude) as they stand in the file; an altitude may be empty."""


class _Reader:
    """Gathers the points while the parser goes through the file."""

    def __init__(self) -> None:
        self.parts: dict[str, list[list[Point]]] = {kind: [[]] for kind in POINTS}
        self._parser = expat.ParserCreate(namespace_separator=" ")
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.CharacterDataHandler = self._text
        self._parser.StartDoctypeDeclHandler = self._refuse
        self._at: Point | None = None
        self._altitude: list[str] | None = None

    def parse(self, content: bytes) -> None:
        """Raises expat.ExpatError for what is not XML, and InputError for a document type."""
        self._parser.Parse(content, True)

    def _refuse(self, *_: object) -> None:
        raise InputError("has a document type, which no GPX has")  # and whose entities can be of any size

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        kind = name.rpartition(" ")[2]
        if kind in POINTS:
            self._at = self._parser.CurrentLineNumber, attributes.get("lat", ""), attributes.get("lon", ""), ""
        elif kind == "ele" and self._at:
            self._altitude = []
        elif kind in PARTS:
            for parts in self.parts.values():
                parts.append([])

    def _text(self, text: str) -> None:
        if self._altitude is not None:
            self._altitude.append(text)

    def _end(self, name: str) -> None:
        kind = name.rpartition(" ")[2]
        if kind == "ele" and self._at and self._altitude is not None:
            self._at, self._altitude = (*self._at[:3], "".join(self._altitude).strip()), None
        elif kind in POINTS and self._at:
            self.parts[kind][-1].append(self._at)
            self._at = None


def read_road(file: Path, known: Collection[str]) -> Columns:
    """The columns of a road in a GPX file, or out of `known` in a CSV file. Raises InputError naming file and line."""
    return read_gpx(file) if file.suffix.lower() == ".gpx" else read_columns(file, known)


def read_gpx(file: Path) -> Columns:
    """Latitude, longitude and, if most points have it, altitude (else NaN) of the track in a GPX `file`.

    A point at the place of the one before it is passed over. Raises InputError naming file and line, also for parts
    that do not join.
    """
    reader = _Reader()
    try:
        reader.parse(file.read_bytes())
    except expat.ExpatError as error:
        raise InputError(f"{file}:{error.lineno}: not a GPX file: {expat.ErrorString(error.code)}") from error
    except OSError as error:
        raise unreadable(file, error) from error
    except (LookupError, ValueError) as error:  # an encoding that the parser does not know, or not of several bytes
        raise InputError(f"{file}: cannot be read: {error}; save it as UTF-8") from error
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    parts = next(filter(None, ([part for part in found if part] for found in reader.parts.values())), [])
    points = [point for part in parts for point in part]
    points = [p for i, p in enumerate(points) if i == 0 or p[1:3] != points[i - 1][1:3]]
    if len(points) < LEAST_ROWS:
        raise InputError(f"{file}: has {len(points)} points of a track or a route, must have at least {LEAST_ROWS}")
    lines = tuple(point[0] for point in points)
    columns = {"latitude_deg": 1, "longitude_deg": 2}
    values = {name: tuple(_number(file, p, p[field], name) for p in points) for name, field in columns.items()}
    _check_joined(file, parts)
    if 2 * sum(bool(p[3]) for p in points) > len(points):
        values["altitude_m"] = tuple(_number(file, p, p[3], "altitude_m") if p[3] else nan for p in points)
    return Columns(file, lines, values)


def _check_joined(file: Path, parts: list[list[Point]]) -> None:
    """Refuse parts of which one begins elsewhere than the one before ends."""
    for before, after in pairwise(parts):
        (south, west), (north, east) = ((float(p[1]), float(p[2])) for p in (before[-1], after[0]))
        across = ((east - west + 180) % 360 - 180) * cos(radians((south + north) / 2))
        gap = EARTH_RADIUS * radians(hypot(north - south, across))
        if gap > JOINED:
            many = f"has {len(parts)} tracks or segments, which do not join: {gap / 1000:.1f} km lie before this one"
            raise InputError(f"{file}:{after[0][0]}: {many}; keep the one that is the road")


def _number(file: Path, point: Point, text: str | int, name: str) -> float:
    try:
        value = float(text)
        if abs(value) < float("inf"):
            return value
    except ValueError:
        pass
    attribute = {"latitude_deg": "lat", "longitude_deg": "lon"}.get(name, "ele")
    wrong = f"{shown(text)} is not a number" if text else "is missing"
    raise InputError(f"{file}:{point[0]}: {attribute}: {wrong}")
