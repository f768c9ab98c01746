"""``gz-onboard estimate``: estimate recorded rides as the daemon would, without a bus.

For each log it writes NAME.estimate.mcap (the estimates and what was received, once a second) and NAME.estimate.png,
and prints a summary. Neither a clock nor a random number is in what it writes: the same log gives the same bytes.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

from gz_onboard import __version__, state
from gz_onboard.can.logfile import LogFile
from gz_onboard.can.recorder import is_complete
from gz_onboard.errors import BAD_INPUT, OK, InputError, not_an_input, writing
from gz_onboard.estimation.ride import RideOptions, known_vehicle, open_estimate, run_ride, state_for, vehicle_of
from gz_onboard.estimation.saved_state import RideState, latest, locked, save_state, saved_at
from gz_onboard.estimation.summary import (
    SUMMARY_VERSION,
    TABLE_FORMATS,
    RideSummary,
    check_table,
    decode_summary,
    encode_summary,
    summary_of,
    summary_text,
    write_summaries,
)
from gz_onboard.imports import require
from gz_onboard.log_rows import ESTIMATE_TOPIC
from gz_onboard.options import add_shared
from gz_onboard.pipeline import dbc_texts, lacking
from gz_onboard.processes import Task, collect, over_rides, tasks_of
from gz_onboard.progress import Progress, progress_bar
from gz_onboard.recording.frames import SignalColumns
from gz_onboard.recording.logs import ESTIMATED, digest_of, read_metadata, read_samples
from gz_onboard.recording.recording import facts_of, of_ride
from gz_onboard.reports.charts import overview
from gz_onboard.reports.results import Failure, clock, number, write_json
from gz_onboard.reports.style import save
from gz_onboard.routes.route import read_route
from gz_onboard.vehicle import find_vehicle

_RECORD = "gz_onboard.estimate"  # of metadata, at the end of the log: the inputs of the estimates, and their summary
_SUMMARY = "summary"


@dataclass(frozen=True)
class EstimateTask(Task):
    """A log to be estimated. resume: keep the result of an earlier run; state: the saved state to continue from."""

    filter_name: str = "scalar"
    frames: bool = False
    signals: bool = False
    route: Path | None = None
    resume: bool = False
    state: RideState | None = None

    @property
    def log(self) -> Path:
        """The MCAP to be written."""
        return self.output(ESTIMATED)

    @property
    def picture(self) -> Path | None:
        """The picture to be drawn, if any."""
        return self.drawn(".estimate")

    @property
    def unfinished(self) -> Path:
        """The MCAP while it is not complete."""
        return self.output(f"{ESTIMATED}.part")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``gz-onboard estimate``."""
    add_shared(parser, "logs", "--vehicle", "--vehicle-id")
    add_shared(parser, "--payload", help="mass of rider and luggage (default: unknown, also where rides.json says it)")
    add_shared(parser, "--route")
    add_shared(parser, "--filter", "--output", "--json")
    table = f"also write the summaries as a table, a row for each log: {' '.join(TABLE_FORMATS)}"
    parser.add_argument("--table", type=Path, metavar="FILE", help=table)
    add_shared(parser, "--format", "--no-plot")
    parser.add_argument("--signals", action="store_true", help="also log the signals of each message, once a second")
    parser.add_argument("--frames", action="store_true", help="also log the raw frames and the range frames")
    kept = "keep the results of an earlier run that are complete and of the same log, vehicle, options and version"
    parser.add_argument("--resume", action="store_true", help=kept)
    keep = "take the rides in the order of their times; each continues from this saved state, as the daemon does"
    parser.add_argument("--state", type=Path, metavar="FILE", help=f"{keep} (default: each starts from nothing)")
    add_shared(parser, "--jobs", "--quiet")


