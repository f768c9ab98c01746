"""Simulated rides."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field, replace

from gz_onboard.api.given import PathLike, VehicleLike, file_of
from gz_onboard.offline.arguments import checked
from gz_onboard.offline.table import Columns, Tabular
from gz_onboard.progress import Progress
from gz_onboard.simulation.output import series_table
from gz_onboard.simulation.plan import SimulationOptions, find_plan, vehicle_on
from gz_onboard.simulation.run import Run
from gz_onboard.simulation.simulate import ride as simulate_plan
from gz_onboard.simulation.summary import SimulationSummary, summarise, summary_text
from gz_onboard.vehicle import Vehicle


@dataclass(frozen=True)
class SimulatedRide(Tabular):
    """A simulated ride: its summary, and the run with its time series and ledger."""

    summary: SimulationSummary
    run: Run = field(repr=False)

    def __str__(self) -> str:
        return summary_text(self.summary)

    def to_table(self) -> Columns:
        """The time series, a row each tenth of a second, with the columns that ``gz-onboard simulate`` writes."""
        return dict(series_table(self.run))


@checked
def simulate(
    what: PathLike,
    vehicle: VehicleLike = "reference",
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
        (vehicle, "the vehicle given")
        if isinstance(vehicle, Vehicle)
        else vehicle_on(os.fspath(what), file_of(vehicle))
    )
    plan = find_plan(os.fspath(what), options, known)
    run, scooter = simulate_plan(known, plan, options, progress)
    summary = summarise(known, plan, os.fspath(what), run, scooter)
    return SimulatedRide(replace(summary, payload_from=payload_from, wall_s=time.perf_counter() - begin), run)
