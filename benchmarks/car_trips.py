"""Real trips of an electric car through the estimator: state of charge, consumption, range on the way.

    python -m benchmarks.car_trips FOLDER [--write docs/results/real-car.md]

FOLDER holds the tables TripA01_2hz.csv.gz and so on that docs/results/real-car.md describes. Trips of odd number made
the vehicle file; those of even number are held out.
"""

from __future__ import annotations

import argparse
import csv
import gzip
from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from math import log, sqrt
from pathlib import Path
from statistics import median

from gz_onboard.constants import WH_PER_KM
from gz_onboard.events import Estimate
from gz_onboard.pipeline import Pipeline
from gz_onboard.recording.decode import feed
from gz_onboard.recording.recording import open_ride
from gz_onboard.vehicle import read_vehicle

VEHICLE = Path(__file__).resolve().parent.parent / "tests" / "vehicles" / "i3" / "trips.toml"
PATTERN = "TripA*_2hz.csv.gz"
MARK = "<!-- made by benchmarks/car_trips.py from here on -->"
COLUMNS = ("t_s", "v_kmh", "v_batt_V", "i_batt_A", "soc_pct", "soc_disp_pct")


@dataclass(frozen=True)
class Car:
    """The car's own table, row by row."""

    time: list[float]  # s
    distance: list[float]  # m so far
    energy: list[float]  # J drawn so far
    soc: list[float]  # of the cells, by its own count
    shown: list[float]  # to its driver, 0 to 1


@dataclass(frozen=True)
class Trip:
    """One trip, judged. Errors of states of charge in shares of 1, others relative to the truth."""

    name: str
    km: float
    wh_per_km: float
    soc_start: float
    soc_rms: float
    shown_rms: float
    modelled: float  # energy of the forward model
    at: float  # share of the way at which the range is judged
    ours: float  # distance for the energy of the rest
    rule: float  # the same, by kilometres over charge so far
    low: float  # P10 of the range over the range as the rest of the trip had it
    high: float  # P90
    distrusted: tuple[str, ...]  # sensors, at any time

    @property
    def held_out(self) -> bool:
        return int(self.name[1:]) % 2 == 0


def read_car(file: Path) -> Car:
    car, way, energy, before = Car([], [], [], [], []), 0.0, 0.0, 0.0
    with gzip.open(file, "rt", encoding="utf-8", newline="") as stream:
        rows = ([float(row[c] or "nan") for c in COLUMNS] for row in csv.DictReader(stream))
        for time, speed, volts, amperes, soc, shown in (row for row in rows if all(x == x for x in row)):
            dt, before = time - before, time
            way += speed / 3.6 * dt
            energy -= volts * amperes * dt
            for values, value in zip(vars(car).values(), (time, way, energy, soc / 100, shown / 100), strict=True):
                values.append(value)
    return car


def judged_at(car: Car) -> int:
    """The row of the slowest moment in the middle third of the way: there the least energy is under way as motion."""
    first, last = (bisect_left(car.distance, share * car.distance[-1]) for share in (1 / 3, 2 / 3))
    return min(range(first, last), key=lambda i: car.distance[i] - car.distance[i - 1])


def judge(file: Path, vehicle_file: Path) -> Trip:
    car, vehicle = read_car(file), read_vehicle(vehicle_file)
    mapping, frames = open_ride(file, vehicle)
    row = judged_at(car)
    seen: list[Estimate] = []
    errors: list[tuple[float, float, float]] = []  # of the cells' state of charge and of that shown; time

    distrusted: set[str] = set()

    def observe(e: Estimate) -> None:
        distrusted.update(e.distrusted)
        if e.soc is None:
            return
        i = min(bisect_left(car.time, e.time), len(car.time) - 1)
        errors.append((pipeline.estimator.pack.state.soc - car.soc[i], e.soc - car.shown[i], e.time))
        if e.time >= car.time[row] and not seen and e.range is not None:
            seen.append(e)

    pipeline = Pipeline(replace(vehicle, mapping=mapping), observer=observe)
    feed(pipeline, frames)
    e, sums = seen[0], pipeline.estimator.forecaster.learner.state.sums
    assert e.range and e.range_p10 and e.range_p90 and e.consumption_expected and e.energy_left
    way, energy, charge = (values[-1] - values[row] for values in (car.distance, car.energy, car.soc))
    window = vehicle.pack.window
    at_row = next(error for error in errors if error[2] >= car.time[row])
    own = car.soc[row] - window.low
    left = e.energy_left * own / (own + at_row[0])  # J, by the car's own count
    true = left / (energy / way)
    return Trip(
        name=file.name[4:7],
        km=car.distance[-1] / 1000,
        wh_per_km=car.energy[-1] / car.distance[-1] / WH_PER_KM,
        soc_start=errors[0][0],
        soc_rms=_rms(error[0] for error in errors),
        shown_rms=_rms(error[1] for error in errors),
        modelled=sums.modelled / sums.measured - 1,
        at=car.distance[row] / car.distance[-1],
        ours=energy / e.consumption_expected / way - 1,
        rule=car.distance[row] / (car.soc[row] - car.soc[0]) * charge / way - 1,
        low=e.range_p10 / true,
        high=e.range_p90 / true,
        distrusted=tuple(sorted(distrusted)),
    )


