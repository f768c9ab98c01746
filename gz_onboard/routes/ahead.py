"""The file of a route that is still to be ridden: GPX, or CSV as `route` has it."""

from __future__ import annotations

import gzip
import zlib
from pathlib import Path

from gz_onboard.errors import InputError, unreadable
from gz_onboard.routes.columns import Columns
from gz_onboard.routes.gpx import read_road
from gz_onboard.routes.route import KNOWN_AHEAD, Route, route_ahead_of, without_holes

LARGEST_FILE = 50_000_000  # bytes, unpacked: a GPX of the most points that are taken has a tenth of it


def read_ahead(file: Path) -> tuple[Columns, Route]:
    """The columns of a route's `file`, and the route. Raises InputError naming file and line."""
    try:
        large = _is_large(file)
    except (OSError, EOFError, zlib.error) as error:
        raise unreadable(file, error) from error
    if large:
        raise InputError(f"{file}: has more than {LARGEST_FILE / 1e6:.0f} MB, unpacked; a route has fewer")
    columns = without_holes(read_road(file, KNOWN_AHEAD))
    return columns, route_ahead_of(columns, file.stem.removesuffix(".route"))


def _is_large(file: Path) -> bool:
    """Whether a file has more than `LARGEST_FILE`; no more is unpacked. OSError, EOFError, zlib.error."""
    if file.suffix != ".gz":
        return file.stat().st_size > LARGEST_FILE
    size = 0
    with gzip.open(file) as stream:
        while size <= LARGEST_FILE and (piece := stream.read(1 << 20)):
            size += len(piece)
    return size > LARGEST_FILE
