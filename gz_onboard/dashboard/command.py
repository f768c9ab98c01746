"""``gz-onboard dashboard``: the range in a terminal or in a browser, from the frames on the bus.

In the terminal from nothing but the range frames; other ways also show a little of the vehicle's own.
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
from gz_onboard.errors import InputError, not_an_input
from gz_onboard.options import add_shared, number
from gz_onboard.vehicle import read_vehicle

DURATIONS = 1e-3, 1e9  # s
LISTEN = "127.0.0.1:8000"
REFERENCE = "reference"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard dashboard``."""
    add = parser.add_argument
    add_source(parser)
    add_vehicle(parser)
    add("--once", action="store_true", help="print one picture as soon as every message has come, and end")
    add("--web", action="store_true", help="serve a page for a browser instead of writing to the terminal")
    add("--listen", metavar="ADDRESS:PORT", help=f"where --web serves it (default: {LISTEN}; port 0: any free one)")
    day = "where --web keeps how far the odometer was when the day began (default: nowhere; it begins with the start)"
    add("--day", type=Path, metavar="FILE", help=day)


def add_source(parser: argparse.ArgumentParser) -> None:
    """The options of every command that shows range frames: where they come from, and for how long."""
    add_shared(parser, "--interface", "--channel")
    dbc = "DBC file of the range frames (default: the vehicle's, range.dbc for the reference scooter)"
    parser.add_argument("--dbc", metavar="FILE", help=dbc)
    duration = number("--duration", *DURATIONS, "s")
    parser.add_argument("--duration", type=duration, metavar="S", help="end after this long")


def add_vehicle(parser: argparse.ArgumentParser) -> None:
    """Whose frames are shown."""
    vehicle = "the vehicle, as for run (default: reference; with --dbc alone only the range frames are read)"
    add_shared(parser, "--vehicle", default=None, help=vehicle)


def view_of(arguments: argparse.Namespace, day: Path | None = None) -> View:
    """What is shown of the range frames, and of the vehicle's own. day: where its begin is kept."""
    from gz_onboard.dashboard.vehicle_frames import VehicleFrames  # not for the terminal

    if arguments.dbc and not arguments.vehicle:
        if day:
            raise InputError(f"--day {day}: with --dbc alone no odometer is read; give --vehicle, too")
        return range_view(arguments)
    vehicle = read_vehicle(arguments.vehicle or REFERENCE)
    if day:
        not_an_input([day], [vehicle.file])
        if day.exists() and not day.is_file():
            raise InputError(f"--day {day}: is not a file")
    own = VehicleFrames(vehicle, day) if vehicle.mapping.reads_frames else None
    return View(find_dbc(arguments.dbc, Path.cwd()) if arguments.dbc else vehicle.publisher(), own)


def range_view(arguments: argparse.Namespace) -> View:
    """What is shown of the range frames alone."""
    if arguments.vehicle and not arguments.dbc:
        return View(read_vehicle(arguments.vehicle).publisher())
    return View(find_dbc(arguments.dbc or RANGE_DBC, Path.cwd()))


@contextmanager
def channel_of(arguments: argparse.Namespace, view: View, others: Sequence[int] | None = ()) -> Iterator[CanChannel]:
    """The open channel of the frames of `view` and of those with the identifiers `others`; None: of all frames."""
    own = view.identifiers
    identifiers = None if others is None or own is None else [*own, *others]
    channel = CanChannel(arguments.interface, arguments.channel, identifiers=identifiers)
    channel.open()
    try:
        yield channel
    finally:
        channel.close()


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard dashboard``: 0, also when ended by Ctrl-C; 1 if --once found no range frames."""
    if arguments.once and arguments.web:
        raise InputError("--once and --web: use one of them; http://ADDRESS:PORT/api/latest is one picture as JSON")
    for option in "listen", "day":
        if (value := getattr(arguments, option)) and not arguments.web:
            raise InputError(f"--{option} {value}: only with --web")
    view = view_of(arguments, arguments.day) if arguments.web else range_view(arguments)
    with channel_of(arguments, view) as channel:
        if arguments.web:
            from gz_onboard.dashboard import web  # not for the terminal: a server is 2 MB

            return web.serve(view, channel, arguments.listen or LISTEN, arguments.duration)
        return terminal.show(view, channel, arguments.once, arguments.duration)
