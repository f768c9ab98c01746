"""What the functions of the API are given: rides as logs or tables, vehicles."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from gz_onboard.offline.samples import Samples, read_samples
from gz_onboard.offline.signal_table import SignalTable
from gz_onboard.offline.table import signal_table
from gz_onboard.vehicle import Vehicle, read_vehicle

PathLike: TypeAlias = str | os.PathLike[str]


class ArrowTable(Protocol):
    """A table of pandas, polars, pyarrow or any other library that speaks Arrow."""

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """As of the Arrow PyCapsule interface."""


Signals: TypeAlias = Mapping[str, Any] | ArrowTable
"""A ride as a table of signals: a time column, and one for each role with its unit, such as ``speed [km/h]``."""


def source_of(data: PathLike | Signals, name: str = "table") -> Path | SignalTable:
    """A path, or the table of signals of a ride. name: what errors call that."""
    return Path(data) if isinstance(data, str | os.PathLike) else signal_table(data, name)


def vehicle_of(given: Vehicle | str | Path) -> Vehicle:
    """The vehicle given, or that of the name or file given."""
    return given if isinstance(given, Vehicle) else read_vehicle(given)


def read_ride(
    source: PathLike | Signals,
    vehicle: Vehicle | str | Path = "reference",
    *,
    name: str | None = None,
    facts: Mapping[str, object] | None = None,
) -> Samples:
    """The samples of a ride by role, in SI units: of a log, or of a table of signals.

    name: of the ride; that of the log if not given. facts: what is known of it beside its signals, such as
    ``{"rider_mass_kg": 85.0}``, in place of what a ``rides.json`` beside the log says of the same. Raises InputError.
    """
    ride = read_samples(source_of(source, name or "table"), vehicle_of(vehicle))
    return replace(ride, name=name or ride.name, facts={**ride.facts, **(facts or {})})
