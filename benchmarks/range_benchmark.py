"""How good the range is on full discharges that nothing was set on, beside the usual estimators.

Scooters of the tests' plant, whose physics, integrator and sensors are not the package's, are ridden by seed until they
give up: riders of 48 to 118 kg whom nobody enters, towns and arterial roads, -5 to 35 degC, hills. Their CAN frames go
as logs through the pipeline of the daemon, which knows the reference scooter's file and starts without a saved state.
Every other ride is of an aged pack: 20 % less capacity, 50 % more resistance.

Seeds 0 to 999 are for development; 1000 and up for the table.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from benchmarks.range_rides import Drawn, Truth, draw, ride_until_empty
from benchmarks.range_yardstick import NAMES, Usual, crps, jumps
from benchmarks.trial import commit
from gz_onboard.bus.logs import read_frames
from gz_onboard.events import Estimate
from gz_onboard.pipeline import Pipeline
from gz_onboard.progress import progress_bar
from gz_onboard.vehicle import read_vehicle

PAGE = Path(__file__).parents[1] / "docs" / "range-benchmark.md"
FIRST = 1000
TOGETHER = 4  # rides that are ridden at once, for memory
LEVELS = tuple(x / 10 for x in range(9, 0, -1))  # SOC, at which estimates are judged
RATED = 33.6 * 51.8 * 3600  # J of the pack's data sheet
RATED_RANGE = RATED / (26.0 * 3.6)  # m: at the consumption of its commissioning rides without hills
SOME_WAY = 0.05  # of the ride, before which jumps do not count


@dataclass(frozen=True)
class Row:
    """One ride at one state of charge; distances in m."""

    seed: int
    aged: bool
    ambient: float
    level: float
    true: float
    ranges: dict[str, float]
    p10: float
    p90: float
    soc_error: float
    soc_sd: float


@dataclass(frozen=True)
class Judged:
    """What one ride gave."""

    drawn: Drawn
    length: float  # m
    rows: list[Row]
    held: float  # share of the way on which P10 to P90 holds the truth
    jumps: list[float]  # m, of each km


def judge(drawn: Drawn, log: Path, truth: Truth) -> Judged:
    """The log through the pipeline, against its truth."""
    usual, waiting = Usual(RATED, RATED_RANGE), list(LEVELS)
    rows: list[Row] = []
    way: list[tuple[float, float, float, float]] = []  # distance, range, P10, P90
    before = 0.0

    def observe(e: Estimate) -> None:
        nonlocal before
        if e.pack_current is None or e.pack_voltage is None or e.range is None:
            return
        usual.ride(e.pack_voltage * e.pack_current, e.speed or 0.0, e.time - before if before else 0.0)
        before = e.time
        distance, soc = (float(np.interp(e.time, truth.time, x)) for x in (truth.distance, truth.soc))
        low, high = e.range_p10 or 0.0, e.range_p90 or 0.0
        if not way or distance - way[-1][0] > 20:
            way.append((distance, e.range, low, high))
        if waiting and soc <= waiting[0]:
            shown = pipeline.estimator.signals["bms_state_of_charge"].value
            ranges = {"ours": e.range, **usual.ranges(shown)}
            left, (error, sd) = truth.distance[-1] - distance, ((e.soc or 0.0) - soc, e.soc_sd or 0.0)
            fields = (drawn.seed, drawn.aged, drawn.ambient, waiting.pop(0), left, ranges, low, high, error, sd)
            rows.append(Row(*fields))

    pipeline = Pipeline(read_vehicle("reference"), observer=observe)
    for frames in read_frames(log):
        pipeline.advance(frames, frames[-1][0])
    at = np.array(way)
    left = truth.distance[-1] - at[:, 0]
    held = float(np.mean((at[:, 2] <= left) & (left <= at[:, 3])))
    later = at[:, 0] > SOME_WAY * truth.distance[-1]
    return Judged(drawn, float(truth.distance[-1]), rows, held, list(jumps(at[later, 0], at[later, 1])))


def _judged(given: tuple[Drawn, Path, Truth]) -> Judged:
    return judge(*given)


def run(drawn: Sequence[Drawn], jobs: int, *, quiet: bool = False) -> list[Judged]:
    """All rides, a few at a time."""
    found: list[Judged] = []
    with (
        progress_bar(lambda: float(len(drawn)), "ride", quiet=quiet) as bar,
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(jobs) as pool,
    ):
        for k in range(0, len(drawn), TOGETHER):
            part = drawn[k : k + TOGETHER]
            ridden = ride_until_empty(part, Path(folder))
            given = [(x, log, truth) for x, (log, truth) in zip(part, ridden, strict=True)]
            for judged in pool.map(_judged, given):
                found.append(judged)
                bar.update(1.0)
            for log, _ in ridden:
                log.unlink()
    return found


def table(judged: Sequence[Judged]) -> list[str]:
    """Errors of the remaining distance above 20 % of charge."""
    rows = [row for x in judged for row in x.rows if row.level >= 0.2]
    lines = [
        "| estimator | median error, % | 90th percentile, % | bias, % | in P10 to P90, % | width, % | CRPS, km |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for name, words in NAMES.items():
        error = np.array([100 * (row.ranges[name] / row.true - 1) for row in rows])
        cells = [np.median(np.abs(error)), np.percentile(np.abs(error), 90), np.mean(error)]
        line = [words, *(f"{x:.1f}" for x in cells)]
        if name == "ours":
            held = 100 * np.mean([row.p10 <= row.true <= row.p90 for row in rows])
            width = 100 * np.mean([(row.p90 - row.p10) / row.true for row in rows])
            line += [f"{held:.0f}", f"{width:.0f}"]
            score = np.mean([crps(row.ranges[name], row.p10, row.p90, row.true) for row in rows])
        else:  # of a number without an interval its error is the score
            line += ["", ""]
            score = np.mean([abs(row.ranges[name] - row.true) for row in rows])
        lines.append("| " + " | ".join([*line, f"{score / 1000:.2f}"]) + " |")
    return lines


def ride_table(judged: Sequence[Judged]) -> list[str]:
    """Ride by ride."""
    lines = [
        "| seed | road | °C | rider, kg | ridden, km | error at 80, 50, 20 %, % | in P10 to P90, % of the way | "
        "jumps per km: 90th percentile, largest, km |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for x in judged:
        at = {row.level: 100 * (row.ranges["ours"] / row.true - 1) for row in x.rows}
        errors = ", ".join(f"{at[level]:+.0f}" if level in at else "" for level in (0.8, 0.5, 0.2))
        moved = f"{np.percentile(x.jumps, 90) / 1000:.1f}, {max(x.jumps) / 1000:.1f}"
        facts = f"{x.drawn.seed} | {x.drawn.kind} | {x.drawn.ambient:.0f} | {x.drawn.mass:.0f} | {x.length / 1000:.1f}"
        lines.append(f"| {facts} | {errors} | {100 * x.held:.0f} | {moved} |")
    return lines


def page(judged: Sequence[Judged], command: str, version: str) -> str:
    """docs/range-benchmark.md."""
    lines = ["# Range benchmark", "", *(__doc__ or "").partition("\n\n")[2].strip().split("\n"), ""]
    lines += [f"Made by `{command}` on commit {version}.", ""]
    for title, aged in (("Healthy packs", False), ("Aged packs", True)):
        some = [x for x in judged if x.drawn.aged == aged]
        if some:
            lines += [f"## {title}", "", *table(some), "", *ride_table(some), ""]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rides", type=int, default=16, metavar="N", help="so many full discharges (default: 16)")
    parser.add_argument("--first", type=int, default=FIRST, metavar="SEED", help="of the first (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="rides at a time (default: 2)")
    parser.add_argument("--output", type=Path, default=PAGE, metavar="FILE", help="page to write (default: the docs')")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all rows as JSON, too")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.rides)
    judged = run([draw(seed, aged=seed % 2 == 1) for seed in seeds], arguments.jobs, quiet=arguments.quiet)
    command = f"python -m benchmarks.range_benchmark --rides {arguments.rides} --first {arguments.first}"
    arguments.output.write_text(page(judged, command, commit()), encoding="utf-8")
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(x) for x in judged]), encoding="utf-8")


if __name__ == "__main__":
    main()
