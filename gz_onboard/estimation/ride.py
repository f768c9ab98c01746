"""Run a recorded ride through the daemon's pipeline, without a bus and as fast as the computer allows."""

from __future__ import annotations

import functools
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np

from gz_onboard.can.codec import LONGEST_PAUSE_NS, Codec
from gz_onboard.can.publisher import KNOWN, Publisher
from gz_onboard.errors import InputError
from gz_onboard.estimation.saved_state import Resumed, RideState, resume
from gz_onboard.estimator.consumption import CONSUMPTION
from gz_onboard.estimator.load_model import Ledger
from gz_onboard.events import Estimate, Reason, RouteState, State
from gz_onboard.log_rows import STATUS_TOPIC, Log, reason_names
from gz_onboard.pipeline import Pipeline, range_publisher
from gz_onboard.processes import Task
from gz_onboard.progress import Progress
from gz_onboard.recording.decode import decode_columns, feed
from gz_onboard.recording.frames import FrameColumns, SignalColumns, on_timeline
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.recording.recording import check_ridden, of_ride, open_ride
from gz_onboard.recording.tables import SignalTable
from gz_onboard.reports.results import FIRST_DATE_NS
from gz_onboard.routes.route import Route
from gz_onboard.vehicle import Vehicle, read_vehicle

IDENTIFICATION_S = 60.0  # from the first frame, within which a signal may say which vehicle it is
PAUSE_S = 30.0  # without frames: after it the recording was stopped, and the time does not count as ridden
MAX_HOLD_S = 1.0  # for which a measured current is held


@dataclass(frozen=True)
class OpenRide:
    """A ride to be estimated.

    source: its log, or the name of its table. vehicle: with the mapping that decodes the ride. frames: without range
    frames of an earlier run; of a table its values.
    """

    source: Path
    vehicle: Vehicle
    frames: FrameColumns | SignalColumns
    damages: list[LogDamage]

    @property
    def start_ns(self) -> int:
        """Time of the first frame [ns since the epoch]."""
        return int(self.frames.time_ns[0])


@dataclass(frozen=True)
class RideOptions:
    """How a ride is estimated and what is logged. ledger: keep where the energy went; state: continue from this."""

    filter_name: str = "scalar"
    frames: bool = False
    signals: bool = False
    route: Route | None = None
    ledger: bool = False
    state: RideState | None = None


