"""Tables of numbers out of CSV and GPX files, with errors that name the file and the line or point."""

from __future__ import annotations

import csv
import gzip
import math
import re
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path

from gz_onboard.errors import InputError, nearest, shown, unreadable

MIN_ROWS = 2
MAX_BYTES = 50_000_000  # of a table, unpacked: a GPX file of the longest route has a tenth of it
MAX_GPX_GAP_M = 100.0  # between the end of one track segment and the start of the next of the same road
METRES_PER_SECOND = {"mps": 1.0, "kmh": 1 / 3.6, "mph": 0.44704}
_DECIMAL_COMMA = re.compile(r"^(\s*[-+]?\d*),(\d+(?:[eE][-+]?\d+)?\s*)$")
_EQUATORIAL_RADIUS_M, _ECCENTRICITY_SQUARED = 6378137.0, 6.69437999014e-3  # WGS 84


@dataclass(frozen=True)
class Columns:
    """Columns of numbers, all of one length."""

    source: str  # what errors call the whole
    places: tuple[str, ...]  # what errors call each row
    values: dict[str, tuple[float, ...]]

    def error(self, row: int, message: str) -> InputError:
        """The error to raise about `row`, counted from 0."""
        return InputError(f"{self.places[row]}: {message}")

    def check(self, name: str, low: float, high: float, unit: str) -> None:
        """Refuse a value of column `name` outside [low, high]."""
        for row, value in enumerate(self.values[name]):
            if not low <= value <= high:
                raise self.error(row, f"{name}: {value:g} {unit} is outside {low:g} to {high:g} {unit}")

    def check_increasing(self, name: str, unit: str, least: float = 0.0) -> None:
        """Refuse a column `name` that does not increase from row to row by more than `least`."""
        for row, (before, after) in enumerate(pairwise(self.values[name]), start=1):
            if not after - before > least:
                raise self.error(row, f"{name}: {after:g} {unit} does not increase (before: {before:g})")


def read_bytes(file: Path, max_bytes: int | None = None) -> bytes:
    """The content of a `file`, unpacked if its name ends in .gz.

    Raises InputError if it cannot be read or has more than `max_bytes`; no more is unpacked.
    """
    try:
        with (gzip.open if file.suffix == ".gz" else open)(file, "rb") as stream:
            content: bytes = stream.read() if max_bytes is None else stream.read(max_bytes + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise unreadable(file, error) from error
    if max_bytes is not None and len(content) > max_bytes:
        raise InputError(f"{file}: has more than {max_bytes / 1e6:.0f} MB, unpacked; a route or cycle has less")
    return content


def csv_rows(file: Path, max_bytes: int | None = None) -> list[tuple[int, list[str]]]:
    """(line, fields) of each line of a CSV `file` (also .csv.gz) but empty ones. InputError if it cannot be read."""
    try:
        return separated(read_bytes(file, max_bytes).decode("utf-8-sig"))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file}: not a CSV file: {error}") from error


def separated(text: str) -> list[tuple[int, list[str]]]:
    """(line, fields) of each line of `text` but empty ones.

    Fields are separated by the mark that the header has most of: commas, semicolons or tabs. A comma in a number is a
    decimal comma where it does not separate fields.
    """
    mark = max(",;\t", key=text.partition("\n")[0].count)
    reader = csv.reader(text.splitlines(keepends=True), delimiter=mark)
    rows = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    if mark == ",":
        return rows
    return [(line, [_DECIMAL_COMMA.sub(r"\1.\2", field) for field in row]) for line, row in rows]


def read_columns(file: Path, known: Collection[str]) -> Columns:
    """Read a CSV `file` of finite numbers whose header names columns out of `known`, with at least two rows.

    Raises InputError, naming file, line and column, if the file cannot be read, a column is unknown or repeated, a row
    has too few or too many fields, or a field is no finite number.
    """
    records = csv_rows(file, MAX_BYTES)
    if not records:
        raise InputError(f"{file}: is empty; its first line must name columns out of {', '.join(known)}")
    line, header = records[0][0], [name.strip() for name in records[0][1]]
    for column, name in enumerate(header):
        if name not in known:
            kmh = name.replace("km/h", "kmh").replace("kph", "kmh")  # else kph is taken for mph
            hint = nearest(kmh.replace("m/s", "mps"), known)
            raise InputError(f"{file}:{line}: unknown column {shown(name)}{hint}; known are {', '.join(known)}")
        if name in header[:column]:
            raise InputError(f"{file}:{line}: column {shown(name)} is there twice")
    if len(records) <= MIN_ROWS:
        raise InputError(f"{file}: has {len(records) - 1} rows below its header, must have at least {MIN_ROWS}")
    table: list[list[float]] = []
    for line, record in records[1:]:
        if len(record) != len(header):
            raise InputError(f"{file}:{line}: has {len(record)} fields, the header has {len(header)}")
        table.append([_number(f"{file}:{line}: {name}", field) for name, field in zip(header, record, strict=True)])
    values = dict(zip(header, zip(*table, strict=True), strict=True))
    return Columns(str(file), tuple(f"{file}:{line}" for line, _ in records[1:]), values)


