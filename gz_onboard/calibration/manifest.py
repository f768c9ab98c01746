"""``calibration.toml``: which file is for which procedure of a calibration.

    schema = 1
    vehicle = "scooter.toml"               # what is known without measuring; or one of the package's own

    [ocv]
    data = ["cell_ocv_25C.csv.gz"]

    [pulse]
    data = ["cell_pulse_0C.csv.gz", "cell_pulse_25C.csv.gz"]
    held_out = ["cell_road_profile_25C.csv"]
    columns = { time = "t_s", voltage = "v_V", current = { column = "i_A", scale = -1 } }

    [cooling]
    data = ["closed_room.csv", "dyno.blf"]
    airflow = { "dyno.blf" = "none" }      # it had no fan; "wheel": as fast as the wheel turns; or m/s

Paths are from the manifest's folder. ``SLOT_columns`` is for the tables of one key only, such as ``held_out_columns``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gz_onboard.calibration.table import Named, read_columns
from gz_onboard.errors import InputError, nearest
from gz_onboard.toml import LONGEST_LIST, Table
from gz_onboard.vehicle import find_vehicle

NAME = "calibration.toml"
LEAST, MOST = 1e-6, 1e6  # a number that is an option of a procedure
_OWN = ("schema", "vehicle", "source")

ByFile = Mapping[str, float | str]
"""Of each file of a procedure, by its name: a number, or one of a few words."""
Option = float | str | ByFile
AIRFLOWS = {"none": 0.0, "wheel": 1.0}
"""What moves past the vehicle, over the wheel's speed: no air in a closed room; air when riding or with a fan that
follows the roller."""
FASTEST_AIR = 100.0  # m/s


@dataclass(frozen=True)
class Slot:
    """What a procedure is given by one key of the manifest.

    kind: "table", "ride", or "any": CSV and Parquet are tables then. least: of files, 0 for a slot that may be left
    out. most: None for any number.
    """

    kind: str
    what: str
    least: int = 0
    most: int | None = None


@dataclass(frozen=True)
class Step:
    """One procedure with its files by slot, names of columns by slot, and options."""

    procedure: str
    files: dict[str, tuple[Path, ...]]
    columns: dict[str, dict[str, Named]] = field(default_factory=dict)
    options: dict[str, Option] = field(default_factory=dict)


def read_manifest(
    folder: Path, slots: Mapping[str, Mapping[str, Slot]], options: Mapping[str, Mapping[str, Option]]
) -> tuple[Path, list[Step]]:
    """(vehicle file, steps in the order of `slots`) of the manifest in `folder` (or of that file itself).

    slots, options: of each procedure, by name; options with their defaults. Raises InputError naming file and line.
    """
    file = folder / NAME if folder.is_dir() else folder
    if not file.is_file():
        raise InputError(f"{file}: no such file; `calibrate all` takes a folder with a manifest {NAME}")
    table = Table.read(file)
    table.only([*_OWN, *slots])
    if table.number("schema") != 1:
        raise table.error(f"is {table.values['schema']}; this version reads 1", "schema")
    steps = [
        _step(table.table(name), name, slots[name], options.get(name, {})) for name in slots if name in table.values
    ]
    if not steps:
        raise table.error(f"names no procedure; there are {', '.join(slots)}")
    try:
        return find_vehicle(table.check_path("vehicle", table.text("vehicle", "reference")), folder=file.parent), steps
    except InputError as error:
        raise table.error(str(error), "vehicle") from error


def _step(table: Table, name: str, slots: Mapping[str, Slot], options: Mapping[str, Option]) -> Step:
    table.only([*slots, *options, "columns", *(f"{slot}_columns" for slot in slots)])
    files = {slot: _files(table, slot) for slot in slots if slot in table.values}
    fitted, held = ({file.resolve() for file in files.get(slot, ())} for slot in ("data", "held_out"))
    if both := fitted & held:
        name_of = min(file.name for file in both)
        raise table.error(f"names {name_of}, which is in data too: what was fitted is not held out", "held_out")
    for slot, needed in slots.items():
        try:
            check_count(name, slot, needed, len(files.get(slot, ())))
        except InputError as error:
            raise table.error(str(error), slot if slot in files else "") from error
    columns = {}
    for slot in files:
        own = f"{slot}_columns"
        if named := read_columns(table.table(own if own in table.values else "columns")):
            columns[slot] = named
    return Step(
        name, files, columns, _options(table, options, [file.name for group in files.values() for file in group])
    )


def check_count(procedure: str, slot: str, needed: Slot, count: int) -> None:
    """InputError if a slot is given too few or too many files."""
    if count < needed.least:
        raise InputError(f"{procedure} needs {needed.what} ({slot}: {needed.least} or more), has {count}")
    if needed.most is not None and count > needed.most:
        raise InputError(f"{procedure} takes {needed.most} for {slot} ({needed.what}), has {count}")


def _files(table: Table, slot: str) -> tuple[Path, ...]:
    value = table.values[slot]
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise table.error("must be the name of a file, or a list of them", slot)
    if len(names) > LONGEST_LIST:
        raise table.error(f"names {len(names)} files, the most are {LONGEST_LIST}", slot)
    folder = table.file.parent
    for i, name in enumerate(names):
        table.check_path(slot, name)
        if not (folder / name).is_file():
            there = sorted(p.name for p in (folder / name).parent.glob("*")) if (folder / name).parent.is_dir() else []
            raise table.error(f"no file {folder / name}{nearest(Path(name).name, there)}", slot)
        if name in names[:i]:
            raise table.error(f"names {name} twice", slot)
    return tuple(folder / name for name in names)


def _options(table: Table, options: Mapping[str, Option], files: Sequence[str]) -> dict[str, Option]:
    found: dict[str, Option] = {}
    for key, default in options.items():
        if key not in table.values:
            continue
        if isinstance(default, str):
            found[key] = table.text(key)
        elif isinstance(default, Mapping):
            found[key] = _airflows(table.table(key), files)
        else:
            found[key] = table.number(key, low=LEAST, high=MOST)
    return found


def _airflows(table: Table, files: Sequence[str]) -> ByFile:
    """Of the `files` that the table names, one of `AIRFLOWS` or a speed [m/s]."""
    table.only(files)
    return {
        name: table.text(name, choices=AIRFLOWS) if isinstance(value, str) else table.number(name, None, 0, FASTEST_AIR)
        for name, value in table.values.items()
    }
