"""The rides in a log, out of its estimates and statuses.

A log of the daemon goes on while the vehicle is parked and charged: a ride ends where that lasts (`BREAK`, `CHARGED`).
What was ridden and drawn stands in a log as sums since the start, so a ride is the difference between two of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gz_onboard.can.publisher import KNOWN
from gz_onboard.constants import WH
from gz_onboard.estimator.energy_counter import EnergyCounter
from gz_onboard.events import Activity, Estimate, RouteState, State
from gz_onboard.lab.history.ride import SECOND_NS, KeptRide
from gz_onboard.lab.logged import Logged, is_estimate, is_number, is_status
from gz_onboard.log_rows import ESTIMATE_TOPIC, RIDE_UNITS, STATUS_TOPIC, WHY_TOPIC
from gz_onboard.offline.results import FIRST_DATE_NS, times

BREAK = 600.0  # s of a stand that ends a ride
CHARGED = 60.0  # s of being charged, likewise
LEAST_DISTANCE = 100.0  # m: less is no ride
_LONGEST_STEP = 10.0  # s between two estimates of which voltage and current tell the energy
_FIRST = 1.5  # s: the first estimate of a run is not later
_LEARNED = {"": "factor", "_sd": "sd", "_share": "share"}  # the ends of our names, and what a log calls them
_USED = (  # of an estimate
    *("time", "distance", "activity", "state", "reasons", "distrusted", "route_state", "cell_temperature"),
    *("soc", "soc_sd", "range", "range_p10", "range_p90"),
)
_STATUS = ("faults", "lost", "kernel_lost", "overrun", "learned")
_RIDE = (*RIDE_UNITS, "rider")
_STANDS = (Activity.PARKED.name, Activity.ASLEEP.name, Activity.CHARGING.name)
_RANGED = tuple(state.name for state in KNOWN)


@dataclass(frozen=True)
class About:
    """What is known of a log's rides beside its rows. facts: of rides.json; route: the name of its file."""

    vehicle: str
    vehicle_key: str
    log: Path
    version: str
    payload: float | None  # kg
    route: str | None
    facts: Mapping[str, Any]


@dataclass
class LogMoment:
    """An estimate with what the status of its second says. ride: as of `log_rows.ride_row`."""

    time_ns: int
    estimate: Logged
    status: Logged
    ride: Logged


def moments_of(samples: Iterable[tuple[str, int, Logged]]) -> tuple[list[LogMoment], list[Logged]]:
    """(the estimates of a log with their statuses, the explanations); samples: topic, time [ns], values."""
    moments: list[LogMoment] = []
    whys: list[Logged] = []
    energy = EnergyCounter(_LONGEST_STEP)
    for topic, time_ns, values in samples:
        if topic == ESTIMATE_TOPIC and is_estimate(values):
            voltage, current = values.get("pack_voltage"), values.get("pack_current")
            energy.add(
                Estimate(values["time"], distance=values["distance"], pack_voltage=voltage, pack_current=current)
            )
            ride = {key: values[key] for key in ("time", "distance")}
            ride |= {
                "energy": energy.net,
                "energy_recovered": energy.recovered,
            }  # of a log whose status does not say it
            ride |= {"energy_distance": energy.distance}
            estimate = {key: values.get(key) for key in _USED}
            moments.append(LogMoment(time_ns, estimate, moments[-1].status if moments else {}, ride))
        elif topic == STATUS_TOPIC and moments and is_status(values):
            status = {key: values[key] for key in _STATUS if key in values}
            if status != moments[-1].status:  # mostly nothing has changed, and six hours are held in memory
                moments[-1].status = status
            if _is_ride(values.get("ride")):
                moments[-1].ride = {key: values["ride"].get(key) for key in _RIDE}
        elif topic == WHY_TOPIC and is_number(values.get("time")) and is_number(values.get("reference")):
            whys.append(values)
    return moments, whys


def rides_of(moments: Sequence[LogMoment], whys: Sequence[Logged], about: About) -> list[KeptRide]:
    """The rides in a log; none if it was parked, or charged, all the time."""
    date = _date(moments)
    rides = (_ride(moments[begin:end], whys, about, date) for begin, end in _spans(moments))
    return [ride for ride in rides if ride.distance_km * 1000 >= LEAST_DISTANCE]


