"""Validations."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from gz_onboard.api.given import PathLike, VehicleLike, file_of
from gz_onboard.arguments import checked
from gz_onboard.errors import InputError
from gz_onboard.progress import Progress
from gz_onboard.recording.logs import logs_among
from gz_onboard.reports.tables import Columns, Tabular, columns_of
from gz_onboard.simulation.plan import vehicle_on
from gz_onboard.validation.comparison import ValidatedRide
from gz_onboard.validation.ride import compare_ride
from gz_onboard.validation.tables import markdown, ride_text
from gz_onboard.vehicle import Vehicle

_ERRORS = ("unit", "percent", "limit_percent", "passed", "rms", "max", "mean_error", "of_spread")


@dataclass(frozen=True)
class Validated(Tabular):
    """Rides against their simulation. rides: of each what ``gz-onboard validate --json`` writes."""

    rides: Sequence[ValidatedRide] = field(repr=False)

    def __str__(self) -> str:
        return "\n".join(map(ride_text, self.rides))

    @property
    def passed(self) -> bool:
        """Whether every ride did."""
        return all(ride.passed for ride in self.rides)

    def to_table(self) -> Columns:
        """A row for each ride, form (open_loop, predictive, components) and channel."""
        rows = [
            {"ride": ride.name, "form": form, "channel": channel, **asdict(errors)}
            for ride in self.rides
            for form, verdict in ride.verdicts.items()
            for channel, errors in verdict.channels.items()
        ]
        return columns_of(rows, {name: name for name in ("ride", "form", "channel", *_ERRORS)})

    def markdown(self) -> str:
        """The tables that ``gz-onboard validate --markdown`` writes."""
        return markdown(self.rides)


@checked
def validate(
    rides: PathLike | Sequence[PathLike], vehicle: VehicleLike = "reference", progress: Progress | None = None
) -> Validated:
    """Compare rides with their simulation: open loop, with the rider model, and each component alone.

    rides: logs, or folders of logs. vehicle: of one given by name or file, the payload is that of ``rides.json`` beside
    the log. progress: takes bytes of the logs. Raises InputError for a ride that cannot be judged, or if there is none.
    """
    several = [rides] if isinstance(rides, str | os.PathLike) else rides
    logs = list(dict.fromkeys(logs_among([Path(ride) for ride in several])))
    if not logs:
        raise InputError("no ride is given")
    found = []
    for log in logs:
        known = vehicle if isinstance(vehicle, Vehicle) else vehicle_on(str(log), file_of(vehicle))[0]
        found.append(compare_ride(log, known, progress or (lambda _: None)).result)
    return Validated(found)
