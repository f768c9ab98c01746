"""One recorded ride through the pipeline of the daemon, as fast as it goes; and the summary of its estimates."""

from __future__ import annotations

import functools
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, cast

from gz_onboard.bus.logfile import LogFile
from gz_onboard.bus.logs import LogDamage
from gz_onboard.bus.publisher import Counts, Publisher
from gz_onboard.constants import WH, WH_PER_KM
from gz_onboard.errors import InputError, writing
from gz_onboard.estimator.load_model import Ledger
from gz_onboard.events import Estimate, Frame, Reason, State
from gz_onboard.lab.estimate_route import RouteSummary, route_summary
from gz_onboard.lab.estimate_tally import Tally
from gz_onboard.lab.plot import plot_log
from gz_onboard.lab.why import Why, why_of
from gz_onboard.log_rows import STATUS_TOPIC, Log
from gz_onboard.offline.processes import Task
from gz_onboard.offline.results import times
from gz_onboard.offline.samples import open_ride
from gz_onboard.offline.signal_table import SignalTable
from gz_onboard.pipeline import TICK_NS, Pipeline, dbc_texts, lacking, range_publisher
from gz_onboard.progress import Progress
from gz_onboard.routes.ahead import read_ahead
from gz_onboard.routes.route import Route
from gz_onboard.vehicle import Vehicle, read_vehicle

SUMMARY_VERSION = 1
TICK_S = TICK_NS * 1e-9
_GAP_NS = 2_000_000_000  # a longer pause between two frames is ridden through in steps
_PAUSE_NS = 30_000_000_000  # beyond this the recording was stopped, and nothing is estimated meanwhile
MOST_SLOW = 0.1  # of the time: energy is not integrated if pack current and voltage come too slowly for longer
_CONFIRM = 3  # fewer frames than this do not set the time


@dataclass(frozen=True)
class EstimateTask(Task):
    """A log to be estimated."""

    filter_name: str = "scalar"
    frames: bool = False
    signals: bool = False
    route: Path | None = None

    @property
    def log(self) -> Path:
        """The MCAP."""
        return self.output(".estimate.mcap")

    @property
    def picture(self) -> Path | None:
        """The picture, if one is to be drawn."""
        return self.drawn(".estimate")

    @property
    def part(self) -> Path:
        """The MCAP while it is not complete."""
        return self.output(".estimate.mcap.part")


