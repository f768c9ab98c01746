"""Codec, estimator, publisher and recorder in a row: the same for a live bus, a replayed log and an offline estimate.

Time is that of the frames. Windows of half a second end on a grid of that time, so it does not matter in what
portions the frames arrive. At the end of each the estimator makes a step and an estimate.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from gz_onboard.can.codec import DROPPING, RANGE, Codec
from gz_onboard.can.origins import Origins
from gz_onboard.can.publisher import KNOWN, MESSAGES, Counts, Publisher
from gz_onboard.constants import BENCH_TEMPERATURE, WH
from gz_onboard.errors import InputError, nearest
from gz_onboard.estimator import signals
from gz_onboard.estimator.battery_filter import SCALAR, Backend
from gz_onboard.estimator.energy_counter import EnergyCounter
from gz_onboard.estimator.estimator import Estimator
from gz_onboard.estimator.forecast import Forecaster
from gz_onboard.events import EFF_FLAG, WINDOW, Estimate, Frame, MessageWindow, Reason, State, hexadecimal
from gz_onboard.log_rows import (
    BATTERY_ENDS_TOPIC,
    CHANGE_TOPIC,
    ESTIMATE_TOPIC,
    LOCATION_TOPIC,
    STATUS_TOPIC,
    WHY_TOPIC,
    Log,
    declare,
    estimate_row,
    explanation_row,
    learned_row,
    location_row,
    position_row,
    reason_names,
    ride_row,
)
from gz_onboard.model.drawable import drawable
from gz_onboard.options import FILTERS
from gz_onboard.vehicle import Vehicle

TICK_NS = 100_000_000  # status at 10 Hz
TICKS_PER_WINDOW = round(WINDOW * 1e9 / TICK_NS)
WINDOW_NS = TICKS_PER_WINDOW * TICK_NS
WINDOWS_PER_RANGE = 2  # range at 1 Hz
FREE = (
    *range(0x600, 0x700, 0x10),
    *range(0x10, 0x600, 0x10),
    *range(0x18FF_6000 | EFF_FLAG, 0x19FF_6000 | EFF_FLAG, 0x1000),
)
"""First identifiers for range frames, best first: 11 bits, low priority, below those of diagnosis from 0x700 on."""


def filter_backend(name: str) -> Backend:
    """Return the backend of the battery filter by its name in `FILTERS`; ``filterpy`` imports numpy and scipy."""
    if name not in FILTERS:
        raise InputError(f"filter {name!r}: must be {' or '.join(FILTERS)}{nearest(name, FILTERS)}")
    if name == "scalar":
        return SCALAR
    from gz_onboard.estimator.filterpy_reference import FILTERPY

    return FILTERPY


@dataclass(frozen=True)
class SystemHealth:
    """Bus and disks around the pipeline, as the daemon sees them; frames are counted since its start."""

    kernel_lost: int = 0
    overrun: int = 0  # left out by the daemon: too many, or stamped while the clock was set
    send_failures: int = 0  # that a channel did not take
    log_lost: int = 0  # that are in no log
    reasons: Reason = field(default=Reason(0))  # bus down, log or state not written


class Pipeline:
    """Turns the frames of one vehicle into estimates.

    log: where to write, if anywhere; log_frames, log_signals: also the raw frames, and each message's latest
    signals once a second. observer: called with each estimate made, at the end of each window.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        *,
        filter_name: str = "scalar",
        log: Log | None = None,
        log_frames: bool = True,
        log_signals: bool = True,
        observer: Callable[[Estimate], None] | None = None,
    ) -> None:
        self.vehicle = vehicle
        self.codec = Codec(vehicle.mapping)
        self.estimator = Estimator(
            self.codec.groups, vehicle.pack, vehicle.model, vehicle.riding, filter_backend(filter_name)
        )
        self.publisher = range_publisher(vehicle)
        self.health = SystemHealth()  # replaced by the daemon
        self.energy = EnergyCounter()
        self.last: Estimate | None = None
        self.last_known: Estimate | None = None  # the last that had a range
        self._log = log
        self.frame_log = log if log_frames else None
        self.signal_log = log if log_signals else None
        self._observer = observer
        self._next_ns: int | None = None
        self._ticks = 0  # since a window ended, counted on
        self._windows = 0
        self._range_due = False  # frames of a second that has ended
        self._counted = Counts()  # at the end of a second
        self._recent = Reason(0)
        if log:
            answers = [request.message for request in vehicle.mapping.requests]
            declare(log, [*self.codec.mapping.database.messages, *answers] if log_signals else ())

    def advance(self, frames: Sequence[Frame], until_ns: int) -> list[Frame]:
        """Process `frames`, ordered by time, up to `until_ns`; return the frames to send."""
        if self._next_ns is None or (frames and self.codec.origin_ns is None):
            # On a silent bus we say that we are there and have nothing; the grid begins with the first frame.
            self._next_ns, self._ticks = (frames[0][0] if frames else until_ns) + TICK_NS, 0
        out: list[Frame] = []
        if not -WINDOW_NS <= until_ns - self._next_ns <= 50 * TICK_NS:  # a pause, or the clock was set
            end = self._next_ns + -self._ticks % TICKS_PER_WINDOW * TICK_NS
            self.end_window(self.codec.windows(), self.codec.seconds(end), end)
            out += self.publish(end)
            begin = frames[0][0] if frames and self._next_ns <= frames[0][0] <= until_ns else until_ns
            self._next_ns, self._ticks = end + ((begin - end) // WINDOW_NS + 1) * WINDOW_NS, 0  # on the same grid
        done = 0
        while (tick_ns := self._next_ns) <= until_ns:
            end = bisect_left(frames, (tick_ns,), done)
            self._take(frames[done:end])
            done = end
            if self._ticks % TICKS_PER_WINDOW == 0:
                self.end_window(self.codec.windows(), self.codec.seconds(tick_ns), tick_ns)
            self._ticks += 1
            self._next_ns += TICK_NS
            out += self.publish(tick_ns)
        self._take(frames[done:])
        return out

    def clock_set(self, delta_ns: int) -> None:
        """Keep the timeline continuous although the clock that stamps the frames was set by `delta_ns`."""
        self.codec.clock_set(delta_ns)
        if self._next_ns is not None:
            self._next_ns += delta_ns

    def _take(self, frames: Sequence[Frame]) -> None:
        self.codec.decode(frames)
        if self.frame_log:
            self.frame_log.frames(frames)

    def end_window(self, windows: Sequence[MessageWindow], now: float, time_ns: int) -> None:
        """Make a step of the estimator with `windows` and an estimate; every second count faults and log.

        The window ends at `now` [s] on the codec's timeline, `time_ns` by the clock of the frames.
        """
        whole_second = self._windows % WINDOWS_PER_RANGE == 0
        self._windows += 1
        if whole_second:
            before, self._counted = self._counted, self.counts()
            self._recent = Reason.FRAMES_DROPPED if self._counted.dropped > before.dropped else Reason(0)
            if self._counted.lost > before.lost:
                self._recent |= Reason.FRAMES_LOST
        self.estimator.step(windows)
        estimate = self.estimator.estimate(now)
        estimate.reasons |= self._recent | self.health.reasons
        if self.health.reasons & Reason.BUS_DOWN and estimate.state is State.VALID:
            estimate.state = State.DEGRADED
        self.last = estimate
        self.energy.add(estimate)
        if estimate.range is not None and estimate.state in KNOWN:
            self.last_known = estimate
        if self._observer:
            self._observer(estimate)
        if whole_second:
            self._range_due = True
            if self._log:
                self._sample(self._log, now, time_ns, estimate)

    def publish(self, time_ns: int) -> list[Frame]:
        """Return the frames to send at a tick, after the first window: status, and the range once a second."""
        assert self.last is not None
        sent = self.publisher.status(self.last, time_ns)
        if self._range_due:
            sent += self.publisher.range(self.last, self._counted, time_ns)
            self._range_due = False
        if self.frame_log:
            self.frame_log.frames(sent)
        return sent

    def counts(self) -> Counts:
        """Return the counts since the start."""
        codec = self.codec
        return Counts(
            dropped=sum(n for (_, reason), n in codec.faults.items() if reason in DROPPING),
            implausible=sum(n for (_, reason), n in codec.faults.items() if reason == RANGE),
            lost=self.health.kernel_lost + self.health.overrun + sum(codec.lost.values()),
            unknown=len(codec.unknown),
        )

    def _sample(self, log: Log, now: float, time_ns: int, estimate: Estimate) -> None:
        log.sample(ESTIMATE_TOPIC, time_ns, estimate_row(estimate))
        log.sample(STATUS_TOPIC, time_ns, self.status())
        for change, why in self.estimator.explainer.news():
            log.sample(CHANGE_TOPIC if change else WHY_TOPIC, time_ns, explanation_row(why))
        if estimate.battery_ends_latitude is not None and estimate.battery_ends_longitude is not None:
            there = estimate.battery_ends_latitude, estimate.battery_ends_longitude
            log.sample(BATTERY_ENDS_TOPIC, time_ns, location_row(time_ns, "battery_ends", *there, None))
        if not self.signal_log:
            return
        logged_ns = time_ns - WINDOWS_PER_RANGE * WINDOW_NS  # what was seen until then was logged before
        for name, (seen_ns, _, data, _) in self.codec.latest.items():
            if seen_ns > logged_ns:
                log.sample(f"/can/{name}", time_ns, self.codec.values(name, data), seen_ns)
        position = position_row(self.estimator.signals, now, time_ns)
        if position and position[0] > logged_ns:
            log.sample(LOCATION_TOPIC, time_ns, position[1], position[0])

    @property
    def foreign(self) -> dict[str, int]:
        """Count frames of another sender on our own identifiers, by identifier: a reader may mistake them for ours."""
        unknown = self.codec.unknown
        return {hexadecimal(i): unknown[i] for i in sorted(self.publisher.identifiers) if i in unknown}

    def status(self) -> dict[str, object]:
        """Return the counts since the start by message and reason, the ride so far, and the learned values."""
        codec, health, estimator, last = self.codec, self.health, self.estimator, self.last or Estimate(0.0)
        ambient = estimator.signals.ambient_temperature.get(last.time)
        faults: dict[str, dict[str, int]] = {}
        for (message, reason), count in sorted(codec.faults.items()):
            faults.setdefault(reason, {})[message or "any"] = count
        return {
            "received": codec.received,
            "error_frames": codec.error_frames,
            "kernel_lost": health.kernel_lost,
            "overrun": health.overrun,
            "send_failures": health.send_failures,
            "log_lost": health.log_lost,
            "unknown_others": codec.unknown_others,
            "copies": codec.copies,
            "foreign": self.foreign,
            "faults": faults,
            "lost": dict(sorted(codec.lost.items())),
            "unknown": {hexadecimal(i): n for i, n in sorted(codec.unknown.items())[:32]},
            "reasons": reason_names(last.reasons),
            "ride": ride_row(last, self.energy, ambient, estimator.forecaster.learner.rider),
            "learned": learned_row(estimator.pack.learned()),
        }


def range_publisher(vehicle: Vehicle) -> Publisher:
    """Make the publisher of the vehicle's range frames.

    InputError if its own messages take their identifiers, or if they cannot say what its battery holds, or how far
    that takes it by the prior riding.
    """
    publisher, mapping = vehicle.publisher(), vehicle.mapping
    asked = {one for request in mapping.requests for one in (request.request, request.response)}
    origins = Origins(mapping, ())
    if clash := [i for i in publisher.identifiers if i in asked or origins.find(i)]:
        free = next(i for i in FREE if not any(i + n in asked or origins.find(i + n) for n in range(MESSAGES)))
        raise vehicle.error(
            f"its DBC files or requests take the identifiers of our own range frames ({publisher.file}): "
            f"{', '.join(hexadecimal(i) for i in sorted(clash))}; give range_identifier = {free:#x}, "
            f"from which on {MESSAGES} are free in them"
        )
    if vehicle.battery:
        full = drawable(vehicle.battery, 1.0, BENCH_TEMPERATURE, 1.0).energy
        forecaster = Forecaster(vehicle.model, vehicle.battery, vehicle.riding)
        reach = forecaster.forecast(1.0, 0.0, BENCH_TEMPERATURE, 0.0, BENCH_TEMPERATURE, 0.0).range
        for what, value, signal, si, unit in (
            ("the battery holds", full, "RANGE_EnergyLeft", WH, "Wh"),
            ("the expected range from full is", reach, "RANGE_Remaining", 1000.0, "km"),
        ):
            if value > (most := publisher.greatest(signal)):
                raise vehicle.error(
                    f"{what} {value / si:.0f} {unit}, but {signal} of {publisher.file} says at most "
                    f"{most / si:g} {unit}: "
                    'give range frames of a larger scale, such as range_dbc = "range_large.dbc"'
                )
    return publisher


def lacking(vehicle: Vehicle) -> list[str]:
    """Return the reasons that would always be set, for sensors that the vehicle does not have."""
    return reason_names(signals.lacking({source.role for source in vehicle.mapping.sources}))


def dbc_texts(vehicle: Vehicle) -> dict[str, bytes]:
    """Return the DBC files that decode a log of this vehicle, by name."""
    own = vehicle.range_dbc.read_bytes() if vehicle.range_identifier is None else vehicle.publisher().dbc()
    return {file.name: file.read_bytes() for file in vehicle.mapping.dbc_files} | {vehicle.range_dbc.name: own}
