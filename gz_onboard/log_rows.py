"""The contents of our logs: topics, their schemas, and estimates and explanations as rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import TYPE_CHECKING, Any, Protocol

from gz_onboard.can.logfile import object_schema
from gz_onboard.estimator.energy_counter import EnergyCounter
from gz_onboard.estimator.pack_age import LearnedFactor
from gz_onboard.estimator.signals import FIX_2D, FIX_3D, Signals
from gz_onboard.events import Cause, Estimate, Explanation, Frame, Reason

if TYPE_CHECKING:
    from cantools.database.can import Message

ESTIMATE_TOPIC = "/estimate"
STATUS_TOPIC = "/status"
WHY_TOPIC, CHANGE_TOPIC = "/why", "/range_change"
LOCATION_TOPIC, BATTERY_ENDS_TOPIC = "/location", "/battery_ends"
COUNTS = ("received", "error_frames", "kernel_lost", "overrun", "send_failures", "log_lost", "unknown_others")
ESTIMATE_UNITS = {
    "time": "s since the first frame",
    "soc": "1",
    "soc_sd": "1",
    "v1": "V of a cell",
    "innovation": "V of a cell",
    "innovation_rms": "V of a cell",
    "pack_voltage": "V",
    "pack_current": "A, positive discharging",
    "cell_temperature": "degC",
    "speed": "m/s",
    "acceleration": "m/s^2",
    "grade": "sine, positive uphill",
    "lean": "rad, positive right",
    "yaw_rate": "rad/s, positive left",
    "heading": "rad, clockwise from north",
    "distance": "m",
    "range": "m",
    "range_p10": "m",
    "range_p90": "m",
    "energy_left": "J",
    "energy_left_sd": "J",
    "consumption_recent": "J/m",
    "consumption_expected": "J/m",
    "consumption_expected_sd": "J/m",
    "charge_power": "W into the pack, while it is charged",
    "time_to_full": "s, likewise",
    "range_full": "m, likewise: when it is full",
    "consumption_factor": "1, measured over modelled",
    "consumption_factor_sd": "1",
    "route_along": "m",
    "route_left": "m",
    "route_energy": "J",
    "route_energy_sd": "J",
    "arrival_soc": "1",
    "arrival_soc_p10": "1",
    "arrival_soc_p90": "1",
    "battery_ends_after": "m",
    "battery_ends_latitude": "deg",
    "battery_ends_longitude": "deg",
}

RIDE_UNITS = {
    "time": ESTIMATE_UNITS["time"],
    "distance": "m",
    "energy": "J, drawn net",
    "energy_recovered": "J",
    "energy_distance": "m of the distance, which the energy is of",
    "energy_missing": "s without voltage or current, not in the energy",
    "ambient_temperature": "degC",
}
"""Of the numbers of `ride_row`."""
_NUMBER: dict[str, Any] = {"type": "number"}
LOCATION_SCHEMA: dict[str, Any] = {
    "title": "foxglove.LocationFix",
    "type": "object",
    "properties": {
        "timestamp": {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
        "frame_id": {"type": "string"},
        "latitude": _NUMBER | {"description": "deg"},
        "longitude": _NUMBER | {"description": "deg"},
        "altitude": _NUMBER | {"description": "m, not there if it is not known"},
        "position_covariance": {"type": "array", "items": _NUMBER, "minItems": 9, "maxItems": 9},
        "position_covariance_type": {"type": "integer", "description": "0: not known"},
    },
    "required": ["timestamp", "frame_id", "latitude", "longitude", "position_covariance", "position_covariance_type"],
}
"""Foxglove's well-known schema of a satellite fix."""
TEXTS = ("state", "reasons", "activity", "route_state", "distrusted")


class Log(Protocol):
    """A log that the pipeline writes to; implemented by `gz_onboard.can.logfile` and `recorder`."""

    def channel(self, topic: str, json_schema: Mapping[str, Any]) -> None:
        """Declare a topic of JSON objects."""

    def frames(self, batch: Sequence[Frame]) -> None:
        """Log raw frames."""

    def sample(self, topic: str, time_ns: int, values: Mapping[str, object], seen_ns: int | None = None) -> None:
        """Log one JSON object; seen_ns: when it was so, if not at `time_ns`."""


def reason_names(found: Reason) -> list[str]:
    """The names of the reasons in a set."""
    return [str(reason.name) for reason in Reason if reason & found]


def estimate_row(estimate: Estimate) -> dict[str, object]:
    """Return an estimate as a row: SI units, state and reasons by name, None for unknown numbers."""
    numbers = {name: getattr(estimate, name) for name in ESTIMATE_UNITS}
    # Seven digits are more than any sensor gives, and compress to half the size of seventeen.
    row: dict[str, object] = {
        name: float(f"{value:.7g}") if value is not None and isfinite(value) else None
        for name, value in numbers.items()
    }
    return row | {
        "time": round(estimate.time, 3),  # of a clock that begins in 1970, after it was set, seven digits are minutes
        "state": estimate.state.name,
        "reasons": " ".join(reason_names(estimate.reasons)),
        "activity": estimate.activity.name,
        "route_state": estimate.route_state.name,
        "distrusted": " ".join(estimate.distrusted),
    }