def run(arguments: argparse.Namespace) -> int:
    """Run ``gz-onboard estimate``: `OK` if every log could be estimated, else `BAD_INPUT`."""
    file: Path | None = arguments.state
    given = {name: getattr(arguments, name) for name in ("frames", "signals", "route", "resume")}
    tasks = tasks_of(arguments, EstimateTask, ".estimate.mcap", filter_name=arguments.filter, **given)
    if file and (arguments.jobs or 1) > 1:
        raise InputError(f"--jobs {arguments.jobs} with --state: each ride continues from the one before; leave it out")
    require("matplotlib", not arguments.no_plot)
    if arguments.table:
        check_table(arguments.table)
    written = [arguments.json, arguments.table, *(file for task in tasks for file in (task.log, task.picture))]
    inputs = [*(task.path for task in tasks), *filter(None, [arguments.route]), find_vehicle(arguments.vehicle)]
    not_an_input([*written, *(state.copies(file) if file else ())], inputs)
    # An error of the vehicle file concerns all logs, not the first one.
    known_vehicle(arguments.vehicle, arguments.payload, arguments.vehicle_id)
    rides: list[RideSummary] = []
    failed: list[Failure] = []
    with (
        locked(file) if file else contextlib.nullcontext(),
        progress_bar(lambda: len(tasks), "rides", quiet=arguments.quiet) as display,
    ):
        unread: list[tuple[EstimateTask, InputError]] = []
        if file:
            tasks, unread = in_order(tasks, file)
        results = chain(_results(tasks, 1 if file else arguments.jobs, display.update), unread)
        text = None if arguments.json == "-" else summary_text
        try:
            rides, failed = collect("estimate", results, display, text, lambda ride: ride.damage)
        except KeyboardInterrupt:
            if len(tasks) > 1:
                display.print("gz-onboard estimate: interrupted; --resume continues after what is written", sys.stderr)
            raise
    write_json(arguments.json, SUMMARY_VERSION, {"rides": rides, "failed": failed})
    if arguments.table:
        write_summaries(arguments.table, rides, failed)
    if file and rides and file.exists() and arguments.json != "-":
        shown = f"--vehicle {arguments.vehicle} --state {file}"
        print(f"what was learned is in {file}; `gz-onboard learned {shown}` shows it")
    return BAD_INPUT if failed else OK


def _results(
    tasks: Sequence[EstimateTask], jobs: int | None, progress: Progress
) -> Iterator[tuple[EstimateTask, RideSummary | InputError]]:
    try:
        yield from over_rides(estimate_log, tasks, jobs, progress)
    finally:
        for task in tasks:  # of processes that were stopped
            with contextlib.suppress(OSError):  # no such folder, which was reported
                task.unfinished.unlink(missing_ok=True)


# --- rides that share a saved state -------------------------------------------------------------------------------


def in_order(
    tasks: Sequence[EstimateTask], file: Path
) -> tuple[list[EstimateTask], list[tuple[EstimateTask, InputError]]]:
    """Sort tasks by the times of their rides, each with the state `file` to continue from; and those without a time.

    Of an earlier run those results are kept that the state includes: of rides that ended before it was saved.
    """
    found: list[tuple[RideState, EstimateTask]] = []
    unread: list[tuple[EstimateTask, InputError]] = []
    for task in tasks:
        try:
            ride = open_estimate(task.path, vehicle_of(task))
            found.append((state_for(file, ride, facts_of(task.path)), task))
        except InputError as error:
            unread.append((task, error))
    found.sort(key=lambda one: one[0].begin_ns)
    saved = _saved_ns(file)
    return [replace(task, state=at, resume=task.resume and at.end_ns <= saved) for at, task in found], unread


def _saved_ns(file: Path) -> float:
    """Return when the state was saved [ns since the epoch]; before all rides if there is none that can be read."""
    try:
        saved = saved_at(copy) if (copy := latest(file)) else None
    except ValueError:  # reported when it is restored
        saved = None
    return -1.0 if saved is None else 1e9 * saved + 1e6  # no ride ends within 1 ms of another


# --- one log ------------------------------------------------------------------------------------------------------


def estimate_log(task: EstimateTask) -> RideSummary:
    """Estimate one log, write its picture and its MCAP, and return its summary. Raises InputError."""
    kept = _kept_summary(task) if task.resume else None
    return kept or _estimate(task)


