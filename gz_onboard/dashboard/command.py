"""``gz-onboard dashboard``: the range in a terminal or in a browser, from the range frames on the bus."""

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

DURATION_S = 1e-3, 1e9
LISTEN = "127.0.0.1:8000"
REFERENCE = "reference"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard dashboard``."""
    add = parser.add_argument
    add_source(parser)
    add("--once", action="store_true", help="print one picture as soon as every message has come, and end")
    add("--web", action="store_true", help="serve a page for a browser instead of writing to the terminal")
    add("--listen", metavar="ADDRESS:PORT", help=f"address for --web (default: {LISTEN}; port 0: any free one)")
    day = "file in which --web keeps the odometer at the start of the day (default: count from the start of the server)"
    add("--day", type=Path, metavar="FILE", help=day)


def add_source(parser: argparse.ArgumentParser) -> None:
    """The options of every command that shows range frames: where they come from, whose they are, for how long."""
    add_shared(parser, "--interface", "--channel")
    dbc = "DBC file of the range frames (default: the vehicle's, range.dbc for the reference scooter)"
    parser.add_argument("--dbc", metavar="FILE", help=dbc)
    vehicle = "the vehicle, as for run (default: reference; with --dbc alone only the range frames are read)"
    add_shared(parser, "--vehicle", default=None, help=vehicle)
    duration = number("--duration", *DURATION_S, "s")
    parser.add_argument("--duration", type=duration, metavar="S", help="end after this time")


def view_of(arguments: argparse.Namespace, *, own_frames: bool = False, day: Path | None = None) -> View:
    """Return the view of the range frames. own_frames: also of the vehicle's; day: file that keeps the day's start."""
    if not arguments.vehicle and (arguments.dbc or not own_frames):
        if day:
            raise InputError(f"--day {day}: with --dbc alone no odometer is read; give --vehicle, too")
        return View(find_dbc(arguments.dbc or RANGE_DBC, Path.cwd()))
    vehicle = read_vehicle(arguments.vehicle or REFERENCE)
    own = None
    if own_frames and vehicle.mapping.reads_frames:
        from gz_onboard.dashboard.vehicle_frames import VehicleFrames  # not for the terminal

        not_an_input([day], [vehicle.file])
        own = VehicleFrames(vehicle, day)
    return View(find_dbc(arguments.dbc, Path.cwd()) if arguments.dbc else vehicle.publisher(), own)


@contextmanager
def channel_of(arguments: argparse.Namespace, view: View, others: Sequence[int] | None = ()) -> Iterator[CanChannel]:
    """Open the channel for the frames of `view` and those with the identifiers `others`; None: for all frames."""
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
    view = view_of(arguments, own_frames=arguments.web, day=arguments.day)
    with channel_of(arguments, view) as channel:
        if arguments.web:
            from gz_onboard.dashboard import server  # not for the terminal: 2 MB

            return server.serve(view, channel, arguments.listen or LISTEN, arguments.duration)
        return terminal.show(view, channel, arguments.once, arguments.duration)
