"""``gz-onboard estimate``: recorded rides through the pipeline of the daemon, without a bus, as fast as it goes.

For each log it writes NAME.estimate.mcap (the estimates and what was received, once a second) and
NAME.estimate.png, and tells what came out. No clock and no chance are in what it writes: the same log gives the
same bytes.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from math import sqrt
from pathlib import Path
from typing import Any

from gz_onboard.bus import _can  # noqa: F401 - before cantools, which would import it with asammdf and pandas
from gz_onboard.bus.logfile import LogFile
from gz_onboard.bus.logs import LogDamage, logs_among, read_frames
from gz_onboard.bus.publisher import WH, WH_PER_KM, Counts, Publisher
from gz_onboard.errors import BAD_INPUT, InputError
from gz_onboard.events import Estimate, Frame, Reason, State
from gz_onboard.lab.plot import plot_log, reason_words
from gz_onboard.lab.processes import Progress, over_rides, progress_bar
from gz_onboard.pipeline import TICK_NS, Pipeline, dbc_texts, range_publisher, reason_names
from gz_onboard.simulation.telling import check_json, clock, explain_keys, number, output_names, times, write_json
from gz_onboard.vehicle import Vehicle, read_vehicle

SUMMARY_VERSION = 1
KEYS = {
    "file": "the log",
    "log": "the MCAP written",
    "plot": "the PNG written, or null",
    "vehicle": "name of the vehicle",
    "filter": "backend of the filter",
    "start_ns": "time of the first frame [ns since the epoch, as in the log]",
    "duration_s": "from the first to the last estimate",
    "distance_km": "ridden",
    "speed_max_km_h": "greatest speed, or null",
    "energy_wh": "drawn from the pack, less what was recovered; null if voltage or current was never known",
    "energy_recovered_wh": "charged into the pack while riding, or null",
    "consumption_wh_km": "energy over distance; null below 0.1 km",
    "soc_start": "state of charge, 0 to 1, at the first estimate that has one",
    "soc_start_sd": "its standard deviation",
    "soc_end": "at the last estimate that has one",
    "soc_end_sd": "its standard deviation",
    "range_start_km": "first range published",
    "range_end_km": "last range published",
    "range_end_p10_km": "exceeded with 90 % probability",
    "range_end_p90_km": "exceeded with 10 % probability",
    "energy_left_wh": "to be drawn before the cut-off, at the end",
    "innovation_rms_v": "root mean square of measured less predicted voltage of a cell [V]",
    "innovation_max_v": "greatest magnitude of the same",
    "states": "seconds in each state",
    "reasons": "seconds with each reason to distrust the estimate",
    "frames": "received",
    "dropped": "frames that failed a check",
    "implausible": "signals out of their physical range",
    "lost": "frames missing by their counters",
    "unknown": "different identifiers that the database does not know",
    "error_frames": "error frames of the bus",
    "faults": "what was dropped, by reason and by message or signal",
    "damage": "what of the log could not be read, or null",
    "cpu_s": "processor time taken, without drawing",
    "real_time_factor": "duration of the ride over the time taken, without drawing",
}
"""What the summary of a ride holds: ``--json`` writes {"version", "rides": [summaries], "failed": [{file, error}]}."""

_GAP_NS = 2_000_000_000  # a longer pause between two frames is ridden through in steps
_PAUSE_NS = 30_000_000_000  # beyond this the recording was stopped, and nothing is estimated meanwhile
_CONFIRM = 3  # fewer frames than this do not set the time


@dataclass(frozen=True)
class Task:
    """One log and what to do with it."""

    path: Path
    stem: Path  # of the files to be written, without their suffixes
    vehicle: str
    payload: float | None = None  # kg
    filter_name: str = "scalar"
    frames: bool = False
    signals: bool = False
    plot: bool = True

    @property
    def log(self) -> Path:
        """The MCAP."""
        return self.stem.with_name(self.stem.name + ".estimate.mcap")

    @property
    def picture(self) -> Path:
        """The PNG."""
        return self.stem.with_name(self.stem.name + ".estimate.png")

    @property
    def part(self) -> Path:
        """The MCAP while it is not complete."""
        return self.log.with_name(self.log.name + ".part")


@dataclass
class Tally:
    """Sums over a ride's estimates; pass it to the pipeline as its observer."""

    first: Estimate | None = None
    last: Estimate | None = None
    soc_start: tuple[float, float] | None = None
    soc_end: tuple[float, float] | None = None
    range_start: float | None = None  # m
    drawn: float | None = None  # J, net
    recovered: float = 0.0  # J
    speed_max: float | None = None  # m/s
    innovation_max: float = 0.0  # V
    ticks: Counter[tuple[State, int]] = field(default_factory=Counter)
    _squares: float = 0.0
    _innovations: int = 0
    _before: float = 0.0

    def __call__(self, e: Estimate) -> None:
        """Take in the next estimate."""
        if self.first is None:
            self.first, self._before = e, e.time
        dt, self._before = e.time - self._before, e.time
        self.last = e
        self.ticks[e.state, int(e.reasons)] += 1
        if e.pack_voltage is not None and e.pack_current is not None and 0 <= dt <= 1:
            energy = e.pack_voltage * e.pack_current * dt
            self.drawn = (self.drawn or 0.0) + energy
            self.recovered -= min(energy, 0.0)
        if e.innovation is not None:
            self._squares += e.innovation * e.innovation
            self._innovations += 1
            self.innovation_max = max(self.innovation_max, abs(e.innovation))
        if e.speed is not None and (self.speed_max is None or e.speed > self.speed_max):
            self.speed_max = e.speed
        if e.soc is not None and e.soc_sd is not None:
            self.soc_end = e.soc, e.soc_sd
            if self.soc_start is None:
                self.soc_start = self.soc_end
        if self.range_start is None:
            self.range_start = e.range

    @property
    def innovation_rms(self) -> float | None:
        """[V] of a cell, or None if there was no innovation."""
        return sqrt(self._squares / self._innovations) if self._innovations else None


