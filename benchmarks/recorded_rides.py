"""Every recorded ride through the simulation, open loop and predictive: the tables of docs/results/recorded-rides.md.

    python benchmarks/recorded_rides.py DATA/rides [--only full_00 ...] [--chassis leaning] [--figures DIR]

DATA/rides holds folders of logs, each with a rides.json that names rider mass and kind. Prints a line of JSON for each
ride and form, then the table.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gz_onboard.reports.style import save
from gz_onboard.simulation.figures import comparison
from gz_onboard.simulation.plan import SimulationOptions, find_plan
from gz_onboard.simulation.run import follow
from gz_onboard.simulation.simulate import ride
from gz_onboard.simulation.summary import compare, measured_columns
from gz_onboard.vehicle import read_vehicle

GROUPS = {  # by folder, then by the begin of the name
    "commissioning/coastdown": "coast-downs",
    "commissioning/dyno": "chassis dynamometer",
    "commissioning/ride": "commissioning, road",
    "fulldischarge": "full discharges",
    "service_a": "service, tyres at half pressure",
    "service_b": "service, nothing wrong",
    "service": "service, others",
}
COLUMNS = ("energy_pct", "consumption_pct", "speed_km_h", "voltage_v", "current_pct", "torque_pct", "motor_k")


def group(folder: str, name: str) -> str:
    """The row of the table that a ride belongs to."""
    return next(text for begin, text in GROUPS.items() if f"{folder}/{name}".startswith(begin))


def both(log: Path, payload: float, chassis: str, figures: Path | None) -> dict[str, dict[str, Any]]:
    """The errors of one ride by form, simulated less measured."""
    options = SimulationOptions(chassis=chassis)
    vehicle = read_vehicle("reference", payload)
    plan = find_plan(str(log), options, vehicle)
    recorded = plan.recorded
    assert recorded
    speeds = recorded.signals["speed"].tolist()
    rider = replace(plan, kind="ride (predictive)", command=lambda: follow(speeds, recorded.dt))
    found = {}
    for form, planned in (("open loop", plan), ("predictive", rider)):
        run, _ = ride(vehicle, planned, options, None)
        measured = measured_columns(recorded, run)
        errors = compare(recorded, run)

        def share(name: str, run: Any = run, measured: Any = measured) -> float:
            error, size = run.series[name] - measured[name], measured[name]
            return float(100 * np.sqrt(np.mean(error**2) / np.mean(size**2)))

        energy = recorded.energy()
        assert energy
        per_metre = run.energy / run.distance / (energy / recorded.distance)
        found[form] = {
            "energy_pct": 100 * (run.energy / energy - 1),
            "consumption_pct": 100 * (per_metre - 1),
            "speed_km_h": errors.rms_speed_km_h,
            "voltage_v": errors.rms_pack_voltage_v,
            "current_pct": share("pack_current"),
            "torque_pct": share("motor_torque"),
            "motor_k": float((run.series["motor_temperature"] - measured["motor_temperature"])[-1]),
            "motor_k_mean": float(np.mean(run.series["motor_temperature"] - measured["motor_temperature"])),
            "soc_end_pct": 100 * float(run.series["soc"][-1] - measured["soc"][-1]),
            "closure": run.closure,
        }
        if figures:
            title = f"{plan.name}, {planned.kind} · {vehicle.name}, payload {payload:g} kg"
            name = f"{log.parent.name}_{plan.name}_{form.replace(' ', '_')}.png"
            figures.mkdir(parents=True, exist_ok=True)
            save(comparison(run, measured, title), figures / name)
    return found


def table(rows: list[dict[str, Any]]) -> str:
    """The rides by group, the range of each error."""
    lines = [
        "| rides | form | number | energy % | Wh/km % | speed, km/h RMS | pack, V RMS | current % | torque % |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    groups: defaultdict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[row["group"], row["form"]].append(row)
    for name in sorted({group for group, _ in groups}):
        for form in ("open loop", "predictive"):
            members = groups[name, form]
            cells = []
            for column in COLUMNS[:-1]:
                sign, digits = ("+", 0) if column in COLUMNS[:2] else ("", 0 if column.endswith("pct") else 1)
                ends = [f"{end([m[column] for m in members]):{sign}.{digits}f}" for end in (min, max)]
                cells.append(ends[0] if ends[0] == ends[1] else " to ".join(ends))
            head = name if form == "open loop" else ""
            text = " | ".join(cells).replace("-", "−").replace("+0 ", "0 ").replace("−0 ", "0 ")
            lines.append(f"| {head} | {form} | {len(members)} | {text} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("rides", type=Path)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--chassis", default="straight")
    parser.add_argument("--figures", type=Path)
    options = parser.parse_args()
    rows = []
    for listed in sorted(options.rides.glob("*/rides.json")):
        for entry in json.loads(listed.read_text()):
            name, folder = entry["name"], listed.parent.name
            if options.only and name not in options.only and f"{folder}/{name}" not in options.only:
                continue
            log = listed.with_name(f"{name}.blf")
            for form, errors in both(log, entry["rider_mass_kg"], options.chassis, options.figures).items():
                row = {"group": group(folder, name), "ride": f"{folder}/{name}", "form": form, **errors}
                rows.append(row)
                print(json.dumps(row), flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
