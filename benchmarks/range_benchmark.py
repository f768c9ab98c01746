"""Measure the range on full discharges and weeks of simulated scooters, against usual estimators.

Scooters of the tests' plant, whose physics, integrator and sensors are not the package's, are ridden by seed until they
give up: riders of 48 to 118 kg, towns and arterial roads, hills, -5 to 35 degC. Their CAN frames go through the
daemon's pipeline with the reference scooter's file and no saved state, without and with the route (altitude of a map,
bends, limits, no stops). Of five rides two are healthy scooters on one kind of road, one is a journey through towns and
between them with climbs of some kilometres, one has an aged pack (20 % less capacity, 50 % more resistance; discharged
twice), one a tyre that loses its air after 40 minutes. Healthy logs are also read from 60 % of charge on. A week has
fifteen rides of 4 to 9 km with rests and charges; the state is kept.

Seeds below 1000 are for development; those below 1125 were seen while the forecast was corrected.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.range_rides import Drawn, Truth, again, draw, ride_until_empty, road_of, route_of
from benchmarks.range_week import NIGHT, RIDES, Ride, ride_weeks
from benchmarks.range_yardstick import BUT_FOR_HEIGHT, NAMES, OURS, Usual, crps, jumps
from benchmarks.trial import commit
from gz_onboard.arrays import Array
from gz_onboard.events import Estimate
from gz_onboard.pipeline import Pipeline
from gz_onboard.progress import progress_bar
from gz_onboard.recording.decode import feed
from gz_onboard.recording.logs import read_log
from gz_onboard.routes.route import read_route
from gz_onboard.vehicle import read_vehicle

PAGE = Path(__file__).parents[1] / "docs" / "results" / "range-benchmark.md"
PICTURE = "../images/range-benchmark.png"  # from the page
FIRST = 1125
TOGETHER = 15  # rides that are ridden at once, for memory
LEVELS = tuple(x / 10 for x in range(9, 0, -1))  # SOC, at which estimates are judged
JUDGED_FROM = 0.2  # SOC: below, an error is of little use in per cent
RATED = 33.6 * 51.8 * 3600  # J of the pack's data sheet
RATED_RANGE = RATED / (26.0 * 3.6)  # m: at the consumption of its commissioning rides without hills
SOME_WAY = 0.05  # of the ride, before which jumps do not count
LEARNED_FROM = 2  # day of a week, from 0, from which something must have been learned
JOINED = 0.6  # SOC from which a late daemon listens
TITLES = {
    "healthy": "healthy, one kind of road",
    "journey": "healthy, journeys with long climbs",
    "aged": "aged packs, first discharge",
    "second": "aged packs, second discharge",
    "punctured": "a tyre loses its air",
    "joined": "joined at 60 % of charge",
}
HEALTHY = "healthy", "journey"  # kinds whose packs and tyres are as their file says
HALF = 0.5  # SOC from which on coverage is reported separately
KEY = "range benchmark"  # of the vehicle, in its saved states
ADVANCED = 20.0  # m between two looks at the interval
COLUMNS = "ridden", "ours", "P10", "P90", "rival"
RIVAL = "rolling"  # of the usual estimators, the one in the picture
State = dict[str, Any] | None


class Interval(NamedTuple):
    """P10 and P90 [m]."""

    low: float
    high: float


@dataclass(frozen=True)
class Row:
    """One ride at one state of charge; distances in m."""

    level: float
    true: float
    ranges: dict[str, float]
    intervals: dict[str, Interval]
    soc_error: float
    soc_sd: float


@dataclass(frozen=True)
class Judged:
    """What one ride gave; held, held_late, jumps: by estimator, see `Followed`."""

    drawn: Drawn
    kind: str  # see `TITLES`
    length: float  # m
    rows: list[Row]
    held: dict[str, float]
    held_late: dict[str, float]
    jumps: dict[str, list[float]]
    way: list[tuple[float, ...]]  # along it, without a route: see `COLUMNS` [m]


@dataclass(frozen=True)
class Followed:
    """One log through the pipeline once."""

    rows: list[Row]
    held: float  # share of the way on which P10 to P90 holds the truth
    held_late: float  # the same, of the way from half the charge on
    jumps: list[float]  # m, of each km
    way: list[tuple[float, ...]]  # see `COLUMNS`
    state: State  # at its end


def follow(
    name: str, log: Path, truth: Truth, state: State = None, route: Path | None = None, since: float = 0.0
) -> Followed:
    """The log through the pipeline against its truth, with a state that was kept and a route; ours is called `name`.

    since: the time [s] before which nobody listens.
    """
    usual, waiting = Usual(RATED, RATED_RANGE), [x for x in LEVELS if x < np.interp(since, truth.time, truth.soc)]
    rows: list[Row] = []
    way: list[tuple[float, ...]] = []
    before = 0.0

    def observe(e: Estimate) -> None:
        nonlocal before
        if e.pack_current is None or e.pack_voltage is None or e.range is None:
            return
        usual.ride(e.pack_voltage * e.pack_current, e.speed or 0.0, e.time - before if before else 0.0)
        before = e.time
        distance, soc = (float(np.interp(since + e.time, truth.time, x)) for x in (truth.distance, truth.soc))
        held = Interval(e.range_p10 or 0.0, e.range_p90 or 0.0)
        if not way or distance - way[-1][0] > ADVANCED:
            shown = pipeline.estimator.signals["bms_state_of_charge"].value
            way.append((distance, e.range, *held, usual.ranges(shown)[RIVAL]))
        if waiting and soc <= waiting[0]:
            shown = pipeline.estimator.signals["bms_state_of_charge"].value
            left, error = truth.distance[-1] - distance, (e.soc or 0.0) - soc
            ranges = {name: e.range, **usual.ranges(shown), BUT_FOR_HEIGHT: float(truth.but_for_height(since + e.time))}
            rows.append(Row(waiting.pop(0), left, ranges, {name: held}, error, e.soc_sd or 0.0))

    pipeline = Pipeline(read_vehicle("reference"), observer=observe)
    if state:
        pipeline.estimator.restore(state, KEY, NIGHT)
    if route:
        forecaster = pipeline.estimator.route
        forecaster.follow(forecaster.prepare(read_route(route)))
    frames = read_log(log)
    feed(pipeline, frames[frames.time_ns >= frames.time_ns[0] + since * 1e9])
    at = np.array(way)
    left = truth.distance[-1] - at[:, 0]
    later = at[:, 0] > at[0, 0] + SOME_WAY * truth.distance[-1]
    holds = (at[:, 2] <= left) & (left <= at[:, 3])
    late = np.interp(at[:, 0], truth.distance, truth.soc) <= HALF
    moved, state = list(jumps(at[later, 0], at[later, 1])), pipeline.estimator.snapshot(KEY)
    return Followed(rows, float(np.mean(holds)), float(np.mean(holds[late])), moved, way, state)


def judge(drawn: Drawn, log: Path, truth: Truth, state: State, kind: str) -> tuple[Judged, State]:
    """One discharge, without a route and with it, each from the `state` kept; and the state kept at its end."""
    route = log.with_suffix(".route.csv")
    route.write_text(route_of(road_of(drawn), positions=False), encoding="utf-8")
    since = truth.time[np.searchsorted(-truth.soc, -JOINED)] if kind == "joined" else 0.0
    free = follow("ours", log, truth, state, since=since)
    ahead = follow("route", log, truth, state, route, since)
    rows = [
        Row(a.level, a.true, a.ranges | b.ranges, a.intervals | b.intervals, a.soc_error, a.soc_sd)
        for a, b in zip(free.rows, ahead.rows, strict=True)
    ]
    held, late, moved = ({"ours": getattr(free, x), "route": getattr(ahead, x)} for x in ("held", "held_late", "jumps"))
    moved[BUT_FOR_HEIGHT] = known_jumps(truth, since)
    return Judged(drawn, kind, float(truth.distance[-1]), rows, held, late, moved, free.way), free.state


def known_jumps(truth: Truth, since: float) -> list[float]:
    """As `Followed.jumps`, of who knows everything but the height: what no estimator without a route can spare."""
    begin, end = np.interp(since, truth.time, truth.distance), truth.distance[-1]
    judged = (truth.distance > begin + SOME_WAY * end) & (truth.distance < end - ADVANCED)
    return list(jumps(truth.distance[judged], truth.but_for_height(truth.time[judged])))


def _judged(given: tuple[Drawn, Path, Truth, State, str]) -> tuple[Judged, State]:
    return judge(*given)


def run(drawn: Sequence[Drawn], jobs: int, *, quiet: bool = False) -> list[Judged]:
    """All discharges, a few at a time; those of aged packs twice, those of healthy ones also joined midway."""
    found: list[Judged] = []
    number = len(drawn) + sum(x.condition in ("aged", "healthy") for x in drawn)
    with (
        progress_bar(lambda: float(number), "discharge", quiet=quiet) as bar,
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(jobs) as pool,
    ):
        for k in range(0, len(drawn), TOGETHER):
            part = list(drawn[k : k + TOGETHER])
            states: list[State] = [None] * len(part)
            for second in (False, True):
                ridden = ride_until_empty(part, Path(folder)) if part else []
                given = []
                for x, way, state in zip(part, ridden, states, strict=True):
                    given.append((x, *way, state, "second" if second else x.condition))
                    given += [(x, *way, None, "joined")] if x.condition == "healthy" else []
                kept = []
                for judged, state in pool.map(_judged, given):
                    found.append(judged)
                    bar.update(1.0)
                    kept += [(again(judged.drawn), state)] if judged.kind == "aged" else []
                for log, _ in ridden:
                    log.unlink()
                part, states = [x for x, _ in kept], [x for _, x in kept]
    return found


# --- weeks -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Day:
    """One ride of a week."""

    week: int
    number: int
    day: int
    length: float  # m
    expected: float  # J/m at its start
    ridden: float  # J/m
    soc_error: float  # at its end


def follow_ride(ride: Ride, state: State) -> tuple[Day, State]:
    """A ride of a week, from the state that the one before left."""
    expected: list[float] = []
    last: list[float] = []

    def observe(e: Estimate) -> None:
        if e.consumption_expected is not None:
            expected.append(e.consumption_expected)
        if e.soc is not None:
            last[:] = [e.soc - float(np.interp(e.time, ride.truth.time, ride.truth.soc))]

    pipeline = Pipeline(read_vehicle("reference"), observer=observe)
    if state:
        pipeline.estimator.restore(state, KEY, ride.away)
    feed(pipeline, read_log(ride.log))
    length = float(ride.truth.distance[-1])
    day = Day(ride.week, ride.number, ride.day, length, expected[0], ride.energy, last[0])
    return day, pipeline.estimator.snapshot(KEY)


def run_weeks(seeds: Sequence[int], jobs: int, *, quiet: bool = False) -> list[Day]:
    """All weeks side by side."""
    days: list[Day] = []
    states: dict[int, State] = dict.fromkeys(seeds)
    with (
        progress_bar(lambda: float(RIDES * len(seeds)), "ride", quiet=quiet) as bar,
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(jobs) as pool,
    ):
        for rides in ride_weeks(seeds, Path(folder)) if seeds else ():
            for day, state in pool.map(follow_ride, rides, [states[ride.week] for ride in rides]):
                days.append(day)
                states[day.week] = state
                bar.update(1.0)
            for ride in rides:
                ride.log.unlink()
    return days


# --- tables ----------------------------------------------------------------------------------------------------------


def judged_rows(judged: Sequence[Judged]) -> list[Row]:
    """Each ride at each tenth of charge that counts."""
    return [row for x in judged for row in x.rows if row.level >= JUDGED_FROM]


def error_percent(rows: Sequence[Row], name: str) -> Array:
    """Errors of the remaining distance [%]."""
    return np.array([100 * (row.ranges[name] / row.true - 1) for row in rows])


def median_table(groups: Mapping[str, Sequence[Judged]]) -> list[str]:
    """Median error of every estimator, a row for each group of discharges."""
    lines = ["| discharges | " + " | ".join(NAMES.values()) + " |", "|---" * (len(NAMES) + 1) + "|"]
    for title, judged in groups.items():
        rows = judged_rows(judged)
        cells = [f"{np.median(np.abs(error_percent(rows, name))):.1f}" for name in NAMES]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return lines


def interval_table(groups: Mapping[str, Sequence[Judged]], name: str) -> list[str]:
    """Tails, interval, score and jumps of one of our estimators, a row for each group of discharges."""
    lines = ["| discharges | 90 % | bias | held | width, % | CRPS, km | jumps, km |", "|---" * 7 + "|"]
    for title, judged in groups.items():
        rows = judged_rows(judged)
        error = error_percent(rows, name)
        width = 100 * np.mean([(row.intervals[name].high - row.intervals[name].low) / row.true for row in rows])
        score = np.mean([crps(row.ranges[name], *row.intervals[name], row.true) for row in rows])
        held, late = (100 * np.mean([getattr(x, share)[name] for x in judged]) for share in ("held", "held_late"))
        moved = np.concatenate([x.jumps[name] for x in judged]) / 1000
        cells = [f"{np.percentile(np.abs(error), 90):.1f}", f"{np.mean(error):.1f}", f"{held:.0f}, {late:.0f}"]
        cells += [f"{width:.0f}", f"{score / 1000:.2f}", f"{np.percentile(moved, 90):.2f}, {moved.max():.1f}"]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return lines


def week_table(days: Sequence[Day]) -> list[str]:
    """Consumption expected at the start of rides against that of the whole week, from the third day on."""
    lines = [
        "| week | ridden, km | ridden, Wh/km | from the third day on expected, Wh/km | median error of that, % | "
        "largest SOC error, points |",
        "|---|---|---|---|---|---|",
    ]
    for week in sorted({x.week for x in days}):
        some = [x for x in days if x.week == week]
        mean = sum(x.ridden * x.length for x in some) / sum(x.length for x in some)
        later = [x.expected for x in some if x.day >= LEARNED_FROM]
        error = np.median([abs(x / mean - 1) for x in later])
        span = f"{min(later) / 3.6:.1f} to {max(later) / 3.6:.1f}"
        soc = max(abs(x.soc_error) for x in some)
        way = sum(x.length for x in some) / 1000
        lines.append(f"| {week} | {way:.0f} | {mean / 3.6:.1f} | {span} | {100 * error:.1f} | {100 * soc:.1f} |")
    return lines


def picture(judged: Judged, file: Path) -> None:
    """Draw one ride: range shown and distance really left, over the distance ridden."""
    from matplotlib.figure import Figure

    ridden, ours, p10, p90, rival = np.array(judged.way).T / 1000
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    axes.fill_between(ridden, p10, p90, color="#0072b2", alpha=0.25, linewidth=0, label="80 % interval")
    axes.plot(ridden, ours, color="#0072b2", label="gz_onboard")
    axes.plot(ridden, rival, color="#d55e00", linewidth=1, label=NAMES[RIVAL])
    axes.plot(ridden, judged.length / 1000 - ridden, "k--", linewidth=1.5, label="really left")
    axes.set(xlabel="ridden, km", ylabel="remaining range shown, km", xlim=(0, judged.length / 1000), ylim=(0, None))
    axes.set_title(f"Ride {judged.drawn.seed}: {judged.drawn.kind}, {judged.drawn.ambient:.0f} °C")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(file, dpi=120)


def page(judged: Sequence[Judged], days: Sequence[Day], command: str, version: str) -> str:
    """docs/results/range-benchmark.md."""
    first = "Error and interval of the range on full discharges of simulated scooters, against usual estimators."
    lines = ["# Range benchmark", "", first, "", *(__doc__ or "").partition("\n\n")[2].strip().split("\n"), ""]
    lines += [
        f"Made by `{command}` on commit {version}; `--json FILE` writes every ride.",
        "",
        "- errors of the range in %, at each tenth of charge from 90 to 20 %: median, *90 %* quantile, *bias*",
        "- *held*: share of the way, and of the way from half charge on, on which P10 to P90 contain the truth, %",
        "- *jumps*: change within one km in addition to the distance, 90th percentile and largest",
        "- *all known but the height to come*: the error that no estimator without a route can avoid",
        "",
    ]
    if judged:
        lines += [f"![One ride: range shown and distance really left]({PICTURE})", ""]
    groups = {"all healthy": [x for x in judged if x.kind in HEALTHY]}
    groups |= {title: [x for x in judged if x.kind == kind] for kind, title in TITLES.items()}
    groups = {f"{title} ({len(some)})": some for title, some in groups.items() if some}
    lines += ["## Median error, %", "", *median_table(groups), ""]
    for name, words in OURS.items():
        lines += [f"## Interval of {words}", "", *interval_table(groups, name), ""]
    if days:
        lines += ["## Weeks", "", *week_table(days), ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rides", type=int, default=30, metavar="N", help="so many full discharges (default: 30)")
    parser.add_argument("--weeks", type=int, default=2, metavar="N", help="so many weeks (default: 2)")
    parser.add_argument("--first", type=int, default=FIRST, metavar="SEED", help="of the first (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="rides at a time (default: 2)")
    parser.add_argument("--output", type=Path, default=PAGE, metavar="FILE", help="page to write (default: the docs')")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all rows as JSON, too")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    arguments = parser.parse_args()
    first, rides, weeks = arguments.first, arguments.rides, arguments.weeks
    drawn = [draw(seed) for seed in range(first, first + rides)]
    judged = run(drawn, arguments.jobs, quiet=arguments.quiet)
    days = run_weeks(range(first, first + weeks), arguments.jobs, quiet=arguments.quiet)
    command = f"python -m benchmarks.range_benchmark --rides {rides} --weeks {weeks} --first {first}"
    if judged:
        (file := arguments.output.parent / PICTURE).parent.mkdir(exist_ok=True)
        picture(judged[0], file)
    arguments.output.write_text(page(judged, days, command, commit()), encoding="utf-8")
    if arguments.json:
        found: Mapping[str, list[dict[str, Any]]] = {
            "discharges": [asdict(x) for x in judged],
            "weeks": [asdict(x) for x in days],
        }
        arguments.json.write_text(json.dumps(found), encoding="utf-8")


if __name__ == "__main__":
    main()
