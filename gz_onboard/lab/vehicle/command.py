"""``gz-onboard vehicle``: begin a vehicle file, check it against logs."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gz_onboard.bus.logs import logs_among
from gz_onboard.errors import BAD_INPUT, FAILED, OK, InputError, not_an_input
from gz_onboard.lab.vehicle import new
from gz_onboard.lab.vehicle.check import CHECK_VERSION, Checked, check_log, check_text
from gz_onboard.lab.vehicle.features import features_of, features_text
from gz_onboard.lab.vehicle.finding import Looks
from gz_onboard.offline.results import Failure, explain_keys, write_json
from gz_onboard.offline.schema import descriptions
from gz_onboard.options import add_shared
from gz_onboard.progress import progress_bar
from gz_onboard.vehicle import Vehicle, find_vehicle, read_vehicle


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard vehicle``."""
    parts = parser.add_subparsers(dest="part", metavar="PART", required=True, help="new or check")
    about = "write a vehicle file to begin with, a comment to each key, and a DBC skeleton; never over a file"
    new.add_arguments(parts.add_parser("new", help=about, description=about, allow_abbrev=False))
    about = "does a vehicle file fit a log? what each role has, what looks right and what wrong, what is missing"
    check = parts.add_parser("check", help=about, description=about, allow_abbrev=False)
    explain_keys(check, "a log", CHECK_VERSION, descriptions(Checked))
    check.add_argument("vehicle", metavar="NAME|TOML", help="name of a built-in vehicle, or a vehicle file")
    add_shared(check, "logs", nargs="*")
    text = "leave out the run through the daemon's pipeline, which takes most of the time"
    check.add_argument("--quick", action="store_true", help=text)
    add_shared(check, "--json", "--quiet")


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard vehicle``: gives the exit status of its part."""
    return new.run(arguments) if arguments.part == "new" else check_vehicle(arguments)


def check_vehicle(arguments: argparse.Namespace) -> int:
    """``gz-onboard vehicle check``: `FAILED` if anything looks wrong, `BAD_INPUT` if a log cannot be used."""
    vehicle = read_vehicle(arguments.vehicle)
    logs = list(dict.fromkeys(logs_among(arguments.logs))) if arguments.logs else []
    not_an_input([arguments.json], [*logs, find_vehicle(arguments.vehicle)])
    spoken = arguments.json != "-"
    if not logs and spoken:
        print(roles_text(vehicle))
    checked, failed = check_logs(logs, vehicle, spoken, arguments)
    features = features_of({source.role for source in vehicle.mapping.sources})
    result = {"vehicle": vehicle.name, "features": features, "rides": checked, "failed": failed}
    write_json(arguments.json, CHECK_VERSION, result)
    if failed:
        return BAD_INPUT
    return FAILED if any(ride.those(Looks.WRONG) for ride in checked) else OK


def check_logs(
    logs: Sequence[Path], vehicle: Vehicle, spoken: bool, how: argparse.Namespace
) -> tuple[list[Checked], list[Failure]]:
    """Each log that can be used checked, and why another cannot; as text on standard output if it is to be `spoken`."""
    checked: list[Checked] = []
    failed: list[Failure] = []
    with progress_bar(lambda: None, "frames", quiet=how.quiet) as display:
        for log in logs:
            try:
                checked.append(check_log(log, vehicle, display.update, how.quick))
            except InputError as error:
                failed.append(Failure(str(log), str(error)))
                display.print(f"gz-onboard vehicle: {error}", sys.stderr)
                continue
            if spoken:
                display.print(check_text(checked[-1]), sys.stdout)
    return checked, failed


def roles_text(vehicle: Vehicle) -> str:
    """What the file alone says: its roles, and what they are enough for."""
    roles = [source.role for source in vehicle.mapping.sources]
    head = f"{vehicle.name}: {len(roles)} roles; give a log to see what fills them"
    return f"{head}\n{features_text(features_of(roles))}"
