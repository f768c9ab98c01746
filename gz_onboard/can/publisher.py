"""Encode estimates as CAN frames: the range at 1 Hz, the status at 10 Hz.

The layout comes from ``dbc/range.dbc``, or from another DBC file with the same messages and signals but other scales
and identifiers. An unknown value, or one that its signal cannot hold, is sent as not available, never as a number;
counts stop at their maximum.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.can.dbc import database_of, find_dbc, read_dbc
from gz_onboard.can.layout import crc8_sae_j1850, identifier_of, raw_range
from gz_onboard.constants import MINUTE, WH, WH_PER_KM
from gz_onboard.errors import InputError, nearest
from gz_onboard.events import EFF_FLAG, MOST_STANDARD, TRANSMITTED, Estimate, Frame, Reason, State

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

RANGE_DBC = "range.dbc"
MESSAGES = 8  # in it
LENGTH = 8  # bytes of each
_SI = {"km": 1000.0, "Wh": WH, "Wh/km": WH_PER_KM, "%": 0.01, "min": MINUTE}  # in one unit of its signals
GROUP_STEP = 0x100  # from one parameter group of J1939 to the next
_NUMBERED = re.compile(rb"\b(BO_|SG_|VAL_|BO_TX_BU_|SIG_GROUP_|SIG_VALTYPE_) (\d+)\b")  # statements on a message


@dataclass(frozen=True)
class Counts:
    """Frames that the daemon counted since its start."""

    dropped: int = 0
    implausible: int = 0
    lost: int = 0
    unknown: int = 0


COUNTS = {f"RANGE_Count{count.name.capitalize()}": count.name for count in fields(Counts)}  # by signal


class Publisher:
    """Encodes estimates by a DBC file, by default `dbc/range.dbc`; its state is the counters of its messages.

    identifier: of the first message, without flags, in place of that in the file; the others follow by `step`.
    InputError if a message or signal is missing in the file or cannot be sent.
    """

    def __init__(self, file: Path | None = None, identifier: int | None = None, step: int = 1) -> None:
        self.file = file or find_dbc(RANGE_DBC)
        self.messages = range_messages(self.file)
        self.sent: dict[int, Message] = {}
        """The messages by the identifiers that they are sent with; EFF_FLAG is set in those of 29 bits."""
        self._encoders: dict[str, _Encoder] = {}
        self._fields: dict[str, _Field] = {}
        for i, (name, message) in enumerate(self.messages.items()):
            sent = identifier_of(message) if identifier is None else identifier + i * step
            sent |= EFF_FLAG if sent > MOST_STANDARD else 0
            self.sent[sent] = message
            self._encoders[name] = _Encoder(message, sent)
            self._fields |= self._encoders[name].fields
        self.identifiers = frozenset(self.sent)
        self._most = {signal: self.greatest(signal) for signal in COUNTS}
        self._status: tuple[Estimate | None, dict[str, int]] = None, {}  # the last that was packed

    def may_have_sent(self, frame: Frame) -> bool:
        """Whether `frame` is like ours, in identifier and checksum: if it is in a log, an earlier run sent it."""
        _, identifier, data, _ = frame
        return identifier in self.identifiers and len(data) == LENGTH and crc8_sae_j1850(data[:-1]) == data[-1]

    def dbc(self) -> bytes:
        """The text of `file` with the identifiers that the frames are sent with."""
        new = {b"%d" % identifier_of(message): b"%d" % identifier for identifier, message in self.sent.items()}
        return _NUMBERED.sub(lambda found: found[1] + b" " + new.get(found[2], found[2]), self.file.read_bytes())

    def greatest(self, signal: str) -> float:
        """The largest value of `signal`, in SI units."""
        field = self._fields[signal]
        return max(limit * field.scale + field.offset for limit in (field.low, field.high))

    def range(self, estimate: Estimate, counts: Counts, time_ns: int) -> list[Frame]:
        """The frames of every second."""
        e = estimate
        state, remaining, p10, p90 = self.reported(e)
        values: dict[str, float | None] = {
            "RANGE_Remaining": remaining,
            "RANGE_RemainingP10": p10,
            "RANGE_RemainingP90": p90,
            "RANGE_EstimateState": state,
            "RANGE_ConsumptionRecent": e.consumption_recent,
            "RANGE_RouteState": e.route_state,
        }
        if state in KNOWN:
            values |= {
                "RANGE_EnergyLeft": e.energy_left,
                "RANGE_ConsumptionExpected": e.consumption_expected,
                "RANGE_TimeToFull": e.time_to_full,
                "RANGE_RemainingFull": e.range_full,
                "RANGE_ChargePower": e.charge_power,
                "RANGE_ArrivalStateOfCharge": e.arrival_soc,
                "RANGE_ArrivalStateOfChargeP10": e.arrival_soc_p10,
                "RANGE_RouteLeft": e.route_left,
                "RANGE_BatteryEndsAfter": e.battery_ends_after,
            }
            if e.why:
                values["RANGE_WhyRated"] = e.why.reference
                for i, (cause, size) in enumerate(e.why.largest()[:2], 1):
                    values |= {f"RANGE_WhyCause{i}": cause, f"RANGE_WhyDistance{i}": size}
        values |= {signal: min(getattr(counts, name), self._most[signal]) for signal, name in COUNTS.items()}
        values |= {signal: 1 for role in e.distrusted if (signal := sensor_signal(role)) in self._fields}
        return self._frames(self._pack(values, [name for name in self.messages if name != STATUS]), time_ns)

    def status(self, estimate: Estimate, time_ns: int) -> list[Frame]:
        """The frame of every tenth of a second. `estimate` may not be changed afterwards: it is packed once."""
        if estimate is not self._status[0]:
            state = self.reported(estimate)[0]
            values: dict[str, float | None] = {"RANGE_StatusState": state, "RANGE_Activity": estimate.activity}
            values |= {reason_signal(reason): 1 for reason in estimate.reasons}
            charge = {SOC: estimate.soc, SIGMA: estimate.soc_sd}
            if state in KNOWN and all(self._fields[signal].raw(value) is not None for signal, value in charge.items()):
                values |= charge  # neither is of use without the other
            self._status = estimate, self._pack(values, [STATUS])
        return self._frames(self._status[1], time_ns)

    def _pack(self, values: Mapping[str, float | None], messages: Iterable[str]) -> dict[str, int]:
        """The bits of `messages` without counter and checksum; what `values` leaves out is 0, or not available."""
        words = {name: self._encoders[name].blank for name in messages}
        for signal, value in values.items():
            field = self._fields[signal]
            if (raw := field.raw(value)) is not None:
                words[field.message] ^= (raw & field.mask ^ field.blank) << field.shift
        return words

    def _frames(self, words: Mapping[str, int], time_ns: int) -> list[Frame]:
        return [self._encoders[name].frame(word, time_ns) for name, word in words.items()]

    def reported(self, e: Estimate) -> tuple[State, float | None, float | None, float | None]:
        """(state, range, P10, P90) [m] as they are sent: never valid unless all three are there and in their order."""
        if e.state not in KNOWN:
            return e.state, None, None, None
        median, p10, p90 = e.range, e.range_p10, e.range_p90
        is_ordered = median is not None and p10 is not None and p90 is not None and 0 <= p10 <= median <= p90
        fields = self._fields
        if not is_ordered or None in (fields["RANGE_Remaining"].raw(median), fields["RANGE_RemainingP10"].raw(p10)):
            return State.INVALID, None, None, None
        if fields["RANGE_RemainingP90"].raw(p90) is None:
            return State.DEGRADED, median, p10, None
        return e.state, median, p10, p90


STATUS, SOC, SIGMA = "RANGE_Status", "RANGE_StateOfCharge", "RANGE_StateOfChargeSigma"
KNOWN = (State.VALID, State.DEGRADED)
"""The states in which numbers are sent."""


def sensor_signal(role: str) -> str:
    """The signal that says that the sensor of `role` is left out: gps_altitude is RANGE_BadGpsAltitude."""
    return "RANGE_Bad" + "".join(word.capitalize() for word in role.split("_"))


@cache
def reason_signal(reason: Reason) -> str:
    """The signal that carries `reason`: NO_IMU is RANGE_NoImu."""
    return "RANGE_" + "".join(word.capitalize() for word in str(reason.name).split("_"))


# --- what a DBC file must hold, and the places of its signals ---------------------------------------------------------


def range_messages(file: Path) -> dict[str, Message]:
    """The messages of our own frames in a DBC file, by name; there may be others in it.

    InputError for a message or signal of ``dbc/range.dbc`` that is missing or cannot be sent.
    """
    return _range_messages(file, read_dbc(file))


@cache  # a vehicle makes several publishers
def _range_messages(file: Path, text: str) -> dict[str, Message]:
    found = {message.name: message for message in database_of([(file, text)]).messages}
    standard_file = find_dbc(RANGE_DBC)
    if file == standard_file:
        return found
    standard = range_messages(standard_file)
    for name, wanted in standard.items():
        if name not in found:
            raise InputError(f"{file}: has no message {name}, which {RANGE_DBC} has{nearest(name, found)}")
        if problem := _message_problem(found[name], wanted):
            raise InputError(f"{file}: message {name}: {problem}")
    return {name: found[name] for name in standard}


def _message_problem(message: Message, wanted: Message) -> str:
    """Why `message` cannot carry the signals of `wanted`, a message of ``dbc/range.dbc``; empty if it can."""
    if message.length != LENGTH or message.is_fd:
        return f"must have 8 bytes in a classic frame, has {message.length}{' in a CAN FD frame' * message.is_fd}"
    signals, models = ({signal.name: signal for signal in one.signals} for one in (message, wanted))
    if missing := [name for name in models if name not in signals]:
        return f"has no signal {missing[0]}{nearest(missing[0], signals)}"
    if more := [name for name in signals if name not in models]:
        return f"has a signal {more[0]}, which {RANGE_DBC} has not"
    problems = ((name, _signal_problem(signals[name], model)) for name, model in models.items())
    return next((f"signal {name} {problem}" for name, problem in problems if problem), "")


def _signal_problem(signal: Signal, model: Signal) -> str:
    """Why `signal` cannot take the part of `model`, from which its scale, offset and limits may differ."""
    if _place(signal) != _place(model):
        return f"is {_place(signal)}, must be {_place(model)}; only its scale, offset and limits may differ"
    if model.length >= 8:  # a quantity, with a code for not available
        needed = (0, 1) if model.name == SOC else (0,)
        missing = [] if model.name.endswith("CRC") else [v for v in needed if _Field(signal, "").raw(v) is None]
        return f"must be able to say {100 * missing[0]} {model.unit or ''}".rstrip() if missing else ""
    most = max(model.choices) if model.choices else 2 if model.name.endswith("Counter") else 1
    low, high = raw_range(signal, not_available=False)
    is_whole = (signal.conversion.scale, signal.conversion.offset, low) == (1, 0, 0) and high >= most
    return "" if is_whole else f"must hold the whole numbers from 0 to {most} (scale 1, offset 0)"


def _place(signal: Signal) -> str:
    """Place, byte order, sign and unit of a signal as a DBC file has them."""
    kind = "floating point " if signal.conversion.is_float else "" if signal.multiplexer_ids is None else "multiplexed "
    order, sign = 1 if signal.byte_order == "little_endian" else 0, "-" if signal.is_signed else "+"
    return f'{kind}{signal.start}|{signal.length}@{order}{sign} "{signal.unit or ""}"'


class _Field:
    """The place of a signal in its message, an integer of the first seven bytes, and its raw values."""

    def __init__(self, signal: Signal, message: str) -> None:
        unit = _SI.get(signal.unit or "", 1.0)
        self.message = message
        self.low, self.high = raw_range(signal, not_available=True)
        self.scale, self.offset = float(signal.conversion.scale) * unit, float(signal.conversion.offset) * unit
        self.mask = (1 << int(signal.length)) - 1
        self.blank = 0 if not signal.unit else self.mask // 2 + 1 if signal.is_signed else self.mask  # or not available
        self.shift = int(signal.start)

    def raw(self, value: float | None) -> int | None:
        """The nearest raw value of one in SI units; None if that is unknown, not finite or cannot be said."""
        if value is None or not abs(value) < 1e15:  # infinity and NaN too
            return None
        raw = round((value - self.offset) / self.scale)
        return raw if self.low <= raw <= self.high else None


class _Encoder:
    """Completes the frames of one message. cantools would take five times as long."""

    def __init__(self, message: Message, identifier: int) -> None:
        fields = {s.name: _Field(s, message.name) for s in message.signals if not s.name.endswith("CRC")}
        self.blank = 2**56 - 1  # ones in unused bits
        for field in fields.values():
            self.blank ^= (field.mask ^ field.blank) << field.shift
        self._identifier, self._counter_field = identifier, fields.pop(f"{message.name}Counter")
        self._counter = 0  # of the next frame
        self.fields = fields

    def frame(self, word: int, time_ns: int) -> Frame:
        """The next frame, whose signals have the bits of `word`."""
        data = (word | self._counter << self._counter_field.shift).to_bytes(7, "little")
        self._counter = (self._counter + 1) % (int(self._counter_field.high) + 1)
        return time_ns, self._identifier, data + bytes((crc8_sae_j1850(data),)), TRANSMITTED
