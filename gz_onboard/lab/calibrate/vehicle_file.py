"""Writes what calibration found into a vehicle file: what was not found stays as the base file has it, comments too."""

from __future__ import annotations

import os
import re
import shutil
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.errors import InputError
from gz_onboard.lab.calibrate.result import Curve, Found, Result
from gz_onboard.physics.effect import PACKAGE_EFFECTS, Effect
from gz_onboard.physics.parameters import declared_parameters
from gz_onboard.vehicle import read_vehicle

DIGITS = 6  # significant ones of a number in the file: far below every standard deviation
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


def write_vehicle(base: Path, results: Sequence[Result], out: Path) -> None:
    """Write the vehicle file `base` with what `results` found to `out`, whole or not at all. InputError, OSError."""
    text = merged(base.read_text(encoding="utf-8"), results, base, out)
    if base.resolve().parent != out.resolve().parent:
        text = with_keys(text, copied_effects(read_vehicle(base).model.effects, out), out)
    temporary = out.with_name(out.name + ".new")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(out)


def merged(text: str, results: Sequence[Result], base: Path, out: Path) -> str:
    """The text of a vehicle file `text` (of the file `base`) with what `results` found, to stand at `out`.

    A later result overrides an earlier one. Values are written with 6 significant digits. Paths to DBC files beside
    `base` are written as seen from `out`. Raises InputError for what the file could not hold.
    """
    document = tomllib.loads(text)
    parameters = {name: found for result in results for name, found in result.parameters.items()}
    curves = {name: curve for result in results for name, curve in result.curves.items()}
    _check(parameters, curves, base)
    order = list(declared_parameters())
    parameters = dict(sorted(parameters.items(), key=lambda p: order.index(p[0]) if p[0] in order else len(order)))
    groups = _correlations(document, results, set(parameters), base)
    new: dict[KeyPath, str] = {
        **{("parameters", name): f"{name} = {_parameter(found)}\n" for name, found in parameters.items()},
        **_moved(document, base, out),
    }
    tables: dict[KeyPath, str] = {
        **{tuple(name.split(".")): _curve(name, curve) for name, curve in curves.items()},
        **{("correlation", name): group for name, group in groups.items()},
    }
    dropped: set[KeyPath] = {("correlation", name) for name in document.get("correlation", {})}
    return _spliced(list(_entries(text, base)), new, tables, dropped, base)


def with_keys(text: str, keys: Mapping[KeyPath, str], file: Path, without: Iterable[KeyPath] = ()) -> str:
    """The text of the vehicle file `file` with the TOML values `keys` at these paths, and without these tables."""
    new = {path: f"{_key(path[-1])} = {value}\n" for path, value in keys.items()}
    return _spliced(list(_entries(text, file)), new, {}, set(without), file)


def copied_effects(effects: Iterable[Effect], out: Path) -> dict[KeyPath, str]:
    """Copy the files of those `effects` that are not the package's into a folder beside the vehicle file `out`.

    Gives the key for `with_keys` that names the folder; nothing if all are the package's.
    """
    own = [file for file in (effect.file for effect in effects) if file.resolve().parent != PACKAGE_EFFECTS]
    if not own:
        return {}
    folder = out.with_name(f"{out.stem}_effects")
    folder.mkdir(exist_ok=True)
    for file in own:
        if file.resolve().parent != folder.resolve():
            shutil.copyfile(file, folder / file.name)
    return {("model", "effects_folder"): string(folder.name)}


