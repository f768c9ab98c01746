"""Correlations of parameters that were found together, from the vehicle file.

[correlation.coastdown]
parameters = ["drag_area", "rolling_resistance_constant"]
value = [[1.0, -0.86], [-0.86, 1.0]]
"""

from __future__ import annotations

from collections.abc import Sequence

from gz_onboard.errors import nearest, shown
from gz_onboard.vehicle import Vehicle


def correlations(vehicle: Vehicle) -> dict[frozenset[str], float]:
    """The correlations in the file of `vehicle`, by the pair of names; InputError for impossible ones."""
    found: dict[frozenset[str], float] = {}
    known, every = vehicle.parameters, vehicle.correlations  # of a calibration under way, not of its base file
    for group in every.values:
        table = every.table(group)
        table.only(["parameters", "value", "source"])
        names = table.texts("parameters", "names of parameters")
        for name in names:
            if name not in known:
                raise table.error(f"no parameter is called {shown(name)}{nearest(name, known)}", "parameters")
            if names.count(name) > 1:
                raise table.error(f"names {name!r} twice", "parameters")
        n = len(names)
        rows = table.rows("value", n, "as many as parameters", -1, 1)
        if len(rows) != n:
            raise table.error(f"must be {n} rows of {n} numbers, as many as parameters", "value")
        for i, row in enumerate(rows):
            for j, r in enumerate(row):
                if r != rows[j][i]:
                    raise table.error(f"row {i + 1}, column {j + 1}: {r:g} is not symmetric", "value")
                if i == j and r != 1:
                    raise table.error(f"the diagonal must be 1, is {r:g}", "value")
                if i != j:
                    found[frozenset((names[i], names[j]))] = r
        if not _is_positive(rows):
            raise table.error("no parameters can have these correlations together: a variance is negative", "value")
    return found


def _is_positive(rows: Sequence[Sequence[float]]) -> bool:
    """Whether a symmetric matrix has no negative variance, except by rounding: all pivots of Gaussian elimination."""
    while rows:
        (pivot, *row), *others = rows
        follows = pivot < 1e-6  # the parameter follows from those before it: its remainder must be rounding
        if pivot < -1e-4 or (follows and any(abs(x) > 1e-2 for x in row)):
            return False
        rows = [
            [x - (0.0 if follows else a * b / pivot) for x, b in zip(other[1:], row, strict=True)]
            for a, other in zip(row, others, strict=True)
        ]
    return True
