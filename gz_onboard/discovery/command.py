"""``gz-onboard discover``: what rides show that the model of the vehicle does not, and why."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gz_onboard.calibration.vehicle_file import vehicle_output
from gz_onboard.discovery.baseline import LEAST_RIDES, baseline
from gz_onboard.discovery.baseline_file import write_baseline
from gz_onboard.discovery.breakdown import loads_by_ride, outlying_rides
from gz_onboard.discovery.candidates import candidates
from gz_onboard.discovery.detectability import implausible_rides, missing_residuals
from gz_onboard.discovery.discovery import discover
from gz_onboard.discovery.extension import write_model
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.summary import listing, summary
from gz_onboard.discovery.verdict import Discovery
from gz_onboard.discovery.wording import Say
from gz_onboard.errors import InputError, near_file, nearest, not_an_input, writing
from gz_onboard.offline.arguments import check_fields
from gz_onboard.offline.processes import Task, over_rides
from gz_onboard.offline.samples import Samples, read_samples, ride_name
from gz_onboard.options import MOST_JOBS, MOST_SEED, add_shared
from gz_onboard.progress import Progress, progress_bar
from gz_onboard.recording.logs import log_suffix, logs_among
from gz_onboard.reports.results import distinct_names, write_json
from gz_onboard.vehicle import Vehicle, find_vehicle, read_vehicle


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command line."""
    parser.add_argument("rides", nargs="*", type=Path, metavar="RIDE", help="logs, or folders of logs")
    add_shared(parser, "--vehicle")
    parser.add_argument(
        "--baseline",
        type=Path,
        metavar="OUT.toml",
        help="take the rides for healthy: write a baseline vehicle file and the scatter of healthy rides; pass it as "
        "--vehicle afterwards",
    )
    add_shared(parser, "--payload", help="mass of rider and luggage, of rides that rides.json does not name")
    add_shared(parser, "--report", "--json")
    beside = "write the pictures of --report beside it too, each as a file; svg and pdf are for papers"
    add_shared(parser, "--format", default=None, help=beside)
    parser.add_argument("--write-model", type=Path, metavar="NEW.toml", help="write the extended vehicle file")
    parser.add_argument(
        "--holdout",
        metavar="RIDE,...",
        help="rides by name that the gain is measured on; each in turn if none is named",
    )
    add_shared(parser, "--effects", help="folder with effects of your own as candidates")
    parser.add_argument("--list", action="store_true", help="list the candidate causes and the data that each needs")
    jobs = min(2, os.cpu_count() or 1)
    add_shared(parser, "--seed")
    add_shared(parser, "--jobs", default=jobs, help="number of parallel processes (default: %(default)s)")
    add_shared(parser, "--quiet")


def run(arguments: argparse.Namespace) -> int:
    """Run the command; 0 if it could answer, whatever the answer."""
    if arguments.effects and not arguments.effects.is_dir():
        raise InputError(f"--effects {arguments.effects}: no such folder")
    if arguments.list:
        print(listing(candidates(arguments.effects)))
        return 0
    logs = find_logs(arguments.rides)
    vehicle = read_vehicle(arguments.vehicle, effects_folder=arguments.effects)
    _check(arguments, logs)
    rides, refused = read_rides(logs, arguments)
    if arguments.baseline:
        return run_baseline(arguments, vehicle, rides, refused)
    options = DiscoveryOptions(arguments.seed, arguments.effects, arguments.jobs, _names(arguments.holdout) or None)
    with progress_bar(lambda: None, quiet=arguments.quiet) as display:
        found = explain(vehicle, rides, options, refused, display.step)
    written = write_extended(found, vehicle, arguments.write_model) if arguments.write_model else []
    if arguments.json:
        write_json(arguments.json, None, found.report)
    if arguments.report:
        from gz_onboard.discovery.page import write_report

        with writing(f"--report {arguments.report}"):
            write_report(found, arguments.report, arguments.picture_format)
    if arguments.json != "-":
        print(summary(found, written))
        if arguments.report:
            print(f"report       {arguments.report}")
    return 0