@dataclass
class RideStatistics:
    """Sums and extremes over the estimates of a ride."""

    last: Estimate | None = None
    last_ranged: Estimate | None = None
    last_on_route: Estimate | None = None
    soc_start: tuple[float, float] | None = None  # mean and standard deviation
    soc_end: tuple[float, float] | None = None
    range_start_m: float | None = None
    on_route_m: float = 0.0
    paused_s: float = 0.0
    speed_max: float | None = None  # m/s
    innovation_max: float = 0.0  # V of a cell
    gauge_start: float | None = None  # SOC that the vehicle itself shows, as of its cells
    charge_as: float = 0.0  # drawn from the pack since then, less what came back
    uncounted_s: float = 0.0  # since then, without a measured current
    estimates: Counter[tuple[State, int]] = field(default_factory=Counter)  # by state and reasons
    distrusted: Counter[str] = field(default_factory=Counter)  # estimates by role
    _squares: float = 0.0
    _innovations: int = 0

    def add(self, e: Estimate, gauge: float | None) -> None:
        """Add the next estimate; gauge: the SOC that the vehicle itself shows."""
        before = self.last
        dt = e.time - before.time if before else 0.0
        self._add_gauge(e, gauge, dt if before else None)
        self.last = e
        self.paused_s += dt if dt > PAUSE_S else 0.0
        self.estimates[e.state, int(e.reasons)] += 1
        self.distrusted.update(e.distrusted)
        if e.route_state == RouteState.ON:
            self.last_on_route = e
            self.on_route_m += e.distance - (before.distance if before else 0.0)
        if e.innovation is not None:
            self._squares += e.innovation * e.innovation
            self._innovations += 1
            self.innovation_max = max(self.innovation_max, abs(e.innovation))
        if e.speed is not None:
            self.speed_max = max(e.speed, e.speed if self.speed_max is None else self.speed_max)
        if e.soc is not None and e.soc_sd is not None:
            self.soc_end = e.soc, e.soc_sd
            self.soc_start = self.soc_start or self.soc_end
        if e.range is not None and e.state in KNOWN:
            self.last_ranged = e
            self.range_start_m = e.range if self.range_start_m is None else self.range_start_m

    def _add_gauge(self, e: Estimate, gauge: float | None, dt: float | None) -> None:
        if gauge is None:
            return
        if self.gauge_start is None or dt is None:
            self.gauge_start = gauge
        elif e.pack_current is None or e.current_modelled or not 0 <= dt <= MAX_HOLD_S:
            self.uncounted_s += dt
        else:
            self.charge_as += e.pack_current * dt

    @property
    def innovation_rms(self) -> float | None:
        """Root mean square of the innovations [V of a cell]; None without any."""
        return sqrt(self._squares / self._innovations) if self._innovations else None

    def by_name(self) -> tuple[Counter[str], Counter[str]]:
        """Count the estimates by state, and by reason."""
        states: Counter[str] = Counter()
        reasons: Counter[str] = Counter()
        for (state, bits), count in self.estimates.items():
            states[state.name] += count
            for name in reason_names(Reason(bits)):
                reasons[name] += count
        return states, reasons


@dataclass(frozen=True)
class RideRun:
    """A ride that went through the pipeline; resumed: None if no saved state was asked for."""

    ride: OpenRide
    options: RideOptions
    pipeline: Pipeline
    statistics: RideStatistics
    cpu_s: float
    wall_s: float
    resumed: Resumed | None


class MemoryLog:
    """A log that keeps its rows in memory, by topic: (time [ns], values)."""

    def __init__(self) -> None:
        self.rows: dict[str, list[tuple[int, Mapping[str, object]]]] = {}

    def channel(self, topic: str, json_schema: Mapping[str, Any]) -> None:
        """See `log_rows.Log`."""
        self.rows[topic] = []

    def frames(self, batch: Sequence[Any]) -> None:
        """See `log_rows.Log`."""

    def sample(self, topic: str, time_ns: int, values: Mapping[str, object], seen_ns: int | None = None) -> None:
        """See `log_rows.Log`."""
        self.rows[topic].append((time_ns, values))

    def values(self, topic: str) -> list[Mapping[str, object]]:
        """Return the rows of a topic without their times."""
        return [values for _, values in self.rows[topic]]


def open_estimate(source: Path | SignalTable, vehicle: Vehicle) -> OpenRide:
    """Read the ride of `vehicle` in a log or a table of signals. Raises InputError."""
    damages: list[LogDamage] = []
    name = source.name if isinstance(source, SignalTable) else source
    mapping, frames = open_ride(source, vehicle, damages.append)
    vehicle = _identified(replace(of_ride(vehicle, source), mapping=mapping), frames, str(name))
    publisher = range_publisher(vehicle)
    if isinstance(frames, FrameColumns):
        frames = _without_range_frames(frames, publisher)
    if not len(frames):
        raise InputError(f"{name}: holds no frames of a vehicle" + (f" ({damages[0]})" if damages else ""))
    return OpenRide(name, vehicle, frames, damages)


def _without_range_frames(frames: FrameColumns, publisher: Publisher) -> FrameColumns:
    """Leave out the frames that an earlier run of the publisher may have sent."""
    alike = np.flatnonzero(np.isin(frames.identifier, list(publisher.identifiers)))
    own = [publisher.may_have_sent(frame) for frame in frames[alike].tuples()]
    return frames[np.delete(np.arange(len(frames)), alike[own])] if any(own) else frames


