"""``gz-onboard history add``: from logs to the rows of a history."""

from __future__ import annotations

import argparse
import functools
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, TextIO

from gz_onboard import __version__
from gz_onboard.errors import BAD_INPUT, OK, InputError, not_an_input
from gz_onboard.lab.estimate import expected_frames
from gz_onboard.lab.estimate_ride import How, known_vehicle, open_estimate, ride_through, vehicle_of
from gz_onboard.lab.history.log_rides import LEAST_DISTANCE, About, moments_of, rides_of
from gz_onboard.lab.history.ride import KeptRide
from gz_onboard.lab.history.store import Kept, Store
from gz_onboard.lab.history.text import HISTORY_VERSION, ride_text
from gz_onboard.lab.kept_rows import KeptRows
from gz_onboard.offline.digest import digest_of
from gz_onboard.offline.processes import Task, over_rides
from gz_onboard.offline.results import Failure, leap_text, write_json
from gz_onboard.offline.samples import facts_of, ride_name
from gz_onboard.options import add_shared
from gz_onboard.progress import Progress, progress_bar
from gz_onboard.recording.logs import log_suffix, logs_among, read_metadata, read_samples
from gz_onboard.routes.route import read_route
from gz_onboard.vehicle import Vehicle, find_vehicle


@dataclass(frozen=True)
class HistoryTask(Task):
    """A log whose rides are to be kept. name: of the vehicle in the history, if it is given."""

    digest: str = ""
    name: str = ""
    route: Path | None = None


@dataclass(frozen=True)
class LogRides:
    """The rides in a log, and what of it could not be read."""

    rides: Sequence[KeptRide]
    damage: str | None
    clock: list[str] = field(default_factory=list)  # where it leaps and is taken as set, in words


