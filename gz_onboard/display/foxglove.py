"""``gz-onboard foxglove``: range frames and positions, live in Foxglove, with the topics and schemas of the log."""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path

from gz_onboard.constants import WH
from gz_onboard.display.command import add_source, live, report, view_of
from gz_onboard.display.view import Picture, encoded, value_at
from gz_onboard.errors import OK, InputError, writing
from gz_onboard.events import RouteState
from gz_onboard.imports import require
from gz_onboard.log_rows import (
    ESTIMATE_TOPIC,
    ESTIMATE_UNITS,
    LOCATION_SCHEMA,
    LOCATION_TOPIC,
    estimate_schema,
    location_row,
)
from gz_onboard.options import host_and_port

LISTEN = "127.0.0.1:8765"
LAYOUT = Path(__file__).with_name("foxglove_layout.json")
ESTIMATE = {
    "soc": ("battery.soc_percent", 0.01),
    "soc_sd": ("battery.soc_sigma_percent", 0.01),
    "range": ("range.km", 1e3),
    "range_p10": ("range.p10_km", 1e3),
    "range_p90": ("range.p90_km", 1e3),
    "energy_left": ("battery.energy_left_wh", WH),
    "consumption_recent": ("consumption.recent_wh_per_km", WH / 1e3),
    "consumption_expected": ("consumption.expected_wh_per_km", WH / 1e3),
    "charge_power": ("charge.power_w", 1.0),
    "time_to_full": ("charge.time_to_full_min", 60.0),
    "range_full": ("charge.range_full_km", 1e3),
    "route_left": ("route.left_km", 1e3),
    "arrival_soc": ("route.arrival_soc_percent", 0.01),
    "arrival_soc_p10": ("route.arrival_soc_p10_percent", 0.01),
    "battery_ends_after": ("route.battery_ends_after_km", 1e3),
}
"""Numbers of an estimate in a log: the place in a picture, and how many SI units its unit has."""


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

    say, context = partial(report, "foxglove"), foxglove.Context()
    host, port = host_and_port(arguments.listen)
    estimates = foxglove.Channel(ESTIMATE_TOPIC, schema=estimate_schema(), context=context)
    view = view_of(arguments, positions=bool(arguments.vehicle))
    if view.has_positions:
        places = foxglove.Channel(LOCATION_TOPIC, schema=LOCATION_SCHEMA, context=context)
    elif arguments.vehicle:
        say(f"{arguments.vehicle}: [roles] must have latitude and longitude: no position is shown")
    with live(view, arguments) as pictures:
        source = f"{arguments.channel} ({arguments.interface})"
        try:
            server = foxglove.start_server(
                name=f"gz-onboard {arguments.channel}", host=host, port=port, capabilities=[], context=context
            )
        except RuntimeError as error:  # the address cannot be used
            raise InputError(f"--listen {arguments.listen}: {error}") from error
        say(f"ws://{f'[{host}]' if ':' in host else host}:{server.port} shows {source}")
        shown_ns = 0
        for picture in pictures:
            estimates.log(encoded(estimate_of(picture)), log_time=time.time_ns())
            if view.has_positions and (here := picture["position"]) and here["time_ns"] != shown_ns:
                shown_ns = here["time_ns"]
                places.log(encoded(location_row(frame="gps", **here)), log_time=time.time_ns())
        server.stop()
    return OK


def estimate_of(picture: Picture) -> dict[str, object]:
    """Convert a picture to an estimate as in logs: SI units, None for numbers that are stale or in no range frame."""
    row: dict[str, object] = dict.fromkeys(ESTIMATE_UNITS)
    for name, (path, unit) in ESTIMATE.items():
        value = value_at(picture, path)
        row[name] = None if value is None else float(f"{value * unit:.7g}")
    on_route = value_at(picture, "route.on_route")
    return row | {
        "state": (picture["state"] or "unknown").upper(),
        "reasons": " ".join(picture["reasons"]).upper(),
        "activity": (picture["activity"] or "unknown").upper(),
        "route_state": (RouteState.NONE if on_route is None else RouteState.ON if on_route else RouteState.OFF).name,
        "distrusted": " ".join(picture["distrusted"]),
    }
