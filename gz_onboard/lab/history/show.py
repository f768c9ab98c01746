"""``gz-onboard history show``: what a history holds, as text, JSON, a table and a picture."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, get_args

from gz_onboard.errors import OK, InputError, not_an_input, writing
from gz_onboard.imports import require
from gz_onboard.lab.estimate_table import FORMATS, check_table
from gz_onboard.lab.history.choice import Choice, period, read_rides
from gz_onboard.lab.history.picture import draw_history
from gz_onboard.lab.history.ride import COLUMNS, KeptRide
from gz_onboard.lab.history.text import HISTORY_VERSION, overview_text
from gz_onboard.lab.history.totals import LearnedAt, NumberedRide, Overview, Totals, overviews
from gz_onboard.offline.results import write_json
from gz_onboard.offline.style import picture_format, save
from gz_onboard.offline.write_tables import write_table
from gz_onboard.options import add_shared

_KINDS: dict[str, type] = {"number": int, **{name: (get_args(kind) or (kind,))[0] for name, kind in COLUMNS.items()}}


@dataclass(frozen=True)
class Shown:
    """Of a vehicle in the JSON."""

    vehicle: Annotated[str, "what it is called in the history"]
    total: Annotated[Totals, "of all rides"]
    months: Annotated[list[Totals], "of each month"]
    temperatures: Annotated[list[Totals], "of each 5 K of the air's temperature"]
    learned: Annotated[list[LearnedAt], "capacity and resistance over time, by the starts of the rides"]
    rides: Annotated[list[dict[str, object]], "each with its number"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard history show``."""
    add = parser.add_argument
    add("--since", metavar="DATE", help="rides from then on: a year, month or day, such as 2025-06")
    add("--until", metavar="DATE", help="rides until then, that day or month among them")
    add("--month", metavar="DATE", help="rides of that month, year or day")
    add("--vehicle", metavar="NAME", help="rides of this vehicle")
    add("--rider", metavar="NAME", help="rides of this rider")
    add("--rides", action="store_true", help="list all rides, not only the latest")
    add_shared(parser, "--json")
    add("--table", type=Path, metavar="FILE", help=f"also write the rides as a table: {' '.join(FORMATS)}")
    add("--plot", type=Path, metavar="PICTURE", help="also draw consumption, temperature, capacity and resistance")


def run(arguments: argparse.Namespace, file: Path) -> int:
    """``gz-onboard history show``. InputError if there is nothing to show."""
    _check(arguments, file)
    rides, undated = read_rides(file, _choice(arguments))
    shown = overviews(rides)
    if arguments.table:
        with writing(arguments.table):
            write_table(arguments.table, ride_table(rides), kinds={**_KINDS, "start": str})
    if arguments.plot:
        with writing(arguments.plot):
            save(draw_history(shown), arguments.plot)
    if arguments.json != "-":
        parts = [overview_text(overview, arguments.rides) for overview in shown]
        print("\n\n".join(parts) if parts else f"{file}: no ride")
    if undated:
        print(
            f"gz-onboard history show: {undated} without a date left out: their logs' clock was not set",
            file=sys.stderr,
        )
    # Last, as who reads it may have had enough before its end.
    write_json(arguments.json, HISTORY_VERSION, {"file": str(file), "vehicles": [_in_json(each) for each in shown]})
    return OK


def _check(arguments: argparse.Namespace, file: Path) -> None:
    """InputError for what cannot be asked for."""
    not_an_input([arguments.json, arguments.table, arguments.plot], [file])
    if arguments.table:
        check_table(arguments.table)
    if arguments.plot:
        picture_format(arguments.plot)
    require("matplotlib", arguments.plot is not None)


def _choice(arguments: argparse.Namespace) -> Choice:
    if arguments.month and (arguments.since or arguments.until):
        raise InputError("--month: is a time of its own; leave out --since and --until")
    since = until = period(arguments.month, "--month") if arguments.month else None
    if arguments.since:
        since = period(arguments.since, "--since")
    if arguments.until:
        until = period(arguments.until, "--until")
    return Choice(arguments.vehicle, arguments.rider, since, until)


def ride_table(rides: Sequence[NumberedRide]) -> dict[str, list[object]]:
    """A row for each ride: its number, its start as a date in UTC, and the fields of `KeptRide`."""
    table: dict[str, list[object]] = {"number": [one.number for one in rides]}
    table["start"] = [_date(one.ride) for one in rides]
    return table | {name: [getattr(one.ride, name) for one in rides] for name in COLUMNS}


def _date(ride: KeptRide) -> str | None:
    return f"{datetime.fromtimestamp(ride.start_ns // 10**9, UTC):%Y-%m-%dT%H:%M:%SZ}" if ride.dated else None


def _in_json(of: Overview) -> Shown:
    rides: list[dict[str, object]] = [{"number": one.number, **asdict(one.ride)} for one in of.rides]
    return Shown(of.vehicle, of.total, of.months, of.temperatures, of.learned, rides)
