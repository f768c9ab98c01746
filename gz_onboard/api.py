"""The Python API: ``import gz_onboard as gz``. Each function does what the command of its name does, without printing.

Results are dataclasses; those with a table have ``to_table()`` (a dict of numpy arrays), ``to_arrow()`` and
``to_pandas()``. A mistake of the user raises `InputError`. Examples: docs/how-to/python.md.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np

from gz_onboard import priors
from gz_onboard import state as state_files
from gz_onboard import vehicle as vehicle_files
from gz_onboard.arguments import checked, within
from gz_onboard.calibration import report as calibration_report
from gz_onboard.calibration import steps as calibration
from gz_onboard.calibration.result import Result
from gz_onboard.calibration.vehicle_file import vehicle_output
from gz_onboard.daemon import learned
from gz_onboard.discovery import baseline as baselines
from gz_onboard.discovery import report as discovery_report
from gz_onboard.discovery import run as discovery
from gz_onboard.discovery.command import DiscoveryOptions, find_logs
from gz_onboard.discovery.extend import write_model
from gz_onboard.discovery.judgement import Discovery, Report
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.errors import InputError, brief, not_an_input, writing
from gz_onboard.estimation import summary as summaries
from gz_onboard.estimation.report import ReportedRide, check_page, page_of, report_of, section_of
from gz_onboard.estimation.ride import MemoryLog, RideOptions, open_estimate, run_ride, state_for
from gz_onboard.estimation.saved_state import locked, save_state
from gz_onboard.estimation.summary import RideSummary
from gz_onboard.estimator.pack_age import LearnedFactor
from gz_onboard.events import Frame
from gz_onboard.export.contents import FRAME, ExportSource, LoggedMessage, LoggedSignals, frame_columns
from gz_onboard.log_rows import CHANGE_TOPIC, ESTIMATE_TOPIC, ESTIMATE_UNITS, TEXTS, WHY_TOPIC
from gz_onboard.options import LONGEST_LOG, MOST_PAYLOAD
from gz_onboard.progress import Progress
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.logs import logs_among
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.recording.recording import Recording, facts_of, read_recording, ride_name
from gz_onboard.recording.tables import SignalTable, table_of
from gz_onboard.reports.results import descriptions, distinct_names
from gz_onboard.reports.tables import Columns, Tabular, array_of, columns_of, table_columns, time_array
from gz_onboard.routes.route import read_route
from gz_onboard.simulation.output import series_table
from gz_onboard.simulation.plan import SimulationOptions, find_plan, vehicle_on
from gz_onboard.simulation.run import Run
from gz_onboard.simulation.simulate import ride as simulate_plan
from gz_onboard.simulation.simulate import variant
from gz_onboard.simulation.summary import SimulationSummary, Variant, summarise, summary_text, variants_text
from gz_onboard.simulation.sweep import Sweep, grid, sweep_of
from gz_onboard.validation.comparison import ValidatedRide
from gz_onboard.validation.report import markdown, ride_text
from gz_onboard.validation.ride import compare_ride
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.check import Checked, RoleSeen, check_log, check_text
from gz_onboard.vehicle_check.command import roles_text
from gz_onboard.vehicle_check.finding import Feature, Finding, Looks, features_of

__all__ = [
    "Baseline",
    "Calibration",
    "CheckedVehicle",
    "Discovered",
    "DiscoveryOptions",
    "EstimatedRide",
    "InputError",
    "LearnedState",
    "LoggedEstimates",
    "LoggedFrames",
    "LoggedMessage",
    "LoggedSignals",
    "Recording",
    "Reported",
    "SimulatedRide",
    "SimulationOptions",
    "Swept",
    "Validated",
    "Vehicle",
    "baseline",
    "calibrate",
    "check_vehicle",
    "discover",
    "estimate",
    "read_estimates",
    "read_frames",
    "read_learned",
    "read_ride",
    "read_signals",
    "read_vehicle",
    "report",
    "simulate",
    "summary_table",
    "sweep",
    "validate",
]

PathLike: TypeAlias = str | os.PathLike[str]


class ArrowTable(Protocol):
    """A table of pandas, polars, pyarrow or any other library that speaks Arrow."""

    def __arrow_c_stream__(self, requested_schema: object | None = None) -> object:
        """See the Arrow PyCapsule interface."""


Signals: TypeAlias = Mapping[str, Any] | ArrowTable
"""A ride as a table of signals: a time column, and one for each role with its unit, such as ``speed [km/h]``."""
VehicleLike: TypeAlias = Vehicle | PathLike
"""A vehicle, or the name of a built-in one, or a vehicle file."""
Rides: TypeAlias = PathLike | Signals | Recording | Sequence[PathLike | Signals | Recording]
"""Logs, folders of logs, tables of signals, or what `read_ride` gave."""


# --- what the functions are given -----------------------------------------------------------------------------------


def _source(data: PathLike | Signals, name: str = "table") -> Path | SignalTable:
    return Path(data) if isinstance(data, str | os.PathLike) else table_of(data, name)


def _file(name: PathLike) -> str | Path:
    return name if isinstance(name, str) else Path(name)


def _vehicle(given: VehicleLike) -> Vehicle:
    return given if isinstance(given, Vehicle) else read_vehicle(given)


def _vehicle_on(what: PathLike, vehicle: VehicleLike) -> tuple[Vehicle, str]:
    """Return the vehicle and the source of its payload: ``rides.json`` next to a log if `vehicle` is a name or file."""
    if isinstance(vehicle, Vehicle):
        return vehicle, "the vehicle given"
    return vehicle_on(os.fspath(what), _file(vehicle))


def _paths(given: PathLike | Iterable[PathLike]) -> list[Path]:
    return [Path(given)] if isinstance(given, str | os.PathLike) else [Path(one) for one in given]


def _some(logs: list[Path]) -> list[Path]:
    if not logs:
        raise InputError("no ride is given")
    return logs


def _table(rows: Sequence[Mapping[str, object]], *names: str) -> Columns:
    return columns_of(rows, {name: name for name in names})


@checked
def read_vehicle(name: PathLike, payload: float | None = None, effects_folder: PathLike | None = None) -> Vehicle:
    """Read the vehicle of a name or file, with the mass of rider and luggage [kg] if it is known.

    effects_folder: with effects of your own, Python code you trust. Raises InputError.
    """
    if payload is not None:
        within("payload", payload, {"payload": (0.0, MOST_PAYLOAD, "kg")})
    folder = None if effects_folder is None else Path(effects_folder)
    vehicle = vehicle_files.read_vehicle(_file(name), payload, folder)
    priors.correlations(vehicle)
    return vehicle


@checked
def read_ride(
    source: PathLike | Signals,
    vehicle: VehicleLike = "reference",
    *,
    name: str | None = None,
    facts: Mapping[str, object] | None = None,
) -> Recording:
    """Read a ride as columns by role, in SI units, from a log or a table of signals.

    name: of the ride; that of the log if not given. facts: known in addition to its signals, such as
    ``{"rider_mass_kg": 85.0}``; they replace those of a ``rides.json`` next to the log. Raises InputError.
    """
    ride = read_recording(_source(source, name or "table"), _vehicle(vehicle))
    return replace(ride, name=name or ride.name, facts={**ride.facts, **(facts or {})})


# --- estimate -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LoggedEstimates(Tabular):
    """The estimates in a log. columns: of each field of the `rows` the column; times: [ns since the epoch]."""

    columns: Mapping[str, str]
    times: Sequence[int]
    rows: Sequence[Mapping[str, object]]

    __repr__ = brief

    def to_table(self) -> Columns:
        """Return a row for each estimate, with the columns that ``gz-onboard export --estimates`` writes."""
        return {"time": time_array(self.times), **columns_of(self.rows, self.columns)}


@dataclass(frozen=True)
class EstimatedRide(Tabular):
    """The estimates of a ride. whys: why the range is what it is, changes: why it changed, a row each."""

    summary: RideSummary
    estimates: LoggedEstimates = field(repr=False)
    whys: Sequence[Mapping[str, object]] = field(repr=False)
    changes: Sequence[Mapping[str, object]] = field(repr=False)

    def __str__(self) -> str:
        return summaries.summary_text(self.summary)

    def to_table(self) -> Columns:
        """Return a row each second, with the columns that ``gz-onboard export --estimates`` writes."""
        return self.estimates.to_table()


@checked
def estimate(
    source: PathLike | Signals,
    vehicle: VehicleLike = "reference",
    *,
    route: PathLike | None = None,
    filter_name: Literal["scalar", "filterpy"] = "scalar",
    state: PathLike | None = None,
    progress: Progress | None = None,
) -> EstimatedRide:
    """Estimate state of charge and range over a log or a table of signals, as the daemon would.

    route: file of the road that is to be ridden. filter_name: scalar or filterpy. state: file of a saved state, to
    continue from if there is one and to save after the ride; saved before the ride began. progress: takes numbers of
    frames. Raises InputError.
    """
    given, log = _source(source), MemoryLog()
    ride = open_estimate(given, _vehicle(vehicle))
    options = RideOptions(filter_name, route=None if route is None else read_route(Path(route)))
    if state is None:
        run = run_ride(ride, options, log, progress)
    else:
        file, facts = Path(state), facts_of(given) if isinstance(given, Path) else {}
        not_an_input(state_files.copies(file), [given] if isinstance(given, Path) else [])
        with locked(file):
            run = run_ride(ride, replace(options, state=state_for(file, ride, facts)), log, progress)
            save_state(file, run.pipeline)
    times = [time_ns for time_ns, _ in log.rows[ESTIMATE_TOPIC]]
    columns = table_columns({**ESTIMATE_UNITS, **dict.fromkeys(TEXTS, "")})
    estimates = LoggedEstimates(columns, times, log.values(ESTIMATE_TOPIC))
    return EstimatedRide(summaries.summary_of(run), estimates, log.values(WHY_TOPIC), log.values(CHANGE_TOPIC))


@checked
def summary_table(rides: Iterable[EstimatedRide]) -> Columns:
    """Return the summaries of rides, a row each, with the columns that ``gz-onboard estimate --table`` writes."""
    table = summaries.summary_table([ride.summary for ride in rides])
    return {name: array_of(column) for name, column in table.items()}


@checked
def read_estimates(log: PathLike) -> LoggedEstimates:
    """Read the estimates that the daemon or ``gz-onboard estimate`` wrote into a log. InputError if it has none."""
    source = ExportSource(Path(log))
    times, rows = zip(*source.estimates(), strict=True)
    return LoggedEstimates(source.columns_of(ESTIMATE_TOPIC), times, rows)


# --- export ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LoggedFrames(Tabular):
    """The frames in a log. damages: what of it could not be read."""

    frames: Sequence[Frame]
    damages: Sequence[LogDamage]

    __repr__ = brief

    def to_table(self) -> Columns:
        """Return a row for each frame, with the columns that ``gz-onboard export --frames`` writes."""
        columns = frame_columns(FrameColumns.of(self.frames))
        kinds: dict[type, Any] = {int: np.int64, bool: bool, str: object}
        arrays = {name: np.array(column, kinds[FRAME[name]]) for name, column in columns.items()}
        return {"time": time_array([frame[0] for frame in self.frames]), **arrays}


@checked
def read_frames(log: PathLike, *, start: float = 0.0, end: float | None = None) -> LoggedFrames:
    """Read the frames in a log. start, end: only those in this part of it [s from its beginning]. Raises InputError."""
    source = _part(log, start, end)
    return LoggedFrames(source.frames().tuples(), source.damages)


@checked
def read_signals(
    log: PathLike,
    vehicle: VehicleLike | None = None,
    *,
    dbc: Sequence[PathLike] = (),
    columns: Sequence[str] | None = None,
    start: float = 0.0,
    end: float | None = None,
) -> LoggedSignals:
    """Read the signals in a log, in the units of the DBC files that decode it.

    These are `dbc`, else those of `vehicle`, else those attached to the log. columns: only these signals, with or
    without their units. start, end: see `read_frames`. Raises InputError.
    """
    if dbc and vehicle is not None:
        raise InputError("dbc: a vehicle has DBC files of its own; give one of the two")
    source = _part(log, start, end, columns)
    return source.signals(_paths(dbc), None if vehicle is None else _vehicle(vehicle))


def _part(log: PathLike, start: float, end: float | None, columns: Sequence[str] | None = None) -> ExportSource:
    within("start", start, {"start": (0.0, LONGEST_LOG, "s")})
    if end is not None and not end > start:
        raise InputError(f"end {end:g} s: must be after start {start:g} s")
    return ExportSource(Path(log), start, None if end is None else min(end, LONGEST_LOG), columns)


# --- learned --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LearnedState(Tabular):
    """The contents of a saved state, as factors on the values of the vehicle file.

    age_s: age of the state by this machine's clock, if known; battery: by name; riders: by rider, then by name. The
    last rider comes first; "" stands for rides without a known rider.
    """

    vehicle: str
    age_s: float | None
    battery: Mapping[str, LearnedFactor]
    riders: Mapping[str, Mapping[str, LearnedFactor]]

    __repr__ = brief

    def __str__(self) -> str:
        return learned.learned_text(self.battery, self.riders)

    def to_table(self) -> Columns:
        """Return a row for each factor. part: ``battery``, or ``rider`` and the rider's name."""
        factors = [("battery", self.battery), *((f"rider {who}".strip(), of) for who, of in self.riders.items())]
        rows: list[dict[str, object]] = [
            {"part": part, "name": name, "factor": x.value, "sd": x.sd, "percent_learned": 100 * x.share}
            for part, found in factors
            for name, x in found.items()
        ]
        return _table(rows, "part", "name", "factor", "sd", "percent_learned")


