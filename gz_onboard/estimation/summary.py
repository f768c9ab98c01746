"""Summarise the estimates of a ride, as JSON, as a table and as text."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from math import sqrt
from pathlib import Path
from typing import Annotated, cast, get_type_hints

from gz_onboard.constants import BENCH_TEMPERATURE, HOUR, WH, WH_PER_KM
from gz_onboard.errors import InputError, nearest, writing
from gz_onboard.estimation.ride import RideRun
from gz_onboard.events import WINDOW, Estimate, Explanation, Reason, RouteState, State, words
from gz_onboard.imports import require
from gz_onboard.pipeline import lacking
from gz_onboard.reports.results import Failure, clock, descriptions, leap_text, number, text_rows, times, to_json
from gz_onboard.reports.tables import write_table

SUMMARY_VERSION = 1
TABLE_FORMATS = (".csv", ".parquet", ".jsonl")
POOR_FIT_V = 0.1  # of a cell, RMS: the innovation of recorded rides is 0.003 to 0.054
GAUGE_SD = 0.06  # of the SOC that a vehicle shows
GAUGE_GAIN = (0.6, 1.7)  # charge counted over charge shown: worn cells count less
WORN_GAIN = 0.85  # likewise; packs that count less are rare
GAUGE_ERROR = 0.2  # SOC: a larger error of the gauge points to a wrong vehicle file
GAUGE_SDS = 3.0
MAX_SLOW = 0.1  # share of the time in which current and voltage may come too slowly to be integrated
MAX_CONTRADICTION = 0.5  # share of the ride: a sensor that fails on the way is a fault, a misfit throughout is not
MIN_MISSING_S = 1.0  # that is worth a line
CONTRADICTIONS = Reason.VOLTAGE_MISMATCH, Reason.CURRENT_MISMATCH, Reason.SENSOR_DISTRUSTED
CHECK_HINT = "what is wrong, `gz-onboard vehicle check` tells, with the same vehicle and {}"


@dataclass(frozen=True)
class Why:
    """A range compared with another, the difference split among causes (docs/explanation/causes.md)."""

    time_s: Annotated[float, "since the first frame"]
    reference_km: Annotated[float, "the rated range; of a change, the range before"]
    range_km: Annotated[float, "the range then; of a change, with the distance ridden since"]
    causes_km: Annotated[dict[str, float], "the share of each cause in the difference; the shares add up to it"]
    forgotten: Annotated[list[str], "roles of sensors found faulty between, whose lessons are forgotten"] = field(
        default_factory=list
    )

    @classmethod
    def of(cls, e: Explanation) -> Why:
        """Convert an explanation, which is in m."""
        causes = {cause.name.lower(): size * 1e-3 for cause, size in e.causes.items()}
        return cls(e.time, e.reference * 1e-3, e.range * 1e-3, causes, list(e.forgotten))


@dataclass(frozen=True)
class RouteSummary:
    """The route given: `state` at the end of the ride, the rest from the last estimate on it; null if unknown."""

    state: str  # of `RouteState`
    ridden_km: float
    grade_known: bool
    along_km: float | None
    left_km: float | None
    energy_wh: float | None  # to the end of the route
    energy_sd_wh: float | None
    arrival_soc: float | None  # 0 to 1; 0 if the battery ends before
    arrival_soc_p10: float | None
    arrival_soc_p90: float | None
    battery_ends_km: float | None  # from the start of the route
    battery_ends_latitude_deg: float | None
    battery_ends_longitude_deg: float | None


@dataclass(frozen=True)
class RideSummary:
    """A ride in the JSON: {"version", "rides": [summaries], "failed": [{file, error}]}."""

    file: Annotated[str, "the log"]
    log: Annotated[str | None, "the MCAP written, or null"]
    plot: Annotated[str | None, "the picture written, or null"]
    vehicle: Annotated[str, "name of the vehicle"]
    filter: Annotated[str, "backend of the filter"]
    start_ns: Annotated[int, "time of the first frame [ns since the epoch, as in the log]"]
    duration_s: Annotated[float, "from the first to the last estimate, without paused_s"]
    distance_km: Annotated[float, "ridden, but for gaps_s"]
    speed_max_km_h: Annotated[float | None, "greatest speed, or null"]
    energy_wh: Annotated[
        float | None,
        "drawn from the pack as measured, less what was recovered (not what was charged), the "
        "sensors' known gain and offsets taken off; "
        "null if voltage or current was never known, or came too slowly for more than a tenth of the time",
    ]
    energy_recovered_wh: Annotated[float | None, "charged into the pack while riding, or null"]
    energy_charged_wh: Annotated[float | None, "charged into the pack by a charger, or null"]
    energy_distance_km: Annotated[float, "of distance_km, ridden while voltage and current were known"]
    energy_missing_s: Annotated[float, "without a voltage or current to be believed: the energy lacks it"]
    consumption_wh_km: Annotated[float | None, "energy over energy_distance_km; null below 0.1 km"]
    soc_start: Annotated[float | None, "state of charge, 0 to 1, at the first estimate that has one"]
    soc_start_sd: Annotated[float | None, "its standard deviation"]
    soc_end: Annotated[float | None, "at the last estimate that has one"]
    soc_end_sd: Annotated[float | None, "its standard deviation"]
    soc_shown_start: Annotated[float | None, "what the vehicle itself showed first, or null"]
    soc_shown_end: Annotated[float | None, "what the vehicle itself showed last, or null"]
    charge_ah: Annotated[
        float | None,
        "drawn from the pack between those two, less what came back; null if more than a tenth was not counted",
    ]
    capacity_ah: Annotated[float | None, "of the vehicle file's pack, in what the vehicle shows as 0 to 100 %"]
    range_start_km: Annotated[float | None, "first range published"]
    range_end_km: Annotated[float | None, "last range published"]
    range_end_p10_km: Annotated[float | None, "exceeded with 90 % probability"]
    range_end_p90_km: Annotated[float | None, "exceeded with 10 % probability"]
    energy_left_wh: Annotated[float | None, "to be drawn before the cut-off, at the end"]
    why: Annotated[Why | None, "why the last range that was explained is not the rated one, or null"]
    changes: Annotated[
        list[Why],
        "each change of the range by 1 km more or less than was ridden, and why; its range_km is the range then plus "
        "what was ridden since reference_km; a charge is one change, told when it is over",
    ]
    route: Annotated[
        RouteSummary | None,
        "of the route given: state at the end (ON, OFF), km ridden on it; and of the last estimate on it km along and "
        "left, energy to its end and state of charge there, km from its start and position where the battery ends "
        "before; or null",
    ]
    saved_state: Annotated[str | None, "with --state: `resumed` from a saved state, or `new` with this ride; or null"]
    saved_state_age_s: Annotated[float | None, "age of that state when the ride began, if it is known"]
    innovation_rms_v: Annotated[float | None, "root mean square of measured less predicted voltage of a cell [V]"]
    innovation_max_v: Annotated[float | None, "greatest magnitude of the same"]
    states: Annotated[dict[str, float], "seconds in each state"]
    reasons: Annotated[dict[str, float], "seconds with each reason to distrust the estimate"]
    distrusted: Annotated[dict[str, float], "seconds by role of a sensor that contradicted the others and was left out"]
    lacking: Annotated[list[str], "reasons that hold for ever, as the vehicle has no such sensors: no degradation"]
    frames: Annotated[int, "received"]
    dropped: Annotated[int, "frames that failed a check"]
    implausible: Annotated[int, "signals out of their physical range"]
    lost: Annotated[int, "frames missing by their counters"]
    unknown: Annotated[int, "different identifiers that the database does not know"]
    foreign: Annotated[dict[str, int], "frames of someone else on the identifiers of the range frames, by identifier"]
    error_frames: Annotated[int, "error frames of the bus"]
    gaps_s: Annotated[float, "without any measurement for too long to go on: distance and energy lack what was ridden"]
    paused_s: Annotated[float, "in pauses of the recording, each of more than 30 s without frames"]
    clock: Annotated[list[str], "where the log's clock leaps and is taken as set, in words"]
    faults: Annotated[dict[str, dict[str, int]], "what was dropped, by reason and by message or signal"]
    damage: Annotated[str | None, "what of the log could not be read, or null"]
    cpu_s: Annotated[float, "processor time taken, without drawing; 0 for a ride kept by --resume"]
    real_time_factor: Annotated[
        float | None, "duration of the ride over the time taken, without drawing; null for a ride kept by --resume"
    ]


KEYS = descriptions(RideSummary)
"""The keys of a ride in the JSON, with their meaning."""


def gains(fell: float) -> tuple[float, float, float]:
    """Return the plausible charge counted while the vehicle's own gauge `fell`, over the charge that it shows.

    (least, least of cells that are not worn, most). The gauge's error, 2 sd at either end, matters the more the less
    it fell; no cells give more than their capacity.
    """
    doubt = 2 * sqrt(2) * GAUGE_SD / abs(fell)
    return GAUGE_GAIN[0], max(min(WORN_GAIN, 1 - doubt), GAUGE_GAIN[0]), min(1 + doubt, GAUGE_GAIN[1])


def summary_of(run: RideRun, log: Path | None = None, picture: Path | None = None) -> RideSummary:
    """Summarise a ride; log, picture: where its estimates were written and drawn."""
    pipeline, s, resumed = run.pipeline, run.statistics, run.resumed
    codec, energy, battery = pipeline.codec, pipeline.energy, pipeline.estimator.pack.battery
    file_battery = pipeline.vehicle.battery
    last, ranged = s.last or Estimate(0.0), s.last_ranged or Estimate(0.0)
    duration = last.time - s.paused_s
    soc_start, soc_end = s.soc_start or (None, None), s.soc_end or (None, None)
    gauge_end = pipeline.estimator.signals["bms_state_of_charge"].last
    counted = s.gauge_start is not None and s.uncounted_s <= MAX_SLOW * duration
    counts, status = pipeline.counts(), pipeline.status()
    states, reasons = s.by_name()
    is_integrated = energy.net is not None and reasons[Reason.SIGNALS_SLOW.name] <= MAX_SLOW * states.total()
    drawn = energy.net if is_integrated else None
    capacity = None  # of the vehicle file, not as the ride has learned it
    if file_battery:
        window = file_battery.window
        capacity = file_battery.pack_capacity(BENCH_TEMPERATURE) * (window.high - window.low)
    return RideSummary(
        file=str(run.ride.source),
        log=str(log) if log else None,
        plot=str(picture) if picture else None,
        vehicle=pipeline.vehicle.name,
        filter=run.options.filter_name,
        start_ns=run.ride.start_ns,
        duration_s=duration,
        distance_km=last.distance * 1e-3,
        speed_max_km_h=times(s.speed_max, 3.6),
        energy_wh=times(drawn, 1 / WH),
        energy_recovered_wh=energy.recovered / WH if is_integrated else None,
        energy_charged_wh=energy.charged / WH if is_integrated else None,
        energy_distance_km=energy.distance * 1e-3,
        energy_missing_s=round(energy.missing, 1),
        consumption_wh_km=times(drawn, 1 / energy.distance / WH_PER_KM) if energy.distance >= 100 else None,
        soc_start=soc_start[0],
        soc_start_sd=soc_start[1],
        soc_end=soc_end[0],
        soc_end_sd=soc_end[1],
        soc_shown_start=None if s.gauge_start is None else battery.window.shown(s.gauge_start, 0.0)[0],
        soc_shown_end=None if gauge_end is None else battery.window.shown(gauge_end, 0.0)[0],
        charge_ah=s.charge_as / HOUR if counted else None,
        capacity_ah=capacity,
        range_start_km=times(s.range_start_m, 1e-3),
        range_end_km=times(ranged.range, 1e-3),
        range_end_p10_km=times(ranged.range_p10, 1e-3),
        range_end_p90_km=times(ranged.range_p90, 1e-3),
        energy_left_wh=times(ranged.energy_left, 1 / WH),
        why=Why.of(last.why) if last.why else None,
        changes=list(map(Why.of, pipeline.estimator.explainer.changes)),
        route=_route_summary(run) if run.options.route else None,
        saved_state=("resumed" if resumed.found else "new") if resumed else None,
        saved_state_age_s=resumed.age_s if resumed else None,
        innovation_rms_v=s.innovation_rms,
        innovation_max_v=s.innovation_max if s.innovation_rms is not None else None,
        states={state.name: round(states[state.name] * WINDOW, 1) for state in State if states[state.name]},
        reasons={name: round(count * WINDOW, 1) for name, count in sorted(reasons.items())},
        distrusted={role: round(count * WINDOW, 1) for role, count in sorted(s.distrusted.items())},
        lacking=lacking(pipeline.vehicle),
        frames=codec.received,
        dropped=counts.dropped,
        implausible=counts.implausible,
        lost=counts.lost,
        unknown=counts.unknown,
        foreign=cast("dict[str, int]", status["foreign"]),
        error_frames=codec.error_frames,
        gaps_s=round(pipeline.estimator.gap_time, 1),
        paused_s=round(s.paused_s, 1),
        clock=[leap_text(*leap) for leap in codec.leaps],
        faults=cast("dict[str, dict[str, int]]", status["faults"]),
        damage=str(run.ride.damages[0]) if run.ride.damages else None,
        cpu_s=run.cpu_s,
        real_time_factor=duration / run.wall_s if s.last else None,
    )


def _route_summary(run: RideRun) -> RouteSummary:
    assert run.options.route
    last = run.statistics.last or Estimate(0.0)
    e = run.statistics.last_on_route or last
    ends = None if e.battery_ends_after is None or e.route_along is None else e.route_along + e.battery_ends_after
    return RouteSummary(
        last.route_state.name,
        run.statistics.on_route_m * 1e-3,
        run.options.route.grade_known,
        times(e.route_along, 1e-3),
        times(e.route_left, 1e-3),
        times(e.route_energy, 1 / WH),
        times(e.route_energy_sd, 1 / WH),
        e.arrival_soc,
        e.arrival_soc_p10,
        e.arrival_soc_p90,
        times(ends, 1e-3),
        e.battery_ends_latitude,
        e.battery_ends_longitude,
    )


# --- kept with the log, for --resume ------------------------------------------------------------------------------


def encode_summary(summary: RideSummary) -> str:
    """Write a summary as JSON, without what depends on the place of the files and on the machine."""
    damage = summary.damage and summary.damage.removeprefix(f"{summary.file}: ")
    plain = replace(summary, file="", log=None, plot=None, damage=damage, cpu_s=0.0, real_time_factor=None)
    return json.dumps(to_json(plain))


def decode_summary(text: str, file: Path, log: Path, picture: Path | None) -> RideSummary | None:
    """Read a summary that `encode_summary` wrote, for these files; None for any other text."""
    try:
        values = json.loads(text)
        values |= {"file": str(file), "log": str(log), "plot": str(picture) if picture else None}
        values["damage"] = values["damage"] and f"{file}: {values['damage']}"
        values["why"] = values["why"] and Why(**values["why"])
        values["changes"] = [Why(**change) for change in values["changes"]]
        values["route"] = values["route"] and RouteSummary(**values["route"])
        return RideSummary(**values)
    except (ValueError, TypeError, KeyError):
        return None


# --- as a table of many rides ---------------------------------------------------------------------------------------

_HINTS = get_type_hints(RideSummary)
CELLS: dict[str, type] = {
    f.name: kind for f in fields(RideSummary) for kind in (str, int, float) if _HINTS[f.name] in (kind, kind | None)
}
"""The fields of a summary that are a number or a text, with their type."""


def summary_table(rides: Sequence[RideSummary], failed: Sequence[Failure] = ()) -> dict[str, list[object]]:
    """Tabulate rides: each of `CELLS`, the seconds in each state, the reasons; and the error of each failed log.

    None is unknown.
    """
    missing = [None] * len(failed)
    table: dict[str, list[object]] = {name: [*(getattr(ride, name) for ride in rides), *missing] for name in CELLS}
    table["file"] = [*(ride.file for ride in rides), *(failure.file for failure in failed)]
    for state in State:
        table[f"{state.name.lower()}_s"] = [*(ride.states.get(state.name, 0.0) for ride in rides), *missing]
    table["reasons"] = [*(" ".join(ride.reasons) for ride in rides), *missing]
    table["error"] = [*(None for _ in rides), *(failure.error for failure in failed)]
    return table


def check_table(out: Path) -> None:
    """InputError if `out` has no format of a table, ModuleNotFoundError if its writer is not installed."""
    require("pyarrow", out.suffix.lower() == ".parquet")
    if not out.name.lower().endswith((*TABLE_FORMATS, ".csv.gz", ".jsonl.gz")):
        formats = ", ".join(TABLE_FORMATS)
        raise InputError(f"--table {out}: a table is written as {formats}{nearest(out.suffix, TABLE_FORMATS)}")


def write_summaries(out: Path, rides: Sequence[RideSummary], failed: Sequence[Failure]) -> None:
    """Write the table, in the format that the name of `out` says. Raises InputError."""
    with writing(out):
        write_table(out, summary_table(rides, failed), kinds={**CELLS, "reasons": str, "error": str})


# --- as text --------------------------------------------------------------------------------------------------------


def summary_text(ride: RideSummary) -> str:
    """Write a ride's summary for a terminal."""
    rows = summary_rows(ride)
    fast = f"{ride.cpu_s:.2f} s of CPU time, {number(ride.real_time_factor, '.0f')} times real time"
    rows.append(("computed", fast if ride.cpu_s else "by an earlier run"))
    if ride.log:
        rows.append(("written", f"{ride.log}{f' and {Path(ride.plot).suffix}' if ride.plot else ''}"))
    return text_rows(ride.file, rows)


