"""Discoveries."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TypeAlias

from gz_onboard.api.given import PathLike, Signals, VehicleLike, read_ride, read_vehicle, vehicle_of
from gz_onboard.arguments import checked
from gz_onboard.calibration.vehicle_file import vehicle_output
from gz_onboard.discovery.baseline import baseline as learn_baseline
from gz_onboard.discovery.baseline import write_baseline
from gz_onboard.discovery.command import DiscoveryOptions, find_logs
from gz_onboard.discovery.extend import write_model
from gz_onboard.discovery.judgement import Discovery, Report
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.report import summary, write_report
from gz_onboard.discovery.run import discover as find
from gz_onboard.errors import InputError, brief, not_an_input, writing
from gz_onboard.recording.recording import Recording, read_recording, ride_name
from gz_onboard.reports.results import distinct_names
from gz_onboard.reports.tables import Columns, Tabular, columns_of
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
        return write_model(self.found, self.vehicle, Path(file))[1]

    @checked
    def write_report(self, file: PathLike) -> None:
        """Write the report as an HTML page. Raises InputError."""
        not_an_input([Path(file)], self.read)
        with writing(file):
            write_report(self.found, Path(file))


Rides: TypeAlias = PathLike | Signals | Recording | Sequence[PathLike | Signals | Recording]
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
    options = options or DiscoveryOptions()
    effects = None if options.effects is None else Path(options.effects)
    shared = effects, progress or (lambda _: None), options.jobs
    found = find(known, samples, options.seed, *shared, options.holdout or ())
    return Discovered(found.report, known, found, [known.file, *logs])


@dataclass(frozen=True)
class Baseline(Tabular):
    """What healthy rides show of a vehicle. vehicle: as they show it, to be given to `discover`; before: as its file
    says; note: how well the rides predict each other, and which were left out.
    """

    vehicle: Vehicle
    before: Vehicle
    note: str
    read: Sequence[Path] = field(repr=False, default=())  # files, which are not written over

    __repr__ = brief

    def __str__(self) -> str:
        return self.note

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
    effects = None if options.effects is None else Path(options.effects)
    found = learn_baseline(known, samples, effects, progress or (lambda _: None), options.jobs)
    assert isinstance(found.healthy, MixedModel)
    return Baseline(found, known, found.healthy.checked, [known.file, *logs])


def _samples_of(rides: Rides, known: Vehicle) -> tuple[list[Recording], list[Path]]:
    """The samples of rides, each by another name, and the logs that were read."""
    several = [rides] if isinstance(rides, str | os.PathLike | Recording | Mapping) else rides
    several = several if isinstance(several, Sequence) else [several]
    given = [
        (f"table {i}", log)
        for i, ride in enumerate(several, 1)
        for log in (find_logs([Path(ride)]) if isinstance(ride, str | os.PathLike) else [ride])
    ]
    logs = [ride for _, ride in given if isinstance(ride, Path)]
    names = iter(distinct_names(logs, [ride_name(log) for log in logs]))
    samples: list[Recording] = []
    for name, ride in given:
        if isinstance(ride, Path):
            samples.append(replace(read_recording(ride, known), name=next(names)))
        else:
            samples.append(ride if isinstance(ride, Recording) else read_ride(ride, known, name=name))
    called = [ride.name for ride in samples]
    if twice := sorted({name for name in called if called.count(name) > 1}):
        raise InputError(f"two rides are called {twice[0]}: rides are told apart by their names; rename one")
    return samples, logs
