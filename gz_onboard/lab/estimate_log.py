"""A log estimated: its MCAP and its picture; or what an earlier run made of it, if that is whole and of the same."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path

from gz_onboard import __version__, state
from gz_onboard.can.logfile import LogFile
from gz_onboard.can.recorder import is_complete
from gz_onboard.errors import InputError, writing
from gz_onboard.lab.estimate_ride import How, Ridden, open_estimate, ride_through, vehicle_of
from gz_onboard.lab.estimate_state import StateAt, latest, text_of
from gz_onboard.lab.estimate_summary import SUMMARY_VERSION, RideSummary, kept_summary, summary_of, summary_to_keep
from gz_onboard.log_rows import ESTIMATE_TOPIC
from gz_onboard.offline.digest import digest_of
from gz_onboard.offline.processes import Task
from gz_onboard.offline.samples import of_ride
from gz_onboard.pipeline import dbc_texts, lacking
from gz_onboard.progress import Progress
from gz_onboard.recording.logs import ESTIMATED, read_metadata, read_samples
from gz_onboard.reports.charts import overview
from gz_onboard.reports.results import clock, number
from gz_onboard.reports.style import save
from gz_onboard.routes.route import read_route
from gz_onboard.vehicle import Vehicle

_RECORD = "gz_onboard.estimate"  # of metadata, at the end of the log: of what the estimates are, and their summary
_SUMMARY = "summary"
_BEFORE, _AFTER = "state_before", "state_after"  # digests of the saved state
_ENDS = (b"IEND\xaeB`\x82", b"</svg>\n", b"%%EOF\n")  # of a picture


@dataclass(frozen=True)
class EstimateTask(Task):
    """A log to be estimated; resume: not if it is already, as it would be now; state: the saved state to go on from."""

    filter_name: str = "scalar"
    frames: bool = False
    signals: bool = False
    route: Path | None = None
    resume: bool = False
    state: StateAt | None = None

    @property
    def log(self) -> Path:
        """The MCAP."""
        return self.output(ESTIMATED)

    @property
    def picture(self) -> Path | None:
        """The picture, if one is to be drawn."""
        return self.drawn(".estimate")

    @property
    def part(self) -> Path:
        """The MCAP while it is not complete."""
        return self.output(f"{ESTIMATED}.part")


def estimate_log(task: EstimateTask, progress: Progress | None = None) -> RideSummary:
    """Estimate one log and write its MCAP and picture; gives its summary. Raises InputError."""
    vehicle = vehicle_of(task)
    made_of = _made_of(task, vehicle)
    if task.resume and (kept := _kept(task, made_of)):
        if progress:
            progress(kept.frames)
        return kept
    route = read_route(task.route) if task.route else None
    ride = open_estimate(task.path, vehicle)
    if task.frames and ride.vehicle.mapping is not vehicle.mapping:
        raise InputError(f"{task.path}: is a table of signals: --frames has nothing to log")
    with writing(task.log):
        log = _open_log(task, ride.vehicle, ride.start_ns)
        try:
            how = How(task.filter_name, task.frames, task.signals, route, state=task.state)
            ridden = ride_through(ride, how, log, progress)
            learned = text_of(ridden.pipeline) if ridden.went_on else None
            summary = summary_of(ridden, task.log, task.picture)
            log.note(_RECORD, {**made_of, **_link(ridden, learned), _SUMMARY: summary_to_keep(summary)})
            log.close()
            task.part.replace(task.log)
        finally:
            log.abandon()
            task.part.unlink(missing_ok=True)
    if task.state and learned:
        with writing(task.state.file):
            state.write(task.state.file, learned)
    if task.picture:
        _draw(task.log, summary, task.picture)
    return summary


def _draw(log: Path, s: RideSummary, picture: Path) -> None:
    """Draw the estimates of a log into `picture`. Raises InputError."""
    start = datetime.fromtimestamp(s.start_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    charge = f"state of charge {number(s.soc_start, '.1f', '', 100)} → {number(s.soc_end, '.1f', '%', 100)}"
    band = f"({number(s.range_end_p10_km, '.1f')}–{number(s.range_end_p90_km, '.1f')})"
    parts = [start, clock(s.duration_s), f"{s.distance_km:z.2f} km", charge]
    parts += [f"range at the end {number(s.range_end_km, '.1f', 'km')} {band}"]
    rows = [values for topic, _, values in read_samples(log) if topic == ESTIMATE_TOPIC]
    title = f"{Path(s.file).name} · {s.vehicle}"
    with writing(picture):
        save(overview(rows, title, "  ·  ".join(["damaged log"] * bool(s.damage) + parts)), picture)


def _link(ridden: Ridden, learned: bytes | None) -> dict[str, str]:
    """Which state the ride went on from and which it left, if any, for what goes on after them."""
    if ridden.went_on is None:
        return {}
    before = ridden.went_on.digest
    return {_BEFORE: before, _AFTER: sha256(learned).hexdigest() if learned else before}


def _open_log(task: EstimateTask, vehicle: Vehicle, start_ns: int) -> LogFile:
    task.part.parent.mkdir(parents=True, exist_ok=True)
    metadata = {
        "vehicle": vehicle.name,
        "vehicle_key": vehicle.key,
        "lacking": " ".join(lacking(vehicle)),
        "source": task.path.name,
        "filter": task.filter_name,
        **({} if task.payload is None else {"payload_kg": f"{task.payload:g}"}),
        **({} if task.route is None else {"route": task.route.name}),
        **({} if task.state is None else {"state": task.state.file.name}),
    }
    return LogFile(task.part.open("wb"), start_ns, metadata, dbc_texts(vehicle))


# --- what an earlier run made ---------------------------------------------------------------------------------------


def kept_in_turn(tasks: Sequence[EstimateTask]) -> list[EstimateTask]:
    """The `tasks`, of one saved state, of which only those resume that led to the state that is there."""
    first = next((task.state for task in tasks if task.state), None)
    there = latest(first.file) if first else None
    wanted = digest_of(there) if there else None
    found: list[EstimateTask] = []
    for task in reversed(tasks):
        made = _made(task, _made_of(task, vehicle_of(task))) if wanted else None
        led = made is not None and made.get(_AFTER) == wanted
        wanted = made[_BEFORE] if made and led else wanted
        found.append(replace(task, resume=led))
    return found[::-1]


def _made_of(task: EstimateTask, vehicle: Vehicle) -> dict[str, str]:
    """All that the estimates of a log depend on, as texts."""
    effects = {effect.file for effect in vehicle.model.effects}
    files = {vehicle.file, vehicle.range_dbc, *vehicle.mapping.dbc_files, *(file for file in effects if file.is_file())}
    return {
        "version": f"{__version__}, summary {SUMMARY_VERSION}",
        "log": digest_of(task.path),
        "vehicle": " ".join(sorted({_digest_once(file) for file in files})),
        "vehicle_id": of_ride(vehicle, task.path).vehicle_id,
        "payload_kg": "" if task.payload is None else f"{task.payload:g}",
        "route": digest_of(task.route) if task.route else "",
        "options": f"filter {task.filter_name}, frames {task.frames}, signals {task.signals}",
        **({} if task.state is None else {"rider": task.state.rider}),
    }


_digest_once: Callable[[Path], str] = functools.lru_cache(maxsize=None)(digest_of)
"""Of the files that are the same for all logs."""


def _kept(task: EstimateTask, made_of: Mapping[str, str]) -> RideSummary | None:
    """The summary of the log that an earlier run wrote, if that is whole and of the same; its picture is drawn anew
    if it is not whole.
    """
    made = _made(task, made_of)
    kept = kept_summary(made.get(_SUMMARY, ""), task.path, task.log, task.picture) if made else None
    if kept is None:
        return None
    if task.picture and not _is_drawn(task.picture, task.log):
        _draw(task.log, kept, task.picture)
    return kept


def _made(task: EstimateTask, made_of: Mapping[str, str]) -> dict[str, str] | None:
    """What an earlier run noted in the log that it wrote, if that is whole and of the same."""
    try:
        if not is_complete(task.log):
            return None
        found = read_metadata(task.log, _RECORD)
    except (OSError, InputError):
        return None
    same = {key: text for key, text in found.items() if key not in (_SUMMARY, _BEFORE, _AFTER)} == made_of
    return found if same and (_BEFORE in found) == (task.state is not None) else None


def _is_drawn(picture: Path, log: Path) -> bool:
    """Whether a picture is whole, and no older than the log that it is of."""
    try:
        with picture.open("rb") as stream:
            return stream.read().endswith(_ENDS) and picture.stat().st_mtime_ns >= log.stat().st_mtime_ns
    except OSError:
        return False
