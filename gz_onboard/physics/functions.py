"""Functions that effects, battery and controller are written with, of floats and of numpy arrays alike.

Elementary functions, the first-order lag, and tables. numpy is imported only where an array comes; on board all is
floats. Tables are straight between their points. The circuit of a cell is geometric over temperature, straight in the
logarithm: resistances fall nearly exponentially with it (Arrhenius), and a straight line between two temperatures is a
tenth too high where they are 20 K apart.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from gz_onboard.arrays import Array

T = TypeVar("T")
Row = tuple[float, ...]
NUMBER = float, int  # a tuple: a union would be built again at each call, which takes longer than the function
STANDSTILL = 0.1  # m/s, or rad/s of a shaft: below it friction fades, so that nothing jumps where the sign changes
NEGLIGIBLE = 1e-20  # share of a value that is too small to change it in floating point


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


# --- first-order lag, dx/dt = (target - x)/τ: an RC pair (target R·I: Lord 2016, eq. 2.22), an effect with memory ---


def decay_over(dt: float, time_constant: float) -> float:
    """The factor by which the distance from the target shrinks in `dt` [s]; `time_constant` in s."""
    return math.exp(-dt / time_constant)


def relaxed(x: T, target: T, decay: T) -> T:
    """`x` after a step over which it decays by `decay` towards a constant `target`; exact."""
    return decay * x + (1 - decay) * target  # type: ignore[operator,no-any-return]


def relaxation(targets: Array, decays: Array, start: float = 0.0, before: bool = False) -> Array:
    """The values (n,) at the ends of all steps from `start` on; targets, decays: (n,).

    before: the values at the beginnings of the steps instead. The remainder of earlier steps is carried over 1, 2, 4,
    ... steps in whole arrays (Hillis & Steele 1986).
    """
    import numpy as np

    values, left, steps = (1 - decays) * targets, decays.copy(), 1
    values[:1] += decays[:1] * start
    while steps < len(values) and left[steps:].max() > NEGLIGIBLE:
        values[steps:] += left[steps:] * values[:-steps]
        left[steps:] *= left[:-steps]
        steps *= 2
    return np.concatenate(([start], values[:-1])) if before else values


def mean_response(decay: float) -> float:
    """The mean of a lag's response over a constant load, as a share of the settled value: 1 - τ/T·(1 - exp(-T/τ)).

    decay: exp(-T/τ), over the load's duration T.
    """
    if decay >= 1:
        return 0.0
    return 1 + (1 - decay) / math.log(decay) if decay > 0 else 1.0


# --- tables: each form for a float (`bisect`) and for arrays ---------------------------------------------------------

KEPT_ROWS = 8  # temperatures whose row of a mesh is kept: a pack and a ride have few at a time


def linear(xs: Row, ys: Row, x: float) -> float:
    """The value at `x`: straight between the points, constant beyond the ends."""
    if x <= xs[0]:
        return ys[0]
    if x >= xs[-1]:
        return ys[-1]
    i = bisect_right(xs, x) - 1
    return ys[i] + (x - xs[i]) * (ys[i + 1] - ys[i]) / (xs[i + 1] - xs[i])


def extended(xs: Row, ys: Row, x: float) -> tuple[float, float]:
    """(value, slope) at `x`: straight between the points, and on along the last slope beyond the ends."""
    i = bisect_right(xs, x, 1, len(xs) - 1) - 1
    slope = (ys[i + 1] - ys[i]) / (xs[i + 1] - xs[i])
    return ys[i] + slope * (x - xs[i]), slope


def extended_over(xs: Array | Row, ys: Array | Row, x: Array) -> Array:
    """`extended` at `x` (m,): values only."""
    import numpy as np

    nodes, values = np.asarray(xs), np.asarray(ys)
    i = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
    slope = (values[i + 1] - values[i]) / (nodes[i + 1] - nodes[i])
    return np.asarray(values[i] + slope * (x - nodes[i]))


def bilinear_over(xs: Array, ys: Array, table: Array, x: Array, y: Array, geometric: bool = False) -> Array:
    """`table` (len(ys), len(xs)) at `x` and `y`, both (m,); the edge beyond, as `Mesh.at`."""
    import numpy as np

    i = np.clip(np.searchsorted(xs, x, side="right") - 1, 0, len(xs) - 2)
    u = np.clip((x - xs[i]) / (xs[i + 1] - xs[i]), 0, 1)
    if len(ys) == 1:
        return np.asarray(table[0][i] * (1 - u) + table[0][i + 1] * u)
    j = np.clip(np.searchsorted(ys, y, side="right") - 1, 0, len(ys) - 2)
    w = np.clip((y - ys[j]) / (ys[j + 1] - ys[j]), 0, 1)
    of = np.log(table) if geometric else table
    left, right = (of[j, k] * (1 - w) + of[j + 1, k] * w for k in (i, i + 1))
    if geometric:
        left, right = np.exp(left), np.exp(right)
    return np.asarray(left * (1 - u) + right * u)


@dataclass(frozen=True)
class PiecewiseLinear:
    """A quantity `y` over another, `x`: straight between its points, constant beyond the ends."""

    x: Row
    y: Row

    def at(self, x: float) -> float:
        """The value at `x`."""
        return linear(self.x, self.y, x)

    def over(self, x: Array) -> Array:
        """The values at `x` (m,)."""
        import numpy as np

        return np.asarray(np.interp(x, self.x, self.y))


@dataclass(frozen=True, eq=False)
class Mesh:
    """Values over SOC (columns) and temperature [degC] (rows)."""

    soc: Row
    temperature: Row
    value: tuple[Row, ...]
    geometric: bool = False  # over temperature; all values are positive then
    _scale: list[float] = field(default_factory=lambda: [1.0], init=False, repr=False)  # one factor, see `rescale`
    _rows: dict[float, Row] = field(default_factory=dict, init=False, repr=False)  # by temperature, the last few

    def at(self, soc: float, temperature: float) -> tuple[float, float]:
        """(value, its slope over SOC); beyond the mesh its edge, with slope zero."""
        xs = self.soc
        row = self._rows.get(temperature) or self._row(temperature)
        i = bisect_right(xs, soc) - 1
        if i < 0:
            return row[0], 0.0
        if i >= len(xs) - 1:
            return row[-1], 0.0
        slope = (row[i + 1] - row[i]) / (xs[i + 1] - xs[i])
        return row[i] + slope * (soc - xs[i]), slope

    def over(self, soc: Array, temperature: Array) -> Array:
        """The values at `soc` and `temperature`, both (m,)."""
        import numpy as np

        nodes = np.array(self.soc), np.array(self.temperature), np.array(self.value)
        return self._scale[0] * bilinear_over(*nodes, soc, temperature, self.geometric)

    def rescale(self, factor: float) -> None:
        """From now on the table's values are read times `factor`."""
        if factor == self._scale[0]:
            return
        self._scale[0] = factor
        self._rows.clear()

    def scaled(self, factor: float) -> Mesh:
        """The same mesh times `factor`."""
        return Mesh(
            self.soc, self.temperature, tuple(tuple(factor * v for v in row) for row in self.value), self.geometric
        )

    def _row(self, temperature: float) -> Row:
        """The values over SOC at `temperature`, kept: it changes far more slowly than SOC."""
        ts, scale = self.temperature, self._scale[0]
        if len(ts) > 1:
            j = min(max(bisect_right(ts, temperature) - 1, 0), len(ts) - 2)
            w = min(max((temperature - ts[j]) / (ts[j + 1] - ts[j]), 0.0), 1.0)
            pairs = zip(self.value[j], self.value[j + 1], strict=True)
            if self.geometric:
                row = tuple([scale * (cold * (warm / cold) ** w) for cold, warm in pairs])
            else:
                row = tuple([scale * (cold + w * (warm - cold)) for cold, warm in pairs])
        else:
            row = tuple([scale * value for value in self.value[0]])
        if len(self._rows) >= KEPT_ROWS:
            self._rows.clear()
        self._rows[temperature] = row
        return row
