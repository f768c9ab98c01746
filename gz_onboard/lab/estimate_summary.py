"""The summary of a ride's estimates."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from math import sqrt
from pathlib import Path
from typing import Annotated, cast

from gz_onboard.constants import BENCH_TEMPERATURE, HOUR, WH, WH_PER_KM
from gz_onboard.events import WINDOW, Estimate, Explanation, Reason, State
from gz_onboard.lab.estimate_ride import Ridden
from gz_onboard.lab.estimate_route import RouteSummary, route_summary
from gz_onboard.pipeline import lacking
from gz_onboard.reports.results import leap_text, times, to_json
from gz_onboard.vehicle import Vehicle

SUMMARY_VERSION = 1
UNFIT = 0.1  # V of a cell, RMS: so far no battery's tables are off its prediction; recorded rides have 0.003 to 0.054
GAINS = (0.6, 1.7)  # of a state of charge counted over what the vehicle shows: aged cells count less
AGED = 0.85  # likewise: packs that count less are rare
SHOWN_SD = 0.06  # of a vehicle's own state of charge
MOST_SLOW = 0.1  # of the time: energy is not integrated if pack current and voltage come too slowly for longer


@dataclass(frozen=True)
class Why:
    """A range against another, split among causes (docs/explanation/causes.md)."""

    time_s: Annotated[float, "since the first frame"]
    reference_km: Annotated[float, "the rated range; of a change, the range before"]
    range_km: Annotated[float, "the range then; of a change, with the distance ridden since"]
    causes_km: Annotated[dict[str, float], "the share of each cause in the difference; the shares add up to it"]
    forgotten: Annotated[list[str], "roles of sensors found faulty between, whose lessons are forgotten"] = field(
        default_factory=list
    )


def why_of(e: Explanation) -> Why:
    """An explanation in km."""
    causes = {cause.name.lower(): size * 1e-3 for cause, size in e.causes.items()}
    return Why(e.time, e.reference * 1e-3, e.range * 1e-3, causes, list(e.forgotten))


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


def gains(fell: float) -> tuple[float, float, float]:
    """(least, least but for aged cells, most) of a charge counted over that by which the vehicle's own gauge `fell`.

    Both as shares of the capacity. No cells give more than theirs, so what is more is the gauge's doubt, 2 sd at either
    end; the less it fell, the more that is.
    """
    doubt = 2 * sqrt(2) * SHOWN_SD / abs(fell)
    return GAINS[0], max(min(AGED, 1 - doubt), GAINS[0]), min(1 + doubt, GAINS[1])


def _capacity(vehicle: Vehicle) -> float | None:
    """Of the file's pack [A·h], between what the vehicle shows as empty and full; not as the ride has learned it."""
    if vehicle.battery is None:
        return None
    window = vehicle.battery.window
    return vehicle.battery.pack_capacity(BENCH_TEMPERATURE) * (window.high - window.low)