def _spans(moments: Sequence[LogMoment]) -> Iterator[tuple[int, int]]:
    """(first, last + 1) of the moments of each ride."""
    begin, riding = 0, False
    for first, last, stands in _stretches(moments):
        hole = first > 0 and _elapsed(moments[first - 1], moments[first]) > BREAK  # in the log
        over = stands and _ends_a_ride(moments[first : last + 1])
        if riding and (hole or over):
            yield begin, first if hole else first + 1  # what was drawn until the stand began belongs to the ride
        if hole or over:
            begin, riding = last if over else first, False
        riding = riding or not stands
    if riding:
        yield begin, len(moments)


def _stretches(moments: Sequence[LogMoment]) -> Iterator[tuple[int, int, bool]]:
    """(first, last, whether the vehicle stands) of the stretches of one kind, and without a hole."""
    begin = 0
    for i, moment in enumerate(moments):
        after = moments[i + 1] if i + 1 < len(moments) else None
        stands = moment.estimate.get("activity") in _STANDS
        if after and (after.estimate.get("activity") in _STANDS) == stands and _elapsed(moment, after) <= BREAK:
            continue
        yield begin, i, stands
        begin = i + 1


def _ends_a_ride(stand: Sequence[LogMoment]) -> bool:
    charged = [moment for moment in stand if moment.estimate.get("activity") == Activity.CHARGING.name]
    long = _elapsed(stand[0], stand[-1]) >= BREAK
    return long or (bool(charged) and _elapsed(charged[0], charged[-1]) >= CHARGED)


def _is_ride(values: object) -> bool:
    """Whether it is one as we write it."""
    if not isinstance(values, dict) or not isinstance(values.get("rider"), str):
        return False
    known = [values.get(name) for name in RIDE_UNITS]
    return all(is_number(value) for value in known if value is not None) and None not in known[:2]


def _elapsed(one: LogMoment, other: LogMoment) -> float:
    return float(other.estimate["time"] - one.estimate["time"])


def _date(moments: Sequence[LogMoment]) -> int:
    """When the time of the estimates began [ns since the epoch], by the last date that the log's clock had.

    The clock of a board may be set while it rides, from 1970 or another zone of time: it is right afterwards.
    """
    begins = [moment.time_ns - round(moment.estimate["time"] * SECOND_NS) for moment in moments]
    return next((begin for begin in reversed(begins) if begin >= FIRST_DATE_NS), begins[-1] if begins else 0)


def _ride(moments: Sequence[LogMoment], whys: Sequence[Logged], about: About, date: int) -> KeptRide:
    """The ride of these moments."""
    last = moments[-1].ride
    first = moments[0].ride
    if first["time"] < _FIRST:  # of the sums' beginning, before the first estimate
        first = dict.fromkeys(first, 0.0)
    drawn, recovered = (_difference(first, last, key, 1 / WH) for key in ("energy", "energy_recovered"))
    told = [why for why in whys if first["time"] <= why["time"] <= last["time"] + _LONGEST_STEP]
    ambient, rider = (_known(moment.ride.get(key) for moment in moments) for key in ("ambient_temperature", "rider"))
    length = round((last["distance"] - first["distance"]) * 1e-3, 5)
    metered = length  # an older log does not say it
    if last.get("energy_distance") is not None:
        metered = (last["energy_distance"] - (first.get("energy_distance") or 0.0)) * 1e-3
    return KeptRide(
        vehicle=about.vehicle,
        start_ns=date + round(first["time"] * SECOND_NS),
        duration_s=round(last["time"] - first["time"], 3),
        distance_km=length,
        energy_wh=drawn,
        energy_recovered_wh=None if drawn is None else recovered,
        consumption_wh_km=round(drawn / metered, 3) if drawn is not None and metered >= LEAST_DISTANCE / 1000 else None,
        **_charge_and_range(moments),
        rated_range_km=round(told[-1]["reference"] * 1e-3, 3) if told else None,
        ambient_C=_mean(ambient) if ambient else about.facts.get("ambient_C"),
        cells_C=_mean(_known(moment.estimate.get("cell_temperature") for moment in moments)),
        **_on_route(moments, about.route),
        rider=str(rider[-1]) if rider else about.facts.get("rider"),
        payload_kg=about.facts.get("rider_mass_kg") if about.payload is None else about.payload,
        degraded_s=_seconds_in(moments, State.DEGRADED),
        invalid_s=_seconds_in(moments, State.INVALID),
        reasons=_words(moments, "reasons"),
        distrusted=_words(moments, "distrusted"),
        dropped=_dropped(moments[-1].status) - (_dropped(moments[0].status) if first["time"] else 0),
        lost=_lost(moments[-1].status) - (_lost(moments[0].status) if first["time"] else 0),
        **_learned(moments[-1].status),
        log=about.log.name,
        vehicle_key=about.vehicle_key,
        version=about.version,
    )


