"""``gz-onboard report``: recorded rides as one self-contained HTML page, for phone and desktop."""

from __future__ import annotations

import argparse
import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array, held_at
from gz_onboard.can.codec import LONGEST_PAUSE_NS, Codec
from gz_onboard.constants import WH
from gz_onboard.errors import BAD_INPUT, OK, InputError, not_an_input, writing
from gz_onboard.estimation.ride import MemoryLog, RideOptions, known_vehicle, open_estimate, run_ride, vehicle_of
from gz_onboard.estimation.summary import RideSummary, Why, missing_energy, summary_of, summary_rows
from gz_onboard.estimator.load_model import Ledger
from gz_onboard.estimator.signals import FIX_2D
from gz_onboard.events import TOLD, cause_words, words
from gz_onboard.log_rows import ESTIMATE_TOPIC
from gz_onboard.options import add_shared
from gz_onboard.processes import Task, collect, over_rides
from gz_onboard.progress import Progress, progress_bar
from gz_onboard.recording.logs import logs_among
from gz_onboard.recording.recording import extended, read_roles, ride_name
from gz_onboard.recording.tables import SignalTable
from gz_onboard.reports.charts import TEMPERATURE_COLOURS, Row, Series, overview, path_map, range_over_distance
from gz_onboard.reports.page import Bar, bar_table, drawn, html_table, page, tiles
from gz_onboard.reports.results import FIRST_DATE_NS, clock, number
from gz_onboard.routes.route import read_route
from gz_onboard.vehicle import Vehicle, find_vehicle

MIN_ENTRY_WH = 0.05
"""Smaller entries of the ledger are left out."""
LONGEST_GAP_S = 10.0
"""Samples further apart have a hole between them."""
MAX_CHANGES = 20
LEARNED_CAUSES = ("riding", "unexplained", "payload", "rolling", "drag")
"""Causes that a sensor which is left out may have taught."""

Position = tuple[float, float]
"""Latitude and longitude [deg]."""


@dataclass(frozen=True)
class ReportTask(Task):
    """A log for the page. located: whether the page shows where the ride was."""

    route: Path | None = None
    located: bool = True


@dataclass(frozen=True)
class ReportedRide:
    """A ride. rows: its estimates, one a second; ledger: of the riding that the forecast learned from;
    path: the positions, a sequence between two holes each; temperatures: by role [degC].
    """

    name: str
    summary: RideSummary
    rows: Sequence[Row]
    ledger: Ledger
    path: list[list[Position]]
    temperatures: dict[str, Series]

    @property
    def ledger_km(self) -> float:
        """The distance that the ledger is of, like the energy."""
        return self.summary.energy_distance_km or self.summary.distance_km

    def ledger_wh(self) -> dict[str, float]:
        """Split the energy [Wh] by effect, the largest first; negative entries gave energy.

        ``beyond the model``: measured less modelled; ``not modelled``: drawn while nothing was learned, as while
        charging, standing long or with a sensor in doubt.
        """
        drawn_wh, modelled = self.summary.energy_wh, self.ledger.modelled
        entries = {words(name): joule / WH for name, joule in modelled.items()}
        if entries:
            entries["beyond the model"] = (self.ledger.measured - sum(modelled.values())) / WH
        if entries and drawn_wh is not None:
            entries["not modelled"] = drawn_wh - self.ledger.measured / WH
        return dict(sorted(entries.items(), key=lambda entry: -entry[1]))


@dataclass(frozen=True)
class RideSection:
    """A ride in the page. cells: its row in the table of all rides, the name first; html: its section."""

    anchor: str
    cells: list[str]
    html: str
    damage: str | None


# --- the command --------------------------------------------------------------------------------------------------


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
    logs = logs_among(arguments.logs)
    out = arguments.output or Path(f"{ride_name(logs[0]) if len(logs) == 1 else 'rides'}.html")
    not_an_input([out], [*logs, *filter(None, [arguments.route]), find_vehicle(arguments.vehicle)])
    check_page(out)
    known_vehicle(arguments.vehicle, arguments.payload)  # its errors concern every log
    given = arguments.vehicle, arguments.payload, False
    more = {"route": arguments.route, "located": not arguments.no_path}
    tasks = [ReportTask(log, Path(f"ride-{i}"), *given, **more) for i, log in enumerate(logs, 1)]
    with progress_bar(lambda: len(logs), "rides", quiet=arguments.quiet) as display:
        results = over_rides(_section_of_log, tasks, arguments.jobs, display.update)
        found, failed = collect("report", results, display, None, lambda ride: ride.damage)
    if found:
        with writing(out):
            out.write_text(page_of(found), encoding="utf-8", errors="replace")
        print(out)
    return BAD_INPUT if failed else OK


def check_page(out: Path) -> None:
    """InputError for a page that cannot be written, before the rides are read."""
    if out.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{out}: the report is a page in HTML; give it a name that ends in .html")
    if not out.parent.is_dir():
        raise InputError(f"{out}: cannot be written: there is no folder {out.parent}; make it")