class _Mute(Publisher):
    """No bus, no range frames: encoding them would take a third of the time."""

    def range(self, estimate: Estimate, counts: Counts, time_ns: int, channel: int = 0) -> list[Frame]:
        return []

    def status(self, estimate: Estimate, time_ns: int, channel: int = 0) -> list[Frame]:
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


def estimate_log(task: Task, progress: Progress | None = None) -> dict[str, Any]:
    """Estimate one log and write its MCAP and picture; gives its summary, see `KEYS`. Raises InputError."""
    vehicle = _vehicle(task.vehicle, task.payload)
    damages: list[LogDamage] = []
    cpu, wall = time.process_time(), time.perf_counter()
    batches = read_frames(task.path, on_damage=damages.append)
    own = range_publisher(vehicle).identifiers
    ours = ([frame for frame in batch if frame[1] not in own] for batch in batches)  # an earlier run's estimates
    batch = next((batch for batch in ours if batch), None)
    if batch is None:
        raise InputError(f"{task.path}: holds no frames of a vehicle" + (f" ({damages[0]})" if damages else ""))
    tally = Tally()
    try:
        log = _open_log(task, vehicle, batch[0][0])
        try:
            pipeline = Pipeline(
                vehicle,
                filter_name=task.filter_name,
                log=log,
                log_frames=task.frames,
                log_signals=task.signals,
                observer=tally,
            )
            if not task.frames:
                pipeline.publisher = _Mute()
            feed(pipeline, _chained(batch, ours), progress)
            if not pipeline.codec.latest:
                raise _unknown(task, vehicle, pipeline)
            log.close()
            task.part.replace(task.log)
        finally:
            log.abandon()
            task.part.unlink(missing_ok=True)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        if task.plot:
            plot_log(task.log, task.picture)
    except OSError as error:
        raise InputError(f"{error.filename or task.log}: cannot be written: {error.strerror or error}") from error
    return _summary(task, pipeline, tally, batch[0][0], damages) | {
        "cpu_s": cpu,
        "real_time_factor": tally.last.time / wall if tally.last else None,
    }


@functools.lru_cache(maxsize=1)
def _vehicle(name: str, payload: float | None) -> Vehicle:
    return read_vehicle(name, payload)


def _chained(first: list[Frame], rest: Iterable[list[Frame]]) -> Iterator[list[Frame]]:
    yield first
    yield from rest


def _open_log(task: Task, vehicle: Vehicle, start_ns: int) -> LogFile:
    task.part.parent.mkdir(parents=True, exist_ok=True)
    metadata = {
        "vehicle": vehicle.name,
        "vehicle_key": vehicle.key,
        "source": task.path.name,
        "filter": task.filter_name,
        **({} if task.payload is None else {"payload_kg": f"{task.payload:g}"}),
    }
    return LogFile(task.part.open("wb"), start_ns, metadata, dbc_texts(vehicle))


def _unknown(task: Task, vehicle: Vehicle, pipeline: Pipeline) -> InputError:
    unknown = sorted(pipeline.codec.unknown)[:5]
    names = ", ".join(f"{identifier & 0x1FFFFFFF:X}" for identifier in unknown)
    return InputError(
        f"{task.path}: vehicle {vehicle.name!r} knows none of its {pipeline.codec.received} frames"
        f"{f' (identifiers {names}, ...)' if names else ''}; give the vehicle that it is of with --vehicle"
    )


