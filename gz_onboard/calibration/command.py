"""``gz-onboard calibrate``: measurements in, a vehicle file out, with a report of how well each number is known."""

from __future__ import annotations

import argparse
from pathlib import Path

from gz_onboard.calibration import report
from gz_onboard.calibration.procedures import PROCEDURES
from gz_onboard.calibration.result import Result
from gz_onboard.calibration.steps import MANIFEST, Step, files_of, requested, run_steps, write_calibration
from gz_onboard.calibration.vehicle_file import vehicle_output
from gz_onboard.errors import OK, InputError, not_an_input, writing
from gz_onboard.options import add_shared
from gz_onboard.progress import progress_bar
from gz_onboard.reports.results import write_json
from gz_onboard.vehicle import read_vehicle


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of ``gz-onboard calibrate``."""
    parser.epilog = "\n".join(
        ["procedures:"]
        + [f"  {'all':<12} everything that the manifest {MANIFEST} of a folder names"]
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
    more = "further data of a procedure, such as held_out=FILE"
    add("--with", dest="more", metavar="NAME=FILE", action="append", default=[], help=more)
    add("--set", metavar="OPTION=VALUE", action="append", default=[], help="an option of a procedure")
    add_shared(parser, "--output", default=None, metavar="TOML", help="write the vehicle file with what was found")
    add_shared(parser, "--report", "--json", "--quiet")


def run(arguments: argparse.Namespace) -> int:
    """Run ``gz-onboard calibrate``; `OK` also where something was refused with its reason."""
    base, steps = _requested(arguments)
    for file in (arguments.output, arguments.report, arguments.json):
        if file is not None and str(file) != "-" and not Path(file).parent.is_dir():
            raise InputError(f"{file}: there is no folder {Path(file).parent}")
    read = [base, *files_of(steps, arguments.data)]
    if arguments.output:
        vehicle_output(arguments.output, read, "--output ")
    not_an_input((arguments.output, arguments.report, arguments.json), read)
    results: list[Result] = []
    trouble: InputError | None = None
    work = sum(len(files) for step in steps for files in step.files.values()) + len(steps)
    with progress_bar(lambda: work, "steps", quiet=arguments.quiet) as display:
        try:
            for result in run_steps(steps, base, lambda text: display.step(text, 1)):
                results.append(result)
        except InputError as error:
            if not results:
                raise
            trouble = error  # what was found before is reported
    text = arguments.json != "-"
    for result in results if text else ():
        print(report.text(result))
    with writing(base):
        if arguments.output and not trouble:
            try:
                write_calibration(base, results, arguments.output)
            except InputError as error:
                trouble = error
        if arguments.report:
            report.write_report(arguments.report, f"Calibration of {read_vehicle(base).name}", results, trouble)
    out = str(arguments.output) if arguments.output and not trouble else None
    write_json(arguments.json, report.VERSION, report.document(results, str(base), out))
    for file in filter(None, (out, arguments.report) if text else ()):
        print(f"{file} written")
    if trouble:
        raise trouble
    return OK


def _requested(arguments: argparse.Namespace) -> tuple[Path, list[Step]]:
    """(vehicle file to start from, steps) of a command line."""
    files: dict[str, list[Path]] = {"data": list(arguments.data)}
    for text in arguments.more:
        slot, equals, file = text.partition("=")
        if not equals:
            raise InputError(f"--with {text}: must be NAME=FILE, such as held_out=FILE")
        files.setdefault(slot, []).append(Path(file))
    return requested(arguments.what, files, arguments.set, arguments.vehicle)
