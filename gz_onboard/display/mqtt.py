"""``gz-onboard mqtt``: publish the range on an MQTT broker, in a form that Home Assistant discovers.

One topic has everything: ``gz-onboard/NAME/state``, a JSON object. It is also the last will, without values, so that
the broker keeps no number of a vehicle that is gone.
"""

from __future__ import annotations

import argparse
import math
import re
import socket
import time
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

from gz_onboard import __version__
from gz_onboard.display.command import add_source, live, report, view_of
from gz_onboard.display.view import ALERTS, Picture, encoded, value_at
from gz_onboard.errors import OK, InputError
from gz_onboard.events import Activity, State
from gz_onboard.imports import require
from gz_onboard.notify import notify

EVERY_S, AT_LEAST_S = 1.0, 10.0  # between two states at least, and at most where nothing has changed
EXPIRES_S = 30  # after which the broker drops a state, and Home Assistant shows none
LONGEST_STATE = 255  # characters that Home Assistant takes as a state
PREFIX = "homeassistant"  # where it looks for discovery messages, unless it is configured otherwise
NONE = "none"  # alert and reasons when all is well

# Attributes of a sensor, as Home Assistant's MQTT discovery names them.
_NUMBER: dict[str, Any] = {"state_class": "measurement", "suggested_display_precision": 0}
_KM = _NUMBER | {"device_class": "distance", "unit_of_measurement": "km", "suggested_display_precision": 1}
_CELL = _NUMBER | {"device_class": "temperature", "unit_of_measurement": "°C"}
_CHARGE = _NUMBER | {"device_class": "battery", "unit_of_measurement": "%"}
_CONSUMPTION = _NUMBER | {"device_class": "energy_distance", "unit_of_measurement": "Wh/km"}
_SIGMA = _NUMBER | {"unit_of_measurement": "%", "suggested_display_precision": 1, "entity_category": "diagnostic"}