def _summary(
    task: Task, pipeline: Pipeline, tally: Tally, start_ns: int, damages: Sequence[LogDamage]
) -> dict[str, Any]:
    last = tally.last or Estimate(0.0)
    soc_start, soc_end = tally.soc_start or (None, None), tally.soc_end or (None, None)
    counts, status = pipeline.counts(), pipeline.status()
    states: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    for (state, bits), ticks in tally.ticks.items():
        states[state.name] += ticks
        for name in reason_names(Reason(bits)):
            reasons[name] += ticks
    return {
        "file": str(task.path),
        "log": str(task.log),
        "plot": str(task.picture) if task.plot else None,
        "vehicle": pipeline.vehicle.name,
        "filter": task.filter_name,
        "start_ns": start_ns,
        "duration_s": last.time,
        "distance_km": last.distance * 1e-3,
        "speed_max_km_h": times(tally.speed_max, 3.6),
        "energy_wh": times(tally.drawn, 1 / WH),
        "energy_recovered_wh": None if tally.drawn is None else tally.recovered / WH,
        "consumption_wh_km": times(tally.drawn, 1 / last.distance / WH_PER_KM) if last.distance >= 100 else None,
        "soc_start": soc_start[0],
        "soc_start_sd": soc_start[1],
        "soc_end": soc_end[0],
        "soc_end_sd": soc_end[1],
        "range_start_km": times(tally.range_start, 1e-3),
        "range_end_km": times(last.range, 1e-3),
        "range_end_p10_km": times(last.range_p10, 1e-3),
        "range_end_p90_km": times(last.range_p90, 1e-3),
        "energy_left_wh": times(last.energy_left, 1 / WH),
        "innovation_rms_v": tally.innovation_rms,
        "innovation_max_v": tally.innovation_max if tally.innovation_rms is not None else None,
        "states": {state.name: round(states[state.name] * 0.1, 1) for state in State if states[state.name]},
        "reasons": {name: round(ticks * 0.1, 1) for name, ticks in sorted(reasons.items())},
        "frames": pipeline.codec.received,
        "dropped": counts.dropped,
        "implausible": counts.implausible,
        "lost": counts.lost,
        "unknown": counts.unknown,
        "error_frames": pipeline.codec.error_frames,
        "faults": status["faults"],
        "damage": str(damages[0]) if damages else None,
    }