def summary_rows(ride: RideSummary) -> list[tuple[str, str]]:
    """Return the names and texts of a summary; the same ride gives the same texts."""
    rows = [
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
        *_route_rows(ride),
    ]
    if ride.saved_state:
        rows.append(("saved state", _state_text(ride)))
    rows += [
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
    ]
    if ride.paused_s:
        rows.append(("pauses", f"{clock(ride.paused_s)} without frames, not counted as ridden"))
    if ride.gaps_s:
        rows.append(("gaps", f"{ride.gaps_s:.1f} s, missing from distance and energy"))
    rows += [
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
    ]
    if doubt := _doubt_of_file(ride):
        rows.append(("vehicle file", f"{doubt}; {CHECK_HINT.format(ride.file)}"))
    if ride.distrusted:
        rows.append(("left out", _durations(ride.distrusted)))
    if ride.lacking:
        rows.append(("never there", ", ".join(words(name) for name in ride.lacking)))
    return rows


def contradicted(ride: RideSummary) -> bool:
    """Return whether measurements contradict the vehicle file, or each other, for most of the ride."""
    longest = max(ride.reasons.get(str(reason.name), 0.0) for reason in CONTRADICTIONS)
    return longest > MAX_CONTRADICTION * sum(ride.states.values()) or (ride.innovation_rms_v or 0.0) > POOR_FIT_V


