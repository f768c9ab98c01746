"""``gz-onboard calibrate``: measurements in, a vehicle file out, with a report of how well each number is known."""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gz_onboard.calibration import manifest, report
from gz_onboard.calibration.manifest import Option, Step, check_count
from gz_onboard.calibration.prior_check import check_against_file
from gz_onboard.calibration.procedures import PROCEDURES, Given, Procedure
from gz_onboard.calibration.result import LackingError, Result
from gz_onboard.calibration.table import read_table
from gz_onboard.calibration.vehicle_file import vehicle_output, write_vehicle
from gz_onboard.errors import OK, InputError, near_file, nearest, not_an_input, writing
from gz_onboard.model.effect import load_effect
from gz_onboard.options import add_shared
from gz_onboard.progress import progress_bar
from gz_onboard.recording.logs import logs_among
from gz_onboard.recording.recording import Recording, read_recording
from gz_onboard.reports.results import write_json
from gz_onboard.vehicle import Vehicle, find_vehicle, read_vehicle


def calibrate(
    steps: Sequence[Step], base: Path, begin: Callable[[str], None] = lambda _: None
) -> Iterator[tuple[Result, float]]:
    """(what it found, seconds that it took) of each of the `steps`, with what those before it found put into `base`.

    begin: is called with the name of each part of the work that begins. Raises InputError for data that cannot be
    used, naming the procedure; one of several that no ride has the sensors for is refused, and the others go on.
    """
    read: dict[Path, Recording] = {}
    results: list[Result] = []
    with tempfile.TemporaryDirectory() as folder:
        for step in steps:
            start = time.perf_counter()
            procedure = PROCEDURES[step.procedure]
            vehicle = _known_by_now(base, results, Path(folder) / "vehicle.toml")
            given = Given(vehicle, results, options={**procedure.options, **step.options})
            for slot, files in step.files.items():
                for file in files:
                    begin(f"{step.procedure}: {file.name}")
                    if is_table(file, procedure.slots[slot].kind):
                        given.tables.setdefault(slot, []).append(read_table(file, step.columns.get(slot)))
                        continue
                    if file not in read:
                        read[file] = read_recording(file, vehicle)
                    given.rides.setdefault(slot, []).append(read[file])
            begin(f"{step.procedure}: fitting")
            try:
                result = procedure.run(given)
                check_against_file(result, vehicle)
                results.append(result)
            except InputError as error:
                if isinstance(error, LackingError) and len(steps) > 1:
                    results.append(Result(step.procedure, refusals=[f"{error}; what the file says stays"]))
                    yield results[-1], time.perf_counter() - start
                    continue
                raise InputError(f"{step.procedure}: {error}") from error
            yield results[-1], time.perf_counter() - start


def is_table(file: Path, kind: str) -> bool:
    """Whether `file` is read as a table, in a slot of `kind` (see `Slot`)."""
    if kind != "any":
        return kind == "table"
    return file.name.endswith((".csv", ".csv.gz", ".parquet", ".pq"))


def for_file(results: Sequence[Result], vehicle: Vehicle) -> list[Result]:
    """`results` with only what a vehicle file holds: the rest is for the report."""
    kept, held = [], set(vehicle.parameters)
    for result in results:
        held |= {p.name for name, seen in result.effects.items() if seen for p in load_effect(name).parameters}
        parameters = {name: f for name, f in result.parameters.items() if name in held}
        curves = {name: c for name, c in result.curves.items() if name.startswith("battery.")}
        covariance = []
        for names, matrix in result.covariance:
            inside = [i for i, name in enumerate(names) if name in held]
            covariance.append((tuple(names[i] for i in inside), np.asarray(matrix)[np.ix_(inside, inside)]))
        kept.append(replace(result, parameters=parameters, curves=curves, covariance=covariance))
    return kept


