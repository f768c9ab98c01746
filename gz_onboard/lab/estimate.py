"""``gz-onboard estimate``: recorded rides through the pipeline of the daemon, without a bus, as fast as it goes.

For each log it writes NAME.estimate.mcap (the estimates and what was received, once a second) and NAME.estimate.png,
and prints a summary. Neither a clock nor a random number is in what it writes: the same log gives the same bytes.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path

from gz_onboard import state
from gz_onboard.constants import HOUR
from gz_onboard.errors import BAD_INPUT, OK, InputError, not_an_input
from gz_onboard.events import Reason, words
from gz_onboard.imports import require
from gz_onboard.lab.estimate_log import EstimateTask, estimate_log, kept_in_turn
from gz_onboard.lab.estimate_order import Unread, in_order
from gz_onboard.lab.estimate_ride import known_vehicle, open_estimate
from gz_onboard.lab.estimate_route import off_text, route_text
from gz_onboard.lab.estimate_state import go_on, held
from gz_onboard.lab.estimate_summary import SUMMARY_VERSION, UNFIT, RideSummary, gains
from gz_onboard.lab.estimate_table import FORMATS, check_table, write_summaries
from gz_onboard.offline.processes import collect, over_rides, tasks_of
from gz_onboard.options import add_shared
from gz_onboard.pipeline import Pipeline
from gz_onboard.progress import Display, Progress, progress_bar
from gz_onboard.recording.logs import is_table
from gz_onboard.reports.results import Failure, clock, descriptions, number, text_rows, write_json
from gz_onboard.vehicle import find_vehicle

LEAST_MISSING = 1.0  # s: less is not told
CONTRADICTING = Reason.VOLTAGE_MISMATCH, Reason.CURRENT_MISMATCH, Reason.SENSOR_DISTRUSTED
SURE = 3.0  # sd
MOST = 0.5  # of the ride: a sensor that fails on the way is a fault, one that never fits may be a wrong vehicle file
TOLD = "what is wrong, `gz-onboard vehicle check` tells, with the same vehicle and {}"
CONTRADICTED = f"what was measured does not fit it; {TOLD}"
FAR_OFF = 0.2  # of the vehicle's own state of charge from the estimated one: more no gauge errs, but by a wrong file
KEYS = descriptions(RideSummary)
"""What the summary of a ride holds."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard estimate``."""
    add_shared(parser, "logs", "--vehicle", "--vehicle-id")
    add_shared(parser, "--payload", help="mass of rider and luggage (default: unknown, also where rides.json says it)")
    add_shared(parser, "--route")
    add_shared(parser, "--filter", "--output", "--json")
    table = f"also write the summaries as a table, a row for each log: {' '.join(FORMATS)}"
    parser.add_argument("--table", type=Path, metavar="FILE", help=table)
    add_shared(parser, "--format", "--no-plot")
    parser.add_argument("--signals", action="store_true", help="also log the signals of each message, once a second")
    parser.add_argument("--frames", action="store_true", help="also log the raw frames and the range frames")
    resume = "keep what an earlier run wrote, where it is whole and of the same log, vehicle, options and version"
    parser.add_argument("--resume", action="store_true", help=resume)
    keep = "take the rides in the order of their times; each continues from this saved state, as the daemon does"
    parser.add_argument("--state", type=Path, metavar="FILE", help=f"{keep} (default: each starts from nothing)")
    add_shared(parser, "--jobs", "--quiet")


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard estimate``: `OK` if every log could be estimated, else `BAD_INPUT`."""
    parts = {"filter_name": arguments.filter, "frames": arguments.frames, "signals": arguments.signals}
    parts |= {"route": arguments.route, "resume": arguments.resume}
    tasks = tasks_of(arguments, EstimateTask, ".estimate.mcap", **parts)
    if arguments.state:
        _check_state(arguments)
    require("matplotlib", not arguments.no_plot)
    if arguments.table:
        check_table(arguments.table)
    written = [arguments.json, arguments.table, *(file for task in tasks for file in (task.log, task.picture))]
    written += state.copies(arguments.state) if arguments.state else ()
    not_an_input(
        written, [*(task.path for task in tasks), *filter(None, [arguments.route]), find_vehicle(arguments.vehicle)]
    )
    known_vehicle(arguments.vehicle, arguments.payload, arguments.vehicle_id)  # its errors are none of a log's
    with held(arguments.state) if arguments.state else contextlib.nullcontext():
        tasks, unread = _in_turn(arguments, tasks) if arguments.state else (tasks, [])
        rides, failed = _estimate(arguments, tasks, unread)
    write_json(arguments.json, SUMMARY_VERSION, {"rides": rides, "failed": failed})
    if arguments.table:
        write_summaries(arguments.table, rides, failed)
    if arguments.state and arguments.state.exists() and arguments.json != "-":
        shown = f"--vehicle {arguments.vehicle} --state {arguments.state}"
        print(f"what was learned is in {arguments.state}; `gz-onboard learned {shown}` shows it")
    return BAD_INPUT if failed else OK


def _check_state(arguments: argparse.Namespace) -> None:
    """InputError for what cannot be together with ``--state``."""
    if (arguments.jobs or 1) > 1:
        raise InputError(f"--jobs {arguments.jobs} with --state: each ride continues from the one before; leave it out")


def _in_turn(arguments: argparse.Namespace, tasks: Sequence[EstimateTask]) -> tuple[list[EstimateTask], list[Unread]]:
    """As `in_order`; InputError if the first that is not kept cannot go on from the state."""
    with _frames_bar(arguments, tasks) as display:
        tasks, unread = in_order(tasks, arguments.state, display.update)
    if arguments.resume:
        tasks = kept_in_turn(tasks)
    *_, last = -1, *(number for number, task in enumerate(tasks) if task.resume)
    for task in tasks[last + 1 : last + 2]:  # the first that goes on from the state that is there
        vehicle = open_estimate(
            task.path, known_vehicle(arguments.vehicle, arguments.payload, arguments.vehicle_id)
        ).vehicle
        if task.state:
            go_on(Pipeline(vehicle), task.state, task.path)
    return tasks, unread


def _estimate(
    arguments: argparse.Namespace, tasks: Sequence[EstimateTask], unread: Sequence[Unread]
) -> tuple[list[RideSummary], list[Failure]]:
    """The summaries, each printed at once, and the failures."""
    with _frames_bar(arguments, tasks) as display:
        results = chain(_results(tasks, 1 if arguments.state else arguments.jobs, display.update), unread)
        text = None if arguments.json == "-" else summary_text
        try:
            return collect("estimate", results, display, text, lambda ride: ride.damage)
        except KeyboardInterrupt:
            if len(tasks) > 1:
                display.print("gz-onboard estimate: interrupted; --resume continues after what is written", sys.stderr)
            raise


def _frames_bar(
    arguments: argparse.Namespace, tasks: Sequence[EstimateTask]
) -> contextlib.AbstractContextManager[Display]:
    return progress_bar(lambda: expected_frames([task.path for task in tasks]), "frames", quiet=arguments.quiet)


def _results(
    tasks: Sequence[EstimateTask], jobs: int | None, progress: Progress
) -> Iterator[tuple[EstimateTask, RideSummary | InputError]]:
    """Each task with its summary or its error, in order."""
    try:
        yield from over_rides(estimate_log, tasks, jobs, progress)
    finally:
        for task in tasks:  # of processes that were stopped
            with contextlib.suppress(OSError):  # no such folder; why was reported
                task.part.unlink(missing_ok=True)


# --- what a person sees -------------------------------------------------------------------------------------------


def expected_frames(logs: Sequence[Path]) -> int | None:
    """About how many frames all the logs hold; None if that of one is unknown."""
    sizes = [_expected(log) for log in logs]
    return sum(size for size in sizes if size) if all(sizes) else None


def _expected(path: Path) -> int | None:
    """About how many frames the log holds: as its header says, or by the length of its lines; None if unknown."""
    try:
        with path.open("rb") as file:
            head = file.read(65536)
        if path.suffix.lower() == ".blf":
            return int.from_bytes(head[32:36], "little")
        if is_table(path):
            return None
        if path.suffix.lower() in (".log", ".asc", ".trc", ".csv"):
            return path.stat().st_size * head.count(b"\n") // max(len(head), 1)
    except OSError:
        pass
    return None


def summary_text(ride: RideSummary) -> str:
    """A ride's summary for a terminal."""
    rows = summary_rows(ride)
    fast = f"{ride.cpu_s:.2f} s of CPU time, {number(ride.real_time_factor, '.0f')} times real time"
    rows.append(("computed", fast if ride.cpu_s else "by an earlier run"))
    if ride.log:
        rows.append(("written", f"{ride.log}{f' and {Path(ride.plot).suffix}' if ride.plot else ''}"))
    return text_rows(ride.file, rows)


