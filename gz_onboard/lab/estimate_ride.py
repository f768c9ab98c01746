"""One recorded ride through the pipeline of the daemon, as fast as it goes."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gz_onboard.can.codec import LONGEST_PAUSE_NS, Codec
from gz_onboard.can.publisher import Publisher
from gz_onboard.errors import InputError
from gz_onboard.estimator.load_model import Ledger
from gz_onboard.events import Estimate
from gz_onboard.lab.estimate_state import StateAt, WentOn, go_on
from gz_onboard.lab.estimate_tally import Tally
from gz_onboard.log_rows import STATUS_TOPIC, Log
from gz_onboard.offline.processes import Task
from gz_onboard.offline.samples import check_ridden, of_ride, open_ride
from gz_onboard.offline.signal_table import SignalTable
from gz_onboard.pipeline import Pipeline, range_publisher
from gz_onboard.progress import Progress
from gz_onboard.recording.decode import decode_columns, feed
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.readers.contents import LogDamage
from gz_onboard.routes.route import Route
from gz_onboard.vehicle import Vehicle, read_vehicle

IDENTIFIED_WITHIN = 60.0  # s from the first frame


@dataclass(frozen=True)
class OpenRide:
    """A ride before its estimation. frames: without the range frames of an earlier run."""

    source: Path  # its log, or what its table is called
    vehicle: Vehicle  # with the mapping of the ride
    start_ns: int
    frames: FrameColumns
    damages: list[LogDamage]


@dataclass(frozen=True)
class How:
    """How a ride is estimated, and what is logged beside the estimates; ledger: whether the load model keeps one.

    state: the saved state to go on from.
    """

    filter_name: str = "scalar"
    frames: bool = False
    signals: bool = False
    route: Route | None = None
    ledger: bool = False
    state: StateAt | None = None


@dataclass(frozen=True)
class Ridden:
    """A ride that went through the pipeline. took: processor and wall time [s]; went_on: from a saved state or not."""

    source: Path
    pipeline: Pipeline
    tally: Tally
    how: How
    damages: Sequence[LogDamage]
    took: tuple[float, float]
    went_on: WentOn | None = None


def open_estimate(source: Path | SignalTable, vehicle: Vehicle) -> OpenRide:
    """The ride of `vehicle` in a log or a table of signals; InputError if there is none."""
    damages: list[LogDamage] = []
    name = source.name if isinstance(source, SignalTable) else source
    mapping, frames = open_ride(source, vehicle, damages.append)
    vehicle = replace(of_ride(vehicle, source), mapping=mapping)
    vehicle = _identified(vehicle, frames, str(name))
    frames = _without_own(frames, range_publisher(vehicle))
    if not len(frames):
        raise InputError(f"{name}: holds no frames of a vehicle" + (f" ({damages[0]})" if damages else ""))
    return OpenRide(name, vehicle, int(frames.time_ns[0]), frames, damages)


def _without_own(frames: FrameColumns, publisher: Publisher) -> FrameColumns:
    """Leave out the frames that an earlier run of the publisher may have sent."""
    alike = np.flatnonzero(np.isin(frames.identifier, list(publisher.identifiers)))
    own = [publisher.may_have_sent(frame) for frame in frames[alike].tuples()]
    return frames[np.delete(np.arange(len(frames)), alike[own])] if any(own) else frames


def _identified(vehicle: Vehicle, frames: FrameColumns, where: str) -> Vehicle:
    """The vehicle whose number the frames show in the first minute, if they show one."""
    sources = tuple(source for source in vehicle.mapping.instruments if source.role == "vehicle_id")
    if not sources:
        return vehicle
    codec = Codec(replace(vehicle.mapping, sources=sources, requests=()), LONGEST_PAUSE_NS)
    times, numbers = decode_columns(frames, codec).get("vehicle_id", (np.zeros(0), np.zeros(0)))
    if not (times[:1] <= IDENTIFIED_WITHIN).any():
        return vehicle
    return vehicle.identified(f"{numbers[0]:.0f}", where)


def ride_through(ride: OpenRide, how: How, log: Log, progress: Progress | None = None) -> Ridden:
    """Take all frames of `ride` through the pipeline, which writes to `log`.

    InputError if not one is the vehicle's, or if the state to go on from does not fit.
    """
    cpu, wall = time.process_time(), time.perf_counter()
    tally = Tally(ride.start_ns)

    def observe(estimate: Estimate) -> None:
        if went_on:  # as the daemon has it: until a voltage comes, what was restored grows older
            pipeline.estimator.pack.wait(estimate.time - (tally.last.time if tally.last else 0.0))
        tally(estimate)
        tally.gauge.take(estimate, own.last)

    pipeline = Pipeline(
        ride.vehicle,
        filter_name=how.filter_name,
        log=log,
        log_frames=how.frames,
        log_signals=how.signals,
        observer=observe,
    )
    own = pipeline.estimator.signals["bms_state_of_charge"]
    pipeline.codec.longest_pause_ns = LONGEST_PAUSE_NS
    went_on = go_on(pipeline, how.state, ride.source) if how.state else None
    if how.ledger:
        pipeline.estimator.forecaster.load.ledger = Ledger()
    if how.route:
        pipeline.estimator.route.follow(pipeline.estimator.route.prepare(how.route))
    feed(pipeline, ride.frames, progress)
    check_ridden(ride.source, ride.vehicle, pipeline.codec)
    if tally.last:  # what came after the last whole second counts too
        log.sample(STATUS_TOPIC, pipeline.codec.time_ns(tally.last.time), pipeline.status())
    took = time.process_time() - cpu, time.perf_counter() - wall
    return Ridden(ride.source, pipeline, tally, how, ride.damages, took, went_on)


def vehicle_of(task: Task) -> Vehicle:
    """The vehicle of a task, read once for all logs of a process."""
    return known_vehicle(task.vehicle, task.payload, task.vehicle_id)


@functools.lru_cache(maxsize=1)
def known_vehicle(name: str, payload: float | None, vehicle_id: str | None = None) -> Vehicle:
    """The vehicle, read once for all logs of a process."""
    return read_vehicle(name, payload, vehicle_id=vehicle_id)