# --- the command --------------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard estimate``."""
    explain_keys(parser, "a ride in the", SUMMARY_VERSION, KEYS)
    add = parser.add_argument
    add(
        "logs",
        nargs="+",
        type=Path,
        metavar="FILE",
        help="candump .log, .asc, .blf, .trc, .mf4, .csv, .mcap, or .gz; or a folder of them (but .csv)",
    )
    add(
        "--vehicle", default="reference", metavar="NAME|TOML", help="vehicle file or one of the package's (%(default)s)"
    )
    add("--payload", type=float, metavar="KG", help="mass of rider and luggage, where it is known")
    add("--filter", default="scalar", choices=("scalar", "filterpy"), help="backend of the SOC filter (%(default)s)")
    add("--output", type=Path, default=Path(), metavar="DIR", help="where to write (the current directory)")
    add("--json", nargs="?", const="-", metavar="FILE|-", help="write the summary as JSON, to standard output or FILE")
    add("--no-plot", action="store_true", help="draw no overview")
    add("--signals", action="store_true", help="write each message's signals into the MCAP too, once a second")
    add("--frames", action="store_true", help="write the raw frames and the range frames into the MCAP too")
    add("--jobs", type=int, metavar="N", help="estimate so many logs at a time (as many as there are processors)")


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard estimate``: 0 if every log could be estimated, else `BAD_INPUT`."""
    tasks = _tasks(arguments)
    _vehicle(arguments.vehicle, arguments.payload)  # its errors are none of a log's
    rides: list[dict[str, Any]] = []
    failed: list[dict[str, str]] = []
    with progress_bar(lambda: _frames(tasks), unit=" frames", unit_scale=True) as (progress, say):
        for task, result in _results(tasks, arguments.jobs, progress):
            if isinstance(result, InputError):
                failed.append({"file": str(task.path), "error": str(result)})
                say(f"gz-onboard estimate: {result}", sys.stderr)
                continue
            rides.append(result)
            if result["damage"]:
                say(f"gz-onboard estimate: {result['damage']}", sys.stderr)
            if arguments.json != "-":
                say(summary_text(result), sys.stdout)
    if arguments.json:
        write_json(arguments.json, {"version": SUMMARY_VERSION, "rides": rides, "failed": failed})
    return BAD_INPUT if failed else 0


def _tasks(arguments: argparse.Namespace) -> list[Task]:
    check_json(arguments.json)
    paths = list(dict.fromkeys(logs_among(arguments.logs)))
    names = output_names(paths, [_stem(path) for path in paths], ".estimate.mcap")
    return [
        Task(
            path,
            arguments.output / name,
            arguments.vehicle,
            arguments.payload,
            arguments.filter,
            arguments.frames,
            arguments.signals,
            not arguments.no_plot,
        )
        for path, name in zip(paths, names, strict=True)
    ]


def _stem(path: Path) -> str:
    """The name without the suffixes of its format."""
    name = path.name
    for suffix in (".gz", path.with_suffix("").suffix if path.suffix.lower() == ".gz" else path.suffix):
        if suffix and name.lower().endswith(suffix.lower()):
            name = name[: -len(suffix)]
    return name.removesuffix(".estimate")


def _results(
    tasks: Sequence[Task], jobs: int | None, progress: Progress
) -> Iterator[tuple[Task, dict[str, Any] | InputError]]:
    """Each task with its summary or its error, in order."""
    try:
        yield from over_rides(estimate_log, tasks, jobs, progress)
    finally:
        for task in tasks:  # of processes that were stopped
            with contextlib.suppress(OSError):  # no such folder; why was told
                task.part.unlink(missing_ok=True)


# --- what a person sees -------------------------------------------------------------------------------------------


def _frames(tasks: Sequence[Task]) -> int | None:
    """About how many frames all the logs hold; None if that of one is unknown."""
    sizes = [_expected(task.path) for task in tasks]
    return sum(size for size in sizes if size) if all(sizes) else None


def _expected(path: Path) -> int | None:
    """About how many frames the log holds: as its header says, or by the length of its lines; None if unknown."""
    try:
        with path.open("rb") as file:
            head = file.read(65536)
        if path.suffix.lower() == ".blf":
            return int.from_bytes(head[32:36], "little")
        if path.suffix.lower() in (".log", ".asc", ".trc", ".csv"):
            return path.stat().st_size * head.count(b"\n") // max(len(head), 1)
    except OSError:
        pass
    return None


def summary_text(ride: dict[str, Any]) -> str:
    """A ride's summary for a terminal."""
    soc = [_percent(ride[f"soc_{end}"], ride[f"soc_{end}_sd"]) for end in ("start", "end")]
    rows = [
        (
            "ride",
            f"{clock(ride['duration_s'])}, {ride['distance_km']:.2f} km, "
            f"at most {number(ride['speed_max_km_h'], '.0f', 'km/h')}",
        ),
        (
            "energy",
            f"{number(ride['energy_wh'], '.0f', 'Wh')} drawn net, "
            f"{number(ride['energy_recovered_wh'], '.0f', 'Wh')} of it recovered before; "
            f"{number(ride['consumption_wh_km'], '.1f', 'Wh/km')}",
        ),
        ("state of charge", f"{soc[0]} at the start, {soc[1]} at the end"),
        (
            "range at the end",
            f"{number(ride['range_end_km'], '.1f', 'km')} "
            f"({number(ride['range_end_p10_km'], '.1f')} to "
            f"{number(ride['range_end_p90_km'], '.1f')}, 80 % interval), "
            f"{number(ride['energy_left_wh'], '.0f', 'Wh')} left",
        ),
        (
            "innovation",
            f"{number(ride['innovation_rms_v'], '.1f', 'mV', 1000)} RMS, "
            f"{number(ride['innovation_max_v'], '.0f', 'mV', 1000)} at most, of a cell",
        ),
        (
            "frames",
            f"{ride['frames']} received, {ride['dropped']} dropped, {ride['lost']} lost, "
            f"{ride['unknown']} unknown identifiers, {ride['error_frames']} error frames",
        ),
        *(
            ("sensor faults", f"{reason}: " + ", ".join(f"{name} {count}" for name, count in places.items()))
            for reason, places in ride["faults"].items()
        ),
        ("state", ", ".join(f"{name.lower()} {duration:.1f} s" for name, duration in ride["states"].items())),
        *(("", f"{reason_words(Reason[name])} {duration:.1f} s") for name, duration in ride["reasons"].items()),
        (
            "computed",
            f"{ride['cpu_s']:.2f} s of processor time, {number(ride['real_time_factor'], '.0f')} times "
            "as fast as the ride",
        ),
        ("written", f"{ride['log']}{' and .png' if ride['plot'] else ''}"),
    ]
    return "\n".join([f"{ride['file']}", *(f"  {name:17} {text}" for name, text in rows)])


def _percent(value: float | None, sd: float | None) -> str:
    return "–" if value is None or sd is None else f"{100 * value:.1f} ± {100 * sd:.1f} %"
