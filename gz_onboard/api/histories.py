"""Histories of rides, kept and read."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gz_onboard.api.given import PathLike, VehicleLike, vehicle_of
from gz_onboard.errors import InputError, brief
from gz_onboard.lab.history.add import AddedRides, HistoryTask, LogRides, keep, new_tasks, rides_in
from gz_onboard.lab.history.choice import Choice, default_file, period, read_rides
from gz_onboard.lab.history.ride import COLUMNS
from gz_onboard.lab.history.store import Store
from gz_onboard.lab.history.text import overview_text
from gz_onboard.lab.history.totals import Overview, overviews
from gz_onboard.offline.arguments import checked
from gz_onboard.offline.table import Columns, Tabular, array_of
from gz_onboard.recording.logs import logs_among
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class History(Tabular):
    """The rides of a history. vehicles: of each vehicle its rides, their totals, and what was learned."""

    file: Path
    vehicles: Sequence[Overview]

    __repr__ = brief

    def __str__(self) -> str:
        return "\n\n".join(overview_text(overview, every=False) for overview in self.vehicles)

    def to_table(self) -> Columns:
        """A row for each ride, with the columns that ``gz-onboard history show --table`` writes."""
        rides = [one for overview in self.vehicles for one in overview.rides]
        starts = [one.ride.start_ns if one.ride.dated else np.datetime64("NaT", "ns") for one in rides]
        head = {
            "number": np.array([one.number for one in rides], dtype=int),
            "start": np.array(starts, dtype="datetime64[ns]"),
        }
        return head | {name: array_of([getattr(one.ride, name) for one in rides]) for name in COLUMNS}


@checked
def add_to_history(
    logs: Iterable[PathLike], file: PathLike | None = None, vehicle: VehicleLike = "reference", *, name: str = ""
) -> AddedRides:
    """Keep the rides in logs, or in folders of them, each once; gives what was added, and what was not, and why.

    file: as of `read_history`. vehicle: of logs of raw frames. name: what the vehicle is called in the history, if not
    as its file says. Raises InputError for a history that cannot be written; a log that cannot be used stops no other.
    """
    paths = logs_among([Path(log) for log in logs], estimates=True)
    of = vehicle_of(vehicle)
    path = default_file() if file is None else Path(file)
    with Store(path, begin=True) as store:
        tasks, known, failed = new_tasks(list(dict.fromkeys(paths)), store.known_logs(), of.name, None, name, None)
        done = AddedRides(str(path), [], known, [], 0, failed)
        for _ in keep(store, ((task, _rides(task, of)) for task in tasks), done):
            pass  # what it says is for a terminal
    return done


def _rides(task: HistoryTask, vehicle: Vehicle) -> LogRides | InputError:
    try:
        return rides_in(task, lambda: vehicle)
    except InputError as error:
        return error


@checked
def read_history(
    file: PathLike | None = None,
    *,
    vehicle: str | None = None,
    rider: str | None = None,
    since: str | None = None,
    until: str | None = None,
) -> History:
    """The rides that ``gz-onboard history add`` has kept; those of a vehicle, a rider, or a time.

    file: where the command keeps them if not given. since, until: a year, month or day, such as ``2025-06``, which is
    included. Raises InputError.
    """
    begin = None if since is None else period(since, "since")
    end = None if until is None else period(until, "until")
    path = default_file() if file is None else Path(file)
    rides, _ = read_rides(path, Choice(vehicle, rider, begin, end))
    return History(path, overviews(rides))