def _section_of_log(task: ReportTask) -> RideSection:
    """The section of the page for one log. Raises InputError."""
    return section_of(report_of(task.path, vehicle_of(task), task.route, task.located), task.stem.name)


# --- the ride -----------------------------------------------------------------------------------------------------


def report_of(
    source: Path | SignalTable,
    vehicle: Vehicle,
    route: Path | None = None,
    located: bool = True,
    progress: Progress | None = None,
) -> ReportedRide:
    """Estimate a ride as the daemon would, with its ledger, path and temperatures. Raises InputError."""
    log, ride = MemoryLog(), open_estimate(source, vehicle)
    road = read_route(route) if route else None
    ridden = run_ride(ride, RideOptions(route=road, ledger=True), log, progress)
    codec = Codec(extended(ride.vehicle.mapping), LONGEST_PAUSE_NS)
    columns = read_roles(ride.source, ride.vehicle, codec, ride.frames)
    return ReportedRide(
        ride_name(ride.source),
        summary_of(ridden),
        [dict(row) for row in log.values(ESTIMATE_TOPIC)],
        ridden.pipeline.estimator.forecaster.load.ledger or Ledger(),
        path_of(columns) if located else [],
        {role: _series(*columns[role]) for role in TEMPERATURE_COLOURS if role in columns},
    )


def _series(times: Array, values: Array) -> Series:
    """The samples of a role, with a NaN in each hole, through which no line is drawn."""
    holes = np.flatnonzero(np.diff(times) > LONGEST_GAP_S) + 1
    return np.insert(times, holes, times[holes]).tolist(), np.insert(values, holes, np.nan).tolist()


def path_of(columns: Mapping[str, tuple[Array, Array]]) -> list[list[Position]]:
    """The positions by a receiver with a fix, split at holes; empty with fewer than two. columns: by role."""
    if not {"latitude", "longitude"} <= columns.keys():
        return []
    times, latitude = columns["latitude"]
    longitude = held_at(times, *columns["longitude"])
    seen = times >= columns["longitude"][0][0]
    if "gps_fix" in columns:
        seen &= held_at(times, *columns["gps_fix"]) >= FIX_2D
    places = np.column_stack([latitude, longitude])[seen]
    runs = np.split(places, np.flatnonzero(np.diff(times[seen]) > LONGEST_GAP_S) + 1)
    return [[(a, b) for a, b in run.tolist()] for run in runs if len(run) > 1]


# --- the page -----------------------------------------------------------------------------------------------------


def page_of(rides: Sequence[RideSection]) -> str:
    """The page of all rides in their order; several have a table of contents."""
    if len(rides) == 1:
        return page(rides[0].cells[0], [rides[0].html])
    heads = ("ride", "start", "time", "km", "Wh/km", "SOC", "range left, km")
    contents = html_table(heads, [ride.cells for ride in rides], range(1, 7), [ride.anchor for ride in rides])
    title = f"{len(rides)} rides"
    return page(title, [f"<h1>{title}</h1>", contents, *(ride.html for ride in rides)])


def section_of(ride: ReportedRide, anchor: str) -> RideSection:
    """The section of a ride; anchor: its id in the page."""
    s = ride.summary
    # The page may be sent to somebody, whom our folders do not concern.
    damage = [f"damaged log: {s.damage.replace(s.file, '').lstrip(': ')}"] if s.damage else []
    about = " · ".join([s.vehicle, _start(s.start_ns), Path(s.file).name, *damage])
    parts = [
        f'<h2>{html.escape(ride.name)}</h2><p class="about">{html.escape(about)}</p>',
        _tiles(ride),
        f"<h3>Path</h3>{drawn(path_map(ride.path), 'the path, north up')}" if ride.path else "",
        *(_charts(ride) if ride.rows else []),
        _ledger(ride),
        _why(s.why),
        _changes(s.changes),
        f'<h3>Summary</h3><div class="summary">{html_table(("", ""), summary_rows(s))}</div>',
    ]
    text = f'<section class="ride" id="{anchor}">' + "\n".join(filter(None, parts)) + "</section>"
    numbers = [number(s.distance_km, ".2f"), number(s.consumption_wh_km, ".1f"), _soc(s), number(s.range_end_km, ".1f")]
    return RideSection(anchor, [ride.name, _start(s.start_ns), clock(s.duration_s), *numbers], text, s.damage)