RANGES = {"seed": (0, MOST_SEED, ""), "jobs": (1, MOST_JOBS, "processes")}
"""What of `DiscoveryOptions` is a number: the least, the greatest, the unit."""


@dataclass(frozen=True)
class DiscoveryOptions:
    """How is searched, as of `discover`. Raises InputError for what is none of these, or out of its range."""

    seed: int = 0
    effects: str | os.PathLike[str] | None = None  # folder of the user's own
    jobs: int = 1
    holdout: Sequence[str] | None = None  # rides by name

    def __post_init__(self) -> None:
        check_fields(self, RANGES)
        if self.effects is not None and not Path(self.effects).is_dir():
            raise InputError(f"effects {self.effects}: no such folder")


def explain(
    vehicle: Vehicle,
    rides: Sequence[Samples],
    options: DiscoveryOptions,
    refused: Sequence[str] = (),
    say: Say | None = None,
) -> Discovery:
    """What `rides` show that `vehicle` does not, with notes on what could not be used; refused: why others are none.

    Raises InputError where no ride can be used.
    """
    left = [*refused, *(f"{r.name}: is a ride on a roller; left out" for r in rides if "roller_speed" in r.columns)]
    rides = [ride for ride in rides if "roller_speed" not in ride.columns]
    if not rides:
        raise InputError("; ".join(left) or "no ride is given")
    known_rides(options.holdout or (), [ride.name for ride in rides])
    effects = None if options.effects is None else Path(options.effects)
    found = discover(vehicle, rides, options.seed, effects, say, options.jobs, options.holdout)
    report = found.report
    report.notes[:0] = left
    report.notes += [
        *loads_by_ride(found),
        *outlying_rides(found),
        *implausible_rides(found.lines),
        *missing_residuals(found),
    ]
    return found


def run_baseline(arguments: argparse.Namespace, vehicle: Vehicle, rides: list[Samples], refused: list[str]) -> int:
    """Learn from healthy rides and write the vehicle file; 0."""
    healthy, left = on_roads(rides)
    with progress_bar(lambda: None, quiet=arguments.quiet) as display:
        found = baseline(vehicle, healthy, arguments.effects, display.step, arguments.jobs)
    write_baseline(found, find_vehicle(arguments.vehicle), arguments.baseline)
    print(
        f"{arguments.baseline}: {vehicle.name} as {len(healthy)} healthy rides show it; what healthy rides look like "
        f"is in {arguments.baseline.with_suffix('.healthy.npz').name} beside it"
    )
    if isinstance(found.healthy, MixedModel):
        print(found.healthy.checked)
    if left:
        print(f"left out, as no rides on a road: {', '.join(left)}")
    for text in refused:
        print(f"note: {text}")
    return 0


def _check(arguments: argparse.Namespace, logs: Sequence[Path]) -> None:
    """InputError for what cannot be, before anything takes long."""
    own = find_vehicle(arguments.vehicle)
    for option in ("baseline", "write_model"):
        if out := getattr(arguments, option):
            vehicle_output(out, [own], f"--{option.replace('_', '-')} ")
    for option in ("baseline", "write_model", "report", "json"):
        file = getattr(arguments, option)
        if file and str(file) != "-" and not Path(file).resolve().parent.is_dir():
            raise InputError(f"--{option.replace('_', '-')} {file}: no folder {Path(file).parent}")
    not_an_input((getattr(arguments, option) for option in ("baseline", "write_model", "report", "json")), [own, *logs])
    if arguments.picture_format and not arguments.report:
        raise InputError(f"--format {arguments.picture_format}: is for the pictures of --report HTML")
    known_rides(_names(arguments.holdout), ride_names(logs))


def _names(texts: str | None) -> list[str]:
    """The names in a list of them."""
    return [name.strip() for name in (texts or "").split(",") if name.strip()]


