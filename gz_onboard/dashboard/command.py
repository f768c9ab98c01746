"""``gz-onboard dashboard``: the range in a terminal or in a browser, from the frames on the bus.

In the terminal from nothing but the range frames; the page also shows a little of the vehicle's own.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from gz_onboard.bus.channel import CanChannel
from gz_onboard.bus.dbc import find_dbc
from gz_onboard.bus.publisher import RANGE_DBC
from gz_onboard.dashboard import terminal
from gz_onboard.dashboard.view import View
from gz_onboard.errors import InputError
from gz_onboard.options import add_shared, number
from gz_onboard.vehicle import read_vehicle

DURATIONS = 1e-3, 1e9  # s
LISTEN = "127.0.0.1:8000"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard dashboard``."""
    add = parser.add_argument
    add_source(parser)
    add("--once", action="store_true", help="print one picture as soon as every message has come, and end")
    add("--web", action="store_true", help="serve a page for a browser instead of writing to the terminal")
    add("--listen", metavar="ADDRESS:PORT", help=f"where --web serves it (default: {LISTEN}; port 0: any free one)")
    vehicle = "whose own frames --web shows, too: the same as for run (default: reference; with --dbc alone: of none)"
    add_shared(parser, "--vehicle", default=None, help=vehicle)
    day = "where --web keeps how far the odometer was when the day began (default: nowhere; it begins with the start)"
    add("--day", type=Path, metavar="FILE", help=day)


def add_source(parser: argparse.ArgumentParser) -> None:
    """The options of every command that shows range frames: where they come from, and for how long."""
    add_shared(parser, "--interface", "--channel")
    dbc = f"DBC file of the range frames, the vehicle's range_dbc (default: {RANGE_DBC})"
    parser.add_argument("--dbc", metavar="FILE", help=dbc)
    duration = number("--duration", *DURATIONS, "s")
    parser.add_argument("--duration", type=duration, metavar="S", help="end after this long")


@contextmanager
def source_of(
    arguments: argparse.Namespace, others: Sequence[int] | None = (), view: View | None = None
) -> Iterator[tuple[View, CanChannel]]:
    """The view, and the open channel of its frames and of those with the identifiers `others`; None: of all frames.

    view: in place of that of the range frames alone.
    """
    view = view or View(find_dbc(arguments.dbc or RANGE_DBC, Path.cwd()))
    own = view.identifiers
    identifiers = None if others is None or own is None else [*own, *others]
    channel = CanChannel(arguments.interface, arguments.channel, identifiers=identifiers)
    channel.open()
    try:
        yield view, channel
    finally:
        channel.close()


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard dashboard``: 0, also when ended by Ctrl-C; 1 if --once found no range frames."""
    if arguments.once and arguments.web:
        raise InputError("--once and --web: use one of them; http://ADDRESS:PORT/api/latest is one picture as JSON")
    if arguments.listen and not arguments.web:
        raise InputError(f"--listen {arguments.listen}: only with --web")
    if (arguments.vehicle or arguments.day) and not arguments.web:
        raise InputError(f"{'--vehicle' if arguments.vehicle else '--day'}: only with --web")
    with source_of(arguments, view=_of_vehicle(arguments) if arguments.web else None) as (view, channel):
        if arguments.web:
            from gz_onboard.dashboard import web  # not for the terminal: a server is 2 MB

            return web.serve(view, channel, arguments.listen or LISTEN, arguments.duration)
        return terminal.show(view, channel, arguments.once, arguments.duration)


def _of_vehicle(arguments: argparse.Namespace) -> View | None:
    """The view of a vehicle's range frames and of its own; None if only a DBC file of range frames is given."""
    if arguments.dbc and not arguments.vehicle:
        return None
    from gz_onboard.dashboard.vehicle_frames import VehicleFrames  # not for the terminal

    vehicle = read_vehicle(arguments.vehicle or "reference")
    if vehicle.range_identifier is not None and not arguments.dbc:
        raise vehicle.error("has a range_identifier: give --dbc FILE, which `run --write-dbc FILE` writes")
    dbc = find_dbc(arguments.dbc, Path.cwd()) if arguments.dbc else vehicle.range_dbc
    return View(dbc, VehicleFrames(vehicle, arguments.day) if vehicle.mapping.reads_frames else None)
