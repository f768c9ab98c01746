"""CSV files of numbers, with errors that name the file, the line and the column."""

from __future__ import annotations

import csv
import gzip
import math
import re
import zlib
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from gz_onboard.errors import InputError, nearest, shown, unreadable

LEAST_ROWS = 2
UNITS = {"mps": 1.0, "kmh": 1 / 3.6, "mph": 0.44704}  # [m/s] in one of each
_KMH = re.compile(r"km?/h|km?ph", re.I)
_DECIMAL = re.compile(r"^(\s*[-+]?\d*),(\d+(?:[eE][-+]?\d+)?\s*)$")


@dataclass(frozen=True)
class Columns:
    """The columns of a CSV file, all of one length, and the line that each row stands on."""

    file: Path
    lines: tuple[int, ...]
    values: dict[str, tuple[float, ...]]

    def __len__(self) -> int:
        return len(self.lines)

    def error(self, row: int, message: str) -> InputError:
        """The error to raise about `row` (0 is the first below the header)."""
        return InputError(f"{self.file}:{self.lines[row]}: {message}")

    def check(self, name: str, low: float, high: float, unit: str) -> None:
        """Refuse a value of column `name` outside [low, high]."""
        for row, value in enumerate(self.values[name]):
            if not low <= value <= high:
                raise self.error(row, f"{name}: {value:g} {unit} is outside {low:g} to {high:g} {unit}")

    def increasing(self, name: str, unit: str) -> None:
        """Refuse a column `name` that does not increase from row to row."""
        values = self.values[name]
        for row in range(1, len(values)):
            if values[row] <= values[row - 1]:
                raise self.error(row, f"{name}: {values[row]:g} {unit} does not increase (before: {values[row - 1]:g})")


def csv_rows(file: Path) -> list[tuple[int, list[str]]]:
    """(line, fields) of each line of a CSV `file` (also .csv.gz) but empty ones. InputError if it cannot be read."""
    try:
        with (gzip.open if file.suffix == ".gz" else open)(file, "rt", encoding="utf-8-sig", newline="") as stream:
            return separated(stream.read())
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file}: not a CSV file: {error}") from error
    except (OSError, EOFError, zlib.error) as error:
        raise unreadable(file, error) from error


def separated(text: str) -> list[tuple[int, list[str]]]:
    """(line, fields) of each line of `text` but empty ones, separated by what the header has most of: commas,
    semicolons or tabs. A comma in a number is a decimal one where it separates nothing.
    """
    mark = max(",;\t", key=text.partition("\n")[0].count)
    reader = csv.reader(text.splitlines(keepends=True), delimiter=mark)
    rows = [(reader.line_num, row) for row in reader if any(map(str.strip, row))]
    return rows if mark == "," else [(line, [_DECIMAL.sub(r"\1.\2", field) for field in row]) for line, row in rows]


def read_columns(file: Path, known: Collection[str]) -> Columns:
    """Read a CSV `file` of finite numbers whose header names columns out of `known`, with at least two rows.

    Blank lines are passed over. Raises InputError, naming file, line and column, if the file cannot be read, a
    column is unknown or there twice, a row has too few or too many fields, or a field is no finite number.
    """
    records = csv_rows(file)
    if not records:
        raise InputError(f"{file}: is empty; its first line must name columns out of {', '.join(known)}")
    line, header = records[0][0], [name.strip() for name in records[0][1]]
    for column, name in enumerate(header):
        if name not in known:
            meant = nearest(_KMH.sub("kmh", name).replace("m/s", "mps"), known)  # or "kph" would be taken for "mph"
            raise InputError(f"{file}:{line}: unknown column {shown(name)}{meant}; known are {', '.join(known)}")
        if name in header[:column]:
            raise InputError(f"{file}:{line}: column {shown(name)} is there twice")
    if len(records) <= LEAST_ROWS:
        raise InputError(f"{file}: has {len(records) - 1} rows below its header, must have at least {LEAST_ROWS}")
    table: list[list[float]] = []
    for line, record in records[1:]:
        if len(record) != len(header):
            raise InputError(f"{file}:{line}: has {len(record)} fields, the header has {len(header)}")
        table.append([_number(f"{file}:{line}: {name}", field) for name, field in zip(header, record, strict=True)])
    values = {name: tuple(row[column] for row in table) for column, name in enumerate(header)}
    return Columns(file, tuple(line for line, _ in records[1:]), values)


def _number(place: str, field: str) -> float:
    try:
        value = float(field)
    except ValueError:
        raise InputError(f"{place}: {shown(field)} is not a number") from None
    if not math.isfinite(value):
        raise InputError(f"{place}: must be a finite number, is {shown(field)}")
    return value
