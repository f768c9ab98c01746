"""The steps of a calibration: procedures with their files, and how they run one after another.

A step comes from a command line (`step_of`) or from a manifest ``calibration.toml``:

    schema = 1
    vehicle = "scooter.toml"               # known without measuring; or one of the package's own

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

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from math import hypot
from pathlib import Path

import numpy as np

from gz_onboard.calibration.cooling import AIRFLOWS
from gz_onboard.calibration.procedures import PROCEDURES, Given, Option
from gz_onboard.calibration.result import LackingError, Result
from gz_onboard.calibration.table import Named, read_columns, read_table
from gz_onboard.calibration.vehicle_file import write_vehicle
from gz_onboard.errors import InputError, near_file, nearest, shown
from gz_onboard.model.effect import load_effect
from gz_onboard.priors import FAR, overrun, stop_at
from gz_onboard.recording.logs import logs_among
from gz_onboard.recording.recording import Recording, read_recording
from gz_onboard.toml import LONGEST_LIST, Table
from gz_onboard.vehicle import Vehicle, find_vehicle, read_vehicle

MANIFEST = "calibration.toml"
OPTION_RANGE = 1e-6, 1e6
AIRFLOW, FASTEST_AIR = "airflow", 100.0  # m/s


@dataclass(frozen=True)
class Step:
    """One procedure with its files by slot, names of columns by slot, and options."""

    procedure: str
    files: dict[str, tuple[Path, ...]]
    columns: dict[str, dict[str, Named]] = field(default_factory=dict)
    options: dict[str, Option] = field(default_factory=dict)


def requested(
    procedure: str, files: Mapping[str, Sequence[Path]], options: Sequence[str], vehicle: str | Path | None
) -> tuple[Path, list[Step]]:
    """(vehicle file to start from, steps) of a `procedure` with its files by slot, or of the manifest for ``all``.

    options: each as NAME=VALUE. vehicle: to start from, ``reference`` or that of the manifest if None. InputError for
    an unknown procedure, slot or option, and for missing files.
    """
    if procedure == "all":
        if options or files.keys() - {"data"}:
            raise InputError("all takes its data and options from the manifest, from nowhere else")
        return read_manifest(files.get("data", []), vehicle)
    if procedure not in PROCEDURES:
        known = ["all", *PROCEDURES]
        raise InputError(
            f"no procedure is called {procedure!r}{nearest(procedure, known)}; there are {', '.join(known)}"
        )
    return find_vehicle(vehicle or "reference"), [step_of(procedure, files, options)]


def files_of(steps: Sequence[Step], data: Sequence[Path]) -> list[Path]:
    """The files that `steps` read, and the manifest in a folder given as `data`."""
    read = [file for step in steps for files in step.files.values() for file in files]
    return [*read, *data, *(folder / MANIFEST for folder in data)]


def _checked(option: str, value: object, error: Callable[[str], InputError]) -> float | str:
    """The `value` of an option, a number or one of `AIRFLOWS`. error: makes the error to raise."""
    if option == AIRFLOW and isinstance(value, str) and value in AIRFLOWS:
        return value
    low, high = (0.0, FASTEST_AIR) if option == AIRFLOW else OPTION_RANGE
    if isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high:
        return float(value)
    words = f" or one of {', '.join(AIRFLOWS)}" if option == AIRFLOW else ""
    raise error(f"must be a number from {low:g} to {high:g}{words}, is {shown(value)}")


def _wrong_files(name: str, files: Mapping[str, Sequence[Path]]) -> tuple[str, str] | None:
    """(slot, why) of files by slot that the procedure `name` cannot take; None if it can."""
    for slot, needed in PROCEDURES[name].slots.items():
        count = len(files.get(slot, ()))
        if count < needed.min_files:
            return slot, f"{name} needs {needed.what} ({slot}: {needed.min_files} or more), has {count}"
        if needed.max_files is not None and count > needed.max_files:
            return slot, f"{name} takes {needed.max_files} for {slot} ({needed.what}), has {count}"
    fitted, held = ({file.resolve() for file in files.get(slot, ())} for slot in ("data", "held_out"))
    for file in sorted(fitted & held):
        return "held_out", f"names {file.name}, which is in data too: a file cannot be both fitted and held out"
    return None


# --- from a command line ------------------------------------------------------------------------------------------


def step_of(name: str, files: Mapping[str, Sequence[Path]], options: Sequence[str] = ()) -> Step:
    """Make a step of the procedure `name` and its files by slot; for rides also folders of logs.

    options: each as NAME=VALUE. InputError for missing files, unknown slots and options.
    """
    values: dict[str, Option] = dict(_option(text, name) for text in options)
    slots, found = PROCEDURES[name].slots, {slot: list(group) for slot, group in files.items()}
    for slot, group in found.items():
        if slot not in slots:
            raise InputError(
                f"--with {slot}={', '.join(map(str, group[:1]))}: {name} has no data {slot!r}{nearest(slot, slots)}; "
                f"there are {', '.join(slots)}"
            )
        if slots[slot].kind != "table":
            found[slot] = logs_among(group)
    if wrong := _wrong_files(name, found):
        raise InputError(f"--with held_out {wrong[1]}" if wrong[0] == "held_out" else wrong[1])
    for file in (file for group in found.values() for file in group):
        if not file.is_file():
            what = "is a folder; give the files in it" if file.is_dir() else f"no such file{near_file(file)}"
            raise InputError(f"{file}: {what}")
    return Step(name, {slot: tuple(group) for slot, group in found.items()}, {}, values)


def _option(text: str, procedure: str) -> tuple[str, Option]:
    name, _, value = text.partition("=")
    options = PROCEDURES[procedure].options
    if name not in options:
        known = ", ".join(options) or "none"
        raise InputError(f"--set {text}: no option {name!r}{nearest(name, options)}; there are {known}")
    number: float | str = value
    with suppress(ValueError):
        number = float(value)
    return name, _checked(name, number, lambda why: InputError(f"--set {text}: {why}"))


# --- from a manifest ----------------------------------------------------------------------------------------------


def read_manifest(data: Sequence[Path], vehicle: str | Path | None = None) -> tuple[Path, list[Step]]:
    """(vehicle file to start from, steps in the order of `PROCEDURES`) of the manifest in the one folder of `data`.

    vehicle: in place of the manifest's. Raises InputError naming file and line.
    """
    if len(data) != 1:
        raise InputError("all takes one folder (or its manifest), which names the files in it")
    file = data[0] / MANIFEST if data[0].is_dir() else data[0]
    if not file.is_file():
        raise InputError(f"{file}: no such file; `calibrate all` takes a folder with a manifest {MANIFEST}")
    table = Table.read(file)
    table.only(["schema", "vehicle", "source", *PROCEDURES])
    if table.number("schema") != 1:
        raise table.error(f"is {table.values['schema']}; this version reads 1", "schema")
    steps = [_manifest_step(table.table(name), name) for name in PROCEDURES if name in table.values]
    if not steps:
        raise table.error(f"names no procedure; there are {', '.join(PROCEDURES)}")
    try:
        named = find_vehicle(table.check_path("vehicle", table.text("vehicle", "reference")), folder=file.parent)
    except InputError as error:
        raise table.error(str(error), "vehicle") from error
    return find_vehicle(vehicle) if vehicle else named, steps


def _manifest_step(table: Table, name: str) -> Step:
    slots, defaults = PROCEDURES[name].slots, PROCEDURES[name].options
    table.only([*slots, *defaults, "columns", *(f"{slot}_columns" for slot in slots)])
    files = {slot: _files(table, slot) for slot in slots if slot in table.values}
    if wrong := _wrong_files(name, files):
        slot, why = wrong
        raise table.error(why, slot if slot in files else "")
    columns: dict[str, dict[str, Named]] = {}
    options: dict[str, Option] = {}
    for slot in files:
        key = f"{slot}_columns"
        if named := read_columns(table.table(key if key in table.values else "columns")):
            columns[slot] = named
    for key in (key for key in defaults if key in table.values):
        value = table.values[key]
        if key == AIRFLOW and isinstance(value, Mapping):
            runs = table.table(key)
            runs.only([file.name for group in files.values() for file in group])
            options[key] = {name: _checked(key, air, partial(runs.error, key=name)) for name, air in value.items()}
        else:
            options[key] = _checked(key, value, partial(table.error, key=key))
    return Step(name, files, columns, options)


def _files(table: Table, slot: str) -> tuple[Path, ...]:
    value, folder = table.values[slot], table.file.parent
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise table.error("must be the name of a file, or a list of them", slot)
    if len(names) > LONGEST_LIST:
        raise table.error(f"names {len(names)} files, the most are {LONGEST_LIST}", slot)
    for i, name in enumerate(names):
        table.check_path(slot, name)
        if not (file := folder / name).is_file():
            there = sorted(other.name for other in file.parent.glob("*")) if file.parent.is_dir() else []
            raise table.error(f"no file {file}{nearest(file.name, there)}", slot)
        if name in names[:i]:
            raise table.error(f"names {name} twice", slot)
    return tuple(folder / name for name in names)


# --- running ------------------------------------------------------------------------------------------------------


def run_steps(steps: Sequence[Step], base: Path, begin: Callable[[str], None] = lambda _: None) -> Iterator[Result]:
    """Run the `steps`, each with the results of those before it put into the vehicle file `base`.

    begin: is called with the name of each part of the work. Raises InputError for data that cannot be used, naming the
    procedure; one of several steps whose sensors no ride has is refused, and the others continue.
    """
    read: dict[Path, Recording] = {}
    results: list[Result] = []
    with tempfile.TemporaryDirectory() as folder:
        for step in steps:
            procedure = PROCEDURES[step.procedure]
            vehicle = _vehicle_so_far(base, results, Path(folder) / "vehicle.toml")
            given = Given(vehicle, results, options={**procedure.options, **step.options})
            for slot, files in step.files.items():
                for file in files:
                    begin(f"{step.procedure}: {file.name}")
                    if procedure.slots[slot].is_table(file):
                        given.tables.setdefault(slot, []).append(read_table(file, step.columns.get(slot)))
                        continue
                    if file not in read:
                        read[file] = read_recording(file, vehicle)
                    given.rides.setdefault(slot, []).append(read[file])
            begin(f"{step.procedure}: fitting")
            try:
                result = procedure.run(given)
                check_against_file(result, vehicle)
            except InputError as error:
                if not isinstance(error, LackingError) or len(steps) == 1:
                    raise InputError(f"{step.procedure}: {error}") from error
                result = Result(step.procedure, refusals=[f"{error}; what the file says stays"])
            results.append(result)
            yield result


def _vehicle_so_far(base: Path, results: Sequence[Result], file: Path) -> Vehicle:
    """The vehicle with `results`; its complaints name the base file."""
    if not results:
        return read_vehicle(base)
    try:
        return replace(write_calibration(base, results, file), file=base)
    except InputError as error:
        raise InputError(str(error).replace(str(file), str(base))) from error


def check_against_file(result: Result, vehicle: Vehicle) -> None:
    """InputError if a ride contradicts `vehicle`: a parameter beyond `FAR` joint standard deviations from its value.

    The message names the signals that led it there (`Found.channel`); values measured on a bench are not judged.
    """
    rows = []
    for name, found in result.parameters.items():
        known = vehicle.parameters.known.get(name)
        if not found.channel or known is None:
            continue
        far = abs(found.value - known.value) / max(hypot(found.sd, known.sd), 1e-300)
        if far > FAR:
            rows.append(overrun(name, known, (found.value, found.sd), far, f"{found.channel} pulls it there"))
    stop_at(rows)


def write_calibration(base: Path, results: Sequence[Result], out: Path) -> Vehicle:
    """Write the vehicle file `base` with `results`, as far as a vehicle file holds them, to `out`.

    Raises InputError, OSError.
    """
    kept, held = [], set(read_vehicle(base).parameters)
    for result in results:
        held |= {p.name for name, seen in result.effects.items() if seen for p in load_effect(name).parameters}
        parameters = {name: found for name, found in result.parameters.items() if name in held}
        curves = {name: curve for name, curve in result.curves.items() if name.startswith("battery.")}
        covariance = []
        for names, matrix in result.covariance:
            inside = [i for i, name in enumerate(names) if name in held]
            covariance.append((tuple(names[i] for i in inside), np.asarray(matrix)[np.ix_(inside, inside)]))
        kept.append(replace(result, parameters=parameters, curves=curves, covariance=covariance))
    return write_vehicle(base, kept, out)
