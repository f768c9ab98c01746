"""A recorded ride with all that its page shows: estimates, summary, ledger, path, temperatures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gz_onboard.constants import WH
from gz_onboard.estimator.load_model import Ledger
from gz_onboard.estimator.signals import FIX_2D
from gz_onboard.events import words
from gz_onboard.lab.estimate_ride import How, open_estimate, ride_through, vehicle_of
from gz_onboard.lab.estimate_summary import RideSummary, summary_of
from gz_onboard.lab.kept_rows import KeptRows
from gz_onboard.lab.logged import Logged
from gz_onboard.log_rows import ESTIMATE_TOPIC
from gz_onboard.offline.processes import Task
from gz_onboard.offline.samples import Samples, read_samples
from gz_onboard.offline.signal_table import SignalTable
from gz_onboard.progress import Progress
from gz_onboard.routes.route import read_route
from gz_onboard.vehicle import Vehicle

TEMPERATURES = ("motor_temperature", "inverter_temperature", "ambient_temperature")
"""Those that are measured beside the cells', whose are in the estimates."""
_APART = 10.0  # s: samples further apart have a hole between them

Position = tuple[float, float]
"""Latitude and longitude [deg]."""
Series = tuple[list[float], list[float]]
"""Times [s since the first frame] and values."""


@dataclass(frozen=True)
class ReportTask(Task):
    """A log of which a page is made."""

    route: Path | None = None
    located: bool = True  # whether the page says where the ride was


@dataclass(frozen=True)
class ReportedRide:
    """A ride. rows: its estimates, one a second; ledger: of the riding that the forecast learned from;
    path: the positions, a sequence between two holes each; temperatures: by role [degC].
    """

    name: str
    summary: RideSummary
    rows: Sequence[Logged]
    ledger: Ledger
    path: list[list[Position]]
    temperatures: dict[str, Series]

    @property
    def ledger_km(self) -> float:
        """The distance that the ledger is of, like the energy."""
        return self.summary.energy_distance_km or self.summary.distance_km

    def ledger_wh(self) -> dict[str, float]:
        """Where the energy went [Wh], the most first: by effect what the model says, and what it leaves. Negative:
        gained.

        ``beyond the model`` is what was measured more than modelled; ``not modelled`` what flowed while nothing was
        learned: charging, standing long, a sensor in doubt.
        """
        drawn, modelled = self.summary.energy_wh, self.ledger.modelled
        entries = {words(name): joule / WH for name, joule in modelled.items()}
        if entries:
            entries["beyond the model"] = (self.ledger.measured - sum(modelled.values())) / WH
        if entries and drawn is not None:
            entries["not modelled"] = drawn - self.ledger.measured / WH
        return dict(sorted(entries.items(), key=lambda entry: -entry[1]))


def read_report(task: ReportTask, progress: Progress | None = None) -> ReportedRide:
    """The ride in the log of `task`. Raises InputError."""
    return report_of(task.path, vehicle_of(task), task.route, task.located, progress)


def report_of(
    source: Path | SignalTable,
    vehicle: Vehicle,
    route: Path | None = None,
    located: bool = True,
    progress: Progress | None = None,
) -> ReportedRide:
    """Estimate a ride as the daemon would, and read what the estimates do not hold. Raises InputError."""
    road = read_route(route) if route else None
    log = KeptRows()
    ridden = ride_through(open_estimate(source, vehicle), How(route=road, ledger=True), log, progress)
    ledger = ridden.pipeline.estimator.forecaster.load.ledger or Ledger()
    samples = read_samples(source, vehicle)
    return ReportedRide(
        samples.name,
        summary_of(ridden),
        [dict(row) for row in log.of(ESTIMATE_TOPIC)],
        ledger,
        path_of(samples) if located else [],
        {role: _series(samples, role) for role in TEMPERATURES if role in samples.columns},
    )


def _series(samples: Samples, role: str) -> Series:
    """With a value that is no number in each hole, through which no line is drawn."""
    import numpy as np

    times, values = samples.columns[role]
    holes = np.flatnonzero(np.diff(times) > _APART) + 1
    return np.insert(times, holes, times[holes]).tolist(), np.insert(values, holes, np.nan).tolist()


def path_of(samples: Samples) -> list[list[Position]]:
    """Where the vehicle was, by a receiver with a fix; empty without one, and without two positions."""
    from gz_onboard.offline.arrays import held_at

    if not {"latitude", "longitude"} <= samples.columns.keys():
        return []
    times, latitude = samples.columns["latitude"]
    longitude = held_at(times, *samples.columns["longitude"])
    seen = times >= samples.columns["longitude"][0][0]
    if "gps_fix" in samples.columns:
        seen &= held_at(times, *samples.columns["gps_fix"]) >= FIX_2D
    runs: list[list[Position]] = []
    before = float("-inf")
    for time, *place in zip(times[seen].tolist(), latitude[seen].tolist(), longitude[seen].tolist(), strict=True):
        if time - before > _APART:
            runs.append([])
        runs[-1].append((place[0], place[1]))
        before = time
    return [run for run in runs if len(run) > 1]
