"""TOML with errors that name the file, the line, the key and the nearest right name."""

from __future__ import annotations

import contextlib
import re
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from gz_onboard.errors import LONGEST_NAME, InputError, nearest, shown

LARGEST_FILE = 1_000_000  # bytes; that of the reference scooter has 20 000
LONGEST_LIST = 1000
LONGEST_PATH = 200  # letters, of up to four bytes: no file system takes much more
MOST_PARTS = 10  # of a key or header; the time to read one grows with their square, and four are the most in use
FEW = 30  # names that a message lists

_HEADER = re.compile(r"^[ \t]*\[\[?[ \t]*[A-Za-z_\"']", re.M)  # not a row of a list of numbers
_STRING = r'"(?:[^"\\\n]|\\.)*+"?|\'[^\'\n]*+\'?'  # on one line; each takes all there is where its end is missing
_TOKEN = re.compile(
    rf"(?P<deep>(?:(?:[\w-]++|{_STRING})[ \t]*\.[ \t]*){{{MOST_PARTS}}})"
    rf'|"""(?:[^\\]|\\.)*?(?:"{{3,5}}|\Z)|\'\'\'.*?(?:\'{{3,5}}|\Z)|{_STRING}|#[^\n]*|[\w-]+',
    re.S,
)


def _quoted(name: str) -> str:
    return rf"[\"']?{re.escape(name)}[\"']?"


def _dotted(path: list[str]) -> str:
    return r"[ \t]*\.[ \t]*".join(map(_quoted, path))