def summary_of(ridden: Ridden, log: Path | None = None, picture: Path | None = None) -> RideSummary:
    """The summary of a ride; log, picture: where its estimates were written and drawn."""
    pipeline, tally, route, went_on = ridden.pipeline, ridden.tally, ridden.how.route, ridden.went_on
    last, ranged = tally.last or Estimate(0.0), tally.ranged or Estimate(0.0)
    changes = pipeline.estimator.explainer.changes
    soc_start, soc_end = tally.soc_start or (None, None), tally.soc_end or (None, None)
    own = pipeline.estimator.signals["bms_state_of_charge"].last  # of the cells
    battery, gauge = pipeline.estimator.pack.battery, tally.gauge
    counted = gauge.first is not None and gauge.uncounted <= MOST_SLOW * (last.time - tally.paused)
    counts, status = pipeline.counts(), pipeline.status()
    states, reasons = tally.by_name()
    drawn = pipeline.energy.net if reasons[Reason.SIGNALS_SLOW.name] <= MOST_SLOW * states.total() else None
    way = pipeline.energy.distance
    return RideSummary(
        file=str(ridden.source),
        log=str(log) if log else None,
        plot=str(picture) if picture else None,
        vehicle=pipeline.vehicle.name,
        filter=ridden.how.filter_name,
        start_ns=tally.start_ns,
        duration_s=last.time - tally.paused,
        distance_km=last.distance * 1e-3,
        speed_max_km_h=times(tally.speed_max, 3.6),
        energy_wh=times(drawn, 1 / WH),
        energy_recovered_wh=None if drawn is None else pipeline.energy.recovered / WH,
        energy_charged_wh=None if drawn is None else pipeline.energy.charged / WH,
        energy_distance_km=way * 1e-3,
        energy_missing_s=round(pipeline.energy.missing, 1),
        consumption_wh_km=times(drawn, 1 / way / WH_PER_KM) if way >= 100 else None,
        soc_start=soc_start[0],
        soc_start_sd=soc_start[1],
        soc_end=soc_end[0],
        soc_end_sd=soc_end[1],
        soc_shown_start=None if gauge.first is None else battery.window.shown(gauge.first, 0.0)[0],
        soc_shown_end=None if own is None else battery.window.shown(own, 0.0)[0],
        charge_ah=gauge.charge / HOUR if counted else None,
        capacity_ah=_capacity(pipeline.vehicle),
        range_start_km=times(tally.range_start, 1e-3),
        range_end_km=times(ranged.range, 1e-3),
        range_end_p10_km=times(ranged.range_p10, 1e-3),
        range_end_p90_km=times(ranged.range_p90, 1e-3),
        energy_left_wh=times(ranged.energy_left, 1 / WH),
        why=why_of(last.why) if last.why else None,
        changes=list(map(why_of, changes)),
        route=route_summary(last, tally.on_route or last, tally.way_on_route, route.grade_known) if route else None,
        saved_state=("resumed" if went_on.found else "new") if went_on else None,
        saved_state_age_s=went_on.age if went_on else None,
        innovation_rms_v=tally.innovation_rms,
        innovation_max_v=tally.innovation_max if tally.innovation_rms is not None else None,
        states={state.name: round(states[state.name] * WINDOW, 1) for state in State if states[state.name]},
        reasons={name: round(ticks * WINDOW, 1) for name, ticks in sorted(reasons.items())},
        distrusted={role: round(ticks * WINDOW, 1) for role, ticks in sorted(tally.distrusted.items())},
        lacking=lacking(pipeline.vehicle),
        frames=pipeline.codec.received,
        dropped=counts.dropped,
        implausible=counts.implausible,
        lost=counts.lost,
        unknown=counts.unknown,
        foreign=cast("dict[str, int]", status["foreign"]),
        error_frames=pipeline.codec.error_frames,
        gaps_s=round(pipeline.estimator.gap_time, 1),
        paused_s=round(tally.paused, 1),
        clock=[leap_text(*leap) for leap in pipeline.codec.leaps],
        faults=cast("dict[str, dict[str, int]]", status["faults"]),
        damage=str(ridden.damages[0]) if ridden.damages else None,
        cpu_s=ridden.took[0],
        real_time_factor=(last.time - tally.paused) / ridden.took[1] if tally.last else None,
    )


def summary_to_keep(summary: RideSummary) -> str:
    """A summary as JSON without what depends on the place of the files, and on the machine."""
    damage = summary.damage and summary.damage.removeprefix(f"{summary.file}: ")
    plain = replace(summary, file="", log=None, plot=None, damage=damage, cpu_s=0.0, real_time_factor=None)
    return json.dumps(to_json(plain))


def kept_summary(text: str, file: Path, log: Path, picture: Path | None) -> RideSummary | None:
    """The summary that `summary_to_keep` gave, of these files; None for any other text."""
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
