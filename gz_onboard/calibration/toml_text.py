"""Edits the text of a TOML file: keys and tables are put in place of others, all else stays, comments too."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gz_onboard.errors import InputError

DIGITS = 6  # significant ones of a number in the file: far below every standard deviation
UNMEASURED = "# Not measured, the shape of what was:"  # begins a comment that goes with its table
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_HEADER = re.compile(r"^[ \t]*\[([^\[\]]+)\][ \t]*(#.*)?$")  # not of an array of tables, of which a vehicle has none

KeyPath = tuple[str, ...]


@dataclass(frozen=True)
class _Entry:
    """Lines of a TOML file that belong together: a header, one key with its value, or comments and blank lines.

    path: of the table for a header, of the key for a key, empty for comments.
    """

    kind: str  # "header", "key", "comment"
    path: KeyPath
    text: str  # with its newline


def rounded(value: float) -> float:
    """`value` as it is written."""
    return float(f"{value:.{DIGITS}g}") + 0.0  # no negative zero


def number(value: float) -> str:
    """A TOML float."""
    return repr(rounded(value))


def string(text: str) -> str:
    """A TOML basic string on one line."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c >= " " and c != "\x7f" else f"\\u{ord(c):04x}" for c in escaped) + '"'


def row(values: Iterable[float]) -> str:
    """A TOML list of floats."""
    return "[" + ", ".join(number(float(v)) for v in values) + "]"


def key(name: str) -> str:
    """A key, quoted if TOML needs it."""
    return name if _BARE.fullmatch(name) else string(name)


def with_keys(text: str, keys: Mapping[KeyPath, str], file: Path) -> str:
    """The text of the vehicle file `file` with the TOML values `keys` at these paths."""
    new = {path: f"{key(path[-1])} = {value}\n" for path, value in keys.items()}
    return spliced(text, new, {}, set(), file)


def _entries(text: str, file: Path) -> Iterable[_Entry]:
    """The parts of a TOML text, which together are that text."""
    inside: KeyPath = ()
    pending = ""
    for line in (part + "\n" for part in text.removesuffix("\n").split("\n")):
        if not pending:
            if not line.strip() or line.lstrip().startswith("#"):
                yield _Entry("comment", (), line)
                continue
            if _HEADER.match(line.rstrip("\n")):
                inside = _path(tomllib.loads(line))
                yield _Entry("header", inside, line)
                continue
            if line.lstrip().startswith("["):
                raise InputError(f"{file}: {line.strip()}: a vehicle file has no arrays of tables")
        pending += line
        try:
            value = tomllib.loads(pending)
        except tomllib.TOMLDecodeError:
            continue  # a value of several lines
        yield _Entry("key", inside + _path(value), pending)
        pending = ""
    if pending:
        raise InputError(f"{file}: not valid TOML near its end")


def _path(parsed: Mapping[str, Any]) -> KeyPath:
    """The one path in the parse of a header, or of one key that may hold an inline table (whose keys do not count)."""
    path: list[str] = []
    value: Any = parsed
    while isinstance(value, Mapping) and len(value) == 1:
        name, value = next(iter(value.items()))
        path.append(name)
    return tuple(path)


def _starts(path: KeyPath, begin: KeyPath) -> bool:
    return path[: len(begin)] == begin


def spliced(
    text: str, new: Mapping[KeyPath, str], tables: Mapping[KeyPath, str], dropped: set[KeyPath], file: Path
) -> str:
    """The TOML `text` of `file` with the keys `new` and the `tables` in place of theirs, and without `dropped`."""
    gone = dropped | set(tables)
    out: list[str] = []
    written: set[KeyPath] = set()
    ends: dict[KeyPath, int] = {}  # of each table the place after its last key
    inside: KeyPath = ()
    away = False  # within a table that goes
    for entry in _entries(text, file):
        if entry.kind == "comment":
            if not away or not entry.text.strip().startswith(UNMEASURED):
                out.append(entry.text)
            continue
        if entry.kind == "header":
            inside = entry.path
            away = False
            for path in gone:
                if _starts(inside, path):
                    away = True
                    if path in tables and path not in written:
                        written.add(path)
                        out.append(tables[path])
            for path in new:
                if _starts(inside, path):  # [parameters.NAME]: the value goes where that table stood, as a table
                    away = True
            if not away:
                out.append(entry.text)
                ends.setdefault(inside, len(out))
                ends[inside] = len(out)
            continue
        if away or any(_starts(entry.path, path) for path in gone):
            continue
        replaced = next((path for path in new if _starts(entry.path, path)), None)
        if replaced is not None:
            if replaced not in written:
                written.add(replaced)
                if replaced[: len(inside)] != inside or len(replaced) != len(inside) + 1:
                    raise InputError(f"{file}: write {'.'.join(replaced)} as one key below [{'.'.join(replaced[:-1])}]")
                out.append(new[replaced])
                ends[inside] = len(out)
            continue
        for path in (*new, *tables):
            if _starts(path, entry.path) and path != entry.path:
                raise InputError(
                    f"{file}: {'.'.join(entry.path)} is an inline table; write it as [{'.'.join(path[:-1])}]"
                )
        out.append(entry.text)
        ends[inside] = len(out)
    return _appended(out, new, tables, written, ends)


def _appended(
    out: list[str],
    new: Mapping[KeyPath, str],
    tables: Mapping[KeyPath, str],
    written: set[KeyPath],
    ends: Mapping[KeyPath, int],
) -> str:
    """Add what had no place yet: keys at the end of their table, tables at the end of the file."""
    left: dict[KeyPath, list[str]] = {}
    for path, text in new.items():
        if path not in written:
            left.setdefault(path[:-1], []).append(text)
    late = {table: keys for table, keys in left.items() if table not in ends}
    for table in sorted((t for t in left if t in ends), key=lambda t: -ends[t]):
        out[ends[table] : ends[table]] = left[table]
    for table, keys in late.items():
        out += ["\n", f"[{'.'.join(map(key, table))}]\n", *keys]
    for path, text in tables.items():
        if path not in written:
            out += ["\n", text]
    return re.sub(r"\n{3,}", "\n\n", "".join(out)).rstrip("\n") + "\n"
