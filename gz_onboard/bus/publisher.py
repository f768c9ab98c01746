"""From estimates to CAN frames, by ``dbc/range.dbc``: the range at 1 Hz, the status at 10 Hz.

What is not known is sent as not available, never as a number; what is beyond a signal's range as its greatest value.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from gz_onboard.bus.checksum import crc8_sae_j1850
from gz_onboard.bus.codec import raw_range
from gz_onboard.bus.mapping import find_dbc, load_database
from gz_onboard.events import TRANSMITTED, Estimate, Frame, Reason, State

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
        }
        return [self._frame(name, values, time_ns, channel) for name, values in frames.items()]

    def status(self, estimate: Estimate, time_ns: int, channel: int = 0) -> list[Frame]:
        """The frame of every tenth of a second."""
        known = estimate.state in (State.VALID, State.DEGRADED)
        values: dict[str, float | None] = {
            "RANGE_StateOfCharge": _scaled(estimate.soc, 100) if known else None,
            "RANGE_StateOfChargeSigma": _scaled(estimate.soc_sd, 100) if known else None,
            "RANGE_StatusState": estimate.state,
        }
        for reason in Reason:
            values[reason_signal(reason)] = bool(estimate.reasons & reason)
        return [self._frame("RANGE_Status", values, time_ns, channel)]

    def _frame(self, name: str, values: dict[str, float | None], time_ns: int, channel: int) -> Frame:
        message = self.database.get_message_by_name(name)
        part = name.removeprefix("RANGE_")
        counter = self._counters[name]
        self._counters[name] = (counter + 1) % 15
        complete = {**values, f"RANGE_{part}Counter": counter, f"RANGE_{part}CRC": 0}
        data = bytearray(message.encode(_raw(message, complete), scaling=False, padding=True, strict=False))
        data[-1] = crc8_sae_j1850(bytes(data[:-1]))
        return time_ns, message.frame_id, bytes(data), channel | TRANSMITTED


def reason_signal(reason: Reason) -> str:
    """The signal that carries `reason`: NO_IMU is RANGE_NoImu."""
    return "RANGE_" + "".join(word.capitalize() for word in str(reason.name).split("_"))


def _scaled(value: float | None, factor: float) -> float | None:
    return None if value is None else value * factor


def _raw(message: Message, values: dict[str, float | None]) -> dict[str, int]:
    """Raw values: the nearest within the limits, or the code for not available."""
    raw: dict[str, int] = {}
    for signal in message.signals:
        value = values[signal.name]
        if value is None or not abs(value) < 1e12:  # infinity and NaN too
            raw[signal.name] = -(2 ** (signal.length - 1)) if signal.is_signed else 2**signal.length - 1
        else:
            low, high = raw_range(signal, not_available=True)
            wanted = (value - float(signal.conversion.offset)) / float(signal.conversion.scale)
            raw[signal.name] = round(min(max(wanted, low), high))
    return raw
