"""Write calibrated values into a vehicle file; everything else in it stays, comments too."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from tomlkit import TOMLDocument
from tomlkit.items import Array as TomlArray
from tomlkit.items import InlineTable, Item, Table

from gz_onboard.arrays import Array
from gz_onboard.calibration.fit import correlation
from gz_onboard.calibration.result import Curve, Found, Result
from gz_onboard.errors import InputError, not_an_input
from gz_onboard.model.effect import BASE_EFFECTS, PACKAGE_EFFECTS, Effect
from gz_onboard.model.parameters import declared_parameters
from gz_onboard.vehicle import Vehicle, read_vehicle

Keys = Mapping[tuple[str, ...], object]  # new values by their path in the file; a dict becomes a table
_MADE_BY = re.compile("^# Made by: .*\n", re.MULTILINE)


def vehicle_output(out: Path, inputs: Sequence[Path], option: str = "") -> None:
    """InputError if `out` cannot be written: not a .toml, or one of `inputs`. option: precedes it in the message."""
    if out.suffix != ".toml":
        raise InputError(f"{option}{out}: a vehicle file is a .toml")
    not_an_input([out], inputs)


def write_vehicle(
    base: Path, results: Sequence[Result], out: Path, maker: str = "gz-onboard calibrate", keys: Keys | None = None
) -> Vehicle:
    """Write the vehicle file `base`, updated with `results` and `keys`, to `out`; return the vehicle as read back.

    The file is written whole or not at all; its first line names the `maker`. Without `keys`, effect files that the
    user wrote are copied if `out` is in another folder. Raises OSError, and InputError for values that no vehicle
    file can hold.
    """
    text = merged(base.read_text(encoding="utf-8"), results, base, out)
    if keys is None and base.resolve().parent != out.resolve().parent:
        keys = copied_effects(read_vehicle(base).model.effects, out)
    if keys:
        document = tomlkit.parse(text)
        _set_all(document, keys)
        text = tomlkit.dumps(document)
    if not text.startswith(head := f"# Made by: {maker}"):
        text = f"{head}\n{_MADE_BY.sub('', text)}"
    temporary = out.with_name(out.name + ".new")
    temporary.write_text(text, encoding="utf-8", errors="replace")
    try:
        vehicle = read_vehicle(temporary)
    except InputError as error:
        message = str(error).replace(str(temporary), str(out))
        raise InputError(f"{message}; this value was found, so the file is not written") from error
    else:
        temporary.replace(out)
    finally:
        temporary.unlink(missing_ok=True)
    return replace(vehicle, file=out)


def merged(text: str, results: Sequence[Result], base: Path, out: Path) -> str:
    """Return the `text` of the vehicle file `base` with `results` in it, to be written to `out`.

    A later result overrides an earlier one. Numbers have 6 significant digits. Paths to DBC files next to `base` are
    rewritten as seen from `out`. Raises InputError for values that the file cannot hold.
    """
    document = tomlkit.parse(text)
    parameters = {name: found for result in results for name, found in result.parameters.items()}
    curves = {name: curve for result in results for name, curve in result.curves.items()}
    order = list(declared_parameters())
    groups = _correlations(document.get("correlation", {}), results, set(parameters), base)
    for name in [name for name in document.get("correlation", {}) if name not in groups]:
        del document["correlation"][name]
    if "battery.ocv" in curves and "battery" in document:
        document["battery"].pop("rest_shift", None)  # it belongs to the previous curve
    new: dict[tuple[str, ...], object] = {
        ("parameters", name): _parameter(parameters[name])
        for name in sorted(parameters, key=lambda name: order.index(name) if name in order else len(order))
    }
    new |= _dbc_paths(document, base, out) | _effects(document, results)
    new |= {tuple(name.split(".")): _curve(curve) for name, curve in curves.items()}
    new |= {("correlation", name): group for name, group in groups.items()}
    _set_all(document, new)
    return tomlkit.dumps(document).rstrip("\n") + "\n"


def copied_effects(effects: Iterable[Effect], out: Path) -> dict[tuple[str, ...], object]:
    """Copy the user's own effect files into a folder next to the vehicle file `out`; return the key that names it.

    Returns nothing if all `effects` belong to the package.
    """
    user_files = [file for file in (effect.file for effect in effects) if file.resolve().parent != PACKAGE_EFFECTS]
    if not user_files:
        return {}
    folder = out.with_name(f"{out.stem}_effects")
    folder.mkdir(exist_ok=True)
    for file in user_files:
        if file.resolve().parent != folder.resolve():
            shutil.copyfile(file, folder / file.name)
    return {("model", "effects_folder"): folder.name}


# --- editing ------------------------------------------------------------------------------------------------------


def _set_all(document: TOMLDocument, keys: Keys) -> None:
    """Put `keys` into `document`, creating the tables on the way."""
    for path, value in keys.items():
        table: Any = document
        for name in path[:-1]:
            if name not in table:
                table[name] = tomlkit.table(is_super_table=isinstance(value, dict) and not isinstance(value, Item))
            table = table[name]
        _set(table, path[-1], value)


def _set(table: Any, key: str, value: object) -> None:
    """Set `key` of `table`, in place if it is there, otherwise before the comments that end the table."""
    old = table.get(key)
    if isinstance(value, dict) and isinstance(old, dict) and not isinstance(old, InlineTable):
        for name in [name for name in old if name not in value]:
            del old[name]
        for name, one in value.items():
            _set(old, name, one)
    elif old is not None:
        table[key] = value
    else:
        body = table.value.body if isinstance(table, Table) else []
        tail: list[Any] = []  # comments before the next table's header
        while body and body[-1][0] is None:
            tail.insert(0, body.pop())
        if isinstance(value, dict) and not isinstance(value, Item):
            new = tomlkit.table()
            for name, one in value.items():
                new.add(name, one)
            table[key] = new.add(tomlkit.nl())
        else:
            table[key] = value
        body.extend(tail)


def _rounded(value: float) -> float:
    return float(f"{value:.6g}") + 0.0  # no negative zero


def _row(values: Iterable[float]) -> list[float]:
    return [_rounded(float(v)) for v in values]


def _rows(matrix: Array) -> TomlArray:
    """The array of `matrix`, one line for each row."""
    array = tomlkit.array()
    for row in matrix:
        array.add_line(_row(row), indent="  ")
    array.add_line(indent="")
    return array


# --- values -------------------------------------------------------------------------------------------------------


def _parameter(found: Found) -> Item:
    pairs = {"value": _rounded(found.value), "unit": found.unit, "sd": _rounded(found.sd), "status": "measured"}
    pairs["source"] = found.source
    return tomlkit.value(f"{{ {', '.join(f'{k} = {tomlkit.item(v).as_string()}' for k, v in pairs.items())} }}")


def _curve(curve: Curve) -> dict[str, object]:
    """The table of `curve`: axes, values, unit, median standard deviation, source."""
    known = np.isfinite(curve.sd)
    sd = {}
    if known.any() and curve.unit in ("V", "V/K"):
        sd["sd"] = _rounded(float(np.median(curve.sd[known])))
    elif known.any():
        sd["sd_relative"] = _rounded(float(np.median(curve.sd[known] / np.abs(curve.value[known]))))
    source = curve.source if known.all() else f"{curve.source}; not measured but extrapolated: {_unmeasured(curve)}"
    return {
        **{axis: _row(values) for axis, values in curve.axes.items()},
        "value": _row(curve.value) if curve.value.ndim == 1 else _rows(curve.value),
        "unit": curve.unit,
        **sd,
        "status": "measured",
        "source": source,
    }


def _unmeasured(curve: Curve) -> str:
    """Say where `curve` has no data, such as "soc 0 to 0.1 at temperature -10"."""
    (inner, nodes), *outer = curve.axes.items()
    parts = []
    for i, sd in enumerate(np.atleast_2d(curve.sd)):
        known = zip(nodes.tolist(), np.isfinite(sd).tolist(), strict=True)
        runs = [[node for node, _ in run] for there, run in groupby(known, itemgetter(1)) if not there]
        spans = [f"{run[0]:g}" + (f" to {run[-1]:g}" if len(run) > 1 else "") for run in runs]
        if spans:
            parts.append(f"{inner} {', '.join(spans)}" + "".join(f" at {name} {at[i]:g}" for name, at in outer))
    return "; ".join(parts)


def _effects(document: TOMLDocument, results: Sequence[Result]) -> dict[tuple[str, ...], object]:
    """The model's effects, with those that the data show and without those that they do not; nothing if unchanged."""
    listed = list(document.get("model", {}).get("effects", BASE_EFFECTS))
    looked_for = {name: seen for result in results for name, seen in result.effects.items()}
    new = [name for name in listed if looked_for.get(name, True)]
    new += [name for name, seen in looked_for.items() if seen and name not in new]
    return {("model", "effects"): tomlkit.item(new).multiline(True)} if new != listed else {}


