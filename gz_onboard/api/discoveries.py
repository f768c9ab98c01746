"""Discoveries."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from gz_onboard.api.given import PathLike, Signals, read_ride, vehicle_of
from gz_onboard.errors import writing
from gz_onboard.lab.discover import command as discovery
from gz_onboard.lab.discover.command import DiscoveryOptions
from gz_onboard.lab.discover.page import write_report
from gz_onboard.lab.discover.result import Report
from gz_onboard.lab.discover.summary import summary
from gz_onboard.lab.discover.verdict import Discovery
from gz_onboard.offline.samples import Samples, read_samples
from gz_onboard.offline.table import Columns, Tabular, columns_of
from gz_onboard.vehicle import Vehicle

_CAUSE = ("name", "parameter", "value", "unit", "ci95_low", "ci95_high", "change", "energy_share", "varies")


@dataclass(frozen=True)
class Discovered(Tabular):
    """What rides show that the model of the vehicle does not. found: with the rides it was reached on."""

    report: Report = field(repr=False)
    vehicle: Vehicle = field(repr=False)
    found: Discovery = field(repr=False)

    def to_table(self) -> Columns:
        """A row for each cause that was named."""
        causes = [{**asdict(c), "ci95_low": c.ci95[0], "ci95_high": c.ci95[1]} for c in self.report.causes]
        return columns_of(causes, {name: name for name in _CAUSE})

    def __str__(self) -> str:
        return summary(self.found, [])

    def write_model(self, file: PathLike) -> list[str]:
        """Write the extended vehicle file, if there is anything to extend it with; gives what was done, in words."""
        return discovery.write_extended(self.found, self.vehicle, Path(file))

    def write_report(self, file: PathLike) -> None:
        """Write the report as an HTML page. Raises InputError."""
        with writing(file):
            write_report(self.found, Path(file))


def discover(
    rides: PathLike | Signals | Samples | Sequence[PathLike | Signals | Samples],
    vehicle: Vehicle | str | Path = "reference",
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
    samples: list[Samples] = []
    for i, ride in enumerate(several, 1):
        if isinstance(ride, Samples):
            samples.append(ride)
        elif isinstance(ride, str | os.PathLike):
            samples += [read_samples(log, known) for log in discovery.find_logs([Path(ride)])]
        else:
            samples.append(read_ride(ride, known, name=f"table {i}"))
    discovery.told_apart([ride.name for ride in samples])
    found = discovery.explain(known, samples, options or DiscoveryOptions(), say=progress)
    return Discovered(found.report, known, found)