def read_gpx(file: Path) -> Columns:
    """Latitude, longitude and, if most points have it, altitude of the track in a GPX `file`, or else of its route.

    A missing altitude is NaN. A point at the place of the one before is left out. A recorder begins a new segment after
    a pause and a new track after a day; a planner writes alternatives that way. Those that begin where the one before
    ends are one road; otherwise nobody knows which of them is meant, and InputError is raised, as for a file that is no
    GPX and for a field that is no number. Errors name the point, counted from 1.
    """
    from xml.etree import ElementTree

    content = read_bytes(file, MAX_BYTES)
    if b"<!DOCTYPE" in content:  # its entities could expand to any size
        raise InputError(f"{file}: has a document type, which no GPX has")
    try:
        root = ElementTree.fromstring(content)
    except ElementTree.ParseError as error:
        raise InputError(f"{file}:{error.position[0]}: not a GPX file: {error}") from error
    except (LookupError, ValueError) as error:  # an encoding that the parser does not know
        raise InputError(f"{file}: cannot be read: {error}; save it as UTF-8") from error
    tracks = [segment.findall("{*}trkpt") for segment in root.iterfind(".//{*}trkseg")]
    parts = list(filter(None, tracks)) or [route.findall("{*}rtept") for route in root.iterfind("{*}rte")]
    starts = {id(part[0]) for part in parts if part}
    rows: dict[str, tuple[float, float, float]] = {}  # by place in the file
    before: tuple[float, float] | None = None
    for number, point in enumerate(chain.from_iterable(parts), start=1):
        place = f"{file}: point {number}"
        here = _number(f"{place}: lat", point.get("lat", "")), _number(f"{place}: lon", point.get("lon", ""))
        gap = math.hypot(*east_north(before, here)) if before and id(point) in starts else 0.0
        if gap > MAX_GPX_GAP_M:
            apart = f"{len(parts)} tracks or segments, which do not join: {gap / 1000:.1f} km lie before this one"
            raise InputError(f"{place}: has {apart}; keep the one that is the road")
        if here != before:
            altitude = (point.findtext("{*}ele") or "").strip()
            rows[place] = *here, _number(f"{place}: ele", altitude) if altitude else math.nan
        before = here
    if len(rows) < MIN_ROWS:
        raise InputError(f"{file}: has {len(rows)} points of a track or a route, must have at least {MIN_ROWS}")
    names = "latitude_deg", "longitude_deg", "altitude_m"
    values = dict(zip(names, zip(*rows.values(), strict=True), strict=True))
    if 2 * sum(map(math.isnan, values["altitude_m"])) >= len(rows):
        del values["altitude_m"]
    return Columns(str(file), tuple(rows), values)


def east_north(start: tuple[float, float], end: tuple[float, float]) -> tuple[float, float]:
    """Metres to the east and north from one (latitude, longitude) [deg] to another nearby, on the WGS 84 ellipsoid."""
    middle = math.radians((start[0] + end[0]) / 2)
    flattening = 1 - _ECCENTRICITY_SQUARED * math.sin(middle) ** 2
    turned = (end[1] - start[1] + 180) % 360 - 180  # a step over the date line is a short one
    east = math.radians(turned) * _EQUATORIAL_RADIUS_M / math.sqrt(flattening) * math.cos(middle)
    north = math.radians(end[0] - start[0]) * _EQUATORIAL_RADIUS_M * (1 - _ECCENTRICITY_SQUARED) / flattening**1.5
    return east, north


def _number(place: str, field: str) -> float:
    try:
        value = float(field)
    except ValueError:
        raise InputError(f"{place}: {shown(field)} is not a number") from None
    if not math.isfinite(value):
        raise InputError(f"{place}: must be a finite number, is {shown(field)}")
    return value
