"""Rides in the order of their times, by the clocks of their logs: as what is learned goes from one to the next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

from gz_onboard.can.codec import LONGEST_PAUSE_NS, Codec
from gz_onboard.errors import InputError
from gz_onboard.estimator.consumption import CONSUMPTION
from gz_onboard.lab.estimate_log import EstimateTask
from gz_onboard.lab.estimate_ride import open_estimate, vehicle_of
from gz_onboard.lab.estimate_state import OVERTAKEN, StateAt, when
from gz_onboard.offline.samples import facts_of
from gz_onboard.offline.signal_table import SignalTable
from gz_onboard.progress import Progress
from gz_onboard.recording.timeline import on_timeline
from gz_onboard.reports.results import FIRST_DATE_NS
from gz_onboard.vehicle import Vehicle

Unread: TypeAlias = tuple[EstimateTask, InputError]
"""A log that cannot be read, and why."""


@dataclass(frozen=True)
class Span:
    """When a ride was [ns since the epoch], and of which vehicle."""

    begin_ns: int
    end_ns: int
    vehicle: str


def span_of(source: Path | SignalTable, vehicle: Vehicle, progress: Progress | None = None) -> Span:
    """When the ride in a log or a table was, by its clock as it is set at the end. InputError if that has no date."""
    ride = open_estimate(source, vehicle)
    codec = Codec(replace(ride.vehicle.mapping, sources=(), requests=()), LONGEST_PAUSE_NS)
    on_timeline(ride.frames.time_ns, codec)
    if progress:
        progress(len(ride.frames))
    return Span(codec.time_ns(0.0), codec.last_ns, ride.vehicle.name)


def state_at(file: Path, source: Path | SignalTable, span: Span) -> StateAt:
    """The saved state, for the ride in `source`, with who rides by the ``rides.json`` beside it. Raises InputError."""
    if span.begin_ns < FIRST_DATE_NS:
        raise undated([source.name if isinstance(source, SignalTable) else source])
    rider = "" if isinstance(source, SignalTable) else str(facts_of(source).get("rider", ""))
    most = CONSUMPTION.most_name_letters
    if len(rider) > most:
        raise InputError(f"{source}: rides.json: rider {rider!r}: must have at most {most} letters")
    return StateAt(file, span.begin_ns, rider)


def undated(logs: Sequence[Path]) -> InputError:
    """That these logs do not tell when they were."""
    return InputError(
        f"{', '.join(map(str, logs))}: has no date, as its clock was not set; a saved state needs the times of the "
        "rides, for their order and what passed between them"
    )


def in_order(
    tasks: Sequence[EstimateTask], file: Path, progress: Progress | None = None
) -> tuple[list[EstimateTask], list[Unread]]:
    """(the tasks in the order of their rides, to go on from the state `file`, those whose logs cannot be read).

    InputError naming the logs if two overlap or are of two vehicles, or if they have no date.
    """
    spans: list[tuple[Span, EstimateTask]] = []
    unread: list[Unread] = []
    for task in tasks:
        try:
            spans.append((span_of(task.path, vehicle_of(task), progress), task))
        except InputError as error:
            unread.append((task, error))
    if without := [task.path for span, task in spans if span.begin_ns < FIRST_DATE_NS]:
        raise undated(without)
    spans.sort(key=lambda one: one[0].begin_ns)
    for (one, before), (other, after) in pairwise(spans):
        if one.vehicle != other.vehicle:
            raise InputError(
                f"{before.path} is of {one.vehicle} and {after.path} of {other.vehicle}: "
                "a saved state is of one vehicle"
            )
        if (one.end_ns - other.begin_ns) * 1e-9 > OVERTAKEN:
            raise InputError(
                f"{before.path} and {after.path} overlap: {_times(one)} and {_times(other)}; "
                "a saved state goes from one ride to the next; give one of the two"
            )
    return [replace(task, state=state_at(file, task.path, span)) for span, task in spans], unread


def _times(span: Span) -> str:
    return f"{when(span.begin_ns * 1e-9)} to {when(span.end_ns * 1e-9)}"
