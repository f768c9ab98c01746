"""What the functions of the API are given: rides as logs or tables, vehicles."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from gz_onboard.arguments import checked, within
from gz_onboard.options import MOST_PAYLOAD
from gz_onboard.priors import correlations
from gz_onboard.recording.recording import Recording, read_recording
from gz_onboard.recording.tables import SignalTable, table_of
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle import read_vehicle as read_vehicle_file

PathLike: TypeAlias = str | os.PathLike[str]


class ArrowTable(Protocol):
    """A table of pandas, polars, pyarrow or any other library that speaks Arrow."""

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """As of the Arrow PyCapsule interface."""


Signals: TypeAlias = Mapping[str, Any] | ArrowTable
"""A ride as a table of signals: a time column, and one for each role with its unit, such as ``speed [km/h]``."""


def source_of(data: PathLike | Signals, name: str = "table") -> Path | SignalTable:
    """A path, or the table of signals of a ride. name: what errors call that."""
    return Path(data) if isinstance(data, str | os.PathLike) else table_of(data, name)


VehicleLike: TypeAlias = Vehicle | PathLike
"""A vehicle, or the name of a built-in one, or a vehicle file."""


def file_of(name: PathLike) -> str | Path:
    """The name of a vehicle or its file, as `find_vehicle` takes it."""
    return name if isinstance(name, str) else Path(name)


def vehicle_of(given: VehicleLike) -> Vehicle:
    """The vehicle given, or that of the name or file given."""
    return given if isinstance(given, Vehicle) else read_vehicle(given)


@checked
def read_vehicle(name: PathLike, payload: float | None = None, effects_folder: PathLike | None = None) -> Vehicle:
    """The vehicle of a name or file, with the mass of rider and luggage [kg] if it is known.

    effects_folder: where effects of your own are: Python code you trust. Raises InputError.
    """
    if payload is not None:
        within("payload", payload, {"payload": (0.0, MOST_PAYLOAD, "kg")})
    vehicle = read_vehicle_file(file_of(name), payload, None if effects_folder is None else Path(effects_folder))
    correlations(vehicle)
    return vehicle


@checked
def read_ride(
    source: PathLike | Signals,
    vehicle: VehicleLike = "reference",
    *,
    name: str | None = None,
    facts: Mapping[str, object] | None = None,
) -> Recording:
    """The samples of a ride by role, in SI units: of a log, or of a table of signals.

    name: of the ride; that of the log if not given. facts: what is known of it beside its signals, such as
    ``{"rider_mass_kg": 85.0}``, in place of what a ``rides.json`` beside the log says of the same. Raises InputError.
    """
    ride = read_recording(source_of(source, name or "table"), vehicle_of(vehicle))
    return replace(ride, name=name or ride.name, facts={**ride.facts, **(facts or {})})
