"""Positions in logs and live in Foxglove, by its well-known schema of a satellite fix."""

from __future__ import annotations

from typing import Any

LOCATION_TOPIC, BATTERY_ENDS_TOPIC = "/location", "/battery_ends"
_NS = 1_000_000_000
_UNKNOWN = 0  # position_covariance_type: no receiver on our buses tells how good it is
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


def location_row(time_ns: int, frame: str, latitude: float, longitude: float, altitude: float | None) -> dict[str, Any]:
    """A position [deg, m] of `time_ns` as ``foxglove.LocationFix``; frame: name of the object."""
    row = {
        "timestamp": {"sec": time_ns // _NS, "nsec": time_ns % _NS},
        "frame_id": frame,
        "latitude": round(latitude, 7),
        "longitude": round(longitude, 7),
        "position_covariance": [0.0] * 9,
        "position_covariance_type": _UNKNOWN,
    }
    return row if altitude is None else row | {"altitude": round(altitude, 2)}