@dataclass(frozen=True)
class RideSummary:
    """A ride in the JSON: {"version", "rides": [summaries], "failed": [{file, error}]}."""

    file: Annotated[str, "the log"]
    log: Annotated[str | None, "the MCAP written, or null"]
    plot: Annotated[str | None, "the picture written, or null"]
    vehicle: Annotated[str, "name of the vehicle"]
    filter: Annotated[str, "backend of the filter"]
    start_ns: Annotated[int, "time of the first frame [ns since the epoch, as in the log]"]
    duration_s: Annotated[float, "from the first to the last estimate"]
    distance_km: Annotated[float, "ridden, but for gaps_s"]
    speed_max_km_h: Annotated[float | None, "greatest speed, or null"]
    energy_wh: Annotated[
        float | None,
        "drawn from the pack, less what was recovered, the sensors' known gain and offsets taken off; "
        "null if voltage or current was never known, or came too slowly for more than a tenth of the time",
    ]
    energy_recovered_wh: Annotated[float | None, "charged into the pack while riding, or null"]
    consumption_wh_km: Annotated[float | None, "energy over distance; null below 0.1 km"]
    soc_start: Annotated[float | None, "state of charge, 0 to 1, at the first estimate that has one"]
    soc_start_sd: Annotated[float | None, "its standard deviation"]
    soc_end: Annotated[float | None, "at the last estimate that has one"]
    soc_end_sd: Annotated[float | None, "its standard deviation"]
    range_start_km: Annotated[float | None, "first range published"]
    range_end_km: Annotated[float | None, "last range published"]
    range_end_p10_km: Annotated[float | None, "exceeded with 90 % probability"]
    range_end_p90_km: Annotated[float | None, "exceeded with 10 % probability"]
    energy_left_wh: Annotated[float | None, "to be drawn before the cut-off, at the end"]
    why: Annotated[Why | None, "why the last range that was explained is not the rated one, or null"]
    changes: Annotated[list[Why], "each change of the range by 1 km more or less than was ridden, and why"]
    route: Annotated[
        RouteSummary | None,
        "of the route given: state at the end (ON, OFF); and of the last estimate on it km along and left, energy to "
        "its end and state of charge there, km from its start and position where the battery ends before; or null",
    ]
    innovation_rms_v: Annotated[float | None, "root mean square of measured less predicted voltage of a cell [V]"]
    innovation_max_v: Annotated[float | None, "greatest magnitude of the same"]
    states: Annotated[dict[str, float], "seconds in each state"]
    reasons: Annotated[dict[str, float], "seconds with each reason to distrust the estimate"]
    distrusted: Annotated[dict[str, float], "seconds by role of a sensor that contradicted the others and was left out"]
    lacking: Annotated[list[str], "reasons that hold for ever, as the vehicle has no such sensors: no degradation"]
    frames: Annotated[int, "received"]
    dropped: Annotated[int, "frames that failed a check"]
    implausible: Annotated[int, "signals out of their physical range"]
    lost: Annotated[int, "frames missing by their counters"]
    unknown: Annotated[int, "different identifiers that the database does not know"]
    foreign: Annotated[dict[str, int], "frames of someone else on the identifiers of the range frames, by identifier"]
    error_frames: Annotated[int, "error frames of the bus"]
    gaps_s: Annotated[float, "without any measurement for too long to go on: distance and energy lack what was ridden"]
    faults: Annotated[dict[str, dict[str, int]], "what was dropped, by reason and by message or signal"]
    damage: Annotated[str | None, "what of the log could not be read, or null"]
    cpu_s: Annotated[float, "processor time taken, without drawing"]
    real_time_factor: Annotated[float | None, "duration of the ride over the time taken, without drawing"]


class _Mute(Publisher):
    """No bus, no range frames: encoding them would take a third of the time."""

    def range(self, estimate: Estimate, counts: Counts, time_ns: int) -> list[Frame]:
        return []

    def status(self, estimate: Estimate, time_ns: int) -> list[Frame]:
        return []


def feed(pipeline: Pipeline, batches: Iterable[Sequence[Frame]], progress: Progress | None = None) -> None:
    """All frames of a log through `pipeline`, in any portions; `progress` is called with their numbers.

    Gaps are ridden through as a live bus would have it, up to a minute; a longer one is a pause of the recording.
    """
    now: int | None = None
    for batch in batches:
        for portion in _without_jumps(batch):
            first, last = portion[0][0], portion[-1][0]
            if now is None:
                now = first
            if len(portion) < _CONFIRM and not -TICK_NS <= last - now <= _PAUSE_NS:  # an odd stamp: the codec judges it
                pipeline.advance(portion, now)
                continue
            if _GAP_NS < first - now <= _PAUSE_NS:
                for step in range(now + _GAP_NS, first, _GAP_NS):
                    pipeline.advance((), step)
            pipeline.advance(portion, last)
            now = last
        if progress:
            progress(len(batch))


def _without_jumps(batch: Sequence[Frame]) -> Iterator[Sequence[Frame]]:
    """Parts of `batch` in which time neither goes back nor leaps by more than a gap, and none longer than that."""
    if not batch:
        return
    if 0 <= batch[-1][0] - batch[0][0] <= _GAP_NS:  # nearly all; single odd stamps within are the codec's business
        yield batch
        return
    begin = 0
    for i in range(1, len(batch)):
        leap = not -TICK_NS <= batch[i][0] - batch[i - 1][0] <= _GAP_NS
        if leap or batch[i][0] - batch[begin][0] > _GAP_NS:  # on a slow bus a batch takes many seconds
            yield batch[begin:i]
            begin = i
    yield batch[begin:]


