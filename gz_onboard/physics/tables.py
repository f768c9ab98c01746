"""Tables and how they are read between their points, one value or a whole ride at a time.

Each form stands twice, for floats (`bisect`, on board: no numpy) and for arrays; a property test holds the two equal.
Linear between the points; beyond the ends the edge counts (`linear`, `Mesh`), or the last slope goes on (`extended`).
The circuit of a cell is geometric over temperature, linear in the logarithm: resistances fall nearly exponentially with
it (Arrhenius), and a straight line between two temperatures is a tenth too high where they are 20 K apart.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gz_onboard.arrays import Array

Row = tuple[float, ...]
KEPT_ROWS = 8  # temperatures whose row of a mesh is kept: a pack and a ride have few at a time


def linear(xs: Row, ys: Row, x: float) -> float:
    """The value at `x` between the points; constant beyond the ends."""
    if x <= xs[0]:
        return ys[0]
    if x >= xs[-1]:
        return ys[-1]
    i = bisect_right(xs, x) - 1
    return ys[i] + (x - xs[i]) * (ys[i + 1] - ys[i]) / (xs[i + 1] - xs[i])


def extended(xs: Row, ys: Row, x: float) -> tuple[float, float]:
    """(value, slope) at `x`; beyond the ends along the last slope."""
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