def summary_rows(ride: RideSummary) -> list[tuple[str, str]]:
    """What a summary says of the ride: names and texts, the same for the same ride."""
    return [
        (
            "ride",
            f"{clock(ride.duration_s)}, {ride.distance_km:z.2f} km, max {number(ride.speed_max_km_h, '.0f', 'km/h')}",
        ),
        *_energy_rows(ride),
        (
            "state of charge",
            f"{_percent(ride.soc_start, ride.soc_start_sd)} at the start, "
            f"{_percent(ride.soc_end, ride.soc_end_sd)} at the end",
        ),
        ("range at the end", _range(ride)),
        *([("route", route_text(ride.route))] if ride.route else []),
        *([("", off)] if ride.route and (off := off_text(ride.route, ride.distance_km)) else []),
        *([("saved state", _state_text(ride))] if ride.saved_state else []),
        (
            "innovation",
            f"{number(ride.innovation_rms_v, '.1f', 'mV', 1000)} RMS, "
            f"{number(ride.innovation_max_v, '.0f', 'mV', 1000)} max, per cell",
        ),
        (
            "frames",
            f"{ride.frames} received, {ride.dropped} dropped, {ride.lost} lost, "
            f"{ride.unknown} unknown identifiers, {ride.error_frames} error frames",
        ),
        *(("clock", text) for text in ride.clock),
        *([("pauses", f"{clock(ride.paused_s)} without frames, not counted as ridden")] if ride.paused_s else []),
        *([("gaps", f"{ride.gaps_s:.1f} s, missing from distance and energy")] if ride.gaps_s else []),
        *(
            ("someone else's", f"{count} frames on {identifier}, a range frame's: give another range_identifier")
            for identifier, count in ride.foreign.items()
        ),
        *(
            ("sensor faults", f"{reason}: " + ", ".join(f"{name} {count}" for name, count in places.items()))
            for reason, places in ride.faults.items()
        ),
        ("state", ", ".join(f"{name.lower()} {duration:.1f} s" for name, duration in ride.states.items())),
        *(("", f"{words(name)} {duration:.1f} s") for name, duration in ride.reasons.items()),
        *(
            _capacity(ride)
            or ([("vehicle file", CONTRADICTED.format(ride.file))] if contradicted(ride) else _own_gauge(ride))
        ),
        *([("left out", _durations(ride.distrusted))] if ride.distrusted else []),
        *([("never there", ", ".join(words(name) for name in ride.lacking))] if ride.lacking else []),
    ]


