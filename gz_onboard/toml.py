"""TOML with errors that name the file, the line, the key and the nearest right name."""

from __future__ import annotations

import contextlib
import re
import tomllib
from collections import Counter
from collections.abc import Collection, Mapping
from itertools import pairwise, takewhile
from pathlib import Path
from typing import Any

from gz_onboard.errors import LONGEST_NAME, InputError, nearest, shown

LARGEST_FILE = 1_000_000  # bytes; that of the reference scooter has 20 000
LONGEST_LIST = 1000
LONGEST_PATH = 200  # letters, of up to four bytes: no file system takes much more
FEW = 30  # names that a message lists
SMALLEST_STEP = 1e-6  # of an axis: a slope over it must stay a number

_HEADER = re.compile(r"[ \t]*(\[\[?)[ \t]*([A-Za-z_\"'][^\[\],]*)\]+[ \t]*(?:#.*)?$")
_KEY = re.compile(r"[ \t]*([\w\"'-][\w\"'. \t-]{0,200})=")
# The time to read a key grows with the square of its parts; four are the most in use.
_DEEP_KEY = re.compile(r"(?<![\w-])(?:[\w-]++[ \t]*+\.[ \t]*+){20}")  # from the beginning of a word only


class Table:
    """A TOML table that knows its place in the file, for error messages.

    text: of the whole file; path: of this table, with an index for one of an array of tables.
    """

    def __init__(self, values: Mapping[str, Any], file: Path, text: str, path: tuple[str, ...] = ()) -> None:
        self.values = values
        self.file = file
        self._text = text
        self._path = path

    @classmethod
    def read(cls, file: Path) -> Table:
        """Read `file`. InputError if it is missing, larger than `LARGEST_FILE`, or not TOML."""
        text = read_text(file, LARGEST_FILE)
        if deep := _DEEP_KEY.search(text):
            line = text.count("\n", 0, deep.start()) + 1
            raise InputError(f"{file}:{line}: {shown(deep[0])}: this key has too many parts")
        try:
            return cls(tomllib.loads(text), file, text)
        except ValueError as error:  # not TOML, or a number of thousands of digits
            raise InputError(f"{file}: not valid TOML: {error}") from error
        except RecursionError as error:
            raise InputError(f"{file}: not valid TOML: brackets are nested too deeply") from error

    def error(self, message: str, key: str = "") -> InputError:
        """Return the error to raise about `key`, or about the table as a whole."""
        path = (*self._path, key) if key else self._path
        line = _line_of(self._text, path)
        place = f"{self.file}:{line}" if line else str(self.file)
        inside = ".".join(part[:LONGEST_NAME] for part in path if not part.isdigit())
        return InputError(f"{place}: {inside}: {message}" if inside else f"{place}: {message}")

    def only(self, known: Collection[str]) -> None:
        """InputError for a key that is not in `known`."""
        for key in self.values:
            if key not in known:
                there_are = f"; known are {', '.join(sorted(known))}" if len(known) <= FEW else ""
                raise self.error(f"unknown key{nearest(key, known)}{there_are}", key)

    def table(self, key: str, short: str = "") -> Table:
        """Return the sub-table `key`; empty if it is missing. short: ``key = value`` is ``{ short = value }``."""
        value = self.values.get(key, {})
        if short and not isinstance(value, Mapping):
            value = {short: value}
        if not isinstance(value, Mapping):
            raise self.error(f"must be a table, is {shown(value)}", key)
        return Table(value, self.file, self._text, (*self._path, key))

    def tables(self, key: str, most: int) -> list[Table]:
        """Return the tables of the array ``[[key]]``, at most `most`; none if it is missing."""
        value = self.values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(one, Mapping) for one in value):
            raise self.error(f"must be tables under headers [[{key}]], is {shown(value)}", key)
        if len(value) > most:
            raise self.error(f"there are {len(value)}, the most are {most}", key)
        return [Table(one, self.file, self._text, (*self._path, key, str(i))) for i, one in enumerate(value)]

    def text(self, key: str, default: str | None = None, choices: Collection[str] = ()) -> str:
        """Return the string `key`, one of `choices` if any are given."""
        value = self.values.get(key, default)
        if not isinstance(value, str):
            raise self.error("is missing" if value is None else f"must be a string, is {shown(value)}", key)
        if choices and value not in choices:
            raise self.error(f"{shown(value)} is not one of {', '.join(choices)}{nearest(value, choices)}", key)
        return value

    def texts(self, key: str, what: str) -> list[str]:
        """Return the list of strings `key`, 1 to `LONGEST_LIST`; `what` they are, for the message."""
        complaint = f"must be a list of {what}, is {shown(self.values.get(key))}"
        texts = self._list(key, complaint)
        if not all(isinstance(text, str) for text in texts):
            raise self.error(complaint, key)
        return texts

    def check_path(self, key: str, text: str) -> str:
        """Return `text`, the value of `key`. InputError if it cannot be a path."""
        if not text or len(text) > LONGEST_PATH or not text.isprintable():
            raise self.error(f"{shown(text)} cannot be the name of a file", key)
        return text

    def number(self, key: str, default: float | None = None, low: float = -1e300, high: float = 1e300) -> float:
        """Return the number `key`, within [low, high]."""
        value = self.values.get(key, default)
        if value is None:
            raise self.error("is missing", key)
        return self._number_of(value, key, low, high)

    def integer(self, key: str, low: int, high: int) -> int:
        """Return the whole number `key`, within [low, high]."""
        value = self.number(key, low=low, high=high)
        if value != int(value):
            raise self.error(f"must be a whole number, is {value:g}", key)
        return int(value)

    def numbers(self, key: str, low: float = -1e300, high: float = 1e300, unit: str = "") -> tuple[float, ...]:
        """Return the list of numbers `key`, each within [low, high]; 1 to `LONGEST_LIST`. unit: for messages."""
        numbers = self._list(key, f"must be a list of numbers, 1 to {LONGEST_LIST}")
        return tuple(self._number_of(number, key, low, high, unit) for number in numbers)

    def increasing(self, key: str, low: float, high: float, unit: str = "") -> tuple[float, ...]:
        """Return `numbers` that increase by `SMALLEST_STEP` or more."""
        row, of = self.numbers(key, low, high, unit), f" {unit}" if unit else ""
        for a, b in pairwise(row):
            if b - a < SMALLEST_STEP:
                raise self.error(f"must increase, but {b:g}{of} follows {a:g}{of}", key)
        return row

    def rows(self, key: str, columns: int, of: str, low: float, high: float) -> tuple[tuple[float, ...], ...]:
        """Return the list of rows of `columns` numbers `key`, each within [low, high]; `of` names them."""
        rows = self._list(key, "must be a list of rows of numbers")
        for row in rows:
            if not isinstance(row, list) or len(row) != columns:
                raise self.error(f"each row must be {columns} numbers ({of}), not {shown(row)}", key)
        return tuple(tuple(self._number_of(number, key, low, high) for number in row) for row in rows)

    def _list(self, key: str, complaint: str) -> list[Any]:
        """Return the list `key` of 1 to `LONGEST_LIST` values."""
        value = self.values.get(key)
        if not isinstance(value, list) or not 0 < len(value) <= LONGEST_LIST:
            raise self.error("is missing" if value is None else complaint, key)
        return value

    def _number_of(self, value: object, key: str, low: float, high: float, unit: str = "") -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(f"must be a number, is {shown(value)}", key)
        if not abs(value) <= 1e300:  # nan is not
            raise self.error(f"must be a finite number, is {shown(value)}", key)
        if not low <= value <= high:
            of = f" {unit}" if unit else ""
            raise self.error(f"{value:g}{of} is outside {low:g} to {high:g}{of}", key)
        return float(value)


