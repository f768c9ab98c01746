"""Lines, bands and stretches as SVG inside a page, no finer than a screen shows.

The pictures are stretched to the width that there is; texts stand beside them as HTML, of one size on every screen.
All colours are names of classes (`reports.page`), for light and dark.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from math import ceil, cos, floor, hypot, isfinite, log10, radians

from gz_onboard.constants import METRES_PER_DEGREE

GRAIN = 1000  # columns and lines of a picture: a screen shows no more
TICKS = 5  # on an axis, about
_STEPS = (1.0, 2.0, 5.0, 10.0)
_BEYOND = 0.05  # of a step: so far a line may leave its axis, as a speed of -0.1 does
_MARGIN = 0.04  # of a map's extent
_LEAST_EXTENT = 20.0  # m of a map: a parked vehicle is a point, not the noise of its receiver
_FLATTEST = 0.35  # height over width of a map, at least
_TALLEST = 1.0  # at most


@dataclass(frozen=True)
class Axis:
    """From `low` to `high`, with the values that are written at it."""

    low: float
    high: float
    ticks: Sequence[float]

    def at(self, value: float) -> float:
        """Where `value` is: 0 at `low`, `GRAIN` at `high`."""
        return GRAIN * (value - self.low) / (self.high - self.low)

    def text(self, tick: float) -> str:
        """As it is written."""
        step = self.ticks[1] - self.ticks[0] if len(self.ticks) > 1 else 1.0
        return f"{tick:z.{max(0, ceil(-log10(step) - 1e-9))}f}"


def axis_of(values: Iterable[float], *, whole: bool = True, zero: bool = False) -> Axis:
    """An axis for the finite ones of `values`; whole: from tick to tick; zero: 0 is on it."""
    finite = [value for value in values if isfinite(value)] + ([0.0] if zero else [])
    low, high = min(finite, default=0.0), max(finite, default=1.0)
    if high - low < 1e-9 * max(1.0, abs(high)):
        low, high = low - (0.0 if zero and low >= 0 else 1.0), high + 1.0
    power = 10 ** floor(log10((high - low) / TICKS))
    step = next(power * s for s in _STEPS if power * s * (TICKS + 0.5) >= high - low)
    if whole:
        low, high = floor(low / step + _BEYOND) * step, ceil(high / step - _BEYOND) * step
    first, last = ceil(low / step - 1e-9), floor(high / step + 1e-9)
    return Axis(low, high, [i * step for i in range(first, last + 1)])


def line(x: Sequence[float], y: Sequence[float], across: Axis, up: Axis) -> str:
    """The path of a line; where a value is not finite it is broken."""
    parts: list[str] = []
    for run in _runs(x, y):
        points = [(at, GRAIN - round(up.at(value))) for at, value in _thinned(run, across)]
        parts.append("M" + "L".join(f"{at} {height}" for at, height in points) + ("h0" if len(points) == 1 else ""))
    return "".join(parts)


def band(x: Sequence[float], low: Sequence[float], high: Sequence[float], across: Axis, up: Axis) -> str:
    """The path of the area between two lines."""
    parts: list[str] = []
    for run in _runs(x, low, high):
        columns = [(at, list(rows)) for at, rows in groupby(run, lambda row: round(across.at(row[0])))]
        tops = [(at, max(row[2] for row in rows)) for at, rows in columns]
        bottoms = [(at, min(row[1] for row in rows)) for at, rows in reversed(columns)]
        corners = (f"{at} {GRAIN - round(up.at(value))}" for at, value in (*tops, *bottoms))
        parts.append("M" + "L".join(corners) + "z")
    return "".join(parts)


def stretches(spans: Iterable[tuple[float, float]], across: Axis) -> str:
    """The path of boxes over the whole height, of spans (begin, length); none is narrower than one column."""
    parts = []
    for begin, length in spans:
        left, right = round(across.at(begin)), round(across.at(begin + length))
        parts.append(f"M{left} 0h{max(right - left, 1)}v{GRAIN}h-{max(right - left, 1)}z")
    return "".join(parts)


def picture(label: str, *paths: tuple[str, str]) -> str:
    """An SVG of (classes, path), stretched to the place that it has; label: for who cannot see it."""
    drawn = "".join(f'<path class="{classes}" d="{path}"/>' for classes, path in paths if path)
    return (
        f'<svg viewBox="0 0 {GRAIN} {GRAIN}" preserveAspectRatio="none" role="img" '
        f'aria-label="{html.escape(label)}">{drawn}</svg>'
    )


def _runs(x: Sequence[float], *columns: Sequence[float]) -> Iterator[list[tuple[float, ...]]]:
    """The rows between those in which something is not finite."""
    rows = zip(x, *columns, strict=True)
    for known, run in groupby(rows, lambda row: all(map(isfinite, row))):
        if known:
            yield list(run)


def _thinned(run: Sequence[tuple[float, ...]], across: Axis) -> Iterator[tuple[int, float]]:
    """Of each column of the picture the first, the lowest, the highest and the last, in their order."""
    for at, rows in groupby(run, lambda row: round(across.at(row[0]))):
        values = [row[1] for row in rows]
        ends = {0, len(values) - 1, values.index(min(values)), values.index(max(values))}
        yield from ((at, values[i]) for i in sorted(ends))


# --- a map --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Map:
    """A path on the ground as SVG, and how long the bar in its corner is [m]."""

    svg: str
    bar: float


def draw_map(runs: Sequence[Sequence[tuple[float, float]]], label: str) -> Map:
    """The way through `runs` of positions (latitude, longitude) [deg], north up; a dot at its begin, a ring at its end.

    Around the middle the earth is taken to be flat, which is right to a per mille over 100 km.
    """
    north, west = runs[0][0]
    cosine = cos(radians(sum(run[0][0] for run in runs) / len(runs)))
    ways = [
        [(((b - west + 180) % 360 - 180) * cosine * METRES_PER_DEGREE, (north - a) * METRES_PER_DEGREE) for a, b in run]
        for run in runs
    ]
    xs, ys = ([point[i] for way in ways for point in way] for i in (0, 1))
    width = max(max(xs) - min(xs), (max(ys) - min(ys)) / _TALLEST, _LEAST_EXTENT) * (1 + 2 * _MARGIN)
    height = max((max(ys) - min(ys)) * (1 + 2 * _MARGIN), _FLATTEST * width)
    left, top = (max(xs) + min(xs) - width) / 2, (max(ys) + min(ys) - height) / 2
    unit = GRAIN / width

    def place(point: tuple[float, float]) -> str:
        return f"{(point[0] - left) * unit:.0f} {(point[1] - top) * unit:.0f}"

    paths = ["M" + "L".join(map(place, _apart(way, 1 / unit))) for way in ways]
    length = next(10**power * s for power in range(7, -1, -1) for s in (5, 2, 1) if 10**power * s <= width / 3)
    tall = round(height * unit)
    bar = f"M20 {tall - 20}h{length * unit:.0f}"
    drawn = (
        ("way blue", "".join(paths)),
        ("dot green", f"M{place(ways[0][0])}h0"),
        ("dot red", f"M{place(ways[-1][-1])}h0"),
        ("bar", bar),
    )
    svg = "".join(f'<path class="{classes}" d="{path}"/>' for classes, path in drawn)
    head = f'<svg class="map" viewBox="0 0 {GRAIN} {tall}" role="img" aria-label="{html.escape(label)}">'
    return Map(f"{head}{svg}</svg>", float(length))


def _apart(way: Sequence[tuple[float, float]], least: float) -> Iterator[tuple[float, float]]:
    """The points of `way` that are `least` from the one before; the last in any case."""
    kept = way[0]
    yield kept
    for point in way[1:-1]:
        if hypot(point[0] - kept[0], point[1] - kept[1]) >= least:
            kept = point
            yield kept
    yield way[-1]
