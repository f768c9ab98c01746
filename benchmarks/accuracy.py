"""Measure estimates on recorded rides: state of charge against a coulomb count, range against the distance ridden.

    python benchmarks/accuracy.py RIDES_FOLDER        # folders of .blf files, each with its rides.json

The reference for the state of charge is a coulomb count from the rest voltage at the start of the ride, with the
pack current as recorded less its known offset and gain. For rides until the scooter gave up, the range is compared
with the distance ridden from where the count passed 80, 50 and 20 %, and with the estimator of a
common telematics module: the energy that the BMS' percentage leaves above 15 % (and, kinder, above 0), over the mean
Wh/km of the last 25 km, 45 Wh/km until one kilometre has been ridden.
"""

from __future__ import annotations

import argparse
import json
from collections import deque
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from math import sqrt
from pathlib import Path
from typing import Any

from gz_onboard.events import Estimate
from gz_onboard.pipeline import Pipeline
from gz_onboard.recording.decode import feed
from gz_onboard.recording.logs import read_log
from gz_onboard.vehicle import read_vehicle


@dataclass
class Sample:
    time: float
    soc: float
    soc_sd: float
    reference: float
    innovation: float
    distance: float
    range: float
    p10: float
    p90: float
    bms_soc: float
    baseline: float  # m, with a reserve of 15 %
    baseline_kind: float  # m, down to 0 %
    used: float  # J since the start
    energy: float  # J left, ours
    consumption: float  # J/m to come, ours


@dataclass
class Baseline:
    """Rolling Wh/km over 25 km."""

    capacity: float  # J
    rows: deque[tuple[float, float]] = field(default_factory=deque)  # (distance [m], energy [J]), each kilometre or so
    energy: float = 0.0
    distance: float = 0.0

    def ride(self, power: float, speed: float, dt: float) -> None:
        self.energy += power * dt
        self.distance += speed * dt
        if not self.rows or self.distance - self.rows[-1][0] > 100:
            self.rows.append((self.distance, self.energy))
        while self.distance - self.rows[0][0] > 25_000:
            self.rows.popleft()

    def range(self, soc: float, reserve: float) -> float:
        way, energy = self.distance - self.rows[0][0], self.energy - self.rows[0][1]
        consumption = energy / way if way > 1000 and energy > 0 else 45 * 3.6
        return max(soc - reserve, 0.0) * self.capacity / consumption


def ride(file: Path, payload: float | None) -> tuple[str, list[Sample]]:
    vehicle = read_vehicle("reference", payload)
    battery = vehicle.pack
    samples: list[Sample] = []
    state: dict[str, Any] = {"soc": None, "time": 0.0, "next": 0.0, "first": None, "charge": 0.0}
    baseline = Baseline(33.6 * 51.8 * 3600)

    def observe(e: Estimate) -> None:
        signals = pipeline.estimator.signals
        if e.pack_current is None or e.pack_voltage is None:
            return
        dt = e.time - state["time"]
        if state["first"] is None:  # at rest: start of the count
            state["first"] = e.pack_voltage, e.pack_current
        else:
            state["charge"] += e.pack_current * dt / 3600
            baseline.ride(e.pack_voltage * e.pack_current, e.speed or 0.0, dt)
        if state["soc"] is None and e.soc is not None:  # by now the temperature is known
            voltage, current = state["first"]
            r0 = battery.r0.at(e.soc, e.cell_temperature or 20.0)[0]
            cell = battery.cell_voltage(voltage, current) + r0 * current / battery.cells_parallel
            state["soc"] = min(battery.soc_at(cell), 1.0)
        if state["soc"] is not None:
            state["soc"] -= state["charge"] / battery.pack_capacity(e.cell_temperature or 20.0)
            state["charge"] = 0.0
        state["time"] = e.time
        if e.time >= state["next"] and e.range is not None and e.soc_sd is not None and baseline.rows:
            state["next"] = e.time + 1.0
            bms = signals["bms_state_of_charge"].value
            soc = e.soc or 0.0, e.soc_sd, state["soc"], e.innovation or 0.0
            reach = e.range, e.range_p10 or 0.0, e.range_p90 or 0.0
            others = bms, baseline.range(bms, 0.15), baseline.range(bms, 0.0), baseline.energy
            ours = e.energy_left or 0.0, e.consumption_expected or 0.0
            samples.append(Sample(e.time, *soc, e.distance, *reach, *others, *ours))

    pipeline = Pipeline(vehicle, observer=observe)
    feed(pipeline, read_log(file))
    return f"{file.parent.name}/{file.stem}", samples


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("rides", type=Path)
    parser.add_argument("--only", default="", help="folders or rides whose name holds this")
    arguments = parser.parse_args()
    work = []
    for notes in sorted(arguments.rides.glob("*/rides.json")):
        for entry in json.loads(notes.read_text()):
            file = notes.parent / f"{entry['name']}.blf"
            if arguments.only in f"{notes.parent.name}/{entry['name']}":
                work.append((file, entry.get("rider_mass_kg")))
    work.sort(key=lambda w: -w[0].stat().st_size)
    with ProcessPoolExecutor(2) as pool:
        results = sorted(pool.map(ride, *zip(*work, strict=True)))
    soc_table(results)
    print()
    range_table([(name, s) for name, s in results if "full" in name])