def _correlations(
    old: Mapping[str, Any], results: Sequence[Result], found: set[str], base: Path
) -> dict[str, dict[str, object]]:
    """The groups of correlated parameters, by name: those in `results`, and those of `old` that still hold."""
    groups: dict[str, dict[str, object]] = {}
    for name, group in old.items():
        kept = [i for i, parameter in enumerate(group["parameters"]) if parameter not in found]
        if len(kept) > 1:
            matrix = np.array(group["value"], dtype=float)[np.ix_(kept, kept)]
            source = {"source": group["source"]} if "source" in group else {}
            groups[name] = {"parameters": [group["parameters"][i] for i in kept], "value": _rows(matrix), **source}
    last = {name: i for i, result in enumerate(results) for name in result.parameters}
    for i, result in enumerate(results):
        for place, (names, covariance) in enumerate(result.covariance):
            for name in names:
                if name not in last:
                    raise InputError(f"{base}: {result.procedure}: a covariance of {name}, which was not found")
            kept = [k for k, name in enumerate(names) if last[name] <= i]  # a later procedure knows better
            if len(kept) > 1:
                groups[result.procedure if place == 0 else f"{result.procedure}_{place + 1}"] = {
                    "parameters": [names[k] for k in kept],
                    "value": _rows(correlation(np.asarray(covariance)[np.ix_(kept, kept)])),
                    "source": f"of {result.procedure}",
                }
    return groups


def _dbc_paths(document: TOMLDocument, base: Path, out: Path) -> dict[tuple[str, ...], object]:
    """The DBC files next to `base`, as seen from `out`."""
    here, there = base.resolve().parent, out.resolve().parent
    names = document.get("dbc", [])
    new = [Path(os.path.relpath(here / n, there)).as_posix() if (here / n).exists() else n for n in names]
    return {("dbc",): new} if here != there and new != list(names) else {}