def explanation_row(why: Explanation) -> dict[str, object]:
    """Return an explanation as a row: causes by name."""
    causes = {cause.name.lower(): size for cause, size in why.causes.items()}
    numbers = {"time": why.time, "reference": why.reference, "range": why.range} | causes
    row: dict[str, object] = {name: round(value, 2) for name, value in numbers.items()}
    return row | ({"forgotten": " ".join(why.forgotten)} if why.forgotten else {})


def ride_row(last: Estimate, energy: EnergyCounter, ambient: float | None, rider: str) -> dict[str, object]:
    """Return distance and energy up to the `last` estimate as a row; ambient: [degC]."""
    return {
        "time": round(last.time, 3),
        "distance": round(last.distance, 2),
        "energy": None if energy.net is None else round(energy.net, 1),
        "energy_recovered": round(energy.recovered, 1),
        "energy_distance": round(energy.distance, 2),
        "energy_missing": round(energy.missing, 1),
        "ambient_temperature": None if ambient is None else round(ambient, 2),
        "rider": rider,
    }


def learned_row(learned: Mapping[str, LearnedFactor]) -> dict[str, dict[str, float]]:
    """Return the learned battery as a row."""
    return {
        name: {"factor": round(x.value, 4), "sd": round(x.sd, 4), "share": round(x.share, 3)}
        for name, x in learned.items()
    }


def location_row(time_ns: int, frame: str, latitude: float, longitude: float, altitude: float | None) -> dict[str, Any]:
    """Return a position [deg, m] of `time_ns` as ``foxglove.LocationFix``; frame: name of the object."""
    row = {
        "timestamp": {"sec": time_ns // 10**9, "nsec": time_ns % 10**9},
        "frame_id": frame,
        "latitude": round(latitude, 7),
        "longitude": round(longitude, 7),
        "position_covariance": [0.0] * 9,
        "position_covariance_type": 0,  # not known: no receiver on our buses says how good its position is
    }
    return row if altitude is None else row | {"altitude": round(altitude, 2)}


def position_row(signals: Signals, now: float, time_ns: int) -> tuple[int, dict[str, Any]] | None:
    """When the vehicle's position was seen [ns], and its row; None if it is not known, or there is no fix.

    now: [s, on the timeline of the signals], the same time as `time_ns` [ns since 1970].
    """
    latitude, longitude = signals.latitude.get(now), signals.longitude.get(now)
    if latitude is None or longitude is None or signals.fix_below(now, FIX_2D):
        return None
    altitude = None if signals.fix_below(now, FIX_3D) else signals.gps_altitude.get(now)
    seen_ns = time_ns - round((now - signals.longitude.time) * 1e9)
    return seen_ns, location_row(seen_ns, "gps", latitude, longitude, altitude)


def estimate_schema() -> dict[str, Any]:
    """The JSON schema of `estimate_row`."""
    schema = object_schema("gz_onboard.Estimate", ESTIMATE_UNITS)
    schema["properties"] |= {name: {"type": "string"} for name in TEXTS}
    return schema


def declare(log: Log, messages: Sequence[Message]) -> None:
    """Declare the topics of a log; messages: those whose decoded signals are logged, too."""
    log.channel(ESTIMATE_TOPIC, estimate_schema())
    causes = [cause.name.lower() for cause in Cause if cause]
    units = {"time": ESTIMATE_UNITS["time"], **dict.fromkeys(("reference", "range", *causes), "m")}
    log.channel(WHY_TOPIC, object_schema("gz_onboard.Why", units))
    change = object_schema("gz_onboard.RangeChange", units)
    change["properties"] |= {"forgotten": {"type": "string"}}
    log.channel(CHANGE_TOPIC, change)
    properties = {
        **{name: {"type": "integer"} for name in COUNTS},
        **{name: {"type": "object"} for name in ("foreign", "faults", "lost", "unknown", "learned")},
        "reasons": {"type": "array", "items": {"type": "string"}},
        "ride": object_schema("gz_onboard.Ride", RIDE_UNITS),
    }
    log.channel(STATUS_TOPIC, {"title": "gz_onboard.Status", "type": "object", "properties": properties})
    log.channel(BATTERY_ENDS_TOPIC, LOCATION_SCHEMA)
    if messages:
        log.channel(LOCATION_TOPIC, LOCATION_SCHEMA)
    for message in messages:
        log.channel(
            f"/can/{message.name}", object_schema(message.name, {s.name: s.unit or "" for s in message.signals})
        )