@checked
def read_learned(file: PathLike | None = None, vehicle: VehicleLike = "reference") -> LearnedState:
    """Read what the daemon has learned of `vehicle` from the state `file` that it saves.

    file: the service's if not given. InputError if there is none, or if it is damaged or of another vehicle.
    """
    known = _vehicle(vehicle)
    path = state_files.state_file(learned.STATE_FOLDER, known.name) if file is None else Path(file)
    estimator, age = learned.read_state(path, known)
    return LearnedState(known.name, age, learned.battery_learned(estimator), learned.riders_learned(estimator))


# --- report ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reported(Tabular):
    """Rides with the contents of their page. rides: summary, estimates, path, temperatures and `ledger_wh` of each."""

    rides: Sequence[ReportedRide] = field(repr=False)
    read: Sequence[Path] = field(repr=False, default=())  # files, which are not written over

    def __str__(self) -> str:
        return "\n".join(summaries.summary_text(ride.summary) for ride in self.rides)

    def to_table(self) -> Columns:
        """Return where the energy went: a row for each ride and entry of its ledger."""
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

    rides: logs, or folders of logs. route: file of the road that was to be ridden. located: whether the page shows
    where the rides were. progress: takes numbers of frames. InputError for a ride that cannot be used, or for none.
    """
    known, logs = _vehicle(vehicle), _some(logs_among(_paths(rides)))
    road = None if route is None else Path(route)
    found = [report_of(log, known, road, located, progress) for log in logs]
    return Reported(found, [known.file, *logs, *([] if road is None else [road])])


# --- simulate -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SimulatedRide(Tabular):
    """A simulated ride: its summary, and the run with its time series and ledger."""

    summary: SimulationSummary
    run: Run = field(repr=False)

    def __str__(self) -> str:
        return summary_text(self.summary)

    def to_table(self) -> Columns:
        """Return the time series, a row each tenth of a second, with the columns of ``gz-onboard simulate``."""
        return dict(series_table(self.run))


@checked
def simulate(
    what: PathLike,
    vehicle: VehicleLike = "reference",
    options: SimulationOptions | None = None,
    progress: Progress | None = None,
) -> SimulatedRide:
    """Ride a built-in drive cycle, the file of a cycle or a route, or the log of a recorded ride.

    vehicle: of one given by name or file, the payload of a recorded ride is that of ``rides.json`` next to its log.
    progress: takes the seconds ridden. Raises InputError.
    """
    begin = time.perf_counter()
    options = options or SimulationOptions()
    known, payload_from = _vehicle_on(what, vehicle)
    plan = find_plan(os.fspath(what), options, known)
    run, scooter = simulate_plan(known, plan, options, progress)
    summary = summarise(known, plan, os.fspath(what), run, scooter)
    return SimulatedRide(replace(summary, payload_from=payload_from, wall_s=time.perf_counter() - begin), run)


@dataclass(frozen=True)
class Swept(Tabular):
    """A ride with other values of parameters.

    sweeps: the parameters with their units. variants: a ride of each value or combination, of which the values of the
    last parameter change fastest.
    """

    what: str
    sweeps: Sequence[Sweep]
    variants: Sequence[Variant] = field(repr=False)

    def __str__(self) -> str:
        return variants_text(self.variants)

    def to_table(self) -> Columns:
        """Return a row for each variant: the parameters, consumption, range, time slower than wanted."""
        columns: dict[str, Sequence[object]] = {
            (one.name if one.unit == "1" else f"{one.name}[{one.unit}]"): [v.values[one.name] for v in self.variants]
            for one in self.sweeps
        }
        results: dict[str, Sequence[object]] = {
            "consumption[Wh/km]": [v.consumption_wh_km for v in self.variants],
            "range[km]": [v.range_km for v in self.variants],
            "shortfall[s]": [v.shortfall_s for v in self.variants],
        }
        return {name: array_of(values) for name, values in {**columns, **results}.items()}


@checked
def sweep(
    what: PathLike,
    parameters: Mapping[str, Iterable[float]],
    vehicle: VehicleLike = "reference",
    options: SimulationOptions | None = None,
    progress: Progress | None = None,
) -> Swept:
    """Ride what `simulate` rides with each combination of values of `parameters`.

    parameters: by name, such as ``{"drag_area": [0.4, 0.5, 0.6]}``; ``battery.cells_parallel`` and
    ``battery.cells_series`` are numbers of cells, which change mass and heat capacity too. progress: takes the seconds
    ridden. Raises InputError.
    """
    options = options or SimulationOptions()
    known, _ = _vehicle_on(what, vehicle)
    sweeps = [sweep_of(name, list(values), known, f"parameters[{name!r}]") for name, values in parameters.items()]
    if not sweeps or not all(one.values for one in sweeps):
        raise InputError("parameters: name at least one, each with at least one value")
    if len({one.name for one in sweeps}) < len(sweeps):
        raise InputError(f"parameters: {', '.join(parameters)}: two of them are the same")
    plan = find_plan(os.fspath(what), options, known)
    return Swept(os.fspath(what), sweeps, [variant(known, one, plan, options, progress) for one in grid(sweeps)])


# --- validate -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Validated(Tabular):
    """Rides compared with their simulation. rides: of each what ``gz-onboard validate --json`` writes."""

    rides: Sequence[ValidatedRide] = field(repr=False)

    def __str__(self) -> str:
        return "\n".join(map(ride_text, self.rides))

    @property
    def passed(self) -> bool:
        """Whether every ride did."""
        return all(ride.passed for ride in self.rides)

    def to_table(self) -> Columns:
        """Return a row for each ride, form (open_loop, predictive, components) and channel."""
        rows = [
            {"ride": ride.name, "form": form, "channel": channel, **asdict(errors)}
            for ride in self.rides
            for form, verdict in ride.verdicts.items()
            for channel, errors in verdict.channels.items()
        ]
        errors = ("unit", "percent", "limit_percent", "passed", "rms", "max", "mean_error", "of_spread")
        return _table(rows, "ride", "form", "channel", *errors)

    def markdown(self) -> str:
        """Return the tables that ``gz-onboard validate --markdown`` writes."""
        return markdown(self.rides)


@checked
def validate(
    rides: PathLike | Sequence[PathLike], vehicle: VehicleLike = "reference", progress: Progress | None = None
) -> Validated:
    """Compare rides with their simulation: open loop, with the rider model, and each component alone.

    rides: logs, or folders of logs. vehicle: of one given by name or file, the payload is that of ``rides.json`` next
    to the log. progress: takes 1 for each ride. InputError for a ride that cannot be judged, or for none.
    """
    logs = _some(logs_among(_paths(rides)))
    found: list[ValidatedRide] = []
    for log in logs:
        found.append(compare_ride(log, _vehicle_on(log, vehicle)[0]).result)
        if progress:
            progress(1)
    return Validated(found)


# --- vehicle check --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CheckedVehicle(Tabular):
    """Logs compared with a vehicle file.

    features: what the file is enough for, whatever the logs hold. logs: of each the source of each role, the findings,
    and the features for which something is missing.
    """

    vehicle: Vehicle
    features: Sequence[Feature]
    logs: Sequence[Checked]

    __repr__ = brief

    def __str__(self) -> str:
        return "\n".join(map(check_text, self.logs)) if self.logs else roles_text(self.vehicle)

    @property
    def wrong(self) -> list[Finding]:
        """Everything that looks wrong, of all logs."""
        return [finding for log in self.logs for finding in log.those(Looks.WRONG)]

    def to_table(self) -> Columns:
        """Return a row for each log and role."""
        rows = [{"file": log.file, **asdict(role)} for log in self.logs for role in log.roles]
        return _table(rows, "file", *descriptions(RoleSeen))


@checked
def check_vehicle(
    vehicle: VehicleLike,
    logs: PathLike | Sequence[PathLike] = (),
    *,
    quick: bool = False,
    progress: Progress | None = None,
) -> CheckedVehicle:
    """Check whether a vehicle file fits logs: the source of each role, what looks wrong, what is missing for what.

    logs: also folders of logs. quick: without the run through the daemon's pipeline, which takes most of the time.
    progress: takes numbers of frames. InputError for a log that cannot be used.
    """
    known = _vehicle(vehicle)
    found = [check_log(log, known, progress, quick) for log in logs_among(_paths(logs))]
    return CheckedVehicle(known, features_of({source.role for source in known.mapping.sources}), found)


# --- calibrate ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Calibration(Tabular):
    """The results of calibration procedures. base: the vehicle file that they started from."""

    base: Path
    results: Sequence[Result] = field(repr=False)
    read: Sequence[Path] = field(repr=False, default=())  # files, which are not written over

    def __str__(self) -> str:
        return "\n".join(map(calibration_report.text, self.results))

    def to_table(self) -> Columns:
        """Return a row for each parameter: procedure, parameter, value, sd, unit, source."""
        rows = [
            {"procedure": result.procedure, "parameter": name, **asdict(found)}
            for result in self.results
            for name, found in result.parameters.items()
        ]
        return _table(rows, "procedure", "parameter", "value", "sd", "unit", "source")

    @checked
    def write(self, file: PathLike) -> Vehicle:
        """Write the vehicle file with the results, and return the vehicle in it. Raises InputError."""
        vehicle_output(Path(file), [self.base, *self.read])
        with writing(file):
            return calibration.write_calibration(self.base, self.results, Path(file))

    @checked
    def write_report(self, file: PathLike) -> None:
        """Write the report as an HTML page. Raises InputError."""
        not_an_input([Path(file)], [self.base, *self.read])
        title = f"Calibration of {read_vehicle(self.base).name}"
        with writing(file):
            calibration_report.write_report(Path(file), title, self.results)


@checked
def calibrate(
    data: PathLike | Iterable[PathLike] | Mapping[str, Sequence[PathLike]],
    vehicle: PathLike | None = None,
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
    slots = data if isinstance(data, Mapping) else {"data": _paths(data)}
    files = {slot: _paths(group) for slot, group in slots.items()}
    texts = [f"{name}={value}" for name, value in (options or {}).items()]
    base, steps = calibration.requested(procedure, files, texts, None if vehicle is None else _file(vehicle))
    found = calibration.run_steps(steps, base, progress or (lambda _: None))
    return Calibration(base, list(found), calibration.files_of(steps, files.get("data", [])))


# --- discover -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Discovered(Tabular):
    """The errors of a vehicle's model that rides show. found: with the rides that show them."""

    report: Report
    vehicle: Vehicle
    found: Discovery
    read: Sequence[Path] = ()  # files, which are not written over

    __repr__ = brief

    def to_table(self) -> Columns:
        """Return a row for each cause that was named."""
        causes = [{**asdict(c), "ci95_low": c.ci95[0], "ci95_high": c.ci95[1]} for c in self.report.causes]
        numbers = ("value", "unit", "ci95_low", "ci95_high", "change", "energy_share", "varies")
        return _table(causes, "name", "parameter", *numbers)

    def __str__(self) -> str:
        return discovery_report.summary(self.found, [])

    @checked
    def write_model(self, file: PathLike) -> list[str]:
        """Write the extended vehicle file, if there is anything to extend it with; return what was done, in words.

        Raises InputError.
        """
        vehicle_output(Path(file), self.read)
        return write_model(self.found, self.vehicle, Path(file))

    @checked
    def write_report(self, file: PathLike) -> None:
        """Write the report as an HTML page. Raises InputError."""
        not_an_input([Path(file)], self.read)
        with writing(file):
            discovery_report.write_report(self.found, Path(file))