def _known_by_now(base: Path, results: Sequence[Result], file: Path) -> Vehicle:
    """The vehicle with what was found so far; its complaints name the base file."""
    if not results:
        return read_vehicle(base)
    try:
        return replace(write_vehicle(base, for_file(results, read_vehicle(base)), file), file=base)
    except InputError as error:
        raise InputError(str(error).replace(str(file), str(base))) from error


# --- command line -------------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of ``gz-onboard calibrate``."""
    parser.epilog = "\n".join(
        ["procedures:"]
        + [f"  {'all':<12} everything that the manifest {manifest.NAME} of a folder names"]
        + [f"  {name:<12} {procedure.what}" for name, procedure in PROCEDURES.items()]
        + [
            "",
            "Tables have the unit in the name of a column: time_s, current_A. Data of each: docs/how-to/calibrate.md.",
        ]
    )
    add = parser.add_argument
    add("what", metavar="WHAT", help="a procedure, or all")
    data = "files, or for rides folders of logs; for `all` a folder with its manifest"
    add("data", metavar="DATA", nargs="+", type=Path, help=data)
    base = "name of a built-in vehicle, or a vehicle file, to start from (default: reference, or the manifest's)"
    add_shared(parser, "--vehicle", default=None, help=base)
    add("--with", dest="more", metavar="NAME=FILE", action="append", default=[], help="further data of a procedure")
    add("--held-out", metavar="FILE", action="append", default=[], help="the same as --with held_out=FILE")
    add("--set", metavar="OPTION=VALUE", action="append", default=[], help="an option of a procedure")
    add_shared(parser, "--output", default=None, metavar="TOML", help="write the vehicle file with what was found")
    add_shared(parser, "--report", "--json", "--quiet")


def plain_options(procedure: Procedure) -> dict[str, float | str]:
    """The options that a command line may give; one for each file is for a manifest."""
    return {name: default for name, default in procedure.options.items() if isinstance(default, float | str)}


def run(arguments: argparse.Namespace) -> int:
    """Run ``gz-onboard calibrate``; `OK` if all was found, also where something was refused with its reason."""
    known_procedure(arguments.what)
    base, steps = _asked(arguments)
    for file in (arguments.output, arguments.report, arguments.json):
        if file is not None and str(file) != "-" and not Path(file).parent.is_dir():
            raise InputError(f"{file}: there is no folder {Path(file).parent}")
    read = [base, *files_of(steps, arguments.data)]
    if arguments.output:
        vehicle_output(arguments.output, read, "--output ")
    not_an_input((arguments.output, arguments.report, arguments.json), read)
    results, took, trouble = _found(steps, base, arguments.quiet)
    text = arguments.json != "-"
    if text:
        for result, seconds in zip(results, took, strict=True):
            print(f"{report.text(result)}\n  ({seconds:.1f} s)")
    with writing(base):
        if arguments.output and not trouble:
            try:
                write_vehicle(base, for_file(results, read_vehicle(base)), arguments.output)
            except InputError as error:
                trouble = error
        if arguments.report:
            report.write_report(arguments.report, f"Calibration of {read_vehicle(base).name}", results, trouble)
    out = str(arguments.output) if arguments.output and not trouble else None
    write_json(arguments.json, report.VERSION, report.document(results, str(base), out))
    if text:
        for file in (out, arguments.report):
            if file:
                print(f"{file} written")
    if trouble:
        raise trouble
    return OK


def _found(steps: Sequence[Step], base: Path, quiet: bool) -> tuple[list[Result], list[float], InputError | None]:
    """(results, seconds that each took, why there are no more); InputError if there is none."""
    results, took = [], []
    total = sum(len(files) for step in steps for files in step.files.values()) + len(steps)
    with progress_bar(lambda: total, "steps", quiet=quiet) as display:
        try:
            for result, seconds in calibrate(steps, base, lambda text: display.step(text, 1)):
                results.append(result)
                took.append(seconds)
        except InputError as error:
            if not results:
                raise
            return results, took, error
    return results, took, None