def _estimate(task: EstimateTask) -> RideSummary:
    route = read_route(task.route) if task.route else None
    ride = open_estimate(task.path, vehicle_of(task))
    if (task.frames or task.signals) and isinstance(ride.frames, SignalColumns):
        option = "--frames" if task.frames else "--signals"
        raise InputError(f"{task.path}: is a table of signals: {option} has nothing to log")
    with writing(task.log):
        task.unfinished.parent.mkdir(parents=True, exist_ok=True)
        metadata = {
            "vehicle": ride.vehicle.name,
            "vehicle_key": ride.vehicle.key,
            "lacking": " ".join(lacking(ride.vehicle)),
            "source": task.path.name,
            "filter": task.filter_name,
            **({} if task.payload is None else {"payload_kg": f"{task.payload:g}"}),
            **({} if task.route is None else {"route": task.route.name}),
            **({} if task.state is None else {"state": task.state.file.name}),
        }
        log = LogFile(task.unfinished.open("wb"), ride.start_ns, metadata, dbc_texts(ride.vehicle))
        try:
            options = RideOptions(task.filter_name, task.frames, task.signals, route, state=task.state)
            found = run_ride(ride, options, log)
            summary = summary_of(found, task.log, task.picture)
            log.note(_RECORD, {**_inputs(task), _SUMMARY: encode_summary(summary)})
            log.close()
            if task.picture:
                _draw(task.unfinished, summary, task.picture)
            task.unfinished.replace(task.log)  # last: a log that is there has its picture
        finally:
            log.abandon()
            task.unfinished.unlink(missing_ok=True)
    if task.state:
        save_state(task.state.file, found.pipeline)
    return summary


def _draw(log: Path, s: RideSummary, picture: Path) -> None:
    """Draw the estimates of a log into `picture`. Raises InputError."""
    start = datetime.fromtimestamp(s.start_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    charge = f"state of charge {number(s.soc_start, '.1f', '', 100)} → {number(s.soc_end, '.1f', '%', 100)}"
    band = f"({number(s.range_end_p10_km, '.1f')}–{number(s.range_end_p90_km, '.1f')})"
    parts = [start, clock(s.duration_s), f"{s.distance_km:z.2f} km", charge]
    parts += [f"range at the end {number(s.range_end_km, '.1f', 'km')} {band}"]
    rows = [values for topic, _, values in read_samples(log) if topic == ESTIMATE_TOPIC]
    title = f"{Path(s.file).name} · {s.vehicle}"
    with writing(picture):
        save(overview(rows, title, "  ·  ".join(["damaged log"] * bool(s.damage) + parts)), picture)


# --- the result of an earlier run ---------------------------------------------------------------------------------


def _inputs(task: EstimateTask) -> dict[str, str]:
    """Return everything that the estimates of a log depend on, files by their content."""
    vehicle = vehicle_of(task)
    effects = {effect.file for effect in vehicle.model.effects}
    files = {vehicle.file, vehicle.range_dbc, *vehicle.mapping.dbc_files, *(file for file in effects if file.is_file())}
    return {
        "version": f"{__version__}, summary {SUMMARY_VERSION}",
        "log": digest_of(task.path),
        "vehicle": " ".join(sorted({_digest_once(file) for file in files})),
        "vehicle_id": of_ride(vehicle, task.path).vehicle_id,
        "payload_kg": "" if task.payload is None else f"{task.payload:g}",
        "route": digest_of(task.route) if task.route else "",
        "options": f"filter {task.filter_name}, frames {task.frames}, signals {task.signals}",
        **({} if task.state is None else {"state": task.state.file.name, "rider": task.state.rider}),
    }


_digest_once = functools.lru_cache(maxsize=None)(digest_of)  # of the files that are the same for all logs


def _kept_summary(task: EstimateTask) -> RideSummary | None:
    """Return the summary of an earlier run, if its log and its picture are complete and had the same inputs."""
    try:
        if not is_complete(task.log):
            return None
        if task.picture and task.picture.stat().st_mtime_ns < task.log.stat().st_mtime_ns:  # of another run
            return None
        found = read_metadata(task.log, _RECORD)
    except (OSError, InputError):
        return None
    text = found.pop(_SUMMARY, "")
    return decode_summary(text, task.path, task.log, task.picture) if found == _inputs(task) else None