@checked
def discover(
    rides: Rides,
    vehicle: VehicleLike = "reference",
    options: DiscoveryOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> Discovered:
    """Find what the model of `vehicle` gets wrong on `rides`, and name the cause.

    rides: logs, folders of logs, tables of signals, or what `read_ride` gave. vehicle: also the one of a `Baseline`.
    progress: takes the step that begins. InputError for a ride that cannot be used, or for none.
    """
    known, options = _vehicle(vehicle), options or DiscoveryOptions()
    recordings, logs = _recordings(rides, known)
    effects = None if options.effects is None else Path(options.effects)
    shared = effects, progress or (lambda _: None), options.jobs
    found = discovery.discover(known, recordings, options.seed, *shared, options.holdout or ())
    return Discovered(found.report, known, found, [known.file, *logs])


@dataclass(frozen=True)
class Baseline(Tabular):
    """A vehicle as healthy rides show it, to be given to `discover`. before: as its file says.

    note: how well the rides predict each other, and which were left out.
    """

    vehicle: Vehicle
    before: Vehicle
    note: str
    read: Sequence[Path] = field(repr=False, default=())  # files, which are not written over

    __repr__ = brief

    def __str__(self) -> str:
        return self.note

    def to_table(self) -> Columns:
        """Return a row for each parameter that was refitted: value and standard deviation, before and after."""
        known, new = self.before.parameters.known, self.vehicle.parameters.known
        rows = [
            {"parameter": name, "unit": x.unit, "value": x.value, "sd": x.sd}
            | {"value_before": known[name].value, "sd_before": known[name].sd}
            for name, x in new.items()
            if x != known[name]
        ]
        return _table(rows, "parameter", "unit", "value_before", "sd_before", "value", "sd")

    @checked
    def write(self, file: PathLike) -> Vehicle:
        """Write the vehicle file and the healthy rides next to it; return the vehicle in it. Raises InputError."""
        vehicle_output(Path(file), self.read)
        with writing(file):
            baselines.write_baseline(self.vehicle, self.before.file, Path(file))
        return read_vehicle(Path(file))


@checked
def baseline(
    rides: Rides,
    vehicle: VehicleLike = "reference",
    options: DiscoveryOptions | None = None,
    progress: Callable[[str], None] | None = None,
) -> Baseline:
    """Learn from three or more `rides` of the healthy vehicle its parameters, and how its rides differ.

    Of the options, `effects` and `jobs` count. InputError for rides that cannot be used, or contradict the vehicle's
    file.
    """
    known, options = _vehicle(vehicle), options or DiscoveryOptions()
    recordings, logs = _recordings(rides, known)
    effects = None if options.effects is None else Path(options.effects)
    found = baselines.baseline(known, recordings, effects, progress or (lambda _: None), options.jobs)
    assert isinstance(found.healthy, MixedModel)
    return Baseline(found, known, found.healthy.checked, [known.file, *logs])


def _recordings(rides: Rides, known: Vehicle) -> tuple[list[Recording], list[Path]]:
    """Read rides, each under another name; return them, and the logs among them."""
    several = [rides] if isinstance(rides, str | os.PathLike | Recording | Mapping) else rides
    several = several if isinstance(several, Sequence) else [several]
    given = [
        (f"table {i}", log)
        for i, ride in enumerate(several, 1)
        for log in (find_logs([Path(ride)]) if isinstance(ride, str | os.PathLike) else [ride])
    ]
    logs = [ride for _, ride in given if isinstance(ride, Path)]
    names = iter(distinct_names(logs, [ride_name(log) for log in logs]))
    found: list[Recording] = []
    for name, ride in given:
        if isinstance(ride, Path):
            found.append(replace(read_recording(ride, known), name=next(names)))
        else:
            found.append(ride if isinstance(ride, Recording) else read_ride(ride, known, name=name))
    called = [ride.name for ride in found]
    if twice := sorted({name for name in called if called.count(name) > 1}):
        raise InputError(f"two rides are called {twice[0]}: rides are told apart by their names; rename one")
    return found, logs
