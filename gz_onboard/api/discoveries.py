"""Discoveries."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

from gz_onboard.api.given import PathLike, Signals, VehicleLike, read_ride, read_vehicle, vehicle_of
from gz_onboard.calibration.vehicle_file import vehicle_output
from gz_onboard.discovery import command as discovery
from gz_onboard.discovery.baseline import baseline as learn_baseline
from gz_onboard.discovery.baseline_file import write_baseline
from gz_onboard.discovery.command import DiscoveryOptions
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.page import write_report
from gz_onboard.discovery.result import Report
from gz_onboard.discovery.summary import summary
from gz_onboard.discovery.verdict import Discovery
from gz_onboard.errors import brief, not_an_input, writing
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


Rides: TypeAlias = PathLike | Signals | Samples | Sequence[PathLike | Signals | Samples]
"""Logs, folders of logs, tables of signals, or what `read_ride` gave."""


@checked
def discover(
    rides: Rides,
    vehicle: VehicleLike = "reference",
    options: DiscoveryOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> Discovered:
    """Find what the model of `vehicle` gets wrong on `rides`, and name the cause.

    rides: logs, folders of logs, tables of signals, or what `read_ride` gave. vehicle: also the one of a `Baseline`.
    progress: takes the step that begins. Raises InputError for a ride that cannot be used, or if there is none.
    """
    known = vehicle_of(vehicle)
    samples, logs = _samples_of(rides, known)
    found = discovery.explain(known, samples, options or DiscoveryOptions(), say=progress)
    return Discovered(found.report, known, found, [known.file, *logs])


@dataclass(frozen=True)
class Baseline(Tabular):
    """What healthy rides show of a vehicle. vehicle: as they show it, to be given to `discover`; before: as its file
    says; note: how well the rides foretell each other; left_out: rides by name that are none on a road.
    """

    vehicle: Vehicle
    before: Vehicle
    note: str
    left_out: Sequence[str] = ()
    read: Sequence[Path] = field(repr=False, default=())  # files, which are not written over

    __repr__ = brief

    def __str__(self) -> str:
        left = [f"left out, as no rides on a road: {', '.join(self.left_out)}"] if self.left_out else []
        return "\n".join([self.note, *left])

    def to_table(self) -> Columns:
        """A row for each parameter that was refitted: its value and standard deviation, before and after."""
        known, new = self.before.parameters.known, self.vehicle.parameters.known
        rows = [
            {"parameter": name, "unit": x.unit, "value": x.value, "sd": x.sd}
            | {"value_before": known[name].value, "sd_before": known[name].sd}
            for name, x in new.items()
            if x != known[name]
        ]
        names = ("parameter", "unit", "value_before", "sd_before", "value", "sd")
        return columns_of(rows, {name: name for name in names})

    @checked
    def write(self, file: PathLike) -> Vehicle:
        """Write the vehicle file, and what healthy rides look like beside it; gives the vehicle in it.

        Raises InputError.
        """
        vehicle_output(Path(file), self.read)
        with writing(file):
            write_baseline(self.vehicle, self.before.file, Path(file))
        return read_vehicle(Path(file))


@checked
def baseline(
    rides: Rides,
    vehicle: VehicleLike = "reference",
    options: DiscoveryOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> Baseline:
    """Learn from `rides` of the healthy vehicle what it is like, and how its rides differ; three at least.

    Of the options, `effects` and `jobs` count. Raises InputError for rides that cannot be used, or contradict the
    vehicle's file.
    """
    known, options = vehicle_of(vehicle), options or DiscoveryOptions()
    samples, logs = _samples_of(rides, known)
    healthy, left = discovery.on_roads(samples)
    effects = None if options.effects is None else Path(options.effects)
    found = learn_baseline(known, healthy, effects, progress, options.jobs)
    told = found.healthy.checked if isinstance(found.healthy, MixedModel) else ""
    return Baseline(found, known, told, left, [known.file, *logs])


def _samples_of(rides: Rides, known: Vehicle) -> tuple[list[Samples], list[Path]]:
    """The samples of rides, each by another name, and the logs that were read."""
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
    return samples, logs