def _check(parameters: Mapping[str, Found], curves: Mapping[str, Curve], base: Path) -> None:
    """InputError if the file could not be read again, naming what was found."""
    declared = declared_parameters()
    for name, found in parameters.items():
        if (known := declared.get(name)) is None:
            continue  # of a user's own effect; reading the file checks it
        value = _rounded(found.value)
        if found.unit != known.unit:
            raise InputError(f"{base}: {name}: was found in {found.unit}, but is in {known.unit}")
        if not known.low <= value <= known.high:
            raise InputError(
                f"{base}: {name}: {value:g} {known.unit} was found, outside {known.low:g} to {known.high:g}"
                f" {known.unit}; {found.source}"
            )
        if not (np.isfinite(found.sd) and found.sd >= 0):
            raise InputError(f"{base}: {name}: its standard deviation came out as {found.sd:g} {known.unit}")
    for name, curve in curves.items():
        shape = tuple(len(axis) for axis in reversed(curve.axes.values()))
        if curve.value.shape != shape or not np.all(np.isfinite(curve.value)):
            raise InputError(f"{base}: {name}: must be {shape} finite numbers, is {curve.value.shape}")


# --- values -------------------------------------------------------------------------------------------------------


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}") + 0.0  # no negative zero


def number(value: float) -> str:
    """A TOML float."""
    return repr(_rounded(value))


def string(text: str) -> str:
    """A TOML basic string on one line."""
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c >= " " and c != "\x7f" else f"\\u{ord(c):04x}" for c in escaped) + '"'


def _row(values: Iterable[float]) -> str:
    return "[" + ", ".join(number(float(v)) for v in values) + "]"


def _parameter(found: Found) -> str:
    return (
        f"{{ value = {number(found.value)}, unit = {string(found.unit)}, sd = {number(found.sd)}, "
        f'status = "measured", source = {string(found.source)} }}'
    )


def _curve(name: str, curve: Curve) -> str:
    """The table of `curve`: axes, value, unit, sd (one number for all of it: the median) and source."""
    lines = [f"[{name}]"]
    lines += [f"{axis} = {_row(values)}" for axis, values in curve.axes.items()]
    if curve.value.ndim == 1:
        lines.append(f"value = {_row(curve.value)}")
    else:
        lines += ["value = [", *(f"  {_row(row)}," for row in curve.value), "]"]
    lines.append(f"unit = {string(curve.unit)}")
    known = np.isfinite(curve.sd)
    if known.any() and curve.unit == "V":
        lines.append(f"sd = {number(float(np.median(curve.sd[known])))}")
    elif known.any():
        lines.append(f"sd_relative = {number(float(np.median(curve.sd[known] / np.abs(curve.value[known]))))}")
    lines += ['status = "measured"', f"source = {string(curve.source)}"]
    if not known.all():
        lines.append(f"# Not measured, the shape of what was: {_unmeasured(curve)}.")
    return "\n".join(lines) + "\n"


def _unmeasured(curve: Curve) -> str:
    """In words, where a curve has no data."""
    names = list(curve.axes)
    inner = curve.axes[names[0]]
    rows: list[tuple[str, Array]] = [("", curve.sd)]
    if curve.sd.ndim == 2:
        outer = curve.axes[names[1]]
        rows = [(f" at {names[1]} {outer[i]:g}", curve.sd[i]) for i in range(len(outer))]
    parts = []
    for where, sd in rows:
        missing = ~np.isfinite(sd)
        if missing.all():
            parts.append(f"all{where}")
        elif missing.any():
            edges = np.flatnonzero(np.diff(np.concatenate([[0], missing.astype(int), [0]])))
            spans = [
                f"{inner[a]:g}" if b - a == 1 else f"{inner[a]:g} to {inner[b - 1]:g}"
                for a, b in list(pairwise(edges))[::2]
            ]
            parts.append(f"{names[0]} {', '.join(spans)}{where}")
    return "; ".join(parts)


# --- correlations -------------------------------------------------------------------------------------------------