def _doubt_of_file(ride: RideSummary) -> str:
    """Say why the vehicle file may be wrong: by its capacity, by contradictions, or by the vehicle's own gauge."""
    first, last, charge, capacity = ride.soc_shown_start, ride.soc_shown_end, ride.charge_ah, ride.capacity_ah
    if first is not None and last is not None and charge is not None and capacity is not None:
        fell = first - last
        if abs(fell) >= GAUGE_ERROR:
            least, _, most = gains(fell)
            if (fits := charge / fell) > 0 and not least < fits / capacity < most:
                return (
                    f"the vehicle itself shows {100 * first:.0f} to {100 * last:.0f} % over {charge:.1f} A·h, as a "
                    f"pack of {fits:.1f} A·h would; the file's has {capacity:.1f} A·h: cell_capacity, cells_parallel, "
                    "the current's scale or the gauge is wrong"
                )
    if contradicted(ride):
        return "what was measured does not fit it"
    found, sd = ride.soc_end, ride.soc_end_sd or 0.0
    if last is None or found is None or abs(last - found) < max(GAUGE_ERROR, GAUGE_SDS * sd):
        return ""
    return (
        f"the vehicle itself shows {100 * last:.0f} % at the end, {100 * abs(last - found):.0f} points "
        f"{'more' if last > found else 'less'}: its gauge or the vehicle file is wrong"
    )