@dataclass(frozen=True)
class OpenRide:
    """A ride that is to be estimated. batches: its frames, without an earlier run's estimates."""

    source: Path  # its log, or what its table is called
    vehicle: Vehicle  # with the mapping of the ride
    start_ns: int
    batches: Iterable[list[Frame]]
    damages: list[LogDamage]  # complete once the frames were read


@dataclass(frozen=True)
class How:
    """How a ride is estimated, and what is logged beside the estimates; ledger: whether the load model keeps one."""

    filter_name: str = "scalar"
    frames: bool = False
    signals: bool = False
    route: Route | None = None
    ledger: bool = False


@dataclass(frozen=True)
class Ridden:
    """A ride that went through the pipeline. took: processor and wall time [s]."""

    source: Path
    pipeline: Pipeline
    tally: Tally
    how: How
    damages: Sequence[LogDamage]
    took: tuple[float, float]


def estimate_log(task: EstimateTask, progress: Progress | None = None) -> RideSummary:
    """Estimate one log and write its MCAP and picture; gives its summary. Raises InputError."""
    vehicle = known_vehicle(task.vehicle, task.payload)
    route = read_ahead(task.route)[1] if task.route else None
    ride = open_estimate(task.path, vehicle)
    if task.frames and ride.vehicle.mapping is not vehicle.mapping:
        raise InputError(f"{task.path}: is a table of signals: --frames has nothing to log")
    with writing(task.log):
        log = _open_log(task, ride.vehicle, ride.start_ns)
        try:
            ridden = ride_through(ride, How(task.filter_name, task.frames, task.signals, route), log, progress)
            log.close()
            task.part.replace(task.log)
        finally:
            log.abandon()
            task.part.unlink(missing_ok=True)
        if task.picture:
            plot_log(task.log, task.picture)
    return summary_of(ridden, task.log, task.picture)


def open_estimate(source: Path | SignalTable, vehicle: Vehicle) -> OpenRide:
    """The ride of `vehicle` in a log or a table of signals; InputError if there is none."""
    damages: list[LogDamage] = []
    name = source.name if isinstance(source, SignalTable) else source
    mapping, batches = open_ride(source, vehicle, damages.append)
    vehicle = replace(vehicle, mapping=mapping)
    own = range_publisher(vehicle).may_have_sent
    ours = ([frame for frame in batch if not own(frame)] for batch in batches)
    first = next((batch for batch in ours if batch), None)
    if first is None:
        raise InputError(f"{name}: holds no frames of a vehicle" + (f" ({damages[0]})" if damages else ""))
    return OpenRide(name, vehicle, first[0][0], chain([first], ours), damages)


def ride_through(ride: OpenRide, how: How, log: Log, progress: Progress | None = None) -> Ridden:
    """Take all frames of `ride` through the pipeline, which writes to `log`. InputError if not one is the vehicle's."""
    cpu, wall = time.process_time(), time.perf_counter()
    tally = Tally(ride.start_ns)
    pipeline = Pipeline(
        ride.vehicle,
        filter_name=how.filter_name,
        log=log,
        log_frames=how.frames,
        log_signals=how.signals,
        observer=tally,
    )
    if how.ledger:
        pipeline.estimator.forecaster.load.ledger = Ledger()
    if how.route:
        pipeline.estimator.ahead.follow(pipeline.estimator.ahead.ready(how.route))
    if not how.frames:
        pipeline.publisher = _Mute()
    feed(pipeline, ride.batches, progress)
    if not pipeline.codec.latest:
        raise _unknown(ride, pipeline)
    if tally.last:  # what came after the last whole second counts too
        log.sample(STATUS_TOPIC, ride.start_ns + round(tally.last.time * 1e9), pipeline.status())
    took = time.process_time() - cpu, time.perf_counter() - wall
    return Ridden(ride.source, pipeline, tally, how, ride.damages, took)


@functools.lru_cache(maxsize=1)
def known_vehicle(name: str, payload: float | None) -> Vehicle:
    """The vehicle, read once for all logs of a process."""
    return read_vehicle(name, payload)


