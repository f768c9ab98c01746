"""Summary of ``gz-onboard simulate``, as JSON and as text."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import WH, WH_PER_KM
from gz_onboard.reports.results import clock, descriptions, number, plain, text_rows, times
from gz_onboard.simulation.plan import Plan
from gz_onboard.simulation.recorded import Recorded
from gz_onboard.simulation.run import COLUMNS, LOADED, BeyondBattery, Run, Shortfall, range_by_energy
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.simulation.turning import STRAIGHT
from gz_onboard.vehicle import Vehicle

SUMMARY_VERSION = 1
_RANGE_BY = {
    "repetition": "ridden until empty",
    "charge": "ridden until no charge was left",
    "cut-off": "ridden until the load pulled the voltage to the cut-off",
    "energy": "ridden, and energy left at the end over the consumption",
    None: "not known",
}
_SHOWN = 5  # shortfalls
_LEAST = 0.005  # Wh: less of the ledger is not shown


@dataclass(frozen=True)
class MeasuredEntry:
    """Measurement of a recorded ride, and the RMS of simulated less measured."""

    distance_km: float
    energy_wh: float | None
    consumption_wh_km: float | None
    rms_speed_km_h: float | None
    rms_pack_voltage_v: float | None
    rms_pack_current_a: float | None
    rms_motor_torque_nm: float | None


@dataclass(frozen=True)
class Variant:
    """The ride with other values of the parameters that are swept."""

    values: dict[str, float]
    consumption_wh_km: float | None
    range_km: float | None
    shortfall_s: float


@dataclass(frozen=True, kw_only=True)
class SimulationSummary:
    """What ``--json`` writes."""

    what: Annotated[str, "the cycle, route or ride, as given"]
    kind: Annotated[str, "cycle, route, ride (open loop) or ride (predictive)"]
    vehicle: Annotated[str, "name of the vehicle"]
    payload_kg: Annotated[float, "mass of rider and luggage"]
    payload_from: Annotated[str, "source of it: --payload, rides.json with the log, or the vehicle file"] = (
        "the vehicle file"
    )
    step_s: Annotated[float, "step of the simulation"]
    duration_s: Annotated[float, "ridden"]
    distance_km: Annotated[float, "ridden"]
    speed_max_km_h: Annotated[float, "greatest speed"]
    repetitions: Annotated[float, "times that the cycle was ridden; the last may be unfinished"]
    energy_wh: Annotated[float, "delivered by the pack, less the energy recovered"]
    energy_recovered_wh: Annotated[float, "charged into the pack"]
    energy_cells_wh: Annotated[float, "that left the cells' chemistry: energy_wh and the heat of the battery"]
    consumption_wh_km: Annotated[float | None, "energy_wh over distance; null below 0.1 km"]
    soc_start: Annotated[float, "state of charge, 0 to 1"]
    soc_end: Annotated[float, "at the end"]
    range_km: Annotated[float | None, "on this riding from soc_start, or null"]
    range_by: Annotated[
        str | None,
        "repetition: ridden until empty; energy: ridden, and energy left at the end over the consumption; cut-off: "
        "ridden until a load pulled the voltage there; charge: ridden until none was left",
    ]
    shortfalls: Annotated[
        list[Shortfall],
        "where the profile asked more than was ridden, worst first: time_s, distance_km, duration_s"
        ", missing_km_h at most, wanted_km_h there, beyond_vehicle (the throttle was open)",
    ]
    shortfall_s: Annotated[float, "their time in all"]
    beyond_battery: Annotated[
        list[BeyondBattery],
        "demands beyond the battery: charge (true: empty; false: a load pulled its voltage to the cut-off), "
        "where it begins time_s, distance_km, soc, current_a, voltage_v; duration_s in all; cutoff_v",
    ]
    range_by_energy_km: Annotated[
        float | None, "distance_km, and energy left at the end over the consumption; never less than ridden; or null"
    ]
    ledger_wh: Annotated[dict[str, float], "where the energy of the cells went, by name; negative: a source"]
    closure: Annotated[float, "energy_cells_wh less the sum of the ledger, over the sum of all magnitudes"]
    chassis: Annotated[str, "straight, planar or leaning"]
    turning_beyond_s: Annotated[
        float, "time in which the road turned harder than the chassis' model goes; its edge was taken"
    ]
    measured: Annotated[
        MeasuredEntry | None,
        "of a recorded ride: distance_km, energy_wh, consumption_wh_km, and RMS of simulated less m"
        "easured: rms_speed_km_h, rms_pack_voltage_v, rms_pack_current_a, rms_motor_torque_nm; else null",
    ]
    files: Annotated[list[str], "written"] = field(default_factory=list)
    wall_s: Annotated[float, "time taken by the simulation"] = 0.0
    sweep: Annotated[list[Variant] | None, "a list of {values, consumption_wh_km, range_km, shortfall_s}, or null"] = (
        None
    )


KEYS = descriptions(SimulationSummary)


def cycle_range(result: Run, scooter: Scooter) -> tuple[float | None, str | None]:
    """(range [km], how it was found)."""
    if result.empty:
        load = result.beyond and result.soc_end > LOADED
        return result.distance * 1e-3, "cut-off" if load else "repetition"
    if result.beyond and result.beyond[-1].charge and result.soc_start > 0.0:
        return result.beyond[-1].distance_km, "charge"
    metres = range_by_energy(scooter, result)
    return times(metres, 1e-3), None if metres is None else "energy"


def summarise(vehicle: Vehicle, plan: Plan, what: str, result: Run, scooter: Scooter) -> SimulationSummary:
    """The summary, without what only the command knows: its time, sweep and files."""
    range_km, by = cycle_range(result, scooter)
    return SimulationSummary(
        what=what,
        kind=plan.kind,
        vehicle=vehicle.name,
        payload_kg=vehicle.parameters["payload_mass"],
        step_s=scooter.dt,
        duration_s=result.duration,
        distance_km=result.distance * 1e-3,
        speed_max_km_h=float(result.series["speed"].max()) * 3.6,
        repetitions=result.duration / plan.seconds if plan.kind == "cycle" else 1.0,
        energy_wh=result.energy / WH,
        energy_recovered_wh=result.recovered / WH,
        energy_cells_wh=result.chemical / WH,
        consumption_wh_km=times(result.consumption, 1 / WH_PER_KM),
        soc_start=result.soc_start,
        soc_end=result.soc_end,
        range_km=range_km,
        range_by=by,
        shortfalls=result.shortfalls,
        shortfall_s=sum(one.duration_s for one in result.shortfalls),
        beyond_battery=list(result.beyond),
        range_by_energy_km=times(range_by_energy(scooter, result), 1e-3),
        ledger_wh={name: energy / WH for name, energy in result.ledger.items()},
        closure=result.closure,
        chassis=scooter.chassis.name if scooter.chassis else STRAIGHT,
        turning_beyond_s=scooter.chassis.beyond if scooter.chassis else 0.0,
        measured=compare(plan.recorded, result) if plan.recorded else None,
    )


def measured_columns(recorded: Recorded, result: Run) -> dict[str, Array]:
    """The recorded columns of a run, at the times of its series."""
    at = np.minimum(np.round(result.series["time"] / recorded.dt).astype(int), len(recorded.signals["speed"]) - 1)
    return {name: values[at] for name, values in recorded.signals.items() if name in COLUMNS}


def compare(recorded: Recorded, result: Run) -> MeasuredEntry:
    """The entry ``measured`` of the summary."""
    columns = measured_columns(recorded, result)
    energy = recorded.energy()

    def rms(name: str, factor: float) -> float | None:
        if name not in columns:
            return None
        return float(np.sqrt(np.mean((result.series[name] - columns[name]) ** 2))) * factor

    return MeasuredEntry(
        distance_km=recorded.distance * 1e-3,
        energy_wh=times(energy, 1 / WH),
        consumption_wh_km=None if energy is None else energy / recorded.distance / WH_PER_KM,
        rms_speed_km_h=rms("speed", 3.6),
        rms_pack_voltage_v=rms("pack_voltage", 1.0),
        rms_pack_current_a=rms("pack_current", 1.0),
        rms_motor_torque_nm=rms("motor_torque", 1.0),
    )


def summary_text(summary: SimulationSummary) -> str:
    """A summary for a terminal."""
    often = f"{summary.repetitions:.3g}"
    repeated = "" if summary.kind != "cycle" else ", once" if often == "1" else f", {often} times"
    distance = f"{summary.distance_km:.2f} km, at most {summary.speed_max_km_h:.0f} km/h{repeated}"
    recovered = f"{summary.energy_wh:.1f} Wh net, after {summary.energy_recovered_wh:.1f} Wh recovered"
    rows = [
        (summary.kind, f"{clock(summary.duration_s)}, {distance}"),
        ("energy", f"{recovered}; {number(summary.consumption_wh_km, '.2f', 'Wh/km')}"),
        ("state of charge", f"{100 * summary.soc_start:.1f} → {100 * summary.soc_end:.1f} %"),
        ("range", f"{number(summary.range_km, '.1f', 'km')} from the start ({_RANGE_BY[summary.range_by]})"),
        *_named("beyond the battery", _beyond_texts(summary)),
        *_named("shortfall", _shortfall_texts(summary)),
        *_named("where it went", _ledger_texts(summary)),
        *_measured_rows(summary.measured),
    ]
    if seconds := summary.turning_beyond_s:
        edge = f"{seconds:.1f} s in bends harder than the {summary.chassis} model goes: taken at its edge"
        rows.append(("turning", edge))
    rows.append(("energy balance", f"closes to {plain(100 * abs(summary.closure))} % of all that flowed"))
    rows.append(("computed in", f"{summary.wall_s:.2f} s, step {1000 * summary.step_s:g} ms"))
    rows += [("written", ", ".join(summary.files))] if summary.files else []
    head = f"{summary.what}, {summary.vehicle}, payload {summary.payload_kg:g} kg (by {summary.payload_from})"
    return "\n".join([text_rows(head, rows), *(["", variants_text(summary.sweep)] if summary.sweep else [])])


def _named(name: str, texts: Sequence[str]) -> list[tuple[str, str]]:
    """Rows of which the first has a name."""
    return [(name if not i else "", text) for i, text in enumerate(texts)]


def _beyond_texts(summary: SimulationSummary) -> list[str]:
    """Demands beyond the battery, and how far the energy that is left would do."""
    texts = []
    for b in summary.beyond_battery:
        begin = f"from {b.time_s:.0f} s, {b.distance_km:.2f} km, for {b.duration_s:.0f} s in all"
        pulled = f"{b.current_a:.0f} A pull the pack to {b.voltage_v:.1f} V at {100 * b.soc:.0f} % of charge"
        texts.append(
            f"{begin}, " + ("no charge is left" if b.charge else f"{pulled}: its cut-off is {b.cutoff_v:.1f} V")
        )
    if summary.range_by == "cut-off" and summary.range_by_energy_km is not None:
        left = f"so it ends with {100 * summary.soc_end:.0f} % left; its energy would do for"
        lower = "a lower current (motor_current_limit, [controller] of the vehicle file)"
        texts.append(f"{left} {summary.range_by_energy_km:.1f} km at {lower}")
    return texts


def _shortfall_texts(summary: SimulationSummary) -> list[str]:
    if not summary.shortfalls:
        return []
    worst = (
        f"at {s.time_s:.0f} s, {s.distance_km:.2f} km, for {s.duration_s:.0f} s: {s.missing_km_h:.1f} km/h below "
        f"{s.wanted_km_h:.0f} km/h: {'beyond the vehicle' if s.beyond_vehicle else 'the lag of the rider'}"
        for s in summary.shortfalls[:_SHOWN]
    )
    return [f"{summary.shortfall_s:.0f} s slower than wanted in all, stretches: {len(summary.shortfalls)}", *worst]


def _ledger_texts(summary: SimulationSummary) -> list[str]:
    ledger = sorted(summary.ledger_wh.items(), key=lambda item: -item[1])
    gross = sum(energy for _, energy in ledger if energy >= _LEAST) or 1.0
    return [
        f"{name.replace('_', ' '):20} {energy:9.2f} Wh {100 * energy / gross:6.1f} %"
        for name, energy in ledger
        if abs(energy) >= _LEAST
    ]


def _measured_rows(m: MeasuredEntry | None) -> list[tuple[str, str]]:
    if not m:
        return []
    energy, consumption = number(m.energy_wh, ".1f", "Wh"), number(m.consumption_wh_km, ".2f", "Wh/km")
    differences = (
        number(m.rms_speed_km_h, ".1f", "km/h"),
        number(m.rms_pack_voltage_v, ".2f", "V"),
        number(m.rms_pack_current_a, ".1f", "A"),
        number(m.rms_motor_torque_nm, ".1f", "N·m"),
    )
    return [
        ("measured", f"{m.distance_km:.2f} km, {energy}, {consumption}"),
        ("simulated less", f"RMS {', '.join(differences)}"),
    ]


def variants_text(sweep: Sequence[Variant]) -> str:
    """A table of the variants, for a terminal."""
    heads = [*sweep[0].values, "Wh/km", "range km", "shortfall s"]
    rows = [heads]
    for v in sweep:
        results = number(v.consumption_wh_km, ".2f"), number(v.range_km, ".1f"), f"{v.shortfall_s:.0f}"
        rows.append([*(f"{value:g}" for value in v.values.values()), *results])
    widths = [max(len(head), 10) for head in heads]
    lines = ("  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)) for row in rows)
    return "\n".join(lines)