def contradicted(ride: RideSummary) -> bool:
    """Whether what was measured contradicts the vehicle file, or itself, for most of the ride."""
    longest = max(ride.reasons.get(str(reason.name), 0.0) for reason in CONTRADICTING)
    return longest > MOST * sum(ride.states.values()) or (ride.innovation_rms_v or 0.0) > UNFIT


def _capacity(ride: RideSummary) -> list[tuple[str, str]]:
    """What to say of the file's capacity, if the vehicle's own gauge moved quite otherwise by the charge counted."""
    first, last, charge, file = ride.soc_shown_start, ride.soc_shown_end, ride.charge_ah, ride.capacity_ah
    if first is None or last is None or charge is None or file is None or abs(first - last) < FAR_OFF:
        return []
    fits = charge / (first - last)
    least, _, most = gains(first - last)
    if fits <= 0 or least < fits / file < most:
        return []
    text = f"the vehicle itself shows {100 * first:.0f} to {100 * last:.0f} % over {charge:.1f} A·h, as a pack of "
    text += f"{fits:.1f} A·h would; the file's has {file:.1f} A·h: cell_capacity, cells_parallel, the current's scale "
    return [("vehicle file", f"{text}or the gauge is wrong; {TOLD.format(ride.file)}")]


def _own_gauge(ride: RideSummary) -> list[tuple[str, str]]:
    """What to say of the vehicle's own gauge, if it shows quite another state of charge."""
    shown, found, sd = ride.soc_shown_end, ride.soc_end, ride.soc_end_sd or 0.0
    if shown is None or found is None or abs(shown - found) < max(FAR_OFF, SURE * sd):
        return []
    away = f"the vehicle itself shows {100 * shown:.0f} % at the end, {100 * abs(shown - found):.0f} points"
    away += f" {'more' if shown > found else 'less'}: its gauge or the vehicle file is wrong"
    return [("vehicle file", f"{away}; {TOLD.format(ride.file)}")]


