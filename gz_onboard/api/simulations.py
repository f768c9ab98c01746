"""Simulated rides."""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from gz_onboard.api.given import PathLike, VehicleLike, file_of
from gz_onboard.arguments import checked
from gz_onboard.errors import InputError
from gz_onboard.progress import Progress
from gz_onboard.reports.tables import Columns, Tabular, array_of
from gz_onboard.simulation.output import series_table
from gz_onboard.simulation.plan import SimulationOptions, find_plan, vehicle_on
from gz_onboard.simulation.run import Run
from gz_onboard.simulation.simulate import ride as simulate_plan
from gz_onboard.simulation.simulate import variant
from gz_onboard.simulation.summary import SimulationSummary, Variant, summarise, summary_text, variants_text
from gz_onboard.simulation.sweep import Sweep, grid, sweep_of
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
    known, payload_from = _vehicle_on(what, vehicle)
    plan = find_plan(os.fspath(what), options, known)
    run, scooter = simulate_plan(known, plan, options, progress)
    summary = summarise(known, plan, os.fspath(what), run, scooter)
    return SimulatedRide(replace(summary, payload_from=payload_from, wall_s=time.perf_counter() - begin), run)


@dataclass(frozen=True)
class Swept(Tabular):
    """A ride with other values of parameters. sweeps: the parameters with their units; variants: a ride of each value,
    or of each combination, of which the values of the last parameter change fastest.
    """

    what: str
    sweeps: Sequence[Sweep]
    variants: Sequence[Variant] = field(repr=False)

    def __str__(self) -> str:
        return variants_text(self.variants)

    def to_table(self) -> Columns:
        """A row for each variant: the parameters, what a kilometre takes, the range, time slower than wanted."""
        columns: dict[str, Sequence[object]] = {
            (one.name if one.unit == "1" else f"{one.name}[{one.unit}]"): [v.values[one.name] for v in self.variants]
            for one in self.sweeps
        }
        told: dict[str, Sequence[object]] = {
            "consumption[Wh/km]": [v.consumption_wh_km for v in self.variants],
            "range[km]": [v.range_km for v in self.variants],
            "shortfall[s]": [v.shortfall_s for v in self.variants],
        }
        return {name: array_of(values) for name, values in {**columns, **told}.items()}


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


def _vehicle_on(what: PathLike, vehicle: VehicleLike) -> tuple[Vehicle, str]:
    """(vehicle, source of its payload)."""
    if isinstance(vehicle, Vehicle):
        return vehicle, "the vehicle given"
    return vehicle_on(os.fspath(what), file_of(vehicle))
