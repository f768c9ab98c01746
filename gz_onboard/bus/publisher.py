"""From estimates to CAN frames, by ``dbc/range.dbc``: the range at 1 Hz, the status at 10 Hz.

What is not known is sent as not available, never as a number; what is beyond a signal's range as its greatest value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gz_onboard.bus.checksum import crc8_sae_j1850
from gz_onboard.bus.codec import raw_range
from gz_onboard.bus.mapping import find_dbc, load_database
from gz_onboard.events import ROLES, TRANSMITTED, Estimate, Frame, Reason, State

if TYPE_CHECKING:
    from cantools.database.can import Message

WH = 3600.0  # J
WH_PER_KM = 3.6  # J/m


@dataclass(frozen=True)
class Counts:
    """What the daemon counted since its start."""

    dropped: int = 0
    implausible: int = 0
    lost: int = 0
    unknown: int = 0


class Publisher:
    """Encodes estimates; its state is the counters of its messages."""

    def __init__(self) -> None:
        self.database = load_database([find_dbc("range.dbc")])
        self._counters = {message.name: 0 for message in self.database.messages}
        names = {s.name for s in self.database.get_message_by_name("RANGE_Sensors").signals}
        self._sensor_signals = [(role, sensor_signal(role)) for role in ROLES if sensor_signal(role) in names]
        self._layouts = {message.name: _layout(message) for message in self.database.messages}

    def range(self, estimate: Estimate, counts: Counts, time_ns: int, channel: int = 0) -> list[Frame]:
        """The frames of every second."""
        e = estimate
        known = e.state in (State.VALID, State.DEGRADED)
        frames: dict[str, dict[str, float | None]] = {
            "RANGE_Estimate": {
                "RANGE_Remaining": _scaled(e.range, 1e-3) if known else None,
                "RANGE_RemainingP10": _scaled(e.range_p10, 1e-3) if known else None,
                "RANGE_RemainingP90": _scaled(e.range_p90, 1e-3) if known else None,
                "RANGE_EstimateState": e.state,
            },
            "RANGE_Energy": {
                "RANGE_EnergyLeft": _scaled(e.energy_left, 1 / WH) if known else None,
                "RANGE_ConsumptionRecent": _scaled(e.consumption_recent, 1 / WH_PER_KM),
                "RANGE_ConsumptionExpected": _scaled(e.consumption_expected, 1 / WH_PER_KM) if known else None,
            },
            "RANGE_Diagnosis": {
                "RANGE_CountDropped": counts.dropped,
                "RANGE_CountImplausible": counts.implausible,
                "RANGE_CountLost": counts.lost,
                "RANGE_CountUnknown": counts.unknown,
            },
            "RANGE_Sensors": {signal: role in e.distrusted for role, signal in self._sensor_signals},
        }
        return [self._frame(name, values, time_ns, channel) for name, values in frames.items()]

    def status(self, estimate: Estimate, time_ns: int, channel: int = 0) -> list[Frame]:
        """The frame of every tenth of a second."""
        known = estimate.state in (State.VALID, State.DEGRADED)
        values: dict[str, float | None] = {
            "RANGE_StateOfCharge": _scaled(estimate.soc, 100) if known else None,
            "RANGE_StateOfChargeSigma": _scaled(estimate.soc_sd, 100) if known else None,
            "RANGE_StatusState": estimate.state,
            "RANGE_Activity": estimate.activity,
        }
        reasons = int(estimate.reasons)
        for bit, signal in _REASON_SIGNALS:
            values[signal] = reasons & bit != 0
        return [self._frame("RANGE_Status", values, time_ns, channel)]

    def _frame(self, name: str, values: dict[str, float | None], time_ns: int, channel: int) -> Frame:
        part = name.removeprefix("RANGE_")
        counter = self._counters[name]
        self._counters[name] = (counter + 1) % 15
        values[f"RANGE_{part}Counter"] = counter
        identifier, word, fields = self._layouts[name]
        for field in fields:
            word |= field.bits(values[field.name])
        data = word.to_bytes(7, "little")
        return time_ns, identifier, data + bytes((crc8_sae_j1850(data),)), channel | TRANSMITTED


def sensor_signal(role: str) -> str:
    """The signal that says that the sensor of `role` is left out: gps_altitude is RANGE_BadGpsAltitude."""
    return "RANGE_Bad" + "".join(word.capitalize() for word in role.split("_"))


def reason_signal(reason: Reason) -> str:
    """The signal that carries `reason`: NO_IMU is RANGE_NoImu."""
    return "RANGE_" + "".join(word.capitalize() for word in str(reason.name).split("_"))


_REASON_SIGNALS = [(int(reason), reason_signal(reason)) for reason in Reason]


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


@dataclass(frozen=True, slots=True)
class _Field:
    """A signal's place in its message, an integer of little-endian bytes, and what can stand in it."""

    name: str
    start: int
    mask: int
    low: float
    high: float
    offset: float
    scale: float
    absent: int

    def bits(self, value: float | None) -> int:
        """The nearest raw value within the limits, or the code for not available, at its place."""
        if value is None or not abs(value) < 1e12:  # infinity and NaN too
            return self.absent << self.start
        wanted = (value - self.offset) / self.scale
        return (round(min(max(wanted, self.low), self.high)) & self.mask) << self.start


def _layout(message: Message) -> tuple[int, int, list[_Field]]:
    """Identifier, unused bits (they are ones), and all signals but the CRC, which is the last of the eight bytes.

    cantools would take five times as long to encode them.
    """
    fields = []
    unused = 2**56 - 1
    for signal in message.signals:
        if signal.name.endswith("CRC"):
            continue
        assert signal.byte_order == "little_endian" and message.length == 8, message.name
        low, high = raw_range(signal, not_available=True)
        absent = 2 ** (signal.length - 1) if signal.is_signed else 2**signal.length - 1
        mask = 2**signal.length - 1
        conversion = signal.conversion
        scaling = float(conversion.offset), float(conversion.scale)
        fields.append(_Field(signal.name, signal.start, mask, low, high, *scaling, absent))
        unused &= ~(mask << signal.start)
    return message.frame_id, unused, fields
