"""Functions that effects, battery and controller are written with: elementary functions and tables.

Elementary functions take floats and numpy arrays alike; numpy is imported only where an array comes. Tables
take floats; `model.series` reads them for arrays. They are straight between their points. The circuit of a cell is
geometric over temperature, straight in the logarithm: resistances fall nearly exponentially with it (Arrhenius), and a
straight line between two temperatures is a tenth too high where they are 20 K apart.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

Row = tuple[float, ...]
NUMBER = float, int  # a tuple: a union would be built again at each call, which takes longer than the function
STANDSTILL = 0.1  # m/s, or rad/s of a shaft: below it friction fades, so that nothing jumps where the sign changes


def _function(of_float: Callable[[float], float], name: str) -> Callable[[Any], Any]:
    """`of_float` for numbers, numpy's function `name` for arrays."""

    def function(x: Any) -> Any:
        if isinstance(x, NUMBER):
            return of_float(x)
        import numpy as np

        return getattr(np, name)(x)

    return function


exp = _function(math.exp, "exp")
sin = _function(math.sin, "sin")  # of rad
cos = _function(math.cos, "cos")  # of rad
sqrt = _function(math.sqrt, "sqrt")
asinh = _function(math.asinh, "arcsinh")


def direction(speed: Any) -> Any:
    """The sign of `speed` [m/s or rad/s], smooth around standstill: friction acts in proportion to it."""
    return speed / (speed * speed + STANDSTILL * STANDSTILL) ** 0.5


def mean_response(decay: float) -> float:
    """The mean response of a first-order lag to a constant load, over the settled value: 1 - τ/T·(1 - exp(-T/τ)).

    decay: exp(-T/τ), over the load's duration T.
    """
    if decay >= 1:
        return 0.0
    return 1 + (1 - decay) / math.log(decay) if decay > 0 else 1.0


# --- tables: lists of segments, looked up by `bisect` ----------------------------------------------------------------

KEPT_ROWS = 8  # temperatures whose row of a mesh is kept: a pack and a ride have few at a time
Segments = list[tuple[float, float, float]]
"""(x, y, slope) at the beginning of each piece: of that below the points, of each between two points, of that above."""


def segments(xs: Row, ys: Iterable[float]) -> Segments:
    """The pieces of the line through the points (`xs`, `ys`), constant beyond the ends."""
    points = list(zip(xs, ys, strict=True))
    inner = [(x, y, (later - y) / (beyond - x)) for (x, y), (beyond, later) in pairwise(points)]
    return [(*points[0], 0.0), *inner, (*points[-1], 0.0)]


@dataclass(frozen=True)
class PiecewiseLinear:
    """A quantity `y` over another, `x`, which increases: straight between its points, constant beyond the ends."""

    x: Row
    y: Row

    @cached_property
    def _segments(self) -> Segments:
        return segments(self.x, self.y)

    def at(self, x: float) -> float:
        """The value at `x`."""
        start, y, slope = self._segments[bisect_right(self.x, x)]
        return y + slope * (x - start)

    def extended(self, x: float) -> tuple[float, float]:
        """(value, slope) at `x`, along the first and the last slope beyond the ends; of two points or more."""
        start, y, slope = self._segments[bisect_right(self.x, x, 1, len(self.x) - 1)]
        return y + slope * (x - start), slope


@dataclass(eq=False)
class Mesh:
    """Values over SOC (columns) and temperature [degC] (rows)."""

    soc: Row
    temperature: Row
    value: tuple[Row, ...]
    geometric: bool = False  # over temperature; all values are positive then

    def __post_init__(self) -> None:
        self._rows: dict[float, Segments] = {}  # by temperature, the last few: it changes far more slowly than SOC

    def at(self, soc: float, temperature: float) -> tuple[float, float]:
        """(value, its slope over SOC); beyond the mesh its edge, with slope zero."""
        row = self._rows.get(temperature) or self._row(temperature)
        start, value, slope = row[bisect_right(self.soc, soc)]
        return value + slope * (soc - start), slope

    def scaled(self, factor: float) -> Mesh:
        """Return a mesh with all values multiplied by `factor`."""
        values = tuple(tuple(factor * v for v in row) for row in self.value)
        return Mesh(self.soc, self.temperature, values, self.geometric)

    def _row(self, temperature: float) -> Segments:
        ts = self.temperature
        j = min(max(bisect_right(ts, temperature) - 1, 0), max(len(ts) - 2, 0))
        cold, warm = self.value[j], self.value[min(j + 1, len(ts) - 1)]
        w = min(max((temperature - ts[j]) / (ts[j + 1] - ts[j]), 0.0), 1.0) if len(ts) > 1 else 0.0
        if self.geometric:
            values = [c * (h / c) ** w for c, h in zip(cold, warm, strict=True)]
        else:
            values = [c + w * (h - c) for c, h in zip(cold, warm, strict=True)]
        if len(self._rows) >= KEPT_ROWS:
            self._rows.clear()
        row = self._rows[temperature] = segments(self.soc, values)
        return row
