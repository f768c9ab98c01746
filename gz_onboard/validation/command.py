"""``gz-onboard validate``: measured rides against their simulation, by the limits of the thesis (Lord 2016, ch. 3).

Each ride is simulated twice from its measured start: open loop, with the measured throttle and brake, and with the
rider model following the measured speed. Each component is also simulated alone, with its measured inputs. Battery
current and voltage, motor torque and speed must be within 20 % (temperatures too), components within 10 %; the page
defines the percentages.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from gz_onboard.errors import BAD_INPUT, FAILED, OK, not_an_input, writing
from gz_onboard.options import add_shared
from gz_onboard.processes import Task, collect, over_rides, tasks_of
from gz_onboard.progress import progress_bar
from gz_onboard.reports.page import mark_of, write_below
from gz_onboard.reports.results import descriptions, write_json
from gz_onboard.validation.comparison import SimulationVerdict, ValidatedRide, pool
from gz_onboard.validation.report import markdown, ride_text, write_report
from gz_onboard.validation.ride import PICTURE, validate_ride
from gz_onboard.vehicle import find_vehicle, read_vehicle

SUMMARY_VERSION = 2
PAGE = "validation.html"
MAKER = "gz-onboard validate"
KEYS = descriptions(SimulationVerdict) | descriptions(ValidatedRide)
"""Keys of a ride in ``--json``: {"version", "rides", "pooled": of all rides, "failed": [{file, error}]}."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard validate``."""
    add_shared(parser, "logs", "--vehicle", "--payload", "--output", "--json")
    parser.add_argument(
        "--markdown",
        type=Path,
        metavar="FILE",
        help=f"write the tables of the page as Markdown; in a file that has the line {mark_of(MAKER)}, below it",
    )
    add_shared(parser, "--format")
    add_shared(parser, "--no-plot", help="draw nothing and write no page")
    parser.add_argument("--gate", action="store_true", help="exit with status 1 if a ride does not pass")
    add_shared(parser, "--jobs", "--quiet")


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard validate``: `OK`; `BAD_INPUT` if a ride cannot be judged; `FAILED` if with --gate one fails."""
    tasks = tasks_of(arguments, Task, PICTURE)
    written = [arguments.json, arguments.markdown, arguments.output / PAGE, *(task.drawn(PICTURE) for task in tasks)]
    not_an_input(written, [*(task.path for task in tasks), find_vehicle(arguments.vehicle)])
    read_vehicle(arguments.vehicle, arguments.payload)  # its errors concern every log
    with writing(arguments.output):
        arguments.output.mkdir(parents=True, exist_ok=True)
    with progress_bar(lambda: len(tasks), "rides", quiet=arguments.quiet) as display:
        results = over_rides(validate_ride, tasks, arguments.jobs, display.update)
        rides, failed = collect("validate", results, display, None if arguments.json == "-" else ride_text)
    together = pool(rides)
    files = []
    with writing(arguments.output):
        if rides and not arguments.no_plot:
            files.append(arguments.output / PAGE)
            write_report(files[-1], rides, together)
        if rides and arguments.markdown:
            files.append(arguments.markdown)
            write_below(arguments.markdown, MAKER, markdown(rides))
    if files and arguments.json != "-":
        print(f"written: {', '.join(map(str, files))}")
    write_json(arguments.json, SUMMARY_VERSION, {"rides": rides, "pooled": together, "failed": failed})
    if failed:
        return BAD_INPUT
    return FAILED if arguments.gate and not all(ride.passed for ride in rides) else OK
