"""TOML with errors that name the file, the line, the key and the nearest right name."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from gz_onboard.errors import InputError, nearest

_HEADER = re.compile(r"^[ \t]*\[\[?[ \t]*[A-Za-z_\"']", re.M)  # not a row of a list of numbers


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
        """Read `file`; InputError if it is missing or not TOML."""
        try:
            text = file.read_text(encoding="utf-8")
            return cls(tomllib.loads(text), file, text)
        except OSError as error:
            raise InputError(f"{file}: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(f"{file}: not valid TOML: {error}") from error

    def error(self, message: str, key: str = "") -> InputError:
        """The error to raise about `key` (or about the table as a whole)."""
        line = self._line(key)
        place = f"{self.file}:{line}" if line else str(self.file)
        inside = ".".join(part for part in (self.name, key) if part)
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
                raise self.error(f"unknown key{nearest(key, known)}; known are {', '.join(sorted(known))}", key)

    def table(self, key: str) -> Table:
        """The sub-table `key`; an empty one if it is not there."""
        value = self.values.get(key, {})
        if not isinstance(value, Mapping):
            raise self.error(f"must be a table, is {value!r}", key)
        return Table(value, self.file, self._text, f"{self.name}.{key}" if self.name else key)

    def text(self, key: str, default: str | None = None, choices: Collection[str] = ()) -> str:
        """The string `key`, one of `choices` if these are given."""
        value = self.values.get(key, default)
        if not isinstance(value, str):
            raise self.error("is missing" if value is None else f"must be a string, is {value!r}", key)
        if choices and value not in choices:
            raise self.error(f"{value!r} is not one of {', '.join(choices)}{nearest(value, choices)}", key)
        return value

    def number(self, key: str, default: float | None = None, low: float = -1e300, high: float = 1e300) -> float:
        """The number `key`, within [low, high]."""
        value = self.values.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error("is missing" if value is None else f"must be a number, is {value!r}", key)
        if not math.isfinite(value):
            raise self.error(f"must be a finite number, is {value}", key)
        if not low <= value <= high:
            raise self.error(f"{value:g} is outside {low:g} to {high:g}", key)
        return float(value)

    def numbers(self, key: str) -> tuple[float, ...]:
        """The list of numbers `key`."""
        value = self.values.get(key)
        if not isinstance(value, list) or not value:
            raise self.error("is missing" if value is None else "must be a list of numbers", key)
        for number in value:
            if isinstance(number, bool) or not isinstance(number, int | float) or not math.isfinite(number):
                raise self.error(f"must hold numbers only, holds {number!r}", key)
        return tuple(float(number) for number in value)