SENSORS: dict[str, tuple[str, dict[str, Any]]] = {
    "range": ("range.km", _KM | {"name": "Range"}),
    "range_p10": ("range.p10_km", _KM | {"name": "Range, surely (P10)"}),
    "range_p90": ("range.p90_km", _KM | {"name": "Range, at best (P90)"}),
    "state_of_charge": ("battery.soc_percent", _CHARGE | {"name": "State of charge"}),
    "state_of_charge_sigma": ("battery.soc_sigma_percent", _SIGMA | {"name": "State of charge, sigma"}),
    "energy_left": (
        "battery.energy_left_wh",
        _NUMBER | {"name": "Energy left", "device_class": "energy_storage", "unit_of_measurement": "Wh"},
    ),
    "consumption_recent": (
        "consumption.recent_wh_per_km",
        _CONSUMPTION | {"name": "Consumption of the last kilometre", "suggested_display_precision": 1},
    ),
    "consumption_expected": (
        "consumption.expected_wh_per_km",
        _CONSUMPTION | {"name": "Consumption expected", "suggested_display_precision": 1},
    ),
    "charge_power": (
        "charge.power_w",
        _NUMBER | {"name": "Charging power", "device_class": "power", "unit_of_measurement": "W"},
    ),
    "time_to_full": (
        "charge.time_to_full_min",
        _NUMBER | {"name": "Time until full", "device_class": "duration", "unit_of_measurement": "min"},
    ),
    "range_full": ("charge.range_full_km", _KM | {"name": "Range when full"}),
    "route_left": ("route.left_km", _KM | {"name": "Distance to the destination"}),
    "arrival_state_of_charge": ("route.arrival_soc_percent", _CHARGE | {"name": "State of charge on arrival"}),
    "rated_range": ("rated_km", _KM | {"name": "Rated range"}),
    "odometer": (  # only grows, so that Home Assistant can sum days and months
        "odometer_km",
        _KM | {"name": "Odometer", "state_class": "total_increasing", "suggested_display_precision": 0},
    ),
    "cell_temperature_coldest": ("cells.coldest_degc", _CELL | {"name": "Coldest cell"}),
    "cell_temperature_hottest": ("cells.hottest_degc", _CELL | {"name": "Hottest cell"}),
    "activity": (
        "activity",
        {"device_class": "enum", "name": "Activity", "options": [a.name.lower() for a in Activity]},
    ),
    "state": (
        "state",
        {"device_class": "enum", "name": "State of the estimate", "options": [s.name.lower() for s in State]},
    ),
    "alert": ("alerts", {"name": "Alert", "device_class": "enum", "options": [NONE, *ALERTS]}),
    "reasons": ("reasons", {"name": "Reasons", "entity_category": "diagnostic"}),
}
"""By their names in the state: the place in a picture, and the attributes."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard mqtt``."""
    add = parser.add_argument
    add("broker", metavar="HOST[:PORT]", help="the broker (port: 1883, with --tls 8883)")
    add_source(parser)
    add("--name", help="name of the vehicle in topics and in Home Assistant (default: this machine's)")
    tls = "encrypt; FILE: the certificates to trust (default: the system's)"
    add("--tls", nargs="?", const="", metavar="FILE", help=tls)
    login = "TOML file with user and password, which only its owner may read (default: none)"
    add("--login", type=Path, metavar="FILE", help=login)


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard mqtt``: 0 when it is ended. InputError for bad options; the broker may be away."""
    require("paho")
    from gz_onboard.display.broker import Broker, read_login

    name = arguments.name or re.sub(r"[^\w-]+", "-", socket.gethostname(), flags=re.ASCII) or "scooter"
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name):
        raise InputError(f"--name {name}: must be of letters, digits, - and _, at most 64")
    topic = f"gz-onboard/{name}/state"
    login = read_login(arguments.login) if arguments.login else (None, None)
    hello = f"{PREFIX}/device/gz-onboard-{name}/config", encoded(discovery(name, topic))
    will = topic, encoded({"status": "offline"} | dict.fromkeys(SENSORS))
    broker = Broker(arguments.broker, name, hello, will, partial(report, "mqtt"), tls=arguments.tls, login=login)
    sent, sent_at = None, -math.inf
    with live(view_of(arguments, own_frames=True), arguments) as pictures, closing(broker):
        broker.start()
        notify(READY=1, STATUS=f"{arguments.channel} ({arguments.interface}) to {broker} as {name}")
        for picture in pictures:
            now, state = time.monotonic(), state_of(picture)
            if not broker.connected:
                sent_at = -math.inf
                continue
            due = now - sent_at >= (AT_LEAST_S if state == sent else EVERY_S)
            if due and broker.publish(topic, encoded(state), EXPIRES_S):
                sent, sent_at = state, now
    return OK


def state_of(picture: Picture) -> dict[str, Any]:
    """Return the values of a picture by name; None if stale, not available or never received."""
    state = {key: value_at(picture, path) for key, (path, _) in SENSORS.items()}
    reasons = picture["reasons"]
    while len(text := ", ".join(reasons)) > LONGEST_STATE:
        reasons = reasons[:-1]
    state |= {"alert": next(iter(picture["alerts"]), NONE), "reasons": (text or NONE) if picture["state"] else None}
    return {"status": "online"} | state


def discovery(name: str, topic: str) -> dict[str, Any]:
    """Return the discovery message for the vehicle `name` with its state at `topic`: one device with its sensors.

    A sensor is available only while the bridge is online and the value is known.
    """
    components = {}
    for key, (_, attributes) in SENSORS.items():
        there = f"value_json.status == 'online' and value_json.{key} is not none"
        components[key] = attributes | {
            "platform": "sensor",
            "unique_id": f"gz-onboard-{name}-{key}",
            "value_template": f"{{{{ value_json.{key} }}}}",
            "availability": [{"topic": topic, "value_template": f"{{{{ 'online' if {there} else 'offline' }}}}"}],
            "expire_after": EXPIRES_S,
        }
    return {
        "device": {"identifiers": [f"gz-onboard-{name}"], "name": name, "manufacturer": "gz_onboard"},
        "origin": {"name": "gz-onboard", "sw_version": __version__},
        "state_topic": topic,
        "components": components,
    }