def _asked(arguments: argparse.Namespace) -> tuple[Path, list[Step]]:
    """(vehicle file to start from, steps) of a command line."""
    if arguments.what == "all":
        if arguments.more or arguments.held_out or arguments.set:
            raise InputError("all takes its data and options from the manifest, not from --with, --held-out or --set")
        return asked_of_manifest(arguments.data, arguments.vehicle)
    procedure = PROCEDURES[arguments.what]
    files: dict[str, list[Path]] = {"data": list(arguments.data)}
    for text in [*arguments.more, *(f"held_out={file}" for file in arguments.held_out)]:
        slot, equals, file = text.partition("=")
        if not equals:
            raise InputError(f"--with {text}: must be NAME=FILE, with one of {', '.join(procedure.slots)}")
        files.setdefault(slot, []).append(Path(file))
    base = find_vehicle(arguments.vehicle or "reference")
    return base, [step_of(arguments.what, files, options_of(arguments.set, arguments.what))]


def files_of(steps: Sequence[Step], data: Sequence[Path]) -> list[Path]:
    """The files that are read for `steps`, with the manifest in what was given as `data`."""
    read = [file for step in steps for files in step.files.values() for file in files]
    return [*read, *data, *(folder / manifest.NAME for folder in data)]


def asked_of_manifest(data: Sequence[Path], vehicle: str | Path | None) -> tuple[Path, list[Step]]:
    """(vehicle file to start from, steps) of a folder's manifest; vehicle: another than the manifest's."""
    if len(data) != 1:
        raise InputError("all takes one folder (or its manifest), which names the files in it")
    slots = {name: p.slots for name, p in PROCEDURES.items()}
    base, steps = manifest.read_manifest(data[0], slots, {name: p.options for name, p in PROCEDURES.items()})
    return (find_vehicle(vehicle) if vehicle else base), steps


def step_of(name: str, files: Mapping[str, Sequence[Path]], options: Mapping[str, Option]) -> Step:
    """The procedure `name` with its data by slot: files, or for rides folders of logs. InputError for what it lacks."""
    procedure, found = PROCEDURES[name], {slot: list(group) for slot, group in files.items()}
    for slot, group in found.items():
        if slot not in procedure.slots:
            raise InputError(
                f"--with {slot}={', '.join(map(str, group[:1]))}: {name} has no data {slot!r}"
                f"{nearest(slot, procedure.slots)}; "
                f"there are {', '.join(procedure.slots)}"
            )
        if procedure.slots[slot].kind != "table":
            found[slot] = logs_among(group)
    for slot, needed in procedure.slots.items():
        check_count(name, slot, needed, len(found.get(slot, ())))
    for file in (file for group in found.values() for file in group):
        if not file.is_file():
            what = "is a folder; give the files in it" if file.is_dir() else f"no such file{near_file(file)}"
            raise InputError(f"{file}: {what}")
    return Step(name, {slot: tuple(group) for slot, group in found.items()}, {}, dict(options))


def known_procedure(name: str) -> None:
    """InputError if no procedure has that name, nor all of them."""
    if name != "all" and name not in PROCEDURES:
        known = ["all", *PROCEDURES]
        raise InputError(f"no procedure is called {name!r}{nearest(name, known)}; there are {', '.join(known)}")


def options_of(texts: Sequence[str], procedure: str) -> dict[str, Option]:
    """The options of a procedure, each given as NAME=VALUE. InputError for one that it has not, or a wrong value."""
    found: dict[str, Option] = {}
    options = plain_options(PROCEDURES[procedure])
    for text in texts:
        name, _, value = text.partition("=")
        if name not in options:
            known = ", ".join(options) or "none"
            raise InputError(f"--set {text}: no option {name!r}{nearest(name, options)}; there are {known}")
        if isinstance(options[name], str):
            found[name] = value
            continue
        try:
            number = float(value)
        except ValueError as error:
            raise InputError(f"--set {text}: {value!r} is not a number") from error
        if not manifest.LEAST <= number <= manifest.MOST:
            raise InputError(f"--set {text}: must be {manifest.LEAST:g} to {manifest.MOST:g}")
        found[name] = number
    return found