def _start(start_ns: int) -> str:
    if start_ns < FIRST_DATE_NS:
        return "–"
    return datetime.fromtimestamp(start_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M UTC")


def _soc(s: RideSummary) -> str:
    return f"{number(s.soc_start, '.1f', '', 100)} → {number(s.soc_end, '.1f', '%', 100)}"


def _tiles(ride: ReportedRide) -> str:
    s = ride.summary
    recovered = number(s.energy_recovered_wh, ".0f", "Wh")
    missing = missing_energy(s)
    over = f"over {s.energy_distance_km:.2f} km: {missing}" if missing else "over the ride"
    band = f"{number(s.range_end_p10_km, '.1f')} to {number(s.range_end_p90_km, '.1f')} km"
    return tiles(
        [
            ("distance", number(s.distance_km, ".2f", "km"), f"in {clock(s.duration_s)}"),
            ("energy", number(s.energy_wh, ".0f", "Wh"), f"drawn, {recovered} recovered"),
            ("consumption", number(s.consumption_wh_km, ".1f", "Wh/km"), over),
            ("soc", _soc(s), f"state of charge, ± {number(s.soc_end_sd, '.1f', '%', 100)}"),
            ("range", number(s.range_end_km, ".1f", "km"), f"range left, {band}"),
        ]
    )


def _charts(ride: ReportedRide) -> Iterable[str]:
    """The range against its outcome, and the overview."""
    known = [row for row in ride.rows if row["range"] is not None]
    if known:
        yield f"<h3>Range over the distance</h3>{drawn(range_over_distance(ride.rows), 'range over the distance')}"
        first, last = (
            f"{row['range'] / 1e3:.1f} km ({row['range_p10'] / 1e3:.1f} to {row['range_p90'] / 1e3:.1f})"
            for row in (known[0], known[-1])
        )
        text = f"At first it said {first}, and {(known[-1]['distance'] - known[0]['distance']) / 1e3:.2f} km later"
        yield f'<p class="note" data-of="forecast">{text} {last}.</p>'
    figure = overview(ride.rows, temperatures=ride.temperatures)
    yield f"<h3>Over time</h3>{drawn(figure, 'range, charge, pack, motion, consumption, temperatures and state')}"


def _ledger(ride: ReportedRide) -> str:
    """The energy by effect of the model, and the rest of the measured energy."""
    drawn_wh, distance = ride.summary.energy_wh, ride.ledger_km

    def bar(name: str, energy: float, colour: str) -> Bar:
        per_km = f"{energy / distance:z.1f}" if distance >= 0.1 else "–"
        return Bar(name, 0.0, energy if colour else 0.0, colour, (f"{energy:z.1f}", per_km))

    entries = {name: energy for name, energy in ride.ledger_wh().items() if abs(energy) >= MIN_ENTRY_WH}
    if not entries:
        return ""
    bars = [bar(name, energy, "blue" if energy > 0 else "green") for name, energy in entries.items()]
    kind = "" if drawn_wh is None else "total"
    if drawn_wh is not None:
        bars.append(bar("drawn from the pack", drawn_wh, ""))
    return (
        "<h3>Where the energy went</h3><p class=note>By the model, second by second. Beyond the model: measured less "
        "modelled. Not modelled: drawn while nothing was learned, as while charging, standing long or with a sensor in "
        f"doubt. Negative: gained.</p>{bar_table('ledger', bars, ('Wh', 'Wh/km'), kind)}"
    )


def _largest(causes: dict[str, float]) -> list[tuple[str, float]]:
    """The causes [km] that are worth showing, the largest first."""
    return sorted(((n, km) for n, km in causes.items() if abs(km) * 1e3 >= TOLD), key=lambda cause: -abs(cause[1]))


def _why(why: Why | None) -> str:
    """From the rated range to that at the end, cause by cause."""
    if why is None:
        return ""
    bars = [Bar("rated range", 0.0, why.reference_km, "grey", (f"{why.reference_km:.1f}",))]
    for name, size in _largest(why.causes_km):
        begin = bars[-1].end
        bars.append(Bar(cause_words(name), begin, begin + size, "green" if size > 0 else "red", (f"{size:+.1f}",)))
    bars.append(Bar("range", 0.0, why.range_km, "blue", (f"{why.range_km:.1f}",)))
    return (
        f"<h3>Why the range is not the rated one</h3><p class=note>At {clock(why.time_s)}, in km; causes below "
        f"{TOLD:.0f} m are left out.</p>{bar_table('why', bars)}"
    )


def changed_by(change: Why) -> dict[str, float]:
    """Causes of a change [km], in words; what a sensor that is left out has taught is one cause."""
    causes = {cause_words(name): km for name, km in change.causes_km.items()}
    if change.forgotten:
        left_out = " and ".join(map(words, change.forgotten))
        learned = sum(causes.pop(cause_words(name), 0.0) for name in LEARNED_CAUSES)
        causes[f"{left_out} left out, what it taught forgotten"] = learned
    return causes


def _changes(changes: Sequence[Why]) -> str:
    """Each change of the range beyond the distance ridden, and its causes."""
    if not changes:
        return ""
    rows = []
    for change in changes[-MAX_CHANGES:]:
        causes = ", ".join(f"{name} {km:+.1f}" for name, km in _largest(changed_by(change)))
        rows.append([clock(change.time_s), f"{change.range_km - change.reference_km:+.1f}", causes])
    more = f"; the last {MAX_CHANGES} of {len(changes)}" if len(changes) > MAX_CHANGES else ""
    title = f"<h3>Changes of the range, in km, beyond the distance ridden{more}</h3>"
    return f'{title}<div data-of="changes">{html_table(("at", "by", "why"), rows, (1,))}</div>'