def _energy_rows(ride: RideSummary) -> list[tuple[str, str]]:
    if ride.energy_wh is None:
        return [("energy", "not known: voltage or current of the pack was not measured, or too seldom")]
    text = (
        f"{ride.energy_wh:.0f} Wh drawn net, after {number(ride.energy_recovered_wh, '.0f', 'Wh')} recovered; "
        f"{number(ride.consumption_wh_km, '.1f', 'Wh/km')}"
    )
    if ride.energy_charged_wh:
        text += f"; {ride.energy_charged_wh:.0f} Wh charged"
    missing = missing_energy(ride)
    return [("energy", text), *([("", f"of {ride.energy_distance_km:.2f} km: {missing}")] if missing else [])]


def missing_energy(ride: RideSummary) -> str:
    """Say which part of the ride a known energy does not include; empty if it is next to nothing."""
    if ride.energy_wh is None or ride.energy_missing_s < MIN_MISSING_S:
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


def _route_rows(ride: RideSummary) -> list[tuple[str, str]]:
    route = ride.route
    if route is None:
        return []
    if route.left_km is None:
        return [("route", "the ride was never on it")]
    low, high = (number(soc, ".0f", "", 100) for soc in (route.arrival_soc_p10, route.arrival_soc_p90))
    text = "" if route.state == RouteState.ON.name else "when last on it, "
    text += f"{route.left_km:.1f} km and {number(route.energy_wh, '.0f', 'Wh')} to its end; "
    if route.battery_ends_km is None:
        text += f"{number(route.arrival_soc, '.0f', '%', 100)} of charge there ({low} to {high}, 80 % interval)"
    else:
        text += f"battery empty at km {route.battery_ends_km:.1f}"
        if route.battery_ends_latitude_deg is not None:
            text += f" ({route.battery_ends_latitude_deg:.5f}, {route.battery_ends_longitude_deg:.5f})"
    rows = [("route", text if route.grade_known else f"{text}; its grades are not known")]
    if route.ridden_km < ride.distance_km / 2:
        rows.append(("", f"only {route.ridden_km:.2f} of the {ride.distance_km:.2f} km ridden were on the route"))
    return rows


def _state_text(ride: RideSummary) -> str:
    if ride.saved_state == "new":
        return "new with this ride"
    age, day = ride.saved_state_age_s, 24 * HOUR
    old = "of an unknown age" if age is None else f"{age / day:.1f} days old" if age > 2 * day else f"{clock(age)} old"
    return f"resumed, {old} at the start"


def _durations(seconds: Mapping[str, float]) -> str:
    return ", ".join(f"{words(role)} {duration:.1f} s" for role, duration in seconds.items())


def _percent(value: float | None, sd: float | None) -> str:
    return "–" if value is None or sd is None else f"{100 * value:.1f} ± {100 * sd:.1f} %"
