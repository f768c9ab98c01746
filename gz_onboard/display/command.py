"""``gz-onboard dashboard``, and the loop from the bus to pictures that it shares with MQTT and Foxglove."""

from __future__ import annotations

import argparse
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from gz_onboard.can.channel import CanChannel
from gz_onboard.can.dbc import find_dbc
from gz_onboard.can.publisher import Publisher
from gz_onboard.display import terminal
from gz_onboard.display.vehicle_frames import VehicleFrames
from gz_onboard.display.view import NO_NEWS, Picture, View, encoded
from gz_onboard.errors import OK, InputError, not_an_input
from gz_onboard.notify import notify, watchdog_interval
from gz_onboard.options import add_shared, number
from gz_onboard.vehicle import read_vehicle

LISTEN = "127.0.0.1:8000"
ONCE_WITHIN_S = 5.0  # that --once waits for every message
POLL_S = 0.05
AGE_S = 0.2  # between two looks for values that have become stale, while no frame comes
AT_LEAST_S = 1.0  # between two pictures though nothing has changed; without one the loop hangs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard dashboard``."""
    add = parser.add_argument
    add_source(parser)
    add("--once", action="store_true", help="print one picture as soon as every message has come, and end")
    add("--web", action="store_true", help="serve a page for a browser instead of writing to the terminal")
    add("--listen", metavar="ADDRESS:PORT", help=f"address for --web (default: {LISTEN}; port 0: any free one)")
    day = "file in which --web keeps the odometer at the start of the day (default: count from the start of the server)"
    add("--day", type=Path, metavar="FILE", help=day)


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard dashboard``: 0, also when ended by Ctrl-C; 1 if --once found no range frames."""
    if arguments.once and arguments.web:
        raise InputError("--once and --web: use one of them; http://ADDRESS:PORT/api/latest is one picture as JSON")
    for option in "listen", "day":
        if (value := getattr(arguments, option)) and not arguments.web:
            raise InputError(f"--{option} {value}: only with --web")
    view = view_of(arguments, own_frames=arguments.web, day=arguments.day)
    if arguments.once:
        arguments.duration = arguments.duration or ONCE_WITHIN_S
    if not arguments.web:
        with live(view, arguments) as pictures:
            return terminal.show(pictures, view.comments, arguments.once)
    from gz_onboard.display.server import Feed, served  # not for the terminal: 2 MB

    feed = Feed()
    with live(view, arguments) as pictures, served(feed, arguments.listen or LISTEN) as address:
        report("dashboard", f"{address} shows {arguments.channel} ({arguments.interface})")
        for picture in pictures:
            feed.publish(encoded(picture))
    return OK


def add_source(parser: argparse.ArgumentParser) -> None:
    """Add the options of every command that shows range frames: which bus, which vehicle, how long."""
    add_shared(parser, "--interface", "--channel")
    dbc = "DBC file of the range frames (default: the vehicle's, range.dbc for the reference scooter)"
    parser.add_argument("--dbc", metavar="FILE", help=dbc)
    vehicle = "the vehicle, as for run (default: reference; with --dbc alone only the range frames are read)"
    add_shared(parser, "--vehicle", default=None, help=vehicle)
    duration = number("--duration", 1e-3, 1e9, "s")
    parser.add_argument("--duration", type=duration, metavar="S", help="end after this time")


def view_of(
    arguments: argparse.Namespace, *, own_frames: bool = False, positions: bool = False, day: Path | None = None
) -> View:
    """Return the view of the range frames that the options ask for.

    own_frames: also of the vehicle's own; positions: also of those that say where it is; day: file that keeps where the
    day began.
    """
    dbc = find_dbc(arguments.dbc, Path.cwd()) if arguments.dbc else None
    if not arguments.vehicle and (dbc or not own_frames):
        if day:
            raise InputError(f"--day {day}: with --dbc alone no odometer is read; give --vehicle, too")
        return View(Publisher(dbc))
    vehicle = read_vehicle(arguments.vehicle or "reference")
    publisher = Publisher(dbc) if dbc else vehicle.publisher()
    if not (own_frames or positions) or not vehicle.mapping.reads_frames:
        return View(publisher)
    not_an_input([day], [vehicle.file])
    return View(publisher, VehicleFrames(vehicle, day, positions=positions))


@contextmanager
def live(view: View, arguments: argparse.Namespace) -> Iterator[Iterator[Picture]]:
    """Open the bus of the options and yield the pictures of `view`, until the duration is over or a signal comes."""
    channel = CanChannel(arguments.interface, arguments.channel, identifiers=view.identifiers)
    channel.open()
    with closing(channel), until_signalled(arguments.duration) as stopped:
        yield pictures(view, channel, stopped)


def pictures(view: View, channel: CanChannel, stopped: Callable[[], bool]) -> Iterator[Picture]:
    """Drain the channel into the view until it is time to stop: a picture when it has changed, and each second."""
    shown: Picture = {}
    looked = given = fed = -math.inf
    interval = watchdog_interval() or math.inf
    while not stopped():
        frames = channel.drain()
        now = time.clock_gettime(time.CLOCK_BOOTTIME)  # runs while the board sleeps: numbers from before are old
        for frame in frames:
            view.take(frame, now)
        if frames or now - looked >= AGE_S:
            looked = now
            picture = view.picture(now, channel.name, channel.interface, channel.up)
            news = {key: value for key, value in picture.items() if key not in NO_NEWS}
            if news != shown or now - given >= AT_LEAST_S:
                shown, given = news, now
                yield picture
        if now - fed >= interval:
            notify(WATCHDOG=1)
            fed = now
        time.sleep(POLL_S)
    notify(STOPPING=1)


@contextmanager
def until_signalled(duration: float | None = None) -> Iterator[Callable[[], bool]]:
    """Yield a function that says whether to stop: after `duration` [s], or at SIGINT, SIGTERM or SIGHUP."""
    end = time.monotonic() + (duration or math.inf)
    stopping = threading.Event()
    in_front = threading.current_thread() is threading.main_thread()  # only there can signals be handled
    wanted = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if in_front else ()
    before = {number: signal.signal(number, lambda *_: stopping.set()) for number in wanted}
    try:
        yield lambda: stopping.is_set() or time.monotonic() >= end
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def report(command: str, text: str) -> None:
    """Say `text` on standard output, where there is one, and to systemd."""
    if sys.stdout is not None:
        print(f"{command}: {text}", flush=True)
    notify(READY=1, STATUS=text)