@dataclass
class AddedRides:
    """What ``history add --json`` writes, as it grows."""

    file: Annotated[str, "the history"]
    rides: Annotated[list[KeptRide], "rides that were added, with the keys of `history show`"]
    known: Annotated[list[str], "logs all of whose rides are in the history already, from them or others"]
    without: Annotated[list[str], "logs without a ride"]
    replaced: Annotated[int, "rides that made place for longer or newer ones"]
    failed: Annotated[list[Failure], "logs that cannot be used, or that were at the same time as another"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard history add``."""
    text = "logs of gz-onboard run or estimate, or of raw frames, which are estimated first; or folders of them"
    add_shared(parser, "logs", help=text)
    parser.add_argument(
        "--name", default="", metavar="NAME", help="what to call the vehicle (default: its file's name)"
    )
    add_shared(parser, "--vehicle", help="vehicle of logs of raw frames, by name or file (default: %(default)s)")
    add_shared(parser, "--vehicle-id")
    add_shared(
        parser,
        "--payload",
        help="mass of rider and luggage on logs of raw frames (default: unknown; of rides.json it is only noted)",
    )
    add_shared(parser, "--route")
    replaces = "read logs again that were read before, and put their rides in place of those that are there"
    parser.add_argument("--replace", action="store_true", help=replaces)
    add_shared(parser, "--json", "--jobs", "--quiet")


def run(arguments: argparse.Namespace, file: Path) -> int:
    """``gz-onboard history add``: `OK` if all rides are in the history, else `BAD_INPUT`."""
    logs = list(dict.fromkeys(logs_among(arguments.logs, estimates=True)))
    not_an_input([file, arguments.json], [*logs, *filter(None, [arguments.route]), find_vehicle(arguments.vehicle)])
    known_vehicle(arguments.vehicle, arguments.payload, arguments.vehicle_id)  # its errors are none of a log's
    with Store(file, begin=True) as store:
        seen = set() if arguments.replace else store.known_logs()
        given = arguments.vehicle, arguments.payload, arguments.name, arguments.route
        tasks, known, failed = new_tasks(logs, seen, *given)
        tasks = [replace(task, vehicle_id=arguments.vehicle_id) for task in tasks]
        paths = [task.path for task in tasks]
        with progress_bar(lambda: expected_frames(paths), "frames", quiet=arguments.quiet) as display:
            spoken = arguments.json != "-"
            for failure in failed:
                display.print(f"gz-onboard history add: {failure.error}", sys.stderr)
            if known and spoken:
                more = f" and {len(known) - 1} more: were" if known[1:] else ": was"
                display.print(f"{known[0]}{more} read before", sys.stdout)
            done = AddedRides(str(file), [], known, [], 0, failed)
            results = over_rides(log_rides, tasks, arguments.jobs, display.update)
            for text, stream in keep(store, results, done, arguments.replace):
                if spoken or stream is sys.stderr:
                    display.print(text, stream)
    write_json(arguments.json, HISTORY_VERSION, done)
    if spoken:
        print(f"{len(done.rides)} {'ride' if len(done.rides) == 1 else 'rides'} added to {file}")
    return BAD_INPUT if done.failed else OK


def new_tasks(
    logs: Sequence[Path], seen: set[tuple[str, str]], vehicle: str, payload: float | None, name: str, route: Path | None
) -> tuple[list[HistoryTask], list[str], list[Failure]]:
    """(a task for each log that is not yet known, those that are, those that cannot be read)."""
    tasks, known, failed = [], [], []
    for log in logs:
        try:
            digest = digest_of(log)
        except InputError as error:
            failed.append(Failure(str(log), str(error)))
            continue
        if (digest, name) in seen:
            known.append(str(log))
            continue
        seen = seen | {(digest, name)}
        given = vehicle, payload, False
        tasks.append(HistoryTask(log, Path(ride_name(log)), *given, digest=digest, name=name, route=route))
    return tasks, known, failed


def keep(
    store: Store, results: Iterable[tuple[HistoryTask, LogRides | InputError]], done: AddedRides, again: bool = False
) -> Iterator[tuple[str, TextIO]]:
    """Keep the rides of each log; gives what is to be said of it, and where. done: what grows."""
    for task, result in results:
        if isinstance(result, InputError):
            done.failed.append(Failure(str(task.path), str(result)))
            yield f"gz-onboard history add: {result}", sys.stderr
            continue
        if result.damage:
            yield f"gz-onboard history add: {result.damage}", sys.stderr
        yield from ((f"{task.path}: {text}", sys.stderr) for text in result.clock)
        kept = store.add(task.digest, task.name, result.rides, replace=again)
        done.rides.extend(kept.added)
        done.replaced += kept.replaced
        if not result.rides:
            done.without.append(str(task.path))
            yield f"{task.path}: no ride of {LEAST_DISTANCE:g} m or more", sys.stdout
        elif not kept.added and not kept.clashes:
            done.known.append(str(task.path))
        yield from ((text, sys.stdout) for text in _said(task.path, kept))
        for ride, other in kept.clashes:
            error = f"{task.path}: {ride_text(ride)}: not added: at the same time as {other.log}, {ride_text(other)}"
            done.failed.append(Failure(str(task.path), error))
            yield f"gz-onboard history add: {error}; `history remove` takes that away", sys.stderr


def _said(log: Path, kept: Kept) -> Iterator[str]:
    yield from (f"{log}: {ride_text(ride)}" for ride in kept.added)
    yield from (f"{log}: is there already, from {other.log}: {ride_text(other)}" for _, other in kept.known)
    if kept.replaced:
        yield f"{log}: in place of {kept.replaced} that {'was' if kept.replaced == 1 else 'were'} there"


def log_rides(task: HistoryTask, progress: Progress | None = None) -> LogRides:
    """The rides in a log: of its estimates, or, of one that has none, of its frames. Raises InputError."""
    return rides_in(task, functools.partial(vehicle_of, task), progress)


def rides_in(task: HistoryTask, known: Callable[[], Vehicle], progress: Progress | None = None) -> LogRides:
    """As `log_rides`; known: gives the vehicle whose frames are in the log."""
    damages: list[str] = []
    facts = facts_of(task.path)
    if log_suffix(task.path) == ".mcap":
        samples = read_samples(task.path, on_damage=lambda damage: damages.append(str(damage)))
        moments, whys = moments_of(samples)
        if moments:
            said = read_metadata(task.path)
            about = About(
                task.name or said.get("vehicle") or task.vehicle,
                said.get("vehicle_key", ""),
                task.path,
                said.get("version", ""),
                _mass(said.get("payload_kg")),
                said.get("route"),
                facts,
            )
            return LogRides(rides_of(moments, whys, about), damages[0] if damages else None)
    vehicle = known()
    road = read_route(task.route) if task.route else None
    log = KeptRows()
    ridden = ride_through(open_estimate(task.path, vehicle), How(route=road), log, progress)
    route = task.route.name if task.route else None
    vehicle = ridden.pipeline.vehicle
    about = About(task.name or vehicle.name, vehicle.key, task.path, __version__, task.payload, route, facts)
    moments, whys = moments_of(log.samples)
    leaps = [leap_text(*leap) for leap in ridden.pipeline.codec.leaps]
    return LogRides(rides_of(moments, whys, about), str(ridden.damages[0]) if ridden.damages else None, leaps)


def _mass(text: str | None) -> float | None:
    """As a log's metadata say it [kg]."""
    try:
        return None if text is None else float(text)
    except ValueError:
        return None
