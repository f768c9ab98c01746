"""Encode estimates as CAN frames: the range at 1 Hz, the status at 10 Hz.

The layout comes from ``dbc/range.dbc``, or from another DBC file with messages and signals of the same names but other
scales, identifiers and places. An unknown value, or one that its signal cannot hold, is sent as not available, never
as a number; counts stop at their maximum.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.bus.checksum import crc8_sae_j1850
from gz_onboard.bus.dbc import database_of, find_dbc, read_dbc
from gz_onboard.bus.layout import first_bit, identifier_of, raw_range
from gz_onboard.constants import MINUTE, WH, WH_PER_KM
from gz_onboard.errors import InputError, nearest
from gz_onboard.events import EFF_FLAG, MOST_STANDARD, TRANSMITTED, Cause, Estimate, Explanation, Frame, Reason, State

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

RANGE_DBC = "range.dbc"
MESSAGES = 8  # in it
LENGTH = 8  # bytes of each
GROUP_STEP = 0x100  # from one parameter group of J1939 to the next
_NUMBERED = re.compile(rb"\b(BO_|SG_|VAL_|BO_TX_BU_|SIG_GROUP_|SIG_VALTYPE_) (\d+)\b")  # statements on a message


@dataclass(frozen=True)
class Counts:
    """Frames that the daemon counted since its start."""

    dropped: int = 0
    implausible: int = 0
    lost: int = 0
    unknown: int = 0


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
        """The largest value of `signal`, in the unit of the DBC."""
        field = self._fields[signal]
        return max(limit * field.scale + field.offset for limit in (field.low, field.high))

    def range(self, estimate: Estimate, counts: Counts, time_ns: int) -> list[Frame]:
        """The frames of every second."""
        e = estimate
        state, remaining, p10, p90 = self.reported(e)
        known = state in KNOWN
        values: dict[str, float | None] = {
            "RANGE_Remaining": remaining,
            "RANGE_RemainingP10": p10,
            "RANGE_RemainingP90": p90,
            "RANGE_EstimateState": state,
            "RANGE_EnergyLeft": _scaled(e.energy_left, 1 / WH) if known else None,
            "RANGE_ConsumptionRecent": _scaled(e.consumption_recent, 1 / WH_PER_KM),
            "RANGE_ConsumptionExpected": _scaled(e.consumption_expected, 1 / WH_PER_KM) if known else None,
            "RANGE_TimeToFull": _scaled(e.time_to_full, 1 / MINUTE) if known else None,
            "RANGE_RemainingFull": _scaled(e.range_full, 1e-3) if known else None,
            "RANGE_ChargePower": e.charge_power if known else None,
            "RANGE_ArrivalStateOfCharge": _scaled(e.arrival_soc, 100) if known else None,
            "RANGE_ArrivalStateOfChargeP10": _scaled(e.arrival_soc_p10, 100) if known else None,
            "RANGE_RouteLeft": _scaled(e.route_left, 1e-3) if known else None,
            "RANGE_BatteryEndsAfter": _scaled(e.battery_ends_after, 1e-3) if known else None,
            "RANGE_RouteState": e.route_state,
            **_why(e.why if known else None),
        }
        counted = ((f"RANGE_Count{name.capitalize()}", count) for name, count in vars(counts).items())
        values |= {signal: min(count, self.greatest(signal)) for signal, count in counted}
        values |= {signal: 1 for role in e.distrusted if (signal := sensor_signal(role)) in self._fields}
        return self._frames(self._pack(values, [name for name in self.messages if name != STATUS]), time_ns)

    def status(self, estimate: Estimate, time_ns: int) -> list[Frame]:
        """The frame of every tenth of a second. `estimate` may not be changed afterwards: it is packed once."""
        if estimate is not self._status[0]:
            state = self.reported(estimate)[0]
            soc, sigma = _scaled(estimate.soc, 100), _scaled(estimate.soc_sd, 100)
            if state not in KNOWN or not (self._can_say(SOC, soc) and self._can_say(SIGMA, sigma)):
                soc = sigma = None  # neither is of use without the other
            values = {SOC: soc, SIGMA: sigma, "RANGE_StatusState": state, "RANGE_Activity": estimate.activity}
            values |= {reason_signal(reason): 1 for reason in estimate.reasons}
            self._status = estimate, self._pack(values, [STATUS])
        return self._frames(self._status[1], time_ns)

    def _pack(self, values: Mapping[str, float | None], messages: Iterable[str]) -> dict[str, int]:
        """The bits of `messages` without counter and checksum; signals that `values` leaves out are 0."""
        words = {name: self._encoders[name].blank for name in messages}
        for signal, value in values.items():
            field = self._fields[signal]
            words[field.message] |= field.bits(value)
        return words

    def _frames(self, words: Mapping[str, int], time_ns: int) -> list[Frame]:
        return [self._encoders[name].frame(word, time_ns) for name, word in words.items()]

    def reported(self, e: Estimate) -> tuple[State, float | None, float | None, float | None]:
        """(state, range, P10, P90) [km] as they are sent: never valid unless all three are there and in their order."""
        if e.state not in KNOWN:
            return e.state, None, None, None
        remaining, p10, p90 = _scaled(e.range, 1e-3), _scaled(e.range_p10, 1e-3), _scaled(e.range_p90, 1e-3)
        if (
            remaining is None
            or p10 is None
            or p90 is None
            or not 0 <= p10 <= remaining <= p90  # so for NaN
            or not self._can_say("RANGE_Remaining", remaining)
            or not self._can_say("RANGE_RemainingP10", p10)
        ):
            return State.INVALID, None, None, None
        if not self._can_say("RANGE_RemainingP90", p90):
            return State.DEGRADED, remaining, p10, None
        return e.state, remaining, p10, p90

    def _can_say(self, signal: str, value: float | None) -> bool:
        return self._fields[signal].raw(value) is not None


STATUS, SOC, SIGMA = "RANGE_Status", "RANGE_StateOfCharge", "RANGE_StateOfChargeSigma"
KNOWN = (State.VALID, State.DEGRADED)
"""The states in which numbers are sent."""


def sensor_signal(role: str) -> str:
    """The signal that says that the sensor of `role` is left out: gps_altitude is RANGE_BadGpsAltitude."""
    return "RANGE_Bad" + "".join(word.capitalize() for word in role.split("_"))


def reason_signal(reason: Reason) -> str:
    """The signal that carries `reason`: NO_IMU is RANGE_NoImu."""
    return "RANGE_" + "".join(word.capitalize() for word in str(reason.name).split("_"))


def _why(why: Explanation | None) -> dict[str, float | None]:
    """The rated range and the two largest causes; unknown ones are None."""
    nothing: tuple[Cause, float | None] = Cause.NONE, None
    values: dict[str, float | None] = {"RANGE_WhyRated": why.reference * 1e-3 if why else None}
    for i, (cause, size) in enumerate([*(why.largest() if why else ()), nothing, nothing][:2], 1):
        values |= {f"RANGE_WhyCause{i}": cause, f"RANGE_WhyDistance{i}": _scaled(size, 1e-3)}
    return values


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


# --- what a DBC file must hold, and the places of its signals ---------------------------------------------------------


def range_messages(file: Path) -> dict[str, Message]:
    """The messages of our own frames in a DBC file, by name; there may be others in it.

    InputError for a message or signal of ``dbc/range.dbc`` that is missing or cannot be sent.
    """
    own = find_dbc(RANGE_DBC)
    return _range_messages(file, read_dbc(file), own, read_dbc(own))


@cache  # a vehicle makes several publishers
def _range_messages(file: Path, text: str, own: Path, own_text: str) -> dict[str, Message]:
    standard = database_of([(own, own_text)])
    found = {message.name: message for message in (standard if file == own else database_of([(file, text)])).messages}
    for wanted in standard.messages:
        if wanted.name not in found:
            near = nearest(wanted.name, found)
            raise InputError(f"{file}: has no message {wanted.name}, which {RANGE_DBC} has{near}")
        if problem := _message_problem(found[wanted.name], wanted):
            raise InputError(f"{file}: message {wanted.name}: {problem}")
    return {wanted.name: found[wanted.name] for wanted in standard.messages}


def _message_problem(message: Message, wanted: Message) -> str:
    """Why `message` cannot carry the signals of `wanted`, a message of ``dbc/range.dbc``; empty if it can."""
    if message.length != 8 or message.is_fd:
        return f"must have 8 bytes in a classic frame, has {message.length}{' in a CAN FD frame' * message.is_fd}"
    signals = {signal.name: signal for signal in message.signals}
    if len({signal.byte_order for signal in message.signals}) > 1:
        return "its signals must all have the same byte order"
    for model in wanted.signals:
        if model.name not in signals:
            return f"has no signal {model.name}{nearest(model.name, signals)}"
        if problem := _signal_problem(signals[model.name], model):
            return f"signal {model.name} {problem}"
    return ""


def _signal_problem(signal: Signal, model: Signal) -> str:
    if signal.conversion.is_float or signal.is_multiplexer or signal.multiplexer_ids is not None:
        return "must be an integer that is in every frame (not floating point, not multiplexed)"
    if model.name.endswith("CRC"):
        return "" if (signal.length, first_bit(signal)) == (8, 56) else "must be the last byte, all 8 bits of it"
    if first_bit(signal) + signal.length > 56:
        return "stands in the last byte, which is the checksum's"
    unit = model.unit or ""
    if model.length >= 8:  # a quantity, with a code for not available
        if (signal.unit or "") != unit:
            return f"has unit {signal.unit or ''!r}, must have {unit!r}; only its scale and place may differ"
        if signal.length < 8:
            return f"needs 8 bits or more for the code 'not available', has {signal.length}"
        missing = [value for value in (0, 100 if model.name == SOC else 0) if _Field(signal, "").raw(value) is None]
        return f"must be able to say {missing[0]} {unit}".rstrip() if missing else ""
    most = max(model.choices) if model.choices else 2 if model.name.endswith("Counter") else 1
    low, high = raw_range(signal, not_available=False)
    is_whole = (signal.conversion.scale, signal.conversion.offset, low) == (1, 0, 0) and high >= most
    return "" if is_whole else f"must hold the whole numbers from 0 to {most} (scale 1, offset 0)"


class _Field:
    """The place of a signal in its message, an integer of the first seven bytes, and its raw values."""

    def __init__(self, signal: Signal, message: str) -> None:
        first = first_bit(signal)
        self.message = message
        self.low, self.high = raw_range(signal, not_available=True)
        self.scale, self.offset = float(signal.conversion.scale), float(signal.conversion.offset)
        self.mask = (1 << int(signal.length)) - 1
        self.absent = self.mask // 2 + 1 if signal.is_signed else self.mask
        self.shift = first if signal.byte_order == "little_endian" else 56 - first - signal.length

    def raw(self, value: float | None) -> int | None:
        """The nearest raw value; None if `value` is unknown, not finite, or outside the range of the signal."""
        if value is None or not abs(value) < 1e12:  # infinity and NaN too
            return None
        raw = round((value - self.offset) / self.scale)
        return raw if self.low <= raw <= self.high else None

    def bits(self, value: float | None) -> int:
        """The nearest raw value, or the code for not available, shifted to its place."""
        raw = self.raw(value)
        return (self.absent if raw is None else raw & self.mask) << self.shift


class _Encoder:
    """Completes the frames of one message. cantools would take five times as long."""

    def __init__(self, message: Message, identifier: int) -> None:
        fields = {s.name: _Field(s, message.name) for s in message.signals if not s.name.endswith("CRC")}
        self.blank = 2**56 - 1  # ones in unused bits; signals that are not ours are not available
        for name, field in fields.items():
            self.blank &= ~(field.mask << field.shift)
            self.blank |= 0 if name.startswith("RANGE_") else field.absent << field.shift
        self._identifier, self._counter_field = identifier, fields.pop(f"{message.name}Counter")
        self._is_little = message.signals[0].byte_order == "little_endian"
        self._counter = 0  # of the next frame
        self.fields = fields

    def frame(self, word: int, time_ns: int) -> Frame:
        """The next frame, whose signals have the bits of `word`."""
        word |= self._counter << self._counter_field.shift
        self._counter = (self._counter + 1) % (int(self._counter_field.high) + 1)
        data = word.to_bytes(7, "little" if self._is_little else "big")
        return time_ns, self._identifier, data + bytes((crc8_sae_j1850(data),)), TRANSMITTED