def _line_of(text: str, path: tuple[str, ...]) -> int | None:
    """The line of the first header or key that has most of `path` in its own; None if none begins alike."""
    found, most = None, 0
    table: tuple[str, ...] = ()
    counts: Counter[str] = Counter()  # of the tables of each array so far, which are at the top
    for number, line in enumerate(text.split("\n"), start=1):
        if header := _HEADER.match(line):
            array, *inner = _parts(header[2])
            counts[array] += header[1] == "[["
            index = [str(counts[array] - 1)] if counts[array] else []
            here = table = (array, *index, *inner)
        elif key := _KEY.match(line):
            here = table + _parts(key[1])
        else:
            continue
        alike = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(here, path, strict=False)))
        if alike > most:
            found, most = number, alike
    return found


def _parts(key: str) -> tuple[str, ...]:
    return tuple(part.strip(" \t\"'") for part in key.split("."))


def is_file(path: Path) -> bool:
    """Whether there is such a file. InputError if the system cannot tell: name too long, no access to the folder."""
    try:
        return path.is_file()
    except OSError as error:
        raise InputError(f"{shown(str(path))}: cannot be read: {error.strerror}") from error


def read_text(file: Path, most: int, encodings: tuple[str, ...] = ("utf-8",)) -> str:
    """Read the text of `file`, of at most `most` bytes, in the first of `encodings` that fits. InputError."""
    try:
        with file.open("rb") as stream:
            data = stream.read(most + 1)
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror}") from error
    if len(data) > most:
        raise InputError(f"{file}: is larger than {most / 1e6:g} MB")
    for encoding in encodings:
        with contextlib.suppress(UnicodeDecodeError):
            return data.decode(encoding)
    raise InputError(f"{file}: is not text in {encodings[0]}")
