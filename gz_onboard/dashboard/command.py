"""``gz-onboard dashboard``: the range in a terminal or in a browser, from nothing but the range frames on the bus."""

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

DURATIONS = 1e-3, 1e9  # s
LISTEN = "127.0.0.1:8000"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard dashboard``."""
    add = parser.add_argument
    add_source(parser)
    add("--once", action="store_true", help="print one picture as soon as every message has come, and end")
    add("--web", action="store_true", help="serve a page for a browser instead of writing to the terminal")
    add("--listen", metavar="ADDRESS:PORT", help=f"where --web serves it (default: {LISTEN}; port 0: any free one)")


def add_source(parser: argparse.ArgumentParser) -> None:
    """The options of every command that shows range frames: where they come from, and for how long."""
    add_shared(parser, "--interface", "--channel")
    dbc = "DBC file of the range frames, the vehicle's range_dbc (default: %(default)s)"
    parser.add_argument("--dbc", default=RANGE_DBC, metavar="FILE", help=dbc)
    duration = number("--duration", *DURATIONS, "s")
    parser.add_argument("--duration", type=duration, metavar="S", help="end after this long")


@contextmanager
def source_of(arguments: argparse.Namespace, others: Sequence[int] | None = ()) -> Iterator[tuple[View, CanChannel]]:
    """The view, and the open channel of its frames and of those with the identifiers `others`; None: of all frames."""
    view = View(find_dbc(arguments.dbc, Path.cwd()))
    identifiers = None if others is None else [*view.identifiers, *others]
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
    with source_of(arguments) as (view, channel):
        if arguments.web:
            from gz_onboard.dashboard import web  # not for the terminal: a server is 2 MB

            return web.serve(view, channel, arguments.listen or LISTEN, arguments.duration)
        return terminal.show(view, channel, arguments.once, arguments.duration)
