"""The tables that results give, in memory."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Arrays of one length by the name of the column, with its unit: ``range[m]``."""


class Tabular(ABC):
    """A result that has a table."""

    @abstractmethod
    def to_table(self) -> Columns:
        """The table as numpy arrays of one length, by column: numbers with nan for what is not known, texts, times."""

    def to_arrow(self) -> Any:
        """The same as a `pyarrow.Table`; what is not known is null."""
        import pyarrow

        return pyarrow.table({name: pyarrow.array(a, from_pandas=True) for name, a in self.to_table().items()})

    def to_pandas(self) -> Any:
        """The same as a `pandas.DataFrame`."""
        import pandas

        return pandas.DataFrame(self.to_table())


def columns_of(rows: Sequence[Mapping[str, object]], names: Mapping[str, str]) -> Columns:
    """The columns of `rows`; names: of each key that becomes a column the column's."""
    return {column: array_of([row.get(key) for row in rows]) for key, column in names.items()}


def array_of(values: Sequence[object]) -> NDArray[Any]:
    """Texts, truth values, or numbers with nan for None."""
    if any(isinstance(value, str) for value in values):
        return np.array(["" if value is None else str(value) for value in values], dtype=object)
    if values and all(isinstance(value, bool) for value in values):
        return np.array(values, dtype=bool)
    numbers = [float(value) if isinstance(value, int | float) else np.nan for value in values]
    return np.array(numbers, dtype=float)


def table_columns(descriptions: Mapping[str, str]) -> dict[str, str]:
    """Return the column of each field of a row, ``name[unit]``: the unit is the first word of its description.

    The field ``time``, since the first frame, is ``elapsed``: a table's first column is the time of the log.
    """
    columns = {}
    for name, text in descriptions.items():
        unit = re.split(r"[ ,]", text)[0]
        columns[name] = ("elapsed" if name == "time" else name) + (f"[{unit}]" if unit not in ("", "1") else "")
    return columns
