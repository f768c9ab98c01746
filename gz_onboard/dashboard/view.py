"""Decode, check and age the range frames on the bus."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.bus.checksum import crc8_sae_j1850
from gz_onboard.bus.layout import raw_range
from gz_onboard.bus.publisher import KNOWN, Publisher, reason_signal
from gz_onboard.dashboard import LATE_PERIODS
from gz_onboard.events import NO_PACK, NO_SENSOR, OF_RIDING, STALE_PERIODS, Activity, Frame, Reason, State

if TYPE_CHECKING:
    from cantools.database.can import Message

    from gz_onboard.dashboard.vehicle_frames import VehicleFrames

TREND_STEP, TREND_STEPS = 10.0, 60  # s between the ranges of the last ten minutes, and their number
PERIODS_MS = {"RANGE_Status": 100}  # where the DBC file does not say; 1000 for other messages


@dataclass
class ReceivedMessage:
    """One message of the range frames: definition, latest values and counts."""

    definition: Message
    period: float  # s
    limits: dict[str, tuple[float, float]]  # raw
    values: dict[str, float | None] = field(default_factory=dict)
    time: float = -math.inf  # s, of the last good frame
    counter: int | None = None
    received: int = 0
    lost: int = 0  # by its counter
    bad: int = 0  # wrong length or checksum, or a counter that does not move

    def late(self, now: float) -> bool:
        """Whether a newer one should have come by `now` [s]."""
        return now - self.time > LATE_PERIODS * self.period

    def stale(self, now: float) -> bool:
        """Whether its values are too old to be shown at `now` [s]."""
        return now - self.time > STALE_PERIODS * self.period

    def take(self, data: bytes, now: float) -> bool:
        """Take in a frame that came at `now`; False for one that fails a check, which is counted and not used."""
        message = self.definition
        if len(data) != message.length or crc8_sae_j1850(data[:-1]) != data[-1]:
            self.bad += 1
            return False
        raw = message.decode_simple(data, decode_choices=False, scaling=False)
        counter = int(str(raw[f"{message.name}Counter"]))
        if self.counter is not None and not self.stale(now):
            step = (counter - self.counter) % (int(self.limits[f"{message.name}Counter"][1]) + 1)
            if step == 0:  # a repeated frame: the sender may hang
                self.bad += 1
                return False
            self.lost += step - 1
        self.counter, self.time = counter, now
        self.received += 1
        for signal in message.signals:
            value = float(str(raw[signal.name]))
            low, high = self.limits[signal.name]
            scale, offset = float(signal.conversion.scale), float(signal.conversion.offset)
            self.values[signal.name] = value * scale + offset if low <= value <= high else None
        return True


class View:
    """The range frames of one vehicle, as last received.

    source: the vehicle's publisher, or a DBC file, the package's ``range.dbc`` if none is given; vehicle: reads the
    vehicle's own frames that are shown. No clock: times [s, monotonic] come with the frames. InputError if a
    message or signal of ``range.dbc`` is missing in the file.
    """

    def __init__(self, source: Publisher | Path | None = None, vehicle: VehicleFrames | None = None) -> None:
        publisher = source if isinstance(source, Publisher) else Publisher(source)
        self.source = publisher
        self.file = publisher.file
        self.vehicle = vehicle
        self.messages: dict[str, ReceivedMessage] = {}
        self._of_signal: dict[str, ReceivedMessage] = {}
        for name, message in publisher.messages.items():
            limits = {s.name: raw_range(s, not_available=True) for s in message.signals}
            period = (message.cycle_time or PERIODS_MS.get(name, 1000)) / 1000
            self.messages[name] = ReceivedMessage(message, period, limits)
            self._of_signal |= dict.fromkeys(limits, self.messages[name])
        self._by_identifier = {i: self.messages[message.name] for i, message in publisher.sent.items()}
        self._seen_sensors = Reason(0)  # by their reasons, the sensors that have worked since the daemon started
        self._ranges: dict[int, float | None] = {}  # km, by the number of the step of `TREND_STEP`

    @property
    def comments(self) -> dict[str, str]:
        """Comments in the DBC file, by signal."""
        return {s.name: s.comment or "" for entry in self.messages.values() for s in entry.definition.signals}

    @property
    def identifiers(self) -> list[int] | None:
        """Of the frames that it reads, for the kernel's filter; None: any."""
        others = self.vehicle.identifiers if self.vehicle else []
        return None if others is None else [*self._by_identifier, *others]

    def take(self, frame: Frame, now: float) -> None:
        """Take in a frame that came at `now`."""
        entry = self._by_identifier.get(frame[1])
        if entry is None:
            if self.vehicle:
                self.vehicle.take(frame, now)
        elif entry.take(frame[2], now):
            name = entry.definition.name
            if name == "RANGE_Estimate":
                step = int(now // TREND_STEP)
                kept = {i: km for i, km in self._ranges.items() if i > step - TREND_STEPS}
                self._ranges = kept | {step: entry.values["RANGE_Remaining"]}
            elif name == "RANGE_Status":
                self._note_sensors(now)

    def _note_sensors(self, now: float) -> None:
        """Note which sensors work: only one of these can be lost."""
        working = ~self.reasons(now)
        if self.activity(now) is Activity.CHARGING:
            working &= ~OF_RIDING  # their absence is not reported then
        starting = self._state("RANGE_StatusState", now) is State.STARTING
        self._seen_sensors = working if starting else self._seen_sensors | working

    def value(self, signal: str, now: float) -> float | None:
        """A signal's value in the units of the DBC file; None if it is stale, not available or never came.

        The consumption of the last kilometre is unknown while the state is invalid, as nobody knows its age.
        """
        if signal == "RANGE_ConsumptionRecent" and self.state(now) is State.INVALID:
            return None
        entry = self._of_signal[signal]
        return None if entry.stale(now) else entry.values.get(signal)

    def state(self, now: float) -> State | None:
        """State of the estimate; None if no frame says it.

        The status comes ten times as often as the range, and may be ahead of it: until the range follows, the state is
        that of the last range, or starting.
        """
        status, estimate = (self._state(name, now) for name in ("RANGE_StatusState", "RANGE_EstimateState"))
        if status in KNOWN and self.value("RANGE_Remaining", now) is None:
            if not self.messages["RANGE_Estimate"].received:
                return State.STARTING
            status = estimate
        return estimate if status is None else status

    def _state(self, signal: str, now: float) -> State | None:
        value = self.value(signal, now)
        return State(int(value)) if value is not None and value in tuple(State) else None

    def activity(self, now: float) -> Activity | None:
        """Activity of the vehicle; None if it is unknown, or before there is an estimate."""
        value = None if self.state(now) is State.STARTING else self.value("RANGE_Activity", now)
        return Activity(int(value)) if value and value in tuple(Activity) else None

    def reasons(self, now: float) -> Reason:
        """Reasons why the estimate is not as good as it could be."""
        return Reason(sum(reason for reason in Reason if self.value(reason_signal(reason), now)))

    def lost(self, now: float) -> Reason:
        """Sensors that have worked and no longer do; one that never worked is missing, not lost."""
        return self.reasons(now) & NO_SENSOR & self._seen_sensors

    def waiting(self, now: float) -> bool:
        """Whether there is no estimate because the scooter is not switched on yet, or sleeps."""
        if self.state(now) not in (State.STARTING, State.INVALID):
            return False
        pack, activity = self.reasons(now) & NO_PACK, self.activity(now)
        return bool(pack) and (activity is Activity.ASLEEP or (not activity and not pack & self._seen_sensors))

    def trend(self, now: float) -> list[float | None]:
        """Ranges [km], one each `TREND_STEP` of the last ten minutes, the oldest first; empty if there is none now."""
        if self.value("RANGE_Remaining", now) is None:
            return []
        step = int(now // TREND_STEP)
        return [self._ranges.get(i) for i in range(step - TREND_STEPS + 1, step + 1)]
