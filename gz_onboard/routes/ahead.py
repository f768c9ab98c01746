"""The file of a route that is still to be ridden: GPX, or CSV as `route` has it."""

from __future__ import annotations

from pathlib import Path

from gz_onboard.errors import InputError, unreadable
from gz_onboard.routes.columns import Columns
from gz_onboard.routes.gpx import read_road
from gz_onboard.routes.route import KNOWN_AHEAD, Route, route_ahead_of

LARGEST_FILE = 50_000_000  # bytes: a GPX of the most points that are taken has a tenth of it


def read_ahead(file: Path) -> tuple[Columns, Route]:
    """The columns of a route's `file`, and the route. Raises InputError naming file and line."""
    try:
        size = file.stat().st_size
    except OSError as error:
        raise unreadable(file, error) from error
    if size > LARGEST_FILE:
        raise InputError(f"{file}: has {size / 1e6:.0f} MB, a route has at most {LARGEST_FILE / 1e6:.0f} MB")
    columns = read_road(file, KNOWN_AHEAD)
    return columns, route_ahead_of(columns, file.stem.removesuffix(".route"))