def _correlations(
    document: Mapping[str, Any], results: Sequence[Result], found: set[str], base: Path
) -> dict[str, str]:
    """The groups of correlated parameters, by name: those found, and what is left of the base file's."""
    groups: dict[str, tuple[list[str], Array, str]] = {}
    for name, group in document.get("correlation", {}).items():
        kept = [i for i, parameter in enumerate(group["parameters"]) if parameter not in found]
        if len(kept) > 1:
            matrix = np.array(group["value"], dtype=float)[np.ix_(kept, kept)]
            groups[name] = ([group["parameters"][i] for i in kept], matrix, group.get("source", ""))
    last = {name: i for i, result in enumerate(results) for name in result.parameters}
    for i, result in enumerate(results):
        for number_, (names, covariance) in enumerate(result.covariance):
            for name in names:
                if name not in last:
                    raise InputError(f"{base}: {result.procedure}: a covariance of {name}, which was not found")
            kept = [k for k, name in enumerate(names) if last[name] <= i]  # a later procedure knows better
            if len(kept) < 2:
                continue
            key = result.procedure if number_ == 0 else f"{result.procedure}_{number_ + 1}"
            matrix = correlation(np.asarray(covariance)[np.ix_(kept, kept)])
            groups[key] = ([names[k] for k in kept], matrix, f"of {result.procedure}")
    return {name: _group(name, *group) for name, group in groups.items()}


def correlation(covariance: Array) -> Array:
    """The correlation of a covariance, exactly symmetric; nothing is correlated with what has no spread."""
    sd = np.sqrt(np.diag(covariance))
    scale = np.where(sd > 0, sd, np.inf)
    matrix = np.clip(covariance / np.outer(scale, scale), -1.0, 1.0)
    matrix = (matrix + matrix.T) / 2
    np.fill_diagonal(matrix, 1.0)
    result: Array = matrix
    return result


def _group(name: str, parameters: list[str], matrix: Array, source: str) -> str:
    lines = [f"[correlation.{_key(name)}]", f"parameters = [{', '.join(map(string, parameters))}]", "value = ["]
    lines += [f"  {_row(row)}," for row in matrix]
    lines += ["]", *([f"source = {string(source)}"] if source else [])]
    return "\n".join(lines) + "\n"


def _key(name: str) -> str:
    return name if _BARE.fullmatch(name) else string(name)


# --- paths --------------------------------------------------------------------------------------------------------


def _moved(document: Mapping[str, Any], base: Path, out: Path) -> dict[KeyPath, str]:
    """The keys that name files beside `base`, as seen from `out`."""
    here, there = base.resolve().parent, out.resolve().parent
    if here == there:
        return {}
    moved: dict[KeyPath, str] = {}

    def seen(name: str) -> str:
        return Path(os.path.relpath(here / name, there)).as_posix() if (here / name).exists() else name

    names = document.get("dbc", [])
    if isinstance(names, list) and all(isinstance(n, str) for n in names) and [seen(n) for n in names] != names:
        moved["dbc",] = f"dbc = [{', '.join(string(seen(name)) for name in names)}]\n"
    return moved


# --- text ---------------------------------------------------------------------------------------------------------


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
        key = next(iter(value))
        path.append(key)
        value = value[key]
    return tuple(path)


def _starts(path: KeyPath, begin: KeyPath) -> bool:
    return path[: len(begin)] == begin


def _spliced(
    entries: list[_Entry], new: Mapping[KeyPath, str], tables: Mapping[KeyPath, str], dropped: set[KeyPath], file: Path
) -> str:
    """The text of `entries` with the keys `new` and the tables `tables` in place of theirs, and without `dropped`."""
    gone = dropped | set(tables)
    out: list[str] = []
    written: set[KeyPath] = set()
    ends: dict[KeyPath, int] = {}  # of each table the place after its last key
    inside: KeyPath = ()
    away = False  # within a table that goes
    for entry in entries:
        if entry.kind == "comment":
            if not away or not entry.text.strip().startswith("# Not measured, the shape of what was:"):
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
        out += ["\n", f"[{'.'.join(map(_key, table))}]\n", *keys]
    for path, text in tables.items():
        if path not in written:
            out += ["\n", text]
    return re.sub(r"\n{3,}", "\n\n", "".join(out)).rstrip("\n") + "\n"
