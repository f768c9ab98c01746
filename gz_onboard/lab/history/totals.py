"""What the rides of months come to."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import groupby
from math import floor
from typing import Annotated, Any

from gz_onboard.lab.history.ride import KeptRide, follows, joined

BAND = 5  # K of the air's temperature
SOME = 0.05  # of what can be learned: less is not told
LEARNED = ("capacity", "resistance")
NO_DATE = "no date"


@dataclass(frozen=True)
class Totals:
    """Of some rides."""

    of: Annotated[str, "of which rides: the month, such as 2025-06, 'no date', or the air, such as '10 to 15 degC'"]
    rides: Annotated[int, "how many"]
    distance_km: Annotated[float, "ridden"]
    duration_s: Annotated[float, "of the rides"]
    energy_wh: Annotated[float | None, "drawn, less what was recovered, on rides of which it is known"]
    energy_recovered_wh: Annotated[float | None, "charged into the pack while riding, likewise"]
    consumption_wh_km: Annotated[float | None, "energy over the distance on which it is known"]
    ambient_C: Annotated[float | None, "mean temperature of the air, by distance"]  # noqa: N815 - as of a ride


@dataclass(frozen=True)
class LearnedAt:
    """What was known of the battery at the end of a ride."""

    name: Annotated[str, "capacity or resistance"]
    start_ns: Annotated[int, "start of the ride"]
    value: Annotated[float, "over what the vehicle file says"]
    sd: Annotated[float, "its standard deviation"]
    share: Annotated[float, "0: nothing is learned, 1: as much as can be"]


@dataclass(frozen=True)
class NumberedRide:
    """A ride and its number in the history; of one in several logs that of the first."""

    number: int
    ride: KeptRide


@dataclass(frozen=True)
class Overview:
    """Of the rides of one vehicle, by start. learned: where more than nothing was."""

    vehicle: str
    total: Totals
    months: list[Totals]
    temperatures: list[Totals]
    learned: list[LearnedAt]
    rides: list[NumberedRide]


def overviews(rides: Iterable[NumberedRide]) -> list[Overview]:
    """An overview of each vehicle; rides: by vehicle and start."""
    found = []
    for vehicle, group in groupby(rides, lambda one: one.ride.vehicle):
        of = list(group)
        plain = [one.ride for one in of]
        cold = sorted((ride for ride in plain if ride.ambient_C is not None), key=lambda ride: ride.ambient_C or 0.0)
        months, bands = _grouped(plain, month_of), _grouped(cold, _band)
        found.append(Overview(vehicle, _totals("all", plain), months, bands, learned_by(plain), of))
    return found


def whole_rides(rides: Iterable[NumberedRide]) -> list[NumberedRide]:
    """`rides`, by vehicle and start, with one in place of the parts of a ride of which the daemon began a new log."""
    whole: list[NumberedRide] = []
    for one in rides:
        if whole and follows(whole[-1].ride, one.ride):
            whole[-1] = NumberedRide(whole[-1].number, joined(whole[-1].ride, one.ride))
        else:
            whole.append(one)
    return whole


def learned_by(rides: Sequence[KeptRide]) -> list[LearnedAt]:
    """What was known of capacity and resistance at the end of each ride, where anything was."""
    found = []
    for name in LEARNED:
        for ride in rides:
            value, sd, share = (getattr(ride, name + part) for part in ("", "_sd", "_share"))
            if value is not None and share >= SOME and ride.dated:
                found.append(LearnedAt(name, ride.start_ns, value, sd, share))
    return found


def local(time_ns: int) -> datetime:
    """A time [ns since the epoch] in the zone of the machine, or of ``TZ``."""
    return datetime.fromtimestamp(time_ns / 1e9, UTC).astimezone()


def month_of(ride: KeptRide) -> str:
    """The month in which a ride began, as of `Totals`."""
    return f"{local(ride.start_ns):%Y-%m}" if ride.dated else NO_DATE


def _band(ride: KeptRide) -> str:
    low = BAND * floor((ride.ambient_C or 0.0) / BAND)
    return f"{low} to {low + BAND} degC"


def _grouped(rides: Sequence[KeptRide], key: Callable[[KeptRide], str]) -> list[Totals]:
    return [_totals(name, list(group)) for name, group in groupby(rides, key)]


def _totals(of: str, rides: Sequence[KeptRide]) -> Totals:
    known = [ride for ride in rides if ride.energy_wh is not None]
    at = [ride for ride in rides if ride.ambient_C is not None]
    energy = _sum(known, "energy_wh") if known else None
    length = sum(ride.metered_km for ride in known)
    warmth = sum((ride.ambient_C or 0.0) * ride.distance_km for ride in at)
    return Totals(
        of,
        len(rides),
        _sum(rides, "distance_km"),
        _sum(rides, "duration_s"),
        energy,
        _sum(known, "energy_recovered_wh") if known else None,
        energy / length if energy is not None and length else None,
        warmth / _sum(at, "distance_km") if at else None,
    )


def _sum(rides: Sequence[KeptRide], name: str) -> float:
    values: list[Any] = [getattr(ride, name) for ride in rides]
    return float(sum(value for value in values if value is not None))
