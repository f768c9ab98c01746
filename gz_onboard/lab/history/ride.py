"""A ride as the history keeps it, and when two of them are the same."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, get_type_hints

from gz_onboard.offline.results import FIRST_DATE_NS
from gz_onboard.offline.schema import descriptions

SECOND_NS = 1_000_000_000
_SLACK_NS = 2 * SECOND_NS  # by so much the ends of one ride differ in two logs of it
_QUARTER_NS = 900 * SECOND_NS  # zones of time differ by whole quarters of an hour
_MOST_ZONES = 14 * 4  # quarters between any zone and UTC
_JOINED_NS = (
    30 * SECOND_NS
)  # a ride goes on in the log that begins so soon after: one that the daemon closed, or a crash


_SOC_APART = 0.05  # of a state of charge: two estimates of one ride differ by less


@dataclass(frozen=True)
class KeptRide:
    """A row of the history's table `rides`, and a ride in its JSON."""

    vehicle: Annotated[str, "what the vehicle is called in the history"]
    start_ns: Annotated[int, "start [ns since the epoch]; before 2000 if the log's clock was not set"]
    duration_s: Annotated[float, "from the start to the end"]
    distance_km: Annotated[float, "ridden"]
    energy_wh: Annotated[float | None, "drawn from the pack, less what was recovered; null if it is not known"]
    energy_recovered_wh: Annotated[float | None, "charged into the pack while riding, or null"]
    consumption_wh_km: Annotated[float | None, "energy over that of the distance on which it is known, or null"]
    soc_start: Annotated[float | None, "state of charge, 0 to 1, at the first estimate that has one"]
    soc_start_sd: Annotated[float | None, "its standard deviation"]
    soc_end: Annotated[float | None, "at the last estimate that has one"]
    soc_end_sd: Annotated[float | None, "its standard deviation"]
    range_start_km: Annotated[float | None, "first range that was shown"]
    range_start_p10_km: Annotated[float | None, "exceeded with 90 % probability"]
    range_start_p90_km: Annotated[float | None, "exceeded with 10 % probability"]
    range_end_km: Annotated[float | None, "last range that was shown"]
    range_end_p10_km: Annotated[float | None, "exceeded with 90 % probability"]
    range_end_p90_km: Annotated[float | None, "exceeded with 10 % probability"]
    rated_range_km: Annotated[float | None, "the last rated range: full, as new, mild, level, no wind"]
    ambient_C: Annotated[float | None, "mean temperature of the air, or that of rides.json"]  # noqa: N815 - as there
    cells_C: Annotated[float | None, "mean temperature of the cells"]  # noqa: N815
    route: Annotated[str | None, "file of the route that was given; 'given' if its name is not known"]
    route_km: Annotated[float | None, "ridden on it"]
    rider: Annotated[str | None, "who rode, or null"]
    payload_kg: Annotated[
        float | None, "mass of rider and luggage: --payload, or of rides.json, which the estimate does not use"
    ]
    degraded_s: Annotated[float, "an input was missing"]
    invalid_s: Annotated[float, "no range was shown"]
    reasons: Annotated[str, "why, and other reasons to distrust the estimate"]
    distrusted: Annotated[str, "roles of the sensors that were left out"]
    dropped: Annotated[int, "frames and signals that failed a check"]
    lost: Annotated[int, "frames missing"]
    capacity: Annotated[float | None, "of the pack, over the vehicle file's, as known at the end"]
    capacity_sd: Annotated[float | None, "its standard deviation"]
    capacity_share: Annotated[float | None, "0: nothing of it is learned, 1: as much as can be"]
    resistance: Annotated[float | None, "of the cells, likewise"]
    resistance_sd: Annotated[float | None, "its standard deviation"]
    resistance_share: Annotated[float | None, "as of the capacity"]
    log: Annotated[str, "name of the log"]
    vehicle_key: Annotated[str, "vehicle, cells and effects of the vehicle file"]
    version: Annotated[str, "of the gz-onboard that made the estimates, if the log says it"]

    @property
    def end_ns(self) -> int:
        """Its end [ns since the epoch]."""
        return self.start_ns + round(self.duration_s * 1e9)

    @property
    def dated(self) -> bool:
        """Whether its date is one: without a clock the date is 1970."""
        return self.start_ns >= FIRST_DATE_NS

    @property
    def metered_km(self) -> float:
        """Of the distance, that on which the energy is known."""
        if not (self.energy_wh and self.consumption_wh_km):
            return 0.0 if self.consumption_wh_km is None else self.distance_km
        return min(self.energy_wh / self.consumption_wh_km, self.distance_km)


