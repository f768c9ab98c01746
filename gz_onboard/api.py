"""The Python API: ``import gz_onboard as gz``. Each function does what the command of its name does, without printing.

Results are dataclasses; those with a table have ``to_table()`` (a dict of numpy arrays), ``to_arrow()`` and
``to_pandas()``. A mistake of the user raises `InputError`. Examples: docs/python.md.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import numpy as np

from gz_onboard.errors import InputError, writing
from gz_onboard.lab import estimate_table, export_tables
from gz_onboard.lab.calibrate import command as calibration
from gz_onboard.lab.calibrate.report import write_report as write_calibration_report
from gz_onboard.lab.calibrate.result import Result
from gz_onboard.lab.calibrate.vehicle_file import write_vehicle
from gz_onboard.lab.discover import command as discovery
from gz_onboard.lab.discover.command import DiscoveryOptions
from gz_onboard.lab.discover.page import write_report as write_discovery_report
from gz_onboard.lab.discover.result import Report
from gz_onboard.lab.discover.summary import summary as discovery_text
from gz_onboard.lab.discover.verdict import Discovery
from gz_onboard.lab.estimate_ride import How, RideSummary, open_estimate, ride_through, summary_of
from gz_onboard.log_rows import CHANGE_TOPIC, ESTIMATE_TOPIC, ESTIMATE_UNITS, TEXTS, WHY_TOPIC, table_columns
from gz_onboard.offline.samples import Samples, read_samples
from gz_onboard.offline.signal_table import SignalTable
from gz_onboard.offline.table import Columns, Tabular, array_of, columns_of, signal_table
from gz_onboard.progress import Progress
from gz_onboard.routes.ahead import read_ahead
from gz_onboard.simulation.output import series_table
from gz_onboard.simulation.plan import SimulationOptions, find_plan, vehicle_on
from gz_onboard.simulation.run import Run
from gz_onboard.simulation.simulate import ride as simulate_plan
from gz_onboard.simulation.summary import SimulationSummary, summarise
from gz_onboard.vehicle import Vehicle, find_vehicle, read_vehicle

__all__ = [
    "Calibration",
    "Discovered",
    "DiscoveryOptions",
    "EstimatedRide",
    "InputError",
    "LoggedEstimates",
    "Samples",
    "SimulatedRide",
    "SimulationOptions",
    "Vehicle",
    "calibrate",
    "discover",
    "estimate",
    "read_estimates",
    "read_ride",
    "read_vehicle",
    "simulate",
    "summary_table",
]

PathLike: TypeAlias = str | os.PathLike[str]


class ArrowTable(Protocol):
    """A table of pandas, polars, pyarrow or any other library that speaks Arrow."""

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """As of the Arrow PyCapsule interface."""


Signals: TypeAlias = Mapping[str, Any] | ArrowTable
"""A ride as a table of signals: a time column, and one for each role with its unit, such as ``speed [km/h]``."""


def _source(data: PathLike | Signals, name: str = "table") -> Path | SignalTable:
    return Path(data) if isinstance(data, str | os.PathLike) else signal_table(data, name)


def _vehicle(given: Vehicle | str | Path) -> Vehicle:
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
    ride = read_samples(_source(source, name or "table"), _vehicle(vehicle))
    return replace(ride, name=name or ride.name, facts={**ride.facts, **(facts or {})})


# --- estimate -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LoggedEstimates(Tabular):
    """The estimates in a log. columns: of each field of the `rows` the column; times: [ns since the epoch]."""

    columns: Mapping[str, str]
    times: Sequence[int]
    rows: Sequence[Mapping[str, object]]

    def to_table(self) -> Columns:
        """A row for each estimate, with the columns that ``gz-onboard export --estimates`` writes."""
        return {"time": np.array(self.times, dtype="datetime64[ns]"), **columns_of(self.rows, self.columns)}


@dataclass(frozen=True)
class EstimatedRide(Tabular):
    """The estimates of a ride. whys: of why the range is what it is, changes: of why it changed, a row each."""

    summary: RideSummary
    estimates: LoggedEstimates
    whys: Sequence[Mapping[str, object]]
    changes: Sequence[Mapping[str, object]]

    def to_table(self) -> Columns:
        """A row each second, with the columns that ``gz-onboard export --estimates`` writes."""
        return self.estimates.to_table()


class _Kept:
    """A log in memory, of rows by topic."""

    def __init__(self) -> None:
        self.rows: dict[str, list[tuple[int, Mapping[str, object]]]] = {}

    def channel(self, topic: str, json_schema: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
        """As of `log_rows.Log`."""
        self.rows[topic] = []

    def frames(self, batch: Sequence[Any]) -> None:
        """As of `log_rows.Log`."""

    def sample(self, topic: str, time_ns: int, values: Mapping[str, object]) -> None:
        """As of `log_rows.Log`."""
        self.rows[topic].append((time_ns, values))

    def of(self, topic: str) -> list[Mapping[str, object]]:
        """The rows of a topic."""
        return [values for _, values in self.rows[topic]]


def estimate(
    source: PathLike | Signals,
    vehicle: Vehicle | str | Path = "reference",
    *,
    route: PathLike | None = None,
    filter_name: str = "scalar",
    progress: Progress | None = None,
) -> EstimatedRide:
    """Estimate state of charge and range over a log or a table of signals, as the daemon would.

    route: file of the road that is to be ridden. filter_name: scalar or filterpy. progress: takes numbers of frames.
    Raises InputError.
    """
    road = read_ahead(Path(route))[1] if route else None
    log = _Kept()
    ride = open_estimate(_source(source), _vehicle(vehicle))
    ridden = ride_through(ride, How(filter_name, route=road), log, progress)
    times = [time_ns for time_ns, _ in log.rows[ESTIMATE_TOPIC]]
    columns = table_columns({**ESTIMATE_UNITS, **dict.fromkeys(TEXTS, "")})
    estimates = LoggedEstimates(columns, times, log.of(ESTIMATE_TOPIC))
    return EstimatedRide(summary_of(ridden), estimates, log.of(WHY_TOPIC), log.of(CHANGE_TOPIC))


def summary_table(rides: Iterable[EstimatedRide]) -> Columns:
    """The summaries of rides, a row each, with the columns that ``gz-onboard estimate --table`` writes."""
    table = estimate_table.summary_table([ride.summary for ride in rides])
    return {name: array_of(column) for name, column in table.items()}


def read_estimates(log: PathLike) -> LoggedEstimates:
    """The estimates that the daemon or ``gz-onboard estimate`` wrote into an MCAP log. InputError if it has none."""
    source = export_tables.Source(Path(log))
    rows = export_tables.estimate_rows(source)
    columns = export_tables.topic_columns(source.log, ESTIMATE_TOPIC)
    return LoggedEstimates(columns, [time_ns for time_ns, _ in rows], [values for _, values in rows])


# --- simulate -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SimulatedRide(Tabular):
    """A simulated ride: its summary, and the run with its time series and ledger."""

    summary: SimulationSummary
    run: Run

    def to_table(self) -> Columns:
        """The time series, a row each tenth of a second, with the columns that ``gz-onboard simulate`` writes."""
        return dict(series_table(self.run))


def simulate(
    what: PathLike,
    vehicle: Vehicle | str | Path = "reference",
    options: SimulationOptions | None = None,
    progress: Progress | None = None,
) -> SimulatedRide:
    """Ride a built-in drive cycle, the file of a cycle or a route, or the log of a recorded ride.

    vehicle: of one given by name or file, the payload of a recorded ride is that of ``rides.json`` beside its log.
    progress: takes the seconds ridden. Raises InputError.
    """
    begin = time.perf_counter()
    options = options or SimulationOptions()
    known, payload_from = (
        (vehicle, "the vehicle given") if isinstance(vehicle, Vehicle) else vehicle_on(os.fspath(what), vehicle)
    )
    plan = find_plan(os.fspath(what), options, known)
    run, scooter = simulate_plan(known, plan, options, progress)
    summary = summarise(known, plan, os.fspath(what), run, scooter)
    return SimulatedRide(replace(summary, payload_from=payload_from, wall_s=time.perf_counter() - begin), run)


# --- calibrate ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Calibration(Tabular):
    """What procedures found. base: the vehicle file that they started from."""

    base: Path
    results: Sequence[Result]

    def to_table(self) -> Columns:
        """A row for each parameter: procedure, parameter, value, sd, unit, source."""
        rows = [
            {"procedure": result.procedure, "parameter": name, **asdict(found)}
            for result in self.results
            for name, found in result.parameters.items()
        ]
        names = ("procedure", "parameter", "value", "sd", "unit", "source")
        return columns_of(rows, {name: name for name in names})

    def write(self, file: PathLike) -> Vehicle:
        """Write the vehicle file with what was found, and give the vehicle in it. Raises InputError."""
        with writing(file):
            return write_vehicle(self.base, calibration.for_file(self.results, read_vehicle(self.base)), Path(file))

    def write_report(self, file: PathLike) -> None:
        """Write the report as an HTML page. Raises InputError."""
        with writing(file):
            write_calibration_report(Path(file), f"Calibration of {read_vehicle(self.base).name}", self.results)


def calibrate(
    data: PathLike | Iterable[PathLike] | Mapping[str, Sequence[PathLike]],
    vehicle: str | Path | None = None,
    *,
    procedure: str = "all",
    options: Mapping[str, float | str] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Calibration:
    """Determine parameters from measurements.

    data: a folder with a manifest, for the procedure ``all``; else the files of the procedure, or a mapping of its
    slots, such as ``{"data": [...], "held_out": [...]}``. vehicle: name or file to start from, ``reference`` or that
    of the manifest if None. progress: takes each part of the work that begins. Raises InputError.
    """
    calibration.known_procedure(procedure)
    if isinstance(data, Mapping):
        files = {slot: [Path(file) for file in group] for slot, group in data.items()}
    else:
        files = {"data": [Path(data)] if isinstance(data, str | os.PathLike) else [Path(file) for file in data]}
    if procedure == "all":
        if options:
            raise InputError("the procedure all takes its options from the manifest")
        base, steps = calibration.asked_of_manifest(files.get("data", []), vehicle)
    else:
        base = find_vehicle(vehicle or "reference")
        texts = [f"{name}={value}" for name, value in (options or {}).items()]
        steps = [calibration.step_of(procedure, files, calibration.options_of(texts, procedure))]
    found = calibration.calibrate(steps, base, progress or (lambda _: None))
    return Calibration(base, [result for result, _ in found])


# --- discover -----------------------------------------------------------------------------------------------------


_CAUSE = ("name", "parameter", "value", "unit", "ci95_low", "ci95_high", "change", "energy_share", "varies")


@dataclass(frozen=True)
class Discovered(Tabular):
    """What rides show that the model of the vehicle does not. found: with the rides it was reached on."""

    report: Report
    vehicle: Vehicle
    found: Discovery

    def to_table(self) -> Columns:
        """A row for each cause that was named."""
        causes = [{**asdict(c), "ci95_low": c.ci95[0], "ci95_high": c.ci95[1]} for c in self.report.causes]
        return columns_of(causes, {name: name for name in _CAUSE})

    def __str__(self) -> str:
        return discovery_text(self.found, [])

    def write_model(self, file: PathLike) -> list[str]:
        """Write the extended vehicle file, if there is anything to extend it with; gives what was done, in words."""
        return discovery.write_extended(self.found, self.vehicle, Path(file))

    def write_report(self, file: PathLike) -> None:
        """Write the report as an HTML page. Raises InputError."""
        with writing(file):
            write_discovery_report(self.found, Path(file))


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
    known = _vehicle(vehicle)
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