class Table:
    """A TOML table that knows where it stands, so that every complaint can say so."""

    def __init__(self, values: Mapping[str, Any], file: Path, text: str, name: str = "") -> None:
        self.values = values
        self.file = file
        self.name = name
        self._text = text

    @classmethod
    def read(cls, file: Path) -> Table:
        """Read `file`; InputError if it is missing, larger than `LARGEST_FILE`, or not TOML."""
        text = read_text(file, LARGEST_FILE)
        if deep := next((token for token in _TOKEN.finditer(text) if token["deep"]), None):
            line = text.count("\n", 0, deep.start()) + 1
            raise InputError(f"{file}:{line}: {shown(deep[0])}: a key has at most {MOST_PARTS} parts")
        try:
            return cls(tomllib.loads(text), file, text)
        except ValueError as error:  # not TOML, or a number of thousands of digits
            raise InputError(f"{file}: not valid TOML: {error}") from error
        except RecursionError as error:
            raise InputError(f"{file}: not valid TOML: brackets in brackets without end") from error

    def error(self, message: str, key: str = "") -> InputError:
        """The error to raise about `key` (or about the table as a whole)."""
        line = self._line(key)
        place = f"{self.file}:{line}" if line else str(self.file)
        inside = ".".join(part[:LONGEST_NAME] for part in (self.name, key) if part)
        return InputError(f"{place}: {inside}: {message}" if inside else f"{place}: {message}")

    def _line(self, key: str) -> int | None:
        """The line on which `key` of this table stands, or else the table; None if a search cannot tell."""
        path = [part for part in (*self.name.split("."), key) if part]
        if path and (header := self._header(path)):
            return self._number(header.start())
        fallback = None
        for depth in range(len(path) - 1, -1, -1):  # the key may stand in an inline table or behind dots
            header = self._header(path[:depth]) if depth else None
            if depth and not header:
                continue
            begin = header.end() if header else 0
            following = _HEADER.search(self._text, begin)
            found = re.compile(rf"^[ \t]*{_quoted(path[depth])}[ \t]*[=.]", re.M).search(
                self._text, begin, following.start() if following else len(self._text)
            )
            if found:
                return self._number(found.start())
            fallback = fallback or header
        inner = re.search(rf"^[ \t]*\[+[ \t]*{_dotted(path)}[ \t]*\.", self._text, re.M)
        found = inner or fallback
        return self._number(found.start()) if found else None

    def _header(self, path: list[str]) -> re.Match[str] | None:
        return re.search(rf"^[ \t]*\[+[ \t]*{_dotted(path)}[ \t]*\]", self._text, re.M)

    def _number(self, position: int) -> int:
        return self._text.count("\n", 0, position) + 1

    def only(self, known: Collection[str]) -> None:
        """Refuse keys that are not in `known`."""
        for key in self.values:
            if key not in known:
                there_are = f"; known are {', '.join(sorted(known))}" if len(known) <= FEW else ""
                raise self.error(f"unknown key{nearest(key, known)}{there_are}", key)

    def table(self, key: str, short: str = "") -> Table:
        """The sub-table `key`; an empty one if it is not there. short: ``key = value`` means ``{ short = value }``."""
        value = self.values.get(key, {})
        if short and not isinstance(value, Mapping):
            value = {short: value}
        if not isinstance(value, Mapping):
            raise self.error(f"must be a table, is {shown(value)}", key)
        return Table(value, self.file, self._text, f"{self.name}.{key}" if self.name else key)

    def tables(self, key: str, most: int) -> list[Table]:
        """The tables of the array `key`, ``[[key]]``, at most `most`; none if it is not there."""
        value = self.values.get(key, [])
        if not isinstance(value, list) or not all(isinstance(one, Mapping) for one in value):
            raise self.error(f"must be tables under headers [[{key}]], is {shown(value)}", key)
        if len(value) > most:
            raise self.error(f"there are {len(value)}, the most are {most}", key)
        name = f"{self.name}.{key}" if self.name else key
        header = re.compile(rf"^[ \t]*\[\[[ \t]*{_dotted(name.split('.'))}[ \t]*\]\]", re.M)
        begins = [found.start() for found in header.finditer(self._text)]
        if len(begins) != len(value):  # written in one line
            return [Table(one, self.file, self._text, name) for one in value]
        ends = [*begins, len(self._text)][1:]
        # Of the text before it only the lines are left: its keys are found where they stand, not in another's.
        texts = ["\n" * self._text.count("\n", 0, i) + self._text[i:k] for i, k in zip(begins, ends, strict=True)]
        return [Table(one, self.file, text, name) for one, text in zip(value, texts, strict=True)]

    def text(self, key: str, default: str | None = None, choices: Collection[str] = ()) -> str:
        """The string `key`, one of `choices` if these are given."""
        value = self.values.get(key, default)
        if not isinstance(value, str):
            raise self.error("is missing" if value is None else f"must be a string, is {shown(value)}", key)
        if choices and value not in choices:
            raise self.error(f"{shown(value)} is not one of {', '.join(choices)}{nearest(value, choices)}", key)
        return value

    def texts(self, key: str, what: str) -> list[str]:
        """The list of strings `key`, at least one, at most `LONGEST_LIST`; `what` they are, for the complaint."""
        complaint = f"must be a list of {what}, is {shown(self.values.get(key))}"
        texts = self._list(key, complaint)
        if not all(isinstance(text, str) for text in texts):
            raise self.error(complaint, key)
        return texts

    def check_path(self, key: str, text: str) -> str:
        """`text`, of the value `key`, if the system takes it for a path; InputError."""
        if not text or len(text) > LONGEST_PATH or not text.isprintable():
            raise self.error(f"{shown(text)} cannot be the name of a file", key)
        return text

    def number(self, key: str, default: float | None = None, low: float = -1e300, high: float = 1e300) -> float:
        """The number `key`, within [low, high]."""
        value = self.values.get(key, default)
        if value is None:
            raise self.error("is missing", key)
        return self._number_of(value, key, low, high)

    def integer(self, key: str, low: int, high: int) -> int:
        """The whole number `key`, within [low, high]."""
        value = self.number(key, low=low, high=high)
        if value != int(value):
            raise self.error(f"must be a whole number, is {value:g}", key)
        return int(value)

    def numbers(self, key: str, low: float = -1e300, high: float = 1e300) -> tuple[float, ...]:
        """The list of numbers `key`, each within [low, high]; at least one, at most `LONGEST_LIST`."""
        numbers = self._list(key, f"must be a list of numbers, 1 to {LONGEST_LIST}")
        return tuple(self._number_of(number, key, low, high) for number in numbers)

    def rows(self, key: str, columns: int, of: str, low: float, high: float) -> tuple[tuple[float, ...], ...]:
        """The list of rows of `columns` numbers `key`, each within [low, high]; `of` says what they are."""
        rows = self._list(key, "must be a list of rows of numbers")
        for row in rows:
            if not isinstance(row, list) or len(row) != columns:
                raise self.error(f"each row must be {columns} numbers ({of}), not {shown(row)}", key)
        return tuple(tuple(self._number_of(number, key, low, high) for number in row) for row in rows)

    def _list(self, key: str, complaint: str) -> list[Any]:
        """The list `key`, at least one value, at most `LONGEST_LIST`."""
        value = self.values.get(key)
        if not isinstance(value, list) or not 0 < len(value) <= LONGEST_LIST:
            raise self.error("is missing" if value is None else complaint, key)
        return value

    def _number_of(self, value: object, key: str, low: float, high: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(f"must be a number, is {shown(value)}", key)
        if not abs(value) <= 1e300:  # nan is not
            raise self.error(f"must be a finite number, is {shown(value)}", key)
        if not low <= value <= high:
            raise self.error(f"{value:g} is outside {low:g} to {high:g}", key)
        return float(value)


def is_file(path: Path) -> bool:
    """Whether there is such a file. InputError where the system does not look: name too long, folder closed."""
    try:
        return path.is_file()
    except OSError as error:
        raise InputError(f"{shown(str(path))}: cannot be read: {error.strerror}") from error


def read_text(file: Path, most: int, encodings: tuple[str, ...] = ("utf-8",)) -> str:
    """The text of `file`, of at most `most` bytes, in the first of `encodings` that fits. InputError."""
    try:
        with file.open("rb") as stream:
            data = stream.read(most + 1)
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror}") from error
    if len(data) > most:
        raise InputError(f"{file}: is larger than {most / 1e6:g} MB; it is not read any further")
    for encoding in encodings:
        with contextlib.suppress(UnicodeDecodeError):
            return data.decode(encoding)
    raise InputError(f"{file}: is no text in {encodings[0]}")