def soc_table(results: list[tuple[str, list[Sample]]]) -> None:
    """Print a row for each group of rides: folder and kind."""
    groups: dict[str, list[list[Sample]]] = {}
    for name, samples in results:
        groups.setdefault(name.rpartition("_")[0], []).append(samples)
    print("| rides | number | worst error | worst error over sigma | innovation, mV RMS a cell |")
    print("|---|---|---|---|---|")
    for name, rides in groups.items():
        worst = max((x.soc - x.reference for s in rides for x in s), key=abs)
        sigmas = max(abs(x.soc - x.reference) / x.soc_sd for s in rides for x in s)
        rms = sorted(1000 * sqrt(sum(x.innovation**2 for x in s) / len(s)) for s in rides)
        print(f"| {name} | {len(rides)} | {100 * worst:+.2f} % | {sigmas:.2f} | {rms[0]:.1f} to {rms[-1]:.1f} |")


def range_table(results: list[tuple[str, list[Sample]]]) -> None:
    print("| ride | at SOC | ridden, km | ours, km (P10 to P90) | error | 25 km mean, 15 % kept | 25 km mean, to 0 % |")
    print("|---|---|---|---|---|---|---|")
    for name, s in results:
        total, end = s[-1].distance, s[-1].used
        for level in (0.8, 0.5, 0.2):
            at = next(x for x in s if x.reference <= level)
            true = total - at.distance
            ours = f"{at.range / 1000:.1f} ({at.p10 / 1000:.1f} to {at.p90 / 1000:.1f})"
            others = " | ".join(f"{x / 1000:.1f}, {_error(x, true)}" for x in (at.baseline, at.baseline_kind))
            print(
                f"| {name} | {100 * level:.0f} % | {true / 1000:.1f} | {ours} | {_error(at.range, true)} | {others} |"
            )
    print()
    for name, s in results:
        total, end = s[-1].distance, s[-1].used
        way = [x for x in s if x.distance > 3000 and total - x.distance > 500]
        inside = sum(x.p10 <= total - x.distance <= x.p90 for x in way) / len(way)
        jumps = [abs((b.range - a.range) + (b.distance - a.distance)) for a, b in zip(s[600:], s[660:], strict=False)]
        half = next(x for x in s if x.reference <= 0.5)
        to_come, ahead = (end - half.used) / 3600, (total - half.distance) * 3.6
        print(
            f"- {name}: the distance that was ridden lies within P10 to P90 for {100 * inside:.0f} % of the way; the "
            f"largest change of the sum of ridden and remaining within a minute is {max(jumps) / 1000:.1f} km; at "
            f"50 %, {to_come:.0f} Wh were still drawn (ours {half.energy / 3600:.0f}) at "
            f"{(end - half.used) / ahead:.1f} Wh/km (ours {half.consumption / 3.6:.1f})"
        )


def _error(value: float, true: float) -> str:
    return f"{100 * (value / true - 1):+.0f} %"


if __name__ == "__main__":
    main()