def _energy_rows(ride: RideSummary) -> list[tuple[str, str]]:
    if ride.energy_wh is None:
        return [("energy", "not known: voltage or current of the pack was not measured, or too seldom")]
    text = (
        f"{ride.energy_wh:.0f} Wh drawn net, after {number(ride.energy_recovered_wh, '.0f', 'Wh')} recovered; "
        f"{number(ride.consumption_wh_km, '.1f', 'Wh/km')}"
    )
    if ride.energy_charged_wh:
        text += f"; {ride.energy_charged_wh:.0f} Wh charged"
    lacks = lacks_energy(ride)
    return [("energy", text), *([("", f"of {ride.energy_distance_km:.2f} km: {lacks}")] if lacks else [])]


def lacks_energy(ride: RideSummary) -> str:
    """What a known energy does not hold of the ride; empty if it is next to nothing."""
    if ride.energy_wh is None or ride.energy_missing_s < LEAST_MISSING:
        return ""
    return f"{ride.energy_missing_s:.1f} s without a credible voltage or current are not included"


def _range(ride: RideSummary) -> str:
    if ride.soc_start is None and Reason.NO_PACK_VOLTAGE.name in ride.lacking:
        return "none: no voltage of the pack or the inverter came"
    return (
        f"{number(ride.range_end_km, '.1f', 'km')} "
        f"({number(ride.range_end_p10_km, '.1f')} to "
        f"{number(ride.range_end_p90_km, '.1f')}, 80 % interval), "
        f"{number(ride.energy_left_wh, '.0f', 'Wh')} left"
    )


def _state_text(ride: RideSummary) -> str:
    if ride.saved_state == "new":
        return "new with this ride"
    age, day = ride.saved_state_age_s, 24 * HOUR
    old = "of an unknown age" if age is None else f"{age / day:.1f} days old" if age > 2 * day else f"{clock(age)} old"
    return f"resumed, {old} at the start"


def _durations(seconds: Mapping[str, float]) -> str:
    """Each role with its time [s]."""
    return ", ".join(f"{words(role)} {duration:.1f} s" for role, duration in seconds.items())


def _percent(value: float | None, sd: float | None) -> str:
    return "–" if value is None or sd is None else f"{100 * value:.1f} ± {100 * sd:.1f} %"
