"""Messages for a broker: the values by name, and the discovery message of Home Assistant.

One topic has everything: ``gz-onboard/NAME/state``, a JSON object. It is also the last will, without values, so that
the broker keeps no number of a vehicle that is gone.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

from gz_onboard import __version__
from gz_onboard.dashboard.picture import ALERTS, Picture
from gz_onboard.events import Activity, State

ONLINE, OFFLINE = "online", "offline"
NONE = "none"  # alert and reasons when all is well
LONGEST = 255  # characters that Home Assistant takes as a state
EXPIRES_S = 30  # after which the broker drops a state, and Home Assistant shows none
PREFIX = "homeassistant"  # where it looks, unless it is configured otherwise


@dataclass(frozen=True)
class SensorEntity:
    """One value. kind: Home Assistant's device class; options: the possible texts."""

    name: str
    kind: str | None = None
    unit: str | None = None
    options: tuple[str, ...] = ()
    digits: int | None = None  # shown after the point
    diagnostic: bool = False
    total: bool = False  # only grows, so that Home Assistant can sum days and months


def _km(name: str) -> SensorEntity:
    return SensorEntity(name, "distance", "km", digits=1)


def _degrees(name: str) -> SensorEntity:
    return SensorEntity(name, "temperature", "°C", digits=0)


def _names(members: type[State] | type[Activity]) -> tuple[str, ...]:
    return tuple(member.name.lower() for member in members)


SENSORS = {
    "range": _km("Range"),
    "range_p10": _km("Range, surely (P10)"),
    "range_p90": _km("Range, at best (P90)"),
    "state_of_charge": SensorEntity("State of charge", "battery", "%", digits=0),
    "state_of_charge_sigma": SensorEntity("State of charge, sigma", None, "%", digits=1, diagnostic=True),
    "energy_left": SensorEntity("Energy left", "energy_storage", "Wh", digits=0),
    "consumption_recent": SensorEntity("Consumption of the last kilometre", "energy_distance", "Wh/km", digits=1),
    "consumption_expected": SensorEntity("Consumption expected", "energy_distance", "Wh/km", digits=1),
    "charge_power": SensorEntity("Charging power", "power", "W", digits=0),
    "time_to_full": SensorEntity("Time until full", "duration", "min", digits=0),
    "range_full": _km("Range when full"),
    "route_left": _km("Distance to the destination"),
    "arrival_state_of_charge": SensorEntity("State of charge on arrival", "battery", "%", digits=0),
    "rated_range": _km("Rated range"),
    "odometer": SensorEntity("Odometer", "distance", "km", digits=0, total=True),
    "cell_temperature_coldest": _degrees("Coldest cell"),
    "cell_temperature_hottest": _degrees("Hottest cell"),
    "activity": SensorEntity("Activity", "enum", options=_names(Activity)),
    "state": SensorEntity("State of the estimate", "enum", options=_names(State)),
    "alert": SensorEntity("Alert", "enum", options=(NONE, *ALERTS)),
    "reasons": SensorEntity("Reasons", diagnostic=True),
}
"""By their names in the state."""


def topic_of(name: str) -> str:
    """Topic of the state of the vehicle `name`."""
    return f"gz-onboard/{name}/state"


def discovery_topic(name: str) -> str:
    """Topic of its discovery message."""
    return f"{PREFIX}/device/gz-onboard-{name}/config"


def state_of(picture: Picture, status: str) -> dict[str, object]:
    """Return the values of a picture by name; None if stale, not available or never received."""
    charge, route, cells = picture.charge, picture.route, picture.cells
    return {
        "status": status,
        "range": picture.range.km,
        "range_p10": picture.range.p10_km,
        "range_p90": picture.range.p90_km,
        "state_of_charge": picture.battery.soc_percent,
        "state_of_charge_sigma": picture.battery.soc_sigma_percent,
        "energy_left": picture.battery.energy_left_wh,
        "consumption_recent": picture.consumption.recent_wh_per_km,
        "consumption_expected": picture.consumption.expected_wh_per_km,
        "charge_power": charge.power_w if charge else None,
        "time_to_full": charge.time_to_full_min if charge else None,
        "range_full": charge.range_full_km if charge else None,
        "route_left": route.left_km if route else None,
        "arrival_state_of_charge": route.arrival_soc_percent if route else None,
        "rated_range": picture.rated_km,
        "odometer": picture.odometer_km,
        "cell_temperature_coldest": cells.coldest_degc if cells else None,
        "cell_temperature_hottest": cells.hottest_degc if cells else None,
        "activity": picture.activity,
        "state": picture.state,
        "alert": next(iter(picture.alerts), NONE) if status == ONLINE else None,
        "reasons": _joined(picture.reasons) if picture.state else None,
    }


def _joined(reasons: Sequence[str]) -> str:
    """Join as many as fit into a state."""
    while len(text := ", ".join(reasons)) > LONGEST:
        reasons = reasons[:-1]
    return text or NONE


def encoded(values: dict[str, object]) -> bytes:
    """Encode as one line of JSON."""
    return json.dumps(values, separators=(",", ":"), allow_nan=False).encode()


def discovery(name: str) -> dict[str, object]:
    """Return the discovery message for the vehicle `name`: one device with its sensors."""
    return {
        "device": {"identifiers": [f"gz-onboard-{name}"], "name": name, "manufacturer": "gz_onboard"},
        "origin": {"name": "gz-onboard", "sw_version": __version__},
        "state_topic": topic_of(name),
        "components": {key: _component(name, key, sensor) for key, sensor in SENSORS.items()},
    }


def _component(name: str, key: str, sensor: SensorEntity) -> dict[str, object]:
    """Describe a sensor, which is available only while the bridge is online and the value is known."""
    there = f"value_json.status == '{ONLINE}' and value_json.{key} is not none"
    about: dict[str, object] = {
        "platform": "sensor",
        "unique_id": f"gz-onboard-{name}-{key}",
        "name": sensor.name,
        "value_template": f"{{{{ value_json.{key} }}}}",
        "availability": [
            {
                "topic": topic_of(name),
                "value_template": f"{{{{ '{ONLINE}' if {there} else '{OFFLINE}' }}}}",
                "payload_available": ONLINE,
                "payload_not_available": OFFLINE,
            }
        ],
        "expire_after": EXPIRES_S,
    }
    if sensor.kind:
        about["device_class"] = sensor.kind
    if sensor.unit:
        about |= {
            "unit_of_measurement": sensor.unit,
            "state_class": "total_increasing" if sensor.total else "measurement",
        }
    if sensor.options:
        about["options"] = list(sensor.options)
    if sensor.digits is not None:
        about["suggested_display_precision"] = sensor.digits
    if sensor.diagnostic:
        about["entity_category"] = "diagnostic"
    return about
