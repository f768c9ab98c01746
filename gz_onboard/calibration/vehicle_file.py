"""Writes what calibration found into a vehicle file: what was not found stays as the base file has it, comments too."""

from __future__ import annotations

import os
import re
import shutil
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.calibration import toml_text
from gz_onboard.calibration.fit import correlation
from gz_onboard.calibration.result import Curve, Found, Result
from gz_onboard.calibration.toml_text import KeyPath, number, spliced, string, with_keys
from gz_onboard.errors import InputError, not_an_input
from gz_onboard.model.effect import BASE_EFFECTS, PACKAGE_EFFECTS, Effect
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.vehicle import Vehicle, read_vehicle

_MADE_BY = re.compile("^# Made by: .*\n", re.MULTILINE)


def vehicle_output(out: Path, inputs: Sequence[Path], option: str = "") -> None:
    """InputError if a vehicle file is not to be written as `out`. option: what stands before its name."""
    if out.suffix != ".toml":
        raise InputError(f"{option}{out}: a vehicle file is a .toml")
    not_an_input([out], inputs)


def write_vehicle(base: Path, results: Sequence[Result], out: Path) -> Vehicle:
    """Write the vehicle file `base` with what `results` found to `out`, as `write_whole`. InputError, OSError."""
    text = merged(base.read_text(encoding="utf-8"), results, base, out)
    if base.resolve().parent != out.resolve().parent:
        text = with_keys(text, copied_effects(read_vehicle(base).model.effects, out), out)
    return write_whole(out, text, "gz-onboard calibrate")


def write_whole(out: Path, text: str, maker: str) -> Vehicle:
    """Write the vehicle file `out`, whole or not at all, its first line naming its `maker`, and give it as read back.

    Raises OSError, and InputError for a text that is no vehicle file: then what stood at `out` stays.
    """
    if not text.startswith(head := f"# Made by: {maker}"):
        text = f"{head}\n{_MADE_BY.sub('', text)}"
    temporary = out.with_name(out.name + ".new")
    temporary.write_text(text, encoding="utf-8", errors="replace")
    try:
        vehicle = read_vehicle(temporary)
    except InputError as error:
        raise InputError(
            f"{str(error).replace(str(temporary), str(out))}; that was found, so the file is not written"
        ) from error
    else:
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)
    return replace(vehicle, file=out)


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
        **_effects(document, results),
    }
    tables: dict[KeyPath, str] = {
        **{tuple(name.split(".")): _curve(name, curve) for name, curve in curves.items()},
        **{("correlation", name): group for name, group in groups.items()},
    }
    dropped: set[KeyPath] = {("correlation", name) for name in document.get("correlation", {})}
    if "battery.ocv" in curves:
        dropped.add(("battery", "rest_shift"))  # which is that of the curve before
    return spliced(text, new, tables, dropped, base)


def _effects(document: Mapping[str, Any], results: Sequence[Result]) -> dict[KeyPath, str]:
    """The model's effects with those that the data show and without those that they do not; nothing if they stay."""
    listed = list(document.get("model", {}).get("effects", BASE_EFFECTS))
    looked_for = {name: seen for result in results for name, seen in result.effects.items()}
    new = [name for name in listed if looked_for.get(name, True)]
    new += [name for name, seen in looked_for.items() if seen and name not in new]
    if new == listed:
        return {}
    lines = "".join(f"    {string(name)},\n" for name in new)
    return {("model", "effects"): f"effects = [\n{lines}]\n"}


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
        value = toml_text.rounded(found.value)
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


def _parameter(found: Found) -> str:
    return (
        f"{{ value = {number(found.value)}, unit = {string(found.unit)}, sd = {number(found.sd)}, "
        f'status = "measured", source = {string(found.source)} }}'
    )


def _curve(name: str, curve: Curve) -> str:
    """The table of `curve`: axes, value, unit, sd (one number for all of it: the median) and source."""
    lines = [f"[{name}]"]
    lines += [f"{axis} = {toml_text.row(values)}" for axis, values in curve.axes.items()]
    if curve.value.ndim == 1:
        lines.append(f"value = {toml_text.row(curve.value)}")
    else:
        lines += ["value = [", *(f"  {toml_text.row(row)}," for row in curve.value), "]"]
    lines.append(f"unit = {string(curve.unit)}")
    known = np.isfinite(curve.sd)
    if known.any() and curve.unit in ("V", "V/K"):
        lines.append(f"sd = {number(float(np.median(curve.sd[known])))}")
    elif known.any():
        lines.append(f"sd_relative = {number(float(np.median(curve.sd[known] / np.abs(curve.value[known]))))}")
    lines += ['status = "measured"', f"source = {string(curve.source)}"]
    if not known.all():
        lines.append(f"{toml_text.UNMEASURED} {_unmeasured(curve)}.")
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
        for place, (names, covariance) in enumerate(result.covariance):
            for name in names:
                if name not in last:
                    raise InputError(f"{base}: {result.procedure}: a covariance of {name}, which was not found")
            kept = [k for k, name in enumerate(names) if last[name] <= i]  # a later procedure knows better
            if len(kept) < 2:
                continue
            key = result.procedure if place == 0 else f"{result.procedure}_{place + 1}"
            matrix = correlation(np.asarray(covariance)[np.ix_(kept, kept)])
            groups[key] = ([names[k] for k in kept], matrix, f"of {result.procedure}")
    return {name: _group(name, *group) for name, group in groups.items()}


def _group(name: str, parameters: list[str], matrix: Array, source: str) -> str:
    lines = [
        f"[correlation.{toml_text.key(name)}]",
        f"parameters = [{', '.join(map(string, parameters))}]",
        "value = [",
    ]
    lines += [f"  {toml_text.row(row)}," for row in matrix]
    lines += ["]", *([f"source = {string(source)}"] if source else [])]
    return "\n".join(lines) + "\n"


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
