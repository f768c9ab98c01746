"""``gz-onboard report``: recorded rides as one self-contained HTML page, for phone and desktop."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gz_onboard.errors import BAD_INPUT, OK, InputError, not_an_input, writing
from gz_onboard.lab.estimate import expected_frames
from gz_onboard.lab.estimate_ride import known_vehicle
from gz_onboard.lab.report_page import cells, contents, section
from gz_onboard.lab.report_ride import ReportedRide, ReportTask, read_report
from gz_onboard.offline.digest import distinct_logs
from gz_onboard.offline.processes import collect, over_rides
from gz_onboard.offline.samples import ride_name
from gz_onboard.options import add_shared
from gz_onboard.progress import Progress, progress_bar
from gz_onboard.reports.page import page
from gz_onboard.vehicle import find_vehicle


@dataclass(frozen=True)
class RideSection:
    """A ride in the page. cells: of the table of all rides; html: its section."""

    anchor: str
    cells: list[str]
    html: str
    damage: str | None


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard report``."""
    add_shared(parser, "logs", "--vehicle")
    add_shared(parser, "--payload", help="mass of rider and luggage (default: unknown, also where rides.json says it)")
    add_shared(parser, "--route")
    text = "page to write (default: the name of the ride, or of several `rides`, with .html)"
    parser.add_argument("-o", "--output", type=Path, metavar="HTML", help=text)
    parser.add_argument("--no-path", action="store_true", help="leave out where the ride was")
    add_shared(parser, "--jobs", "--quiet")


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard report``: `OK` if every log is in the page, else `BAD_INPUT`."""
    logs = distinct_logs(arguments.logs)
    out = arguments.output or Path(f"{ride_name(logs[0]) if len(logs) == 1 else 'rides'}.html")
    not_an_input([out], [*logs, *filter(None, [arguments.route]), find_vehicle(arguments.vehicle)])
    check_page(out)
    known_vehicle(arguments.vehicle, arguments.payload)  # its errors are none of a log's
    given = arguments.vehicle, arguments.payload, False
    more = {"route": arguments.route, "located": not arguments.no_path}
    tasks = [ReportTask(log, Path(f"ride-{i}"), *given, **more) for i, log in enumerate(logs, 1)]
    with progress_bar(lambda: expected_frames(logs), "frames", quiet=arguments.quiet) as display:
        results = over_rides(ride_section, tasks, arguments.jobs, display.update)
        found, failed = collect("report", results, display, None, lambda ride: ride.damage)
    if found:
        with writing(out):
            out.write_text(page_of(found), encoding="utf-8", errors="replace")
        print(out)
    return BAD_INPUT if failed else OK


def check_page(out: Path) -> None:
    """InputError for a page that cannot be, before anything takes long."""
    if out.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{out}: the report is a page in HTML; give it a name that ends in .html")
    if not out.parent.is_dir():
        raise InputError(f"{out}: cannot be written: there is no folder {out.parent}; make it")


def ride_section(task: ReportTask, progress: Progress | None = None) -> RideSection:
    """The section of the page for one log. Raises InputError."""
    return section_of(read_report(task, progress), task.stem.name)


def section_of(ride: ReportedRide, anchor: str) -> RideSection:
    """The section of a ride; anchor: its id in the page."""
    return RideSection(anchor, cells(ride), section(ride, anchor), ride.summary.damage)


def page_of(rides: Sequence[RideSection]) -> str:
    """The page of all rides, in their order; of several with a table above."""
    title = rides[0].cells[0] if len(rides) == 1 else f"{len(rides)} rides"
    head = [] if len(rides) == 1 else [f"<h1>{title}</h1>", contents([(ride.anchor, ride.cells) for ride in rides])]
    return page(title, [*head, *(ride.html for ride in rides)])
