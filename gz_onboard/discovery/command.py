"""``gz-onboard discover``: differences between rides and the vehicle's model, and their causes."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gz_onboard.arguments import check_fields
from gz_onboard.calibration.vehicle_file import vehicle_output
from gz_onboard.discovery.baseline import baseline, write_baseline
from gz_onboard.discovery.extend import write_model
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.parameters import candidates
from gz_onboard.discovery.report import listing, summary
from gz_onboard.discovery.run import discover, known_rides
from gz_onboard.errors import InputError, near_file, not_an_input, writing
from gz_onboard.options import MOST_JOBS, MOST_SEED, add_shared
from gz_onboard.processes import Task, over_rides
from gz_onboard.progress import progress_bar
from gz_onboard.recording.logs import log_suffix, logs_among
from gz_onboard.recording.recording import Recording, read_recording, ride_name
from gz_onboard.reports.results import distinct_names, write_json
from gz_onboard.vehicle import find_vehicle, read_vehicle


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
    names = distinct_names(logs, [ride_name(log) for log in logs])
    vehicle = read_vehicle(arguments.vehicle, effects_folder=arguments.effects)
    holdout = [name.strip() for name in (arguments.holdout or "").split(",") if name.strip()]
    known_rides(holdout, names)
    _check_outputs(arguments, [find_vehicle(arguments.vehicle), *logs])
    rides, refused = read_rides(logs, names, arguments)
    with progress_bar(lambda: None, quiet=arguments.quiet) as display:
        shared = arguments.effects, display.step, arguments.jobs
        if arguments.baseline:
            healthy = baseline(vehicle, rides, *shared)
        else:
            found = discover(vehicle, rides, arguments.seed, *shared, holdout, refused)
    if arguments.baseline:
        with writing(f"--baseline {arguments.baseline}"):
            write_baseline(healthy, vehicle.file, arguments.baseline)
        file = arguments.baseline.with_suffix(".healthy.npz").name
        print(f"{arguments.baseline}: {vehicle.name} as healthy rides show it; their statistics are in {file}")
        assert isinstance(healthy.healthy, MixedModel)
        print("\nnote: ".join([healthy.healthy.checked, *refused]))
        return 0
    written = write_model(found, vehicle, arguments.write_model) if arguments.write_model else []
    if arguments.json:
        write_json(arguments.json, None, found.report)
    if arguments.report:
        from gz_onboard.discovery.report import write_report

        with writing(f"--report {arguments.report}"):
            write_report(found, arguments.report)
    if arguments.json != "-":
        print(summary(found, written))
        if arguments.report:
            print(f"report       {arguments.report}")
    return 0


@dataclass(frozen=True)
class DiscoveryOptions:
    """Options of `discover`. Raises InputError for a wrong type, or a number out of its range."""

    seed: int = 0
    effects: str | os.PathLike[str] | None = None  # folder of the user's own
    jobs: int = 1
    holdout: Sequence[str] | None = None  # rides by name

    def __post_init__(self) -> None:
        check_fields(self, {"seed": (0, MOST_SEED, ""), "jobs": (1, MOST_JOBS, "processes")})
        if self.effects is not None and not Path(self.effects).is_dir():
            raise InputError(f"effects {self.effects}: no such folder")


def _check_outputs(arguments: argparse.Namespace, inputs: Sequence[Path]) -> None:
    """InputError for a file that cannot be written, before anything takes long."""
    options = {f"--{name.replace('_', '-')}": getattr(arguments, name) for name in ("baseline", "write_model")}
    for option, out in options.items():
        if out:
            vehicle_output(out, inputs[:1], f"{option} ")
    options |= {"--report": arguments.report, "--json": arguments.json}
    for option, file in options.items():
        if file and str(file) != "-" and not Path(file).resolve().parent.is_dir():
            raise InputError(f"{option} {file}: no folder {Path(file).parent}")
    not_an_input(options.values(), inputs)


def find_logs(paths: Sequence[Path]) -> list[Path]:
    """The logs among `paths`, those of folders in the order of their names. InputError for none."""
    logs = logs_among(paths)
    if not logs:
        raise InputError("no ride is given; gz-onboard discover --list prints the candidate causes")
    for log in logs:
        if not log.is_file():
            raise InputError(f"{log}: no such log{near_file(log)}")
        log_suffix(log)
    return logs


@dataclass(frozen=True)
class _Reading(Task):
    """A log to be read; its payload is for one whose facts have none."""

    effects: Path | None = None  # folder of the user's own


def _read(task: _Reading) -> Recording:
    samples = read_recording(task.path, read_vehicle(task.vehicle, effects_folder=task.effects))
    if task.payload is not None and samples.rider_mass is None:
        samples = replace(samples, facts={**samples.facts, "rider_mass_kg": task.payload})
    return samples


def read_rides(
    logs: Sequence[Path], names: Sequence[str], arguments: argparse.Namespace
) -> tuple[list[Recording], list[str]]:
    """The rides of these `names`, and why a log is none. InputError if no log is one."""
    tasks = [_Reading(log, log, arguments.vehicle, arguments.payload, effects=arguments.effects) for log in logs]
    rides: list[Recording] = []
    refused: list[str] = []
    with progress_bar(lambda: len(tasks), "rides", quiet=arguments.quiet) as display:
        for (_, result), name in zip(over_rides(_read, tasks, arguments.jobs), names, strict=True):
            if isinstance(result, InputError):
                refused.append(str(result))
            else:
                rides.append(replace(result, name=name))
            display.update(1)
    if not rides:
        raise InputError("; ".join(refused))
    return rides, refused
