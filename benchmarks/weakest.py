"""Measure the gain from the weakest group of cells: full discharges of the tests' plant, with and without one.

    python -m benchmarks.weakest SEED...     # about 10 minutes for three seeds on one core
    python -m benchmarks.weakest SEED... --keep FOLDER    # the rides are kept there, and not ridden again

Each seed is a scooter, a road, a rider and a day; it is ridden until the weakest group gives up, once for each pack of
`PACKS`. The estimator hears the messages of battery, inverter and motor, from full, with nothing learned before; once
with and once without the lowest cell's voltage. The errors are those of the energy left, over the energy drawn
until the end: the rider's share in the range is not the battery's. The plant's equations and sensors are separate from
the package's.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.range_rides import EMPTY, GIVES_UP, draw, road_of
from gz_onboard.arrays import Array
from gz_onboard.events import Group
from gz_onboard.vehicle import read_vehicle
from tests.events import Event, EventEstimator
from tests.plant.machine import scooter
from tests.plant.ride import STEP, Hidden, ride
from tests.plant.sensors import measure

PACKS = {
    "healthy": Hidden(),
    "capacity": Hidden(weak_capacity=0.92, weak_resistance=1.15),
    "charge": Hidden(weak_charge=0.04),
    "resistance": Hidden(weak_resistance=1.4),
    "aged": Hidden(capacity_factor=0.85, resistance_factor=1.3, weak_capacity=0.92, weak_resistance=1.2),
}
LEVELS = 0.5, 0.2  # SOC of the mean cell
GROUPS = [
    Group("Pack", ("pack_voltage", "pack_current", "bms_state_of_charge"), 0.1),
    Group("Motor", ("motor_speed",), 0.1),
    Group("Inverter", ("inverter_voltage", "inverter_current"), 0.1),
    Group("Auxiliary", ("auxiliary_current",), 0.1),
    Group("Cells", ("cell_temperature", "lowest_cell_voltage"), 1.0),
    Group("Air", ("ambient_temperature",), 1.0),
]
THINNED = {"motor_speed": 10}  # of so many messages one is heard

Columns = dict[str, Array]
"""Of one ride: values by role, times [s] by role and " time"; what happened each second by "true " and name."""


def ride_all(seeds: Sequence[int]) -> dict[str, Columns]:
    """The rides of `seeds` with each of `PACKS`, by name."""
    drawn = [draw(seed) for seed in seeds for _ in PACKS]
    packs = [pack for _ in seeds for pack in PACKS]
    ridden = ride([road_of(x) for x in drawn], [scooter(x.machine) for x in drawn], [PACKS[p] for p in packs], GIVES_UP)
    found = {}
    for x, pack, way in zip(drawn, packs, ridden, strict=True):
        c = {name: column.astype(float) for name, column in way.columns.items()}
        if pack == "healthy" and c["soc"][-1] > EMPTY:
            raise RuntimeError(f"ride {x.seed} ended with {c['soc'][-1]:.0%} of charge: its road is too short")
        columns: Columns = {}
        for role, (times, values) in measure(way, pack, cells=True).columns.items():
            if any(role in group.roles for group in GROUPS):
                columns |= {role: values, f"{role} time": times}
        energy = np.cumsum(c["pack_voltage"] * c["pack_current"]) * STEP
        second = slice(None, None, round(1 / STEP))
        columns |= {"true energy": energy[second], "true soc": c["soc"][second], "true way": c["distance"][second]}
        found[f"{x.seed} {pack}"] = columns
    return found


def events(columns: Columns, lowest: Any = None) -> Iterator[Event]:
    """Return the signals of the bus. lowest: changes the lowest cell's voltage, from time [s] and value."""
    rows: list[Event] = []
    for index, group in enumerate(GROUPS):
        thin = slice(None, None, THINNED.get(group.roles[0], 1))
        times = columns[f"{group.roles[0]} time"][thin].tolist()
        values = [columns[role][thin].tolist() for role in group.roles]
        if lowest and "lowest_cell_voltage" in group.roles:
            values[1] = [lowest(t, v) for t, v in zip(times, values[1], strict=True)]
        rows += [(t, index, x) for t, x in zip(times, zip(*values, strict=True), strict=True)]
    yield from sorted(rows, key=lambda row: row[0])


def estimates(columns: Columns, lowest: Any = None) -> tuple[list[Any], EventEstimator]:
    """An estimate each second, and the estimator at the end."""
    vehicle = read_vehicle("reference")
    estimator, made = EventEstimator(GROUPS, vehicle.pack, vehicle.model, vehicle.riding), []
    due = 0.0
    for event in events(columns, lowest):
        estimator.handle(event)
        if event[0] >= due:
            due = event[0] + 1.0
            made.append(estimator.estimate(event[0]))
    return made, estimator


def errors(columns: Columns, made: Sequence[Any]) -> list[float]:
    """Errors of the energy left at `LEVELS`, over the energy drawn until the end."""
    energy, soc = columns["true energy"], columns["true soc"]
    found = []
    for level in LEVELS:
        at = int(np.argmax(soc <= level))
        estimate = min(made, key=lambda e: abs(e.time - at))
        found.append(estimate.energy_left / (energy[-1] - energy[at]) - 1)
    return found


def main() -> None:
    """Ride, estimate, print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("seeds", nargs="+", type=int, metavar="SEED")
    parser.add_argument("--keep", type=Path, metavar="FOLDER")
    arguments = parser.parse_args()
    print("| ride | end | at 50 %, without | with | at 20 %, without | with | charge | capacity | resistance |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for seed in arguments.seeds:
        file = arguments.keep / f"weakest_{seed}.npz" if arguments.keep else None
        if file and file.exists():
            rides: dict[str, Columns] = {}
            with np.load(file) as kept:
                for key in kept.files:
                    name, _, column = key.partition("/")
                    rides.setdefault(name, {})[column] = kept[key]
        else:
            rides = ride_all([seed])
            if file:
                flat: dict[str, Any] = {f"{name}/{c}": x for name, ride in rides.items() for c, x in ride.items()}
                np.savez_compressed(file, **flat)
        for name, columns in rides.items():
            made, estimator = estimates(columns)
            without, _ = estimates(columns, lambda t, v: None)
            learned = " | ".join(f"{x.value:.3f} ± {x.sd:.3f}" for x in estimator.pack.weakest.learned().values())
            pairs = zip(errors(columns, without), errors(columns, made), strict=True)
            told = " | ".join(f"{100 * before:+.1f} % | {100 * now:+.1f} %" for before, now in pairs)
            print(f"| {name} | {100 * columns['true soc'][-1]:.1f} % | {told} | {learned} |", flush=True)


if __name__ == "__main__":
    main()
