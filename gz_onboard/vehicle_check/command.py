"""``gz-onboard vehicle``: begin a vehicle file, check it against logs, draw its efficiency."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from gz_onboard.errors import BAD_INPUT, FAILED, OK, InputError, not_an_input, writing
from gz_onboard.offline.correlations import correlations
from gz_onboard.offline.digest import distinct_logs
from gz_onboard.offline.results import Failure, write_json
from gz_onboard.offline.style import save
from gz_onboard.options import LOG_SUFFIXES, add_shared, number
from gz_onboard.progress import progress_bar
from gz_onboard.vehicle import Vehicle, find_vehicle, read_vehicle
from gz_onboard.vehicle_check import new
from gz_onboard.vehicle_check.check import CHECK_VERSION, Checked, check_log, check_text
from gz_onboard.vehicle_check.features import features_of, features_text
from gz_onboard.vehicle_check.finding import Looks
from gz_onboard.vehicle_check.maps import WARM, efficiency_maps, fit_of


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard vehicle``."""
    parts = parser.add_subparsers(dest="part", metavar="new|check|maps", required=True, help="new, check or maps")
    about = "write a vehicle file to begin with, a comment to each key, and a DBC skeleton; never over a file"
    new.add_arguments(parts.add_parser("new", help=about, description=about, allow_abbrev=False))
    about = "does a vehicle file fit a log? what each role has, what looks right and what wrong, what is missing"
    check = parts.add_parser("check", help=about, description=about, allow_abbrev=False)
    check.add_argument("vehicle", metavar="NAME|TOML", help="name of a built-in vehicle, or a vehicle file")
    add_shared(check, "logs", nargs="*")
    text = "leave out the run through the daemon's pipeline, which takes most of the time"
    check.add_argument("--quick", action="store_true", help=text)
    add_shared(check, "--json", "--quiet")
    about = "draw the efficiency of motor, inverter and both over speed and torque, and what was measured of it"
    _add_maps(parts.add_parser("maps", help=about, description=about, allow_abbrev=False))


def _add_maps(maps: argparse.ArgumentParser) -> None:
    maps.add_argument("vehicle", metavar="NAME|TOML", help="name of a built-in vehicle, or a vehicle file")
    text = "points to be drawn over it: tables of a dynamometer as for `calibrate losses`, or logs of rides"
    maps.add_argument("data", nargs="*", type=Path, metavar="DATA", help=text)
    of_motor = "of the motor (default: %(default)g)"
    maps.add_argument(
        "--temperature", type=number("--temperature", -40.0, 200.0, "degC"), default=WARM, metavar="DEGC", help=of_motor
    )
    kmh = number("--top-speed", 1.0, 500.0, "km/h")
    end = "of the vehicle, where the map ends (default: by the controller in the file, or as measured)"
    maps.add_argument("--top-speed", type=kmh, metavar="KMH", help=end)
    add_shared(maps, "--output", "--format")


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard vehicle``: gives the exit status of its part."""
    part = {"new": new.run, "check": check_vehicle, "maps": draw_vehicle}[arguments.part]
    return part(arguments)


def draw_vehicle(arguments: argparse.Namespace) -> int:
    """``gz-onboard vehicle maps``."""
    from gz_onboard.vehicle_check.maps_plot import draw_maps

    vehicle = read_vehicle(arguments.vehicle)
    picture = arguments.output / f"{vehicle.name}.maps.{arguments.picture_format}"
    not_an_input([picture], [*arguments.data, find_vehicle(arguments.vehicle)])
    top_speed = arguments.top_speed / 3.6 if arguments.top_speed else None
    maps = efficiency_maps(vehicle, arguments.data, arguments.temperature, top_speed)
    for part, source, count, rms, r2 in fit_of(vehicle, maps):
        known = "" if r2 is None else f", R² {r2:.4f}"
        print(f"{part}: {count} points of {source}, measured less map {100 * rms:.2f} % RMS{known}")
    with writing(picture):
        arguments.output.mkdir(parents=True, exist_ok=True)
        save(draw_maps(maps), picture)
    print(picture)
    return OK


def check_vehicle(arguments: argparse.Namespace) -> int:
    """``gz-onboard vehicle check``: `FAILED` if anything looks wrong, `BAD_INPUT` if a log cannot be used."""
    if what := _no_vehicle(Path(arguments.vehicle)):
        raise InputError(f"{arguments.vehicle}: is {what}; the vehicle comes first, by name or file, then its logs")
    vehicle = read_vehicle(arguments.vehicle)
    correlations(vehicle)
    logs = distinct_logs(arguments.logs)
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


def _no_vehicle(given: Path) -> str | None:
    """What stands in the vehicle's place, if that is a log, or a folder in which there is no vehicle file."""
    if given.name.lower().removesuffix(".gz").endswith(LOG_SUFFIXES):
        return "a log"
    return "a folder" if given.is_dir() and not any(given.glob("*.toml")) else None


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
                display.print(f"gz-onboard vehicle check: {error}", sys.stderr)
                continue
            if spoken:
                display.print(check_text(checked[-1]), sys.stdout)
    return checked, failed


def roles_text(vehicle: Vehicle) -> str:
    """What the file alone says: its roles, and what they are enough for."""
    roles = [source.role for source in vehicle.mapping.sources]
    head = f"{vehicle.name}: {len(roles)} roles; give a log to see what fills them"
    return f"{head}\n{features_text(features_of(roles))}"
