"""The cells of columns, of whatever library these are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gz_onboard.errors import InputError, shown

_CALENDAR = np.array(["0001-01-01", "9999-12-31"], "datetime64[s]")  # the days that `datetime` has


def rows_of(columns: Sequence[tuple[str, object]], name: str) -> tuple[list[str], list[tuple[int, tuple[Any, ...]]]]:
    """(header, rows) of columns by name: each row its number, from 1, and its cells.

    name: what errors call the table. InputError for what is no column, and for columns of unlike lengths.
    """
    cells = [_cells(column, name, header) for header, column in columns]
    header = [header for header, _ in columns]
    if len({len(column) for column in cells}) > 1:
        said = ", ".join(f"{one} {len(column)}" for one, column in zip(header, cells, strict=True))
        raise InputError(f"{name}: its columns have unlike lengths: {said}")
    return header, list(enumerate(zip(*cells, strict=True), 1))


def _cells(column: object, name: str, header: str) -> list[Any]:
    """The cells of a column as Python has them; times as dates or durations.

    name, header: what errors call table and column. InputError for what is no array, and for dates of no calendar.
    """
    array = _array(column)
    if array.ndim != 1:
        raise InputError(f"{name}: column {header!r}: must be an array of one dimension, is {shown(column)}")
    if array.dtype.kind == "M":
        seconds = array.astype("datetime64[s]")
        beyond = np.flatnonzero((seconds < _CALENDAR[0]) | (seconds > _CALENDAR[1]))
        if len(beyond):
            raise InputError(f"{name}:{beyond[0] + 1}: column {header!r}: {array[beyond[0]]} is not a plausible time")
    if array.dtype.kind in "Mm":
        array = array.astype(f"{array.dtype.kind}8[us]")  # as `datetime`, which has no ns
    cells: list[Any] = array.tolist()
    return cells


def _array(column: object) -> NDArray[Any]:
    """A column as an array; one of no dimension for what is none."""
    if isinstance(column, Iterable) and not isinstance(column, str | bytes | Mapping | AbstractSet):
        kind = getattr(getattr(column, "dtype", None), "kind", "")
        with suppress(TypeError, ValueError):  # of rows of unlike lengths
            if isinstance(column, np.ndarray):
                return column
            cells = column if hasattr(column, "__array__") else list(column)
            return np.asarray(cells, "M8[us]" if kind == "M" else None)  # or pandas gives dates of a zone one by one
    return np.array(0)