def _open_log(task: EstimateTask, vehicle: Vehicle, start_ns: int) -> LogFile:
    task.part.parent.mkdir(parents=True, exist_ok=True)
    metadata = {
        "vehicle": vehicle.name,
        "vehicle_key": vehicle.key,
        "lacking": " ".join(lacking(vehicle)),
        "source": task.path.name,
        "filter": task.filter_name,
        **({} if task.payload is None else {"payload_kg": f"{task.payload:g}"}),
    }
    return LogFile(task.part.open("wb"), start_ns, metadata, dbc_texts(vehicle))


def _unknown(ride: OpenRide, pipeline: Pipeline) -> InputError:
    unknown = sorted(pipeline.codec.unknown)[:5]
    names = ", ".join(f"{identifier & 0x1FFFFFFF:X}" for identifier in unknown)
    return InputError(
        f"{ride.source}: vehicle {ride.vehicle.name!r} knows none of its {pipeline.codec.received} frames"
        f"{f' (identifiers {names}, ...)' if names else ''}; name its vehicle with --vehicle"
    )


def summary_of(ridden: Ridden, log: Path | None = None, picture: Path | None = None) -> RideSummary:
    """The summary of a ride; log, picture: where its estimates were written and drawn."""
    pipeline, tally, route = ridden.pipeline, ridden.tally, ridden.how.route
    last, ranged = tally.last or Estimate(0.0), tally.ranged or Estimate(0.0)
    changes = pipeline.estimator.attribution.changes
    soc_start, soc_end = tally.soc_start or (None, None), tally.soc_end or (None, None)
    counts, status = pipeline.counts(), pipeline.status()
    states, reasons = tally.by_name()
    drawn = pipeline.drawn.net if reasons[Reason.SIGNALS_SLOW.name] <= MOST_SLOW * states.total() else None
    return RideSummary(
        file=str(ridden.source),
        log=str(log) if log else None,
        plot=str(picture) if picture else None,
        vehicle=pipeline.vehicle.name,
        filter=ridden.how.filter_name,
        start_ns=tally.start_ns,
        duration_s=last.time,
        distance_km=last.distance * 1e-3,
        speed_max_km_h=times(tally.speed_max, 3.6),
        energy_wh=times(drawn, 1 / WH),
        energy_recovered_wh=None if drawn is None else pipeline.drawn.recovered / WH,
        consumption_wh_km=times(drawn, 1 / last.distance / WH_PER_KM) if last.distance >= 100 else None,
        soc_start=soc_start[0],
        soc_start_sd=soc_start[1],
        soc_end=soc_end[0],
        soc_end_sd=soc_end[1],
        range_start_km=times(tally.range_start, 1e-3),
        range_end_km=times(ranged.range, 1e-3),
        range_end_p10_km=times(ranged.range_p10, 1e-3),
        range_end_p90_km=times(ranged.range_p90, 1e-3),
        energy_left_wh=times(ranged.energy_left, 1 / WH),
        why=why_of(last.why) if last.why else None,
        changes=list(map(why_of, changes)),
        route=route_summary(last, tally.on_route or last, route.grade_known) if route else None,
        innovation_rms_v=tally.innovation_rms,
        innovation_max_v=tally.innovation_max if tally.innovation_rms is not None else None,
        states={state.name: round(states[state.name] * TICK_S, 1) for state in State if states[state.name]},
        reasons={name: round(ticks * TICK_S, 1) for name, ticks in sorted(reasons.items())},
        distrusted={role: round(ticks * TICK_S, 1) for role, ticks in sorted(tally.distrusted.items())},
        lacking=lacking(pipeline.vehicle),
        frames=pipeline.codec.received,
        dropped=counts.dropped,
        implausible=counts.implausible,
        lost=counts.lost,
        unknown=counts.unknown,
        foreign=cast("dict[str, int]", status["foreign"]),
        error_frames=pipeline.codec.error_frames,
        gaps_s=round(pipeline.estimator.gap_time, 1),
        faults=cast("dict[str, dict[str, int]]", status["faults"]),
        damage=str(ridden.damages[0]) if ridden.damages else None,
        cpu_s=ridden.took[0],
        real_time_factor=tally.last.time / ridden.took[1] if tally.last else None,
    )