def known_rides(holdout: Sequence[str], names: Sequence[str]) -> None:
    """InputError if not all of the rides to be held out are among those called `names`, or none is left."""
    for name in holdout:
        if name not in names:
            raise InputError(f"holdout: no ride is called {name!r}{nearest(name, names)}")
    if holdout and set(holdout) >= set(names):
        raise InputError("holdout: no ride is left to be fitted")


def ride_names(logs: Sequence[Path]) -> list[str]:
    """What the ride of each log is called, each differently; InputError if that cannot be."""
    return distinct_names(logs, [ride_name(log) for log in logs])


def told_apart(names: Sequence[str]) -> None:
    """InputError if two rides have the same name."""
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"two rides are called {twice[0]}: rides are told apart by their names; rename one")


# --- rides --------------------------------------------------------------------------------------------------------


def find_logs(paths: Sequence[Path]) -> list[Path]:
    """The logs among `paths`, those of folders in the order of their names. InputError for none."""
    logs = logs_among(paths)
    if not logs:
        raise InputError("no ride is given; gz-onboard discover --list prints what could be found in one")
    for log in logs:
        if not log.is_file():
            raise InputError(f"{log}: no such log{near_file(log)}")
        log_suffix(log)
    return logs


@dataclass(frozen=True)
class _Reading(Task):
    """A log to be read; its payload is for one whose facts have none."""

    effects: Path | None = None  # folder of the user's own


def _read(task: _Reading, _: Progress) -> Samples:
    samples = read_samples(task.path, read_vehicle(task.vehicle, effects_folder=task.effects))
    if task.payload is not None and samples.rider_mass is None:
        samples = replace(samples, facts={**samples.facts, "rider_mass_kg": task.payload})
    return samples


def read_rides(logs: Sequence[Path], arguments: argparse.Namespace) -> tuple[list[Samples], list[str]]:
    """The rides, and why a log is none. InputError if no log is one."""
    tasks = [_Reading(log, log, arguments.vehicle, arguments.payload, effects=arguments.effects) for log in logs]
    rides: list[Samples] = []
    refused: list[str] = []
    with progress_bar(lambda: len(tasks), "rides", quiet=arguments.quiet) as display:
        for (_, result), name in zip(over_rides(_read, tasks, arguments.jobs), ride_names(logs), strict=True):
            if isinstance(result, InputError):
                refused.append(str(result))
            else:
                rides.append(replace(result, name=name))
            display.update(1)
    if not rides:
        raise InputError("; ".join(refused))
    return rides, refused


def on_roads(rides: Sequence[Samples]) -> tuple[list[Samples], list[str]]:
    """The rides on a road, not on a roller and no coast-downs, as far as is written down; the names of the others.

    InputError if these are missing to the rides that a baseline needs.
    """
    roads = [r for r in rides if "roller_speed" not in r.columns and r.facts.get("kind") != "coastdown"]
    left = [ride.name for ride in rides if all(ride is not road for road in roads)]
    if left and len(roads) < LEAST_RIDES:
        raise InputError(
            f"{len(roads)} healthy rides: three are the least that tell how rides differ; "
            f"left out, as no rides on a road: {', '.join(left)}"
        )
    return roads, left


# --- the extended model -------------------------------------------------------------------------------------------


def write_extended(found: Discovery, vehicle: Vehicle, out: Path) -> list[str]:
    """Write the extended model if there is anything to extend it with; what was done, in words."""
    report = found.report
    if all(cause.varies for cause in report.causes) and report.unknown is None:
        return ["not written: there is nothing to extend it with"]
    with writing(f"--write-model {out}"):
        added = write_model(found, vehicle, vehicle.file, out)
    written = [str(out), *added] if report.extended_model else ["not written", *added]
    if report.ambiguous:
        written.append(
            "of causes that cannot be told apart it has the likeliest: right for these rides, perhaps not for others"
        )
    return written
