"""What the road load learned on board is worth, on rides of the tests' plant, whose truth is known.

Each ride is another scooter, rider, road and weather, by seed, with one thing wrong or none. Its frames go as a log
through the pipeline of the daemon, which knows the reference scooter's file and no payload.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gz_onboard.bus.logs import read_frames
from gz_onboard.estimator.road_load import NAMES, RoadParameter
from gz_onboard.pipeline import Pipeline
from gz_onboard.progress import progress_bar
from gz_onboard.vehicle import read_vehicle
from tests.plant.cases import stranger
from tests.plant.logs import write_log
from tests.plant.machine import G, scooter
from tests.plant.ride import Hidden, Ridden, ride
from tests.plant.roads import KINDS, plan
from tests.plant.sensors import measure

PAGE = Path(__file__).parents[1] / "docs" / "road-load.md"
MARK = "<!-- made by benchmarks/road_load.py from here on -->"
SECONDS = 1800.0
TOGETHER = 8  # rides that are ridden at once, for memory
PLANS = 5_000_000_000
HIDDEN = {
    "": Hidden(),
    "soft tyres": Hidden(rolling_factor=1.4),
    "wide clothes": Hidden(drag_factor=1.3),
    "lamps, 60 W": Hidden(auxiliary=60.0),
    "luggage, 30 kg": Hidden(luggage=30.0),
    "current +5 %": Hidden(current_factor=1.05),
    "speed +5 %": Hidden(speed_factor=1.05),
}
UNITS = {"mass": (1.0, ".0f"), "rolling": (1000.0, ".1f"), "drag": (1.0, ".2f"), "auxiliaries": (1.0, ".0f")}


@dataclass(frozen=True)
class Found:
    """One ride: what is true and what was learned, by `NAMES`."""

    seed: int
    kind: str
    hidden: str
    kilometres: float
    true: dict[str, float]
    learned: dict[str, RoadParameter]

    def off(self, name: str) -> float:
        """In sd."""
        x = self.learned[name]
        return (x.value - self.true[name]) / x.sd


def true_load(ridden: Ridden) -> dict[str, float]:
    """Of a ride of the plant; the bearings' drag counts as rolling resistance, bends do not."""
    m, h, c = ridden.machine, ridden.hidden, ridden.columns
    payload = ridden.plan.rider.mass + h.luggage
    rolling = ridden.rolling + m.bearing_drag / ((m.mass + payload) * G)
    auxiliaries = m.auxiliary + h.auxiliary + m.brake_light * float(c["brake"].mean())
    return dict(zip(NAMES, (payload, rolling, ridden.drag_area, auxiliaries), strict=True))


def follow(log: Path) -> dict[str, RoadParameter]:
    """What the daemon learns of a log."""
    pipeline = Pipeline(read_vehicle("reference"))
    for frames in read_frames(log):
        pipeline.advance(frames, frames[-1][0])
    return pipeline.estimator.road_load.learned()


def run(seeds: Sequence[int], jobs: int, *, quiet: bool = False) -> list[Found]:
    """All rides, some at a time."""
    found = []
    names = list(HIDDEN)
    with (
        progress_bar(lambda: float(len(seeds)), "ride", quiet=quiet) as bar,
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(jobs) as pool,
    ):
        for start in range(0, len(seeds), TOGETHER):
            part = seeds[start : start + TOGETHER]
            hidden = [names[i % len(names)] for i in range(start, start + len(part))]
            ridden = _ride(part, hidden)
            logs = [Path(folder) / f"{seed}.blf" for seed in part]
            for x, log in zip(ridden, logs, strict=True):
                write_log(measure(x, log.stem), log)
            for seed, name, x, learned in zip(part, hidden, ridden, pool.map(follow, logs), strict=True):
                way = float(x.columns["distance"][-1]) / 1000
                found.append(Found(seed, x.plan.kind, name, way, true_load(x), learned))
                bar.update(1.0)
            for log in logs:
                log.unlink()
    return found


def _ride(seeds: Sequence[int], hidden: Sequence[str]) -> list[Ridden]:
    plans = []
    for seed in seeds:
        rng = np.random.default_rng([seed, 411])
        kind, rider = str(rng.choice(sorted(KINDS))), stranger(rng)
        ambient, soc, hilly = (float(rng.uniform(*ends)) for ends in ((-2, 33), (0.6, 1.0), (0.3, 1.6)))
        plans.append(plan(PLANS + seed, kind, rider, ambient, soc, hilly=hilly, duration=SECONDS))
    return ride(plans, [scooter(seed) for seed in seeds], [HIDDEN[name] for name in hidden])


def table(found: Iterable[Found]) -> list[str]:
    """Ride by ride: true, and learned with its sd and how much of what can be known it is."""
    lines = [
        "| seed | road | km | hidden | payload, kg | rolling, 1/1000 | drag area, m² | auxiliaries, W |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for x in found:
        cells = []
        for name, (unit, form) in UNITS.items():
            learned = x.learned[name]
            value, sd, true = (f"{unit * y:{form}}" for y in (learned.value, learned.sd, x.true[name]))
            cells.append(f"{true}: {value} ± {sd}" if learned.share else f"{true}: –")
        lines.append(f"| {x.seed} | {x.kind} | {x.kilometres:.0f} | {x.hidden} | " + " | ".join(cells) + " |")
    return lines


def summary(found: Sequence[Found]) -> list[str]:
    """The errors in sd, over the rides on which something was learned."""
    lines = ["| | payload | rolling | drag area | auxiliaries |", "| --- | --- | --- | --- | --- |"]
    of = {name: np.array([x.off(name) for x in found if x.learned["mass"].share]) for name in NAMES}
    for words, figure in (
        ("root mean square of error over sd", lambda z: f"{np.sqrt(np.mean(z * z)):.2f}"),
        ("its mean", lambda z: f"{np.mean(z):+.2f}"),
        ("within 2 sd, %", lambda z: f"{100 * np.mean(np.abs(z) < 2):.0f}"),
    ):
        lines.append(f"| {words} | " + " | ".join(figure(of[name]) for name in NAMES) + " |")
    shares = {name: np.median([x.learned[name].share for x in found if x.learned["mass"].share]) for name in NAMES}
    return [*lines, "| learned, median, % | " + " | ".join(f"{100 * shares[name]:.0f}" for name in NAMES) + " |"]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--rides", type=int, default=21, metavar="N", help="so many (default: %(default)s)")
    parser.add_argument("--first", type=int, default=300, metavar="SEED", help="of the first (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="logs at a time (default: 2)")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    arguments = parser.parse_args()
    found = run(range(arguments.first, arguments.first + arguments.rides), arguments.jobs, quiet=arguments.quiet)
    command = f"python -m benchmarks.road_load --rides {arguments.rides} --first {arguments.first}"
    head = PAGE.read_text(encoding="utf-8").partition(MARK)[0] if PAGE.exists() else ""
    made = [MARK, "", *summary(found), "", f"Ride by ride (`{command}`); “–”: refused.", "", *table(found), ""]
    PAGE.write_text(head + "\n".join(made), encoding="utf-8")


if __name__ == "__main__":
    main()
