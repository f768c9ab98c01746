"""Tables in memory: what others hand over as signals of a ride, and what a result gives."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from gz_onboard.errors import InputError
from gz_onboard.offline.cells import rows_of
from gz_onboard.offline.signal_table import SignalTable, is_time

Columns: TypeAlias = dict[str, NDArray[Any]]
"""Arrays of one length by the name of the column, with its unit: ``range[m]``."""

# --- in -----------------------------------------------------------------------------------------------------------


def signal_table(data: object, name: str = "table") -> SignalTable:
    """The signals of a ride in a table: a mapping of columns, or a table of pandas, polars, pyarrow or their like.

    The first column is the time, as in a CSV file; of a mapping, the column that is one, wherever it stands; of pandas
    also the index. name: what errors call it. Raises InputError for what is no table, or has columns of unlike lengths.
    """
    columns = _columns(data, name)
    columns.sort(key=lambda column: not is_time(column[0]))
    return SignalTable(Path(name), *rows_of(columns, name))


def _columns(data: Any, name: str) -> list[tuple[str, object]]:
    """The columns of a table, each with its name."""
    if isinstance(data, Mapping):
        return [(str(header), column) for header, column in data.items()]
    if hasattr(data, "iloc") and hasattr(data, "columns"):  # pandas, which may have two columns of one name
        columns = [(str(header), data.iloc[:, i]) for i, header in enumerate(data.columns)]
        headers = [header for header, _ in columns]
        if twice := next((header for header in headers if headers.count(header) > 1), None):
            raise InputError(f"{name}: has two columns {twice!r}")
        index = str(data.index.name)
        return [(index, data.index), *columns] if is_time(index) and index not in headers else columns
    if hasattr(data, "__arrow_c_stream__"):
        try:
            import pyarrow
        except ImportError as error:
            raise InputError(f"{name}: a {type(data).__name__} needs pyarrow; a dict of arrays does without") from error
        with suppress(pyarrow.ArrowException, TypeError, ValueError, RuntimeError):  # a column alone speaks Arrow too
            table = pyarrow.table(data)
            return list(zip(table.column_names, table.columns, strict=True))
    raise InputError(
        f"{name}: {type(data).__name__} is no table of signals; give a dict of arrays by column, or a table of "
        "pandas, polars or pyarrow"
    )


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


def table_columns(descriptions: Mapping[str, str]) -> dict[str, str]:
    """Return the column of each field of a row, ``name[unit]``: the unit is the first word of its description.

    The field ``time``, since the first frame, is ``elapsed``: a table's first column is the time of the log.
    """
    columns = {}
    for name, text in descriptions.items():
        unit = re.split(r"[ ,]", text)[0]
        columns[name] = ("elapsed" if name == "time" else name) + (f"[{unit}]" if unit not in ("", "1") else "")
    return columns
