"""What the range frames on the bus say now: decoded, checked and aged."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.bus.checksum import crc8_sae_j1850
from gz_onboard.bus.layout import raw_range
from gz_onboard.bus.publisher import KNOWN, Publisher, reason_signal, sensor_signal
from gz_onboard.events import NO_PACK, NO_SENSOR, OF_RIDING, ROLES, STALE_PERIODS, Activity, Cause, Frame, Reason, State

if TYPE_CHECKING:
    from cantools.database.can import Message

    from gz_onboard.dashboard.vehicle_frames import VehicleFrames

LATE_PERIODS = 3  # after so many the numbers are shown in grey, after STALE_PERIODS not at all
NEARLY_EMPTY = 15.0  # %: a state of charge that the rider is told of
TREND_STEP, TREND_STEPS = 10.0, 60  # s between the ranges of the last ten minutes, and their number
PERIODS = {"RANGE_Status": 100}  # ms, where the DBC does not say; of the others 1000
_NUMBERS = {  # how each is written: format, unit
    "RANGE_Remaining": (".1f", "km"),
    "RANGE_RemainingP10": (".1f", "km"),
    "RANGE_RemainingP90": (".1f", "km"),
    "RANGE_EnergyLeft": (".0f", "Wh"),
    "RANGE_ConsumptionRecent": (".1f", "Wh/km"),
    "RANGE_ConsumptionExpected": (".1f", "Wh/km"),
    "RANGE_WhyRated": (".1f", "km"),
    "RANGE_StateOfCharge": (".1f", "%"),
    "RANGE_StateOfChargeSigma": (".1f", "%"),
    "RANGE_RemainingFull": (".1f", "km"),
    "RANGE_ChargePower": (".0f", "W"),
}


@dataclass
class Received:
    """What is known of one message."""

    definition: Message
    period: float  # s
    limits: dict[str, tuple[float, float]]  # raw
    values: dict[str, float | None] = field(default_factory=dict)
    time: float = -math.inf  # s, when it last came whole
    counter: int | None = None
    received: int = 0
    lost: int = 0  # by its counter
    bad: int = 0  # length, checksum, or a counter that stands still

    def late(self, now: float) -> bool:
        """Whether a newer one should have come by `now` [s]."""
        return now - self.time > LATE_PERIODS * self.period

    def stale(self, now: float) -> bool:
        """Whether its values are too old to be shown at `now` [s]."""
        return now - self.time > STALE_PERIODS * self.period


class View:
    """What the range frames say: those of a vehicle's publisher, or of a DBC file, the package's ``range.dbc`` if none
    is given.

    No clock: times [s, monotonic] come with the frames. InputError if the file has not what ``range.dbc`` has.
    """

    def __init__(self, source: Publisher | Path | None = None, vehicle: VehicleFrames | None = None) -> None:
        publisher = source if isinstance(source, Publisher) else Publisher(source)
        self.source = publisher
        self.file = publisher.file
        self.vehicle = vehicle  # of what is shown of the vehicle's own frames
        messages = publisher.messages
        self.messages: dict[str, Received] = {}
        self.comments = {s.name: s.comment or "" for m in messages.values() for s in m.signals}
        for name, message in messages.items():
            limits = {s.name: raw_range(s, not_available=True) for s in message.signals}
            self.messages[name] = Received(message, (message.cycle_time or PERIODS.get(name, 1000)) / 1000, limits)
        self._by_identifier = {i: self.messages[message.name] for i, message in publisher.sent().items()}
        self._came = Reason(0)  # by their reasons, the sensors that have been there since the daemon started
        self._ranges: dict[int, float | None] = {}  # km, by the number of the step of `TREND_STEP`

    @property
    def identifiers(self) -> list[int] | None:
        """Of the frames that it reads: all that the kernel need let through; None: any."""
        others = self.vehicle.identifiers if self.vehicle else []
        return None if others is None else [*self._by_identifier, *others]

    def take(self, frame: Frame, now: float) -> None:
        """Take in a frame that came at `now`; one that fails a check is counted and not used."""
        _, identifier, data, _ = frame
        entry = self._by_identifier.get(identifier)
        if entry is None:
            if self.vehicle:
                self.vehicle.take(frame, now)
            return
        message = entry.definition
        if len(data) != message.length or crc8_sae_j1850(data[:-1]) != data[-1]:
            entry.bad += 1
            return
        raw = message.decode_simple(data, decode_choices=False, scaling=False)
        counter = int(str(raw[f"{message.name}Counter"]))
        if entry.counter is not None and not entry.stale(now):
            step = (counter - entry.counter) % (int(entry.limits[f"{message.name}Counter"][1]) + 1)
            if step == 0:  # the same frame again: who sends it may hang
                entry.bad += 1
                return
            entry.lost += step - 1
        entry.counter = counter
        entry.time = now
        entry.received += 1
        for signal in message.signals:
            value = float(str(raw[signal.name]))
            low, high = entry.limits[signal.name]
            scale, offset = float(signal.conversion.scale), float(signal.conversion.offset)
            entry.values[signal.name] = value * scale + offset if low <= value <= high else None
        if message.name == "RANGE_Estimate":
            step = int(now // TREND_STEP)
            kept = {i: km for i, km in self._ranges.items() if i > step - TREND_STEPS}
            self._ranges = kept | {step: entry.values["RANGE_Remaining"]}
        elif message.name == "RANGE_Status":
            self._note_sensors(now)

    def _note_sensors(self, now: float) -> None:
        """Note which sensors are there: only one that has been can be lost."""
        working = ~sum(self.reasons(now), Reason(0))
        if self.activity(now) == "charging":
            working &= ~OF_RIDING  # their absence is not reported then
        starting = self._state("RANGE_StatusState", now) == State.STARTING
        self._came = working if starting else self._came | working

    def value(self, signal: str, now: float) -> float | None:
        """A signal's value in the units of the DBC; None if it is stale, not available or never came.

        Of the last kilometre nothing is told while the state is invalid: nobody knows how old it is.
        """
        if signal == "RANGE_ConsumptionRecent" and self.state(now) is State.INVALID:
            return None
        for entry in self.messages.values():
            if signal in entry.limits:
                return None if entry.stale(now) else entry.values.get(signal)
        raise KeyError(signal)

    def text(self, signal: str, now: float) -> str:
        """The value with its unit; a dash if there is none."""
        value = self.value(signal, now)
        form, unit = _NUMBERS[signal]
        return "–" if value is None else f"{value:{form}} {unit}"

    def state(self, now: float) -> State | None:
        """How far the numbers can be trusted; None if nothing says so.

        The status comes ten times as often as the range, and may say what no range has yet: until then the state
        is that of the last range, or starting.
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

    def reasons(self, now: float) -> list[Reason]:
        """Why the estimate is not what it could be."""
        return [reason for reason in Reason if self.value(reason_signal(reason), now)]

    def lost(self, now: float) -> list[Reason]:
        """The sensors from which nothing comes any more; one that never came is missing, not lost."""
        return [reason for reason in self.reasons(now) if reason & NO_SENSOR & self._came]

    def waiting(self, now: float) -> bool:
        """Whether there is no estimate because the scooter is not on yet, or has gone to sleep."""
        if self.state(now) not in (State.STARTING, State.INVALID):
            return False
        pack, activity = sum(self.reasons(now), Reason(0)) & NO_PACK, self.activity(now)
        return bool(pack) and (activity == "asleep" or (not activity and not pack & self._came))

    def trend(self, now: float) -> list[float | None]:
        """The range [km] every `TREND_STEP` of the last ten minutes, the oldest first; None where it was not known.

        Nothing while there is no range now.
        """
        if self.value("RANGE_Remaining", now) is None:
            return []
        step = int(now // TREND_STEP)
        return [self._ranges.get(i) for i in range(step - TREND_STEPS + 1, step + 1)]

    def activity(self, now: float) -> str:
        """What the vehicle does, in a word; nothing if it is not known, or before there is an estimate."""
        value = None if self.state(now) is State.STARTING else self.value("RANGE_Activity", now)
        return Activity(int(value)).name.lower() if value and value in tuple(Activity) else ""

    def charge(self, now: float) -> str:
        """Power, time to full and the range then; nothing while nothing is charged."""
        minutes = self.value("RANGE_TimeToFull", now)
        if minutes is None:
            return ""
        hours, rest = divmod(round(minutes), 60)
        time = f"{hours} h {rest:02d} min" if hours else f"{rest} min"
        return f"{self.text('RANGE_ChargePower', now)}, full in {time}, {self.text('RANGE_RemainingFull', now)} then"

    def why(self, now: float) -> list[tuple[Cause, float]]:
        """The largest causes of what the range is beside the rated one, with what each makes of it [km]."""
        pairs = [[self.value(f"RANGE_Why{what}{i}", now) for what in ("Cause", "Distance")] for i in (1, 2)]
        return [(Cause(int(cause)), size) for cause, size in pairs if cause and cause in tuple(Cause) and size]

    def distrusted(self, now: float) -> list[str]:
        """The roles whose sensors contradict the others and are left out."""
        signals = self.messages["RANGE_Sensors"].limits
        return [role for role in ROLES if sensor_signal(role) in signals and self.value(sensor_signal(role), now)]

    def stale(self, now: float) -> dict[str, float]:
        """Age [s] of each message that is stale, infinite if it never came."""
        return {name: now - entry.time for name, entry in self.messages.items() if entry.stale(now)}

    def age(self, now: float) -> float:
        """[s] since the last good frame; infinite if none ever came."""
        return now - max(entry.time for entry in self.messages.values())

    def bad(self) -> int:
        """How many frames failed a check."""
        return sum(entry.bad for entry in self.messages.values())

    def complete(self) -> bool:
        """Whether every message has come."""
        return all(entry.received for entry in self.messages.values())