def _identified(vehicle: Vehicle, frames: FrameColumns | SignalColumns, where: str) -> Vehicle:
    """Return the vehicle of the number that the frames of the first minute show, if they show one."""
    sources = tuple(source for source in vehicle.mapping.instruments if source.role == "vehicle_id")
    if not sources:
        return vehicle
    codec = Codec(replace(vehicle.mapping, sources=sources, requests=()), LONGEST_PAUSE_NS)
    times, numbers = decode_columns(frames, codec).get("vehicle_id", (np.zeros(0), np.zeros(0)))
    if not (times[:1] <= IDENTIFICATION_S).any():
        return vehicle
    return vehicle.identified(f"{numbers[0]:.0f}", where)


def run_ride(ride: OpenRide, options: RideOptions, log: Log | None = None, progress: Progress | None = None) -> RideRun:
    """Take all frames of `ride` through the pipeline, which writes to `log`.

    progress: takes numbers of frames. InputError if the vehicle knows none of the frames, or if the saved state does
    not fit.
    """
    cpu, wall = time.process_time(), time.perf_counter()
    statistics = RideStatistics()

    def observe(estimate: Estimate) -> None:
        if resumed:  # as in the daemon: until a voltage comes, a restored state grows older
            pipeline.estimator.pack.wait(estimate.time - (statistics.last.time if statistics.last else 0.0))
        statistics.add(estimate, gauge.last)

    pipeline = Pipeline(
        ride.vehicle,
        filter_name=options.filter_name,
        log=log,
        log_frames=options.frames,
        log_signals=options.signals,
        observer=observe,
    )
    gauge = pipeline.estimator.signals["bms_state_of_charge"]
    pipeline.codec.longest_pause_ns = LONGEST_PAUSE_NS
    resumed = resume(pipeline, options.state, ride.source) if options.state else None
    if options.ledger:
        pipeline.estimator.forecaster.load.ledger = Ledger()
    if options.route:
        pipeline.estimator.route.follow(pipeline.estimator.route.prepare(options.route))
    feed(pipeline, ride.frames, progress)
    check_ridden(ride.source, ride.vehicle, pipeline.codec)
    if log and statistics.last:  # with the counts since the last whole second
        log.sample(STATUS_TOPIC, pipeline.codec.time_ns(statistics.last.time), pipeline.status())
    took = time.process_time() - cpu, time.perf_counter() - wall
    return RideRun(ride, options, pipeline, statistics, *took, resumed)


def state_for(file: Path, ride: OpenRide, facts: Mapping[str, object]) -> RideState:
    """Return the saved state `file` for a ride, whose times are by its clock as it is set at the end.

    InputError for a ride without a date, which has no place among others.
    """
    codec = Codec(replace(ride.vehicle.mapping, sources=(), requests=()), LONGEST_PAUSE_NS)
    on_timeline(ride.frames.time_ns, codec)
    if codec.time_ns(0.0) < FIRST_DATE_NS:
        raise InputError(
            f"{ride.source}: has no date, as its clock was not set; a saved state needs the times of the rides, for "
            "their order and what passed between them"
        )
    rider = str(facts.get("rider", ""))
    if len(rider) > CONSUMPTION.max_name_letters:
        raise InputError(
            f"{ride.source}: rides.json: rider {rider!r}: must have at most {CONSUMPTION.max_name_letters} letters"
        )
    return RideState(file, codec.time_ns(0.0), codec.last_ns, rider)


def vehicle_of(task: Task) -> Vehicle:
    """Read the vehicle of a task, once for all logs of a process."""
    return known_vehicle(task.vehicle, task.payload, task.vehicle_id)


@functools.lru_cache(maxsize=1)
def known_vehicle(name: str, payload: float | None, vehicle_id: str | None = None) -> Vehicle:
    """Read a vehicle, once for all logs of a process."""
    return read_vehicle(name, payload, vehicle_id=vehicle_id)
