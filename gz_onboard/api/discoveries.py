"""Discoveries."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from gz_onboard.api.given import PathLike, Signals, VehicleLike, read_ride, vehicle_of
from gz_onboard.errors import brief, not_an_input, writing
from gz_onboard.lab.calibrate.vehicle_file import vehicle_output
from gz_onboard.lab.discover import command as discovery
from gz_onboard.lab.discover.command import DiscoveryOptions
from gz_onboard.lab.discover.page import write_report
from gz_onboard.lab.discover.result import Report
from gz_onboard.lab.discover.summary import summary
from gz_onboard.lab.discover.verdict import Discovery
from gz_onboard.offline.arguments import checked
from gz_onboard.offline.samples import Samples, read_samples
from gz_onboard.offline.table import Columns, Tabular, columns_of
from gz_onboard.vehicle import Vehicle

_CAUSE = ("name", "parameter", "value", "unit", "ci95_low", "ci95_high", "change", "energy_share", "varies")


@dataclass(frozen=True)
class Discovered(Tabular):
    """What rides show that the model of the vehicle does not. found: with the rides it was reached on."""

    report: Report
    vehicle: Vehicle
    found: Discovery
    read: Sequence[Path] = ()  # files, which are not written over

    __repr__ = brief

    def to_table(self) -> Columns:
        """A row for each cause that was named."""
        causes = [{**asdict(c), "ci95_low": c.ci95[0], "ci95_high": c.ci95[1]} for c in self.report.causes]
        return columns_of(causes, {name: name for name in _CAUSE})

    def __str__(self) -> str:
        return summary(self.found, [])

    @checked
    def write_model(self, file: PathLike) -> list[str]:
        """Write the extended vehicle file, if there is anything to extend it with; gives what was done, in words.

        Raises InputError.
        """
        vehicle_output(Path(file), self.read)
        return discovery.write_extended(self.found, self.vehicle, Path(file))

    @checked
    def write_report(self, file: PathLike) -> None:
        """Write the report as an HTML page. Raises InputError."""
        not_an_input([Path(file)], self.read)
        with writing(file):
            write_report(self.found, Path(file))


@checked
def discover(
    rides: PathLike | Signals | Samples | Sequence[PathLike | Signals | Samples],
    vehicle: VehicleLike = "reference",
    options: DiscoveryOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> Discovered:
    """Find what the model of `vehicle` gets wrong on `rides`, and name the cause.

    rides: logs, folders of logs, tables of signals, or what `read_ride` gave. progress: takes the step that begins.
    Raises InputError for a ride that cannot be used, or if there is none.
    """
    known = vehicle_of(vehicle)
    several = [rides] if isinstance(rides, str | os.PathLike | Samples | Mapping) else rides
    several = several if isinstance(several, Sequence) else [several]
    given = [
        (f"table {i}", log)
        for i, ride in enumerate(several, 1)
        for log in (discovery.find_logs([Path(ride)]) if isinstance(ride, str | os.PathLike) else [ride])
    ]
    logs = [ride for _, ride in given if isinstance(ride, Path)]
    names = iter(discovery.ride_names(logs))
    samples: list[Samples] = []
    for name, ride in given:
        if isinstance(ride, Path):
            samples.append(replace(read_samples(ride, known), name=next(names)))
        else:
            samples.append(ride if isinstance(ride, Samples) else read_ride(ride, known, name=name))
    discovery.told_apart([ride.name for ride in samples])
    found = discovery.explain(known, samples, options or DiscoveryOptions(), say=progress)
    return Discovered(found.report, known, found, [known.file, *logs])