COLUMNS: Mapping[str, Any] = {f.name: get_type_hints(KeptRide)[f.name] for f in fields(KeptRide)}
"""The type of each field."""
MEANING = descriptions(KeptRide)


def same_ride(one: KeptRide, other: KeptRide) -> bool:
    """Whether two rides of a vehicle are one, in two logs of which one has no date or another zone of time.

    By what was ridden: a log that was exported has the same frames.
    """
    apart = other.start_ns - one.start_ns
    if one.dated and other.dated:
        quarters = round(apart / _QUARTER_NS)
        if abs(quarters) > _MOST_ZONES or abs(apart - quarters * _QUARTER_NS) > _SLACK_NS:
            return False
    return (
        abs(one.duration_s - other.duration_s) <= 1.5
        and _near(one.distance_km, other.distance_km, 0.005)
        and _near(one.energy_wh, other.energy_wh, 1.0)
        and _near(one.soc_end, other.soc_end, _SOC_APART)
    )


def _near(one: float | None, other: float | None, apart: float) -> bool:
    return one is None or other is None or abs(one - other) <= max(apart, 0.001 * abs(one))


def overlap(one: KeptRide, other: KeptRide) -> bool:
    """Whether two rides of a vehicle were at the same time."""
    if not (one.dated and other.dated):
        return False
    return min(one.end_ns, other.end_ns) - max(one.start_ns, other.start_ns) > _SLACK_NS


def contradicts(one: KeptRide, other: KeptRide) -> bool:
    """Whether the ride `other` cannot be a part of `one` that covers its time: a clock was wrong, as on each boot."""
    if other.distance_km > one.distance_km + 0.05:
        return True
    if one.soc_start is None or one.soc_end is None or other.soc_start is None:
        return False
    together = abs(other.start_ns - one.start_ns) <= _SLACK_NS
    ends = (one.soc_start, one.soc_start if together else one.soc_end)
    return not min(ends) - _SOC_APART <= other.soc_start <= max(ends) + _SOC_APART


def covers(one: KeptRide, other: KeptRide) -> bool:
    """Whether `one` lasts from the start to the end of `other`."""
    return one.start_ns <= other.start_ns + _SLACK_NS and one.end_ns >= other.end_ns - _SLACK_NS


def follows(one: KeptRide, other: KeptRide) -> bool:
    """Whether `other` is the rest of the ride `one`, of which the daemon began a new log."""
    return one.vehicle == other.vehicle and one.dated and abs(other.start_ns - one.end_ns) <= _JOINED_NS


def joined(one: KeptRide, other: KeptRide) -> KeptRide:
    """The ride of which `one` is the first part and `other` the rest."""
    first = {f.name: getattr(one, f.name) for f in fields(KeptRide)}
    last = {f.name: getattr(other, f.name) for f in fields(KeptRide)}
    whole = {name: last[name] if last[name] is not None else first[name] for name in first}
    for name in ("vehicle", "start_ns", "log", *(name for name in first if "_start" in name)):
        whole[name] = first[name] if first[name] is not None else last[name]
    for name in ("distance_km", "energy_wh", "energy_recovered_wh", "route_km", "degraded_s", "invalid_s"):
        known = [part[name] for part in (first, last) if part[name] is not None]
        enough = 1 if name == "route_km" else 2
        whole[name] = sum(known) if len(known) >= enough else None
    for name in ("dropped", "lost"):
        whole[name] = first[name] + last[name]
    for name in ("ambient_C", "cells_C"):
        known = [(part[name], part["duration_s"]) for part in (first, last) if part[name] is not None]
        length = sum(seconds for _, seconds in known)
        whole[name] = sum(value * seconds for value, seconds in known) / length if length else whole[name]
    for name in ("reasons", "distrusted"):
        whole[name] = " ".join(dict.fromkeys([*first[name].split(), *last[name].split()]))
    energy, length = whole["energy_wh"], one.metered_km + other.metered_km
    whole["consumption_wh_km"] = energy / length if energy is not None and length else None
    whole["duration_s"] = (other.end_ns - one.start_ns) * 1e-9
    return replace(one, **whole)
