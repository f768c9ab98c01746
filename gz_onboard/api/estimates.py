"""Estimates, made and read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from gz_onboard import state as saved_state
from gz_onboard.api.given import PathLike, Signals, VehicleLike, source_of, vehicle_of
from gz_onboard.arguments import checked
from gz_onboard.errors import brief, not_an_input, writing
from gz_onboard.estimation import summary
from gz_onboard.estimation.ride import MemoryLog, RideOptions, RideRun, open_estimate, run_ride, state_for
from gz_onboard.estimation.saved_state import held, text_of
from gz_onboard.estimation.summary import RideSummary, summary_of, summary_text
from gz_onboard.export.contents import ExportSource
from gz_onboard.log_rows import CHANGE_TOPIC, ESTIMATE_TOPIC, ESTIMATE_UNITS, TEXTS, WHY_TOPIC, Log
from gz_onboard.progress import Progress
from gz_onboard.recording.tables import SignalTable
from gz_onboard.reports.tables import Columns, Tabular, array_of, columns_of, table_columns
from gz_onboard.routes.route import read_route
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class LoggedEstimates(Tabular):
    """The estimates in a log. columns: of each field of the `rows` the column; times: [ns since the epoch]."""

    columns: Mapping[str, str]
    times: Sequence[int]
    rows: Sequence[Mapping[str, object]]

    __repr__ = brief

    def to_table(self) -> Columns:
        """A row for each estimate, with the columns that ``gz-onboard export --estimates`` writes."""
        return {"time": np.array(self.times, dtype="datetime64[ns]"), **columns_of(self.rows, self.columns)}


@dataclass(frozen=True)
class EstimatedRide(Tabular):
    """The estimates of a ride. whys: of why the range is what it is, changes: of why it changed, a row each."""

    summary: RideSummary
    estimates: LoggedEstimates = field(repr=False)
    whys: Sequence[Mapping[str, object]] = field(repr=False)
    changes: Sequence[Mapping[str, object]] = field(repr=False)

    def __str__(self) -> str:
        return summary_text(self.summary)

    def to_table(self) -> Columns:
        """A row each second, with the columns that ``gz-onboard export --estimates`` writes."""
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

    route: file of the road that is to be ridden. filter_name: scalar or filterpy. state: file of a saved state to go
    on from, if there is one, and to save after the ride; it must have been saved before the ride began. progress: takes
    numbers of frames. Raises InputError.
    """
    road = None if route is None else read_route(Path(route))
    how, log = RideOptions(filter_name, route=road), MemoryLog()
    given, known = source_of(source), vehicle_of(vehicle)
    if state is None:
        ridden = run_ride(open_estimate(given, known), how, log, progress)
    else:
        ridden = _going_on(given, known, Path(state), how, log, progress)
    times = [time_ns for time_ns, _ in log.rows[ESTIMATE_TOPIC]]
    columns = table_columns({**ESTIMATE_UNITS, **dict.fromkeys(TEXTS, "")})
    estimates = LoggedEstimates(columns, times, log.values(ESTIMATE_TOPIC))
    return EstimatedRide(summary_of(ridden), estimates, log.values(WHY_TOPIC), log.values(CHANGE_TOPIC))


def _going_on(
    source: Path | SignalTable, vehicle: Vehicle, file: Path, how: RideOptions, log: Log, progress: Progress | None
) -> RideRun:
    """The ride, resumed from the saved state `file`, which is saved after it."""
    not_an_input(saved_state.copies(file), [source] if isinstance(source, Path) else [])
    with held(file):
        at = state_for(file, source, vehicle)
        at.check_date(source if isinstance(source, Path) else source.name)
        ridden = run_ride(open_estimate(source, vehicle), replace(how, state=at), log, progress)
        if text := text_of(ridden.pipeline):
            with writing(file):
                saved_state.write(file, text)
    return ridden


@checked
def summary_table(rides: Iterable[EstimatedRide]) -> Columns:
    """The summaries of rides, a row each, with the columns that ``gz-onboard estimate --table`` writes."""
    table = summary.summary_table([ride.summary for ride in rides])
    return {name: array_of(column) for name, column in table.items()}


@checked
def read_estimates(log: PathLike) -> LoggedEstimates:
    """The estimates that the daemon or ``gz-onboard estimate`` wrote into an MCAP log. InputError if it has none."""
    source = ExportSource(Path(log))
    rows = source.estimates()
    return LoggedEstimates(
        source.columns_of(ESTIMATE_TOPIC), [time_ns for time_ns, _ in rows], [values for _, values in rows]
    )
