"""``gz-onboard history``: the rides of months in one file, and what they come to."""

from __future__ import annotations

import argparse
from pathlib import Path

from gz_onboard.errors import OK
from gz_onboard.lab.history import add, show
from gz_onboard.lab.history.choice import FILE, default_file
from gz_onboard.lab.history.store import Store
from gz_onboard.lab.history.text import ride_text
from gz_onboard.options import number

_MOST_RIDES = 10**12


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard history``."""
    parts = parser.add_subparsers(dest="part", metavar="add|show|remove", required=True, help="add, show or remove")
    for name, about, declare in (
        ("add", "keep the rides in logs; a ride that is there already is not counted twice", add.add_arguments),
        ("show", "totals by month and temperature, what was learned of the battery, the rides", show.add_arguments),
        ("remove", "take rides out of the history; the logs that they are from stay known", _add_remove),
    ):
        part = parts.add_parser(name, help=about, description=about, allow_abbrev=False)
        declare(part)
        text = f"the history (default: {FILE.name} in $STATE_DIRECTORY, or in ~/.local/share/gz-onboard)"
        part.add_argument("--file", type=Path, metavar="SQLITE", help=text)


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard history``: gives the exit status of its part."""
    file = arguments.file or default_file()
    if arguments.part == "remove":
        with Store(file) as store:
            for ride in store.remove(list(dict.fromkeys(arguments.numbers))):
                print(f"removed: {ride.log}: {ride_text(ride)}")
        return OK
    return add.run(arguments, file) if arguments.part == "add" else show.run(arguments, file)


def _add_remove(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard history remove``."""
    kind = number("NUMBER", 1, _MOST_RIDES, kind=int)
    parser.add_argument("numbers", nargs="+", type=kind, metavar="NUMBER", help="of a ride, as `history show` has it")
