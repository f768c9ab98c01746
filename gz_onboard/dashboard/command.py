"""``gz-onboard dashboard``: the range in a terminal or in a browser, from the range frames on the bus."""

from __future__ import annotations

import argparse
from pathlib import Path

from gz_onboard.dashboard import terminal
from gz_onboard.dashboard.live import add_source, live, report, view_of
from gz_onboard.dashboard.view import encoded
from gz_onboard.errors import OK, InputError

LISTEN = "127.0.0.1:8000"


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
    if not arguments.web:
        return terminal.show(view, arguments)
    from gz_onboard.dashboard.server import Feed, served  # not for the terminal: 2 MB

    feed = Feed()
    with live(view, arguments) as pictures, served(feed, arguments.listen or LISTEN) as address:
        report("dashboard", f"{address} shows {arguments.channel} ({arguments.interface})")
        for picture in pictures:
            feed.publish(encoded(picture))
    return OK