def _rms(values: Iterable[float]) -> float:
    squares = [value * value for value in values]
    return sqrt(sum(squares) / len(squares))


# --- the page -----------------------------------------------------------------------------------------------------


def report(trips: Sequence[Trip]) -> list[str]:
    groups = {name: [t for t in trips if t.held_out == held] for name, held in GROUPS.items()}
    head = " | ".join(f"{name} ({len(mine)} trips)" for name, mine in groups.items())
    lines = [f"| | aim | {head} |", "|---|---|---|---|"]
    for text, aim, figure in FIGURES:
        lines.append(f"| {text} | {aim} | {' | '.join(figure(mine) for mine in groups.values())} |")
    return lines


def _median(error: Callable[[Trip], float]) -> Callable[[Sequence[Trip]], str]:
    return lambda trips: f"{100 * median(abs(error(t)) for t in trips):.1f} %"


def _spread(error: Callable[[Trip], float]) -> Callable[[Sequence[Trip]], str]:
    return lambda trips: f"{_rms(log(1 + error(t)) for t in trips):.2f}"


def _inside(trips: Sequence[Trip]) -> str:
    inside = sum(t.low <= 1 <= t.high for t in trips)
    return f"{inside} of {len(trips)}, {100 * inside / len(trips):.0f} %"


GROUPS = {"calibration": False, "held out": True}
FIGURES: tuple[tuple[str, str, Callable[[Sequence[Trip]], str]], ...] = (
    (
        "state of charge, RMS of all trips",
        "2 points",
        lambda trips: f"{100 * _rms(t.soc_rms for t in trips):.1f} points",
    ),
    ("the same, median of the trips", "", lambda trips: f"{100 * median(t.soc_rms for t in trips):.1f} points"),
    (
        "state of charge shown, RMS of all trips",
        "",
        lambda trips: f"{100 * _rms(t.shown_rms for t in trips):.1f} points",
    ),
    ("energy by the model, median error", "8 %", _median(lambda t: t.modelled)),
    ("remaining distance, median error", "less than by the rule", _median(lambda t: t.ours)),
    ("the same, RMS of its logarithm", "the same", _spread(lambda t: t.ours)),
    ("rule: kilometres over charge so far, median error", "", _median(lambda t: t.rule)),
    ("the same, RMS of its logarithm", "", _spread(lambda t: t.rule)),
    ("within P10 to P90", "75 to 85 %", _inside),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, help="of the trips")
    parser.add_argument("--vehicle", type=Path, default=VEHICLE, help="vehicle file, in place of the one of the page")
    parser.add_argument("--write", type=Path, help="replace everything after the mark in this file")
    arguments = parser.parse_args()
    files = sorted(arguments.folder.glob(PATTERN))
    if not files:
        raise SystemExit(
            f"car_trips: {arguments.folder}: no {PATTERN} there; docs/results/real-car.md says where they are from"
        )
    with ProcessPoolExecutor(2) as pool:
        lines = report(list(pool.map(partial(judge, vehicle_file=arguments.vehicle), files)))
    if arguments.write:
        head = arguments.write.read_text(encoding="utf-8").partition(MARK)[0]
        arguments.write.write_text("\n".join([head + MARK, "", *lines]) + "\n", encoding="utf-8")
    else:
        print(*lines, sep="\n")


if __name__ == "__main__":
    main()
