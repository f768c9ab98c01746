"""``gz-onboard foxglove``: range frames and positions, live in Foxglove, with the topics and schemas of the log."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from gz_onboard import notify
from gz_onboard.bridges.live_positions import LivePositions
from gz_onboard.constants import WH
from gz_onboard.dashboard.command import add_source, channel_of, view_of
from gz_onboard.dashboard.picture import Picture
from gz_onboard.dashboard.pictures import pictures, until_signalled
from gz_onboard.dashboard.server import host_and_port
from gz_onboard.errors import OK, InputError, writing
from gz_onboard.events import Frame, RouteState
from gz_onboard.imports import require
from gz_onboard.location_rows import LOCATION_SCHEMA, LOCATION_TOPIC
from gz_onboard.log_rows import ESTIMATE_TOPIC, ESTIMATE_UNITS, estimate_schema
from gz_onboard.vehicle import read_vehicle

LISTEN = "127.0.0.1:8765"
LAYOUT = Path(__file__).with_name("foxglove_layout.json")
UNKNOWN = "UNKNOWN"  # state or activity that no range frame says


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard foxglove``."""
    add_source(parser)
    listen = "address for Foxglove to connect to (default: %(default)s; port 0: any free one)"
    parser.add_argument("--listen", metavar="ADDRESS:PORT", default=LISTEN, help=listen)
    layout = "write a layout for logs and live topics, for Foxglove to import, and end"
    parser.add_argument("--write-layout", type=Path, metavar="FILE", help=layout)


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard foxglove``: 0 when it is ended. InputError for bad options."""
    if arguments.write_layout:
        with writing(arguments.write_layout):
            arguments.write_layout.write_bytes(LAYOUT.read_bytes())
        return OK
    require("foxglove")
    import foxglove

    host, port = host_and_port(arguments.listen)
    view = view_of(arguments)
    context = foxglove.Context()
    estimates = foxglove.Channel(ESTIMATE_TOPIC, schema=estimate_schema(), context=context)
    positions = _positions(arguments.vehicle) if arguments.vehicle else None
    places = foxglove.Channel(LOCATION_TOPIC, schema=LOCATION_SCHEMA, context=context) if positions else None

    def show_positions(frames: Sequence[Frame]) -> None:
        if positions and places:
            for row in positions.take(frames):
                places.log(_json(row), log_time=time.time_ns())

    others = positions.identifiers if positions else ()
    with channel_of(arguments, view, others) as channel, until_signalled(arguments.duration) as stopped:
        try:
            server = foxglove.start_server(
                name=f"gz-onboard {channel.name}", host=host, port=port, capabilities=[], context=context
            )
        except RuntimeError as error:  # the address cannot be used
            raise InputError(f"--listen {arguments.listen}: {error}") from error
        try:
            address = f"[{host}]" if ":" in host else host
            _say(f"ws://{address}:{server.port} shows {channel.name} ({channel.interface})")
            for new in pictures(view, channel, stopped, show_positions):
                estimates.log(_json(row_of(new)), log_time=time.time_ns())
        finally:
            notify.stopping()
            server.stop()
    return OK


def _positions(name: str) -> LivePositions | None:
    """The positions of the vehicle `name`, if its file maps them."""
    vehicle = read_vehicle(name)
    if missing := LivePositions.lacking(vehicle):
        _say(f"{vehicle.file}: [roles] has no {' and no '.join(missing)}: no position is shown")
        return None
    return LivePositions(vehicle)


def _say(text: str) -> None:
    if sys.stdout is not None:
        print(f"foxglove: {text}", flush=True)
    notify.ready(text)


def _json(row: Mapping[str, object]) -> bytes:
    return json.dumps(row, separators=(",", ":"), allow_nan=False).encode()


def row_of(picture: Picture) -> dict[str, object]:
    """Convert a picture to an estimate as in logs: SI units, None for numbers that are stale or in no range frame."""
    charge, route, battery = picture.charge, picture.route, picture.battery
    numbers = {
        "soc": (battery.soc_percent, 0.01),
        "soc_sd": (battery.soc_sigma_percent, 0.01),
        "range": (picture.range.km, 1e3),
        "range_p10": (picture.range.p10_km, 1e3),
        "range_p90": (picture.range.p90_km, 1e3),
        "energy_left": (battery.energy_left_wh, WH),
        "consumption_recent": (picture.consumption.recent_wh_per_km, WH / 1e3),
        "consumption_expected": (picture.consumption.expected_wh_per_km, WH / 1e3),
        "charge_power": (charge.power_w if charge else None, 1.0),
        "time_to_full": (charge.time_to_full_min if charge else None, 60.0),
        "range_full": (charge.range_full_km if charge else None, 1e3),
        "route_left": (route.left_km if route else None, 1e3),
        "arrival_soc": (route.arrival_soc_percent if route else None, 0.01),
        "arrival_soc_p10": (route.arrival_soc_p10_percent if route else None, 0.01),
        "battery_ends_after": (route.battery_ends_after_km if route else None, 1e3),
    }
    row: dict[str, object] = dict.fromkeys(ESTIMATE_UNITS)
    row |= {name: value if value is None else float(f"{value * unit:.7g}") for name, (value, unit) in numbers.items()}
    on = RouteState.NONE if route is None else RouteState.ON if route.on_route else RouteState.OFF
    return row | {
        "state": (picture.state or UNKNOWN).upper(),
        "reasons": " ".join(picture.reasons).upper(),
        "activity": (picture.activity or UNKNOWN).upper(),
        "route_state": on.name,
        "distrusted": " ".join(picture.distrusted),
    }
