"""``gz-onboard vehicle``: start a vehicle file, check it against logs."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from gz_onboard.errors import BAD_INPUT, FAILED, OK, InputError, not_an_input
from gz_onboard.options import LOG_SUFFIXES, add_shared
from gz_onboard.priors import correlations
from gz_onboard.progress import progress_bar
from gz_onboard.recording.logs import logs_among
from gz_onboard.reports.results import Failure, write_json
from gz_onboard.vehicle import Vehicle, find_vehicle, read_vehicle
from gz_onboard.vehicle_check import new
from gz_onboard.vehicle_check.check import CHECK_VERSION, Checked, check_log, check_text
from gz_onboard.vehicle_check.finding import Looks, features_of, features_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of ``gz-onboard vehicle``."""
    parts = parser.add_subparsers(dest="part", metavar="new|check", required=True, help="new or check")
    about = "write a commented vehicle file to start from, and a DBC skeleton; never over a file"
    new.add_arguments(parts.add_parser("new", help=about, description=about, allow_abbrev=False))
    about = "check a vehicle file against logs: the signal of each role, likely mistakes, missing roles"
    check = parts.add_parser("check", help=about, description=about, allow_abbrev=False)
    check.add_argument("vehicle", metavar="NAME|TOML", help="name of a built-in vehicle, or a vehicle file")
    add_shared(check, "logs", nargs="*")
    text = "skip the run through the daemon's pipeline, which takes most of the time"
    check.add_argument("--quick", action="store_true", help=text)
    add_shared(check, "--json", "--quiet")


def run(arguments: argparse.Namespace) -> int:
    """Run ``gz-onboard vehicle new`` or ``check``; returns the exit status."""
    return new.run(arguments) if arguments.part == "new" else check_vehicle(arguments)


def check_vehicle(arguments: argparse.Namespace) -> int:
    """``gz-onboard vehicle check``: `FAILED` if anything looks wrong, `BAD_INPUT` if a log cannot be used."""
    given = Path(arguments.vehicle)
    if given.name.lower().removesuffix(".gz").endswith(LOG_SUFFIXES):
        raise InputError(f"{given}: is a log; the vehicle comes first, by name or file, then its logs")
    if given.is_dir() and not any(given.glob("*.toml")):
        raise InputError(f"{given}: is a folder; the vehicle comes first, by name or file, then its logs")
    vehicle = read_vehicle(arguments.vehicle)
    correlations(vehicle)
    logs = logs_among(arguments.logs)
    not_an_input([arguments.json], [*logs, find_vehicle(arguments.vehicle)])
    print_text = arguments.json != "-"
    if not logs and print_text:
        print(roles_text(vehicle))
    checked: list[Checked] = []
    failed: list[Failure] = []
    with progress_bar(lambda: None, "frames", quiet=arguments.quiet) as display:
        for log in logs:
            try:
                checked.append(check_log(log, vehicle, display.update, arguments.quick))
            except InputError as error:
                failed.append(Failure(str(log), str(error)))
                display.print(f"gz-onboard vehicle check: {error}", sys.stderr)
                continue
            if print_text:
                display.print(check_text(checked[-1]), sys.stdout)
    features = features_of({source.role for source in vehicle.mapping.sources})
    result = {"vehicle": vehicle.name, "features": features, "rides": checked, "failed": failed}
    write_json(arguments.json, CHECK_VERSION, result)
    if failed:
        return BAD_INPUT
    return FAILED if any(ride.those(Looks.WRONG) for ride in checked) else OK


def roles_text(vehicle: Vehicle) -> str:
    """List, for a terminal, the features that the roles of the file are enough for."""
    roles = [source.role for source in vehicle.mapping.sources]
    head = f"{vehicle.name}: {len(roles)} roles; give a log to see what fills them"
    return f"{head}\n{features_text(features_of(roles))}"
