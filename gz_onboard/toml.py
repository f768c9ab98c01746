"""TOML with errors that name the file, the line, the key and the nearest right name."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from gz_onboard.errors import InputError, nearest


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
        """The line on which `key` of this table stands, as far as a search can tell."""
        header = 0
        if self.name:
            found = re.search(rf"^\s*\[+\s*{re.escape(self.name)}\s*\]+", self._text, re.M)
            if not found:  # an inline table: the last part of its name is a key
                parent, _, last = self.name.rpartition(".")
                return Table(self.values, self.file, self._text, parent)._line(last) if last != self.name else None
            header = found.end()
            if not key:
                return self._text.count("\n", 0, found.start()) + 1
        found = re.compile(rf"^\s*(\[[^\]\n]*\.)?[\"']?{re.escape(key)}[\"']?\s*[=.\]]", re.M).search(
            self._text, header
        )
        return self._text.count("\n", 0, found.start()) + 1 + found.group().count("\n", 0, 1) if found else None

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
        if not low <= value <= high:  # NaN fails too
            raise self.error(f"{value:g} is outside {low:g} to {high:g}", key)
        return float(value)

    def numbers(self, key: str) -> tuple[float, ...]:
        """The list of numbers `key`."""
        value = self.values.get(key)
        if not isinstance(value, list) or not value:
            raise self.error("is missing" if value is None else "must be a list of numbers", key)
        for number in value:
            if isinstance(number, bool) or not isinstance(number, int | float) or math.isnan(number):
                raise self.error(f"must hold numbers only, holds {number!r}", key)
        return tuple(float(number) for number in value)