def _charge_and_range(moments: Sequence[LogMoment]) -> dict[str, Any]:
    rows = [moment.estimate for moment in moments]
    charged = [row for row in rows if row.get("soc") is not None]
    ranged = [row for row in rows if row.get("range") is not None and row["state"] in _RANGED]
    found: dict[str, Any] = {}
    for end, i in (("start", 0), ("end", -1)):
        found |= {f"{x}_{end}{sd}": charged[i][x + sd] if charged else None for x in ("soc",) for sd in ("", "_sd")}
        for part in ("", "_p10", "_p90"):
            found[f"range_{end}{part}_km"] = times(ranged[i][f"range{part}"], 1e-3) if ranged else None
    return found


def _on_route(moments: Sequence[LogMoment], name: str | None) -> dict[str, Any]:
    """The route that was given, and what was ridden on it."""
    states = [moment.estimate.get("route_state", RouteState.NONE.name) for moment in moments]
    if not any(state in (RouteState.ON.name, RouteState.OFF.name) for state in states):
        return {"route": None, "route_km": None}
    ridden = 0.0
    for i in range(1, len(moments)):
        if states[i] == RouteState.ON.name:
            ridden += moments[i].estimate["distance"] - moments[i - 1].estimate["distance"]
    return {"route": name or "given", "route_km": ridden * 1e-3}


def _learned(status: Logged) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in ("capacity", "resistance"):
        learned = status.get("learned")
        of = learned.get(name) if isinstance(learned, dict) else None
        numbers = of if isinstance(of, dict) and all(is_number(of.get(key)) for key in _LEARNED.values()) else {}
        found |= {f"{name}{part}": numbers.get(key) for part, key in _LEARNED.items()}
    return found


def _difference(first: Logged, last: Logged, key: str, factor: float) -> float | None:
    return None if last.get(key) is None else round((last[key] - (first.get(key) or 0.0)) * factor, 3)


def _known(values: Iterable[Any]) -> list[Any]:
    return [value for value in values if value is not None and value != ""]


def _mean(values: Sequence[float]) -> float | None:
    return round(sum(values) / len(values), 2) if values else None


def _seconds_in(moments: Sequence[LogMoment], state: State) -> float:
    """Each estimate stands for the time until the next, but for no more than the longest step."""
    total = 0.0
    for i in range(len(moments) - 1):
        if moments[i].estimate["state"] == state.name:
            total += min(_elapsed(moments[i], moments[i + 1]), _LONGEST_STEP)
    return round(total, 1)


def _words(moments: Sequence[LogMoment], key: str) -> str:
    """The names in a text of the estimates, each once."""
    texts = [text for moment in moments if isinstance(text := moment.estimate[key], str)]
    return " ".join(dict.fromkeys(word for text in texts for word in text.split()))


def _dropped(status: Logged) -> int:
    return int(sum(sum(places.values()) for places in status.get("faults", {}).values()))


def _lost(status: Logged) -> int:
    counts = [*status.get("lost", {}).values(), *(status.get(name, 0) for name in ("kernel_lost", "overrun"))]
    return int(sum(count for count in counts if is_number(count)))
