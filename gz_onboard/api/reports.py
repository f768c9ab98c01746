"""Reports of rides."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from gz_onboard.api.given import PathLike, VehicleLike, vehicle_of
from gz_onboard.arguments import checked
from gz_onboard.errors import InputError, not_an_input, writing
from gz_onboard.estimation.report import ReportedRide, check_page, page_of, report_of, section_of
from gz_onboard.estimation.summary import summary_text
from gz_onboard.progress import Progress
from gz_onboard.recording.logs import distinct_logs
from gz_onboard.reports.tables import Columns, Tabular, columns_of


@dataclass(frozen=True)
class Reported(Tabular):
    """Rides with all that their page shows. rides: of each its summary, estimates, path, temperatures, and
    `ledger_wh`, where the energy went.
    """

    rides: Sequence[ReportedRide] = field(repr=False)
    read: Sequence[Path] = field(repr=False, default=())  # files, which are not written over

    def __str__(self) -> str:
        return "\n".join(summary_text(ride.summary) for ride in self.rides)

    def to_table(self) -> Columns:
        """Where the energy went: a row for each ride and entry of its ledger."""
        rows = [
            {"ride": ride.name, "where": where, "energy": energy}
            | {"per_km": energy / ride.ledger_km if ride.ledger_km else None}
            for ride in self.rides
            for where, energy in ride.ledger_wh().items()
        ]
        return columns_of(
            rows, {"ride": "ride", "where": "where", "energy": "energy[Wh]", "per_km": "consumption[Wh/km]"}
        )

    @checked
    def write(self, file: PathLike) -> None:
        """Write the page. Raises InputError."""
        not_an_input([Path(file)], self.read)
        check_page(Path(file))
        page = page_of([section_of(ride, f"ride-{i}") for i, ride in enumerate(self.rides, 1)])
        with writing(file):
            Path(file).write_text(page, encoding="utf-8", errors="replace")


@checked
def report(
    rides: PathLike | Sequence[PathLike],
    vehicle: VehicleLike = "reference",
    *,
    route: PathLike | None = None,
    located: bool = True,
    progress: Progress | None = None,
) -> Reported:
    """Estimate rides as the daemon would, and keep all that ``gz-onboard report`` shows of them.

    rides: logs, or folders of logs. route: file of the road that was to be ridden. located: whether the page says
    where the rides were. progress: takes numbers of frames. Raises InputError for a ride that cannot be used, or if
    there is none.
    """
    known = vehicle_of(vehicle)
    several = [rides] if isinstance(rides, str | os.PathLike) else rides
    logs = distinct_logs(map(Path, several))
    if not logs:
        raise InputError("no ride is given")
    road = None if route is None else Path(route)
    found = [report_of(log, known, road, located, progress) for log in logs]
    return Reported(found, [known.file, *logs, *([] if road is None else [road])])
