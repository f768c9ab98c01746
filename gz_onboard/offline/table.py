"""Tables in memory: what others hand over as signals of a ride, and what a result gives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gz_onboard.errors import InputError, shown
from gz_onboard.offline.signal_table import SignalTable, arrow_rows, is_time

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Arrays of one length by the name of the column, with its unit: ``range[m]``."""

# --- in -----------------------------------------------------------------------------------------------------------


def signal_table(data: object, name: str = "table") -> SignalTable:
    """The signals of a ride in a table: a mapping of columns, or a table of pandas, polars, pyarrow or their like.

    The first column is the time, as in a CSV file; of a mapping, the column that is one, wherever it stands; of pandas
    also the index. name: what errors call it. Raises InputError for what is no table, or has columns of unlike lengths.
    """
    if isinstance(data, Mapping):
        return SignalTable(Path(name), *_mapping_rows(data, name))
    try:
        import pyarrow
    except ImportError as error:
        raise InputError(f"{name}: a {type(data).__name__} needs pyarrow; a dict of arrays does without") from error
    if isinstance(data, pyarrow.Table):
        table = data
    elif hasattr(data, "iloc") and hasattr(data, "reset_index"):  # pandas
        if not data.columns.is_unique:  # type: ignore[attr-defined]
            twice = data.columns[data.columns.duplicated()][0]  # type: ignore[attr-defined]
            raise InputError(f"{name}: has two columns {str(twice)!r}")
        table = pyarrow.Table.from_pandas(
            data.reset_index() if is_time(str(data.index.name)) else data,  # type: ignore[attr-defined]
            preserve_index=False,
        )
    elif hasattr(data, "__arrow_c_stream__"):
        table = pyarrow.table(data)
    else:
        raise InputError(
            f"{name}: {type(data).__name__} is no table of signals; give a dict of arrays by column, or a table of "
            "pandas, polars or pyarrow"
        )
    names = table.column_names
    return SignalTable(Path(name), *arrow_rows(table.select(_time_first(names))))


def _mapping_rows(data: Mapping[Any, Any], name: str) -> tuple[list[str], list[tuple[int, tuple[Any, ...]]]]:
    names = list(data)
    order = [names[i] for i in _time_first([str(one) for one in names])]
    columns = [_cells(data[one], f"{name}: column {str(one)!r}") for one in order]
    lengths = {str(one): len(column) for one, column in zip(order, columns, strict=True)}
    if len(set(lengths.values())) > 1:
        said = ", ".join(f"{one} {length}" for one, length in lengths.items())
        raise InputError(f"{name}: its columns have unlike lengths: {said}")
    return [str(one) for one in order], list(enumerate(zip(*columns, strict=True), 1))


def _time_first(names: Sequence[str]) -> list[int]:
    """The places of the columns, that of the time first."""
    at = next((i for i, name in enumerate(names) if is_time(name)), 0)
    return sorted(range(len(names)), key=lambda i: (i != at, i))


def _cells(column: object, place: str) -> list[Any]:
    """The cells of a column as Python has them; times as dates. InputError, which begins with `place`, for no array."""
    array = np.array(0)
    if isinstance(column, Iterable) and not isinstance(column, str):
        with suppress(TypeError, ValueError):  # of no dimension, of rows of unlike lengths
            array = column if isinstance(column, np.ndarray) else np.asarray(list(column))
    if array.ndim != 1:
        raise InputError(f"{place}: must be an array of one dimension, is {shown(column)}")
    if array.dtype.kind == "M":
        array = array.astype("datetime64[us]")  # as `datetime`, which has no ns
    cells: list[Any] = array.tolist()
    return cells


# --- out ----------------------------------------------------------------------------------------------------------


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
