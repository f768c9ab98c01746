"""Vehicle files, checked against logs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from gz_onboard.api.given import PathLike, VehicleLike, vehicle_of
from gz_onboard.arguments import checked
from gz_onboard.errors import brief
from gz_onboard.progress import Progress
from gz_onboard.recording.logs import distinct_logs
from gz_onboard.reports.results import descriptions
from gz_onboard.reports.tables import Columns, Tabular, columns_of
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.check import Checked, RoleSeen, check_log, check_text
from gz_onboard.vehicle_check.command import roles_text
from gz_onboard.vehicle_check.finding import Feature, Finding, Looks, features_of


@dataclass(frozen=True)
class CheckedVehicle(Tabular):
    """Logs against a vehicle file. features: what it is enough for, whatever the logs hold; logs: of each what fills
    the roles, findings, and the features that it lacks something for.
    """

    vehicle: Vehicle
    features: Sequence[Feature]
    logs: Sequence[Checked]

    __repr__ = brief

    def __str__(self) -> str:
        return "\n".join(map(check_text, self.logs)) if self.logs else roles_text(self.vehicle)

    @property
    def wrong(self) -> list[Finding]:
        """What looks wrong, of all logs."""
        return [finding for log in self.logs for finding in log.those(Looks.WRONG)]

    def to_table(self) -> Columns:
        """A row for each log and role."""
        rows = [{"file": log.file, **asdict(role)} for log in self.logs for role in log.roles]
        return columns_of(rows, {name: name for name in ("file", *descriptions(RoleSeen))})


@checked
def check_vehicle(
    vehicle: VehicleLike,
    logs: PathLike | Sequence[PathLike] = (),
    *,
    quick: bool = False,
    progress: Progress | None = None,
) -> CheckedVehicle:
    """Check whether a vehicle file fits logs of it: what fills each role, what looks wrong, what is missing for what.

    logs: also folders of logs. quick: without the run through the daemon's pipeline, which takes most of the time.
    progress: takes numbers of frames. Raises InputError for a log that cannot be used.
    """
    known = vehicle_of(vehicle)
    several = [logs] if isinstance(logs, str | os.PathLike) else logs
    found = [check_log(log, known, progress, quick) for log in distinct_logs(map(Path, several))]
    return CheckedVehicle(known, features_of({source.role for source in known.mapping.sources}), found)
