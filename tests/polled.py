"""Requests and answers as frames, written apart from the package's own reading of them."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from gz_onboard.can.requests import Request
from gz_onboard.events import Frame
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.support import EPOCH, MS, S

KONA = Path(__file__).parent / "vehicles" / "kona" / "kona.toml"
STEADY = {"BatteryCurrent": 20.0, "BatteryVoltage": 365.0, "BatteryTemperature": 20, "MotorSpeed": 3000}
CHARGE = 60.0  # %


@cache
def kona() -> Vehicle:
    return read_vehicle(KONA)


def request(name: str) -> Request:
    return next(one for one in kona().mapping.requests if one.name == name)


def payload(of: Request, **values: float) -> bytes:
    """A positive answer; bytes that no signal has are 0xA5."""
    blank = bytearray(b"\xa5" * of.message.length)
    for signal in of.message.signals:
        raw = round((values[signal.name] - float(signal.offset)) / float(signal.scale))
        size = signal.length // 8
        first = signal.start // 8
        blank[first : first + size] = raw.to_bytes(size, "big", signed=signal.is_signed)
    return of.prefix + bytes(blank)


def carried(data: bytes, address: int | None = None) -> list[bytes]:
    """The frames that carry `data` by ISO 15765-2, padded with 0xAA."""
    before = b"" if address is None else bytes([address])
    room = 8 - len(before)
    if len(data) < room:
        return [(before + bytes([len(data)]) + data).ljust(8, b"\xaa")]
    frames = [before + bytes([0x10 | len(data) >> 8, len(data) & 0xFF]) + data[: room - 2]]
    rest = data[room - 2 :]
    for number, at in enumerate(range(0, len(rest), room - 1), 1):
        frames.append((before + bytes([0x20 | number & 0xF]) + rest[at : at + room - 1]).ljust(8, b"\xaa"))
    return frames


def answer(of: Request, time_ns: int, **values: float) -> list[Frame]:
    """The frames of a positive answer, a millisecond apart, from `time_ns` on."""
    address = of.addresses[1] if of.addresses else None
    parts = carried(payload(of, **values), address)
    return [(time_ns + i * MS, of.response, part, 0) for i, part in enumerate(parts)]


def exchange(of: Request, time_ns: int, **values: float) -> list[Frame]:
    """What a tester and the ECU send: request, flow control, answer."""
    first, *others = answer(of, time_ns + 10 * MS, **values)
    asked = (time_ns, of.request, carried(bytes([of.prefix[0] - 0x40]) + of.prefix[1:])[0], 0)
    control: list[Frame] = [(first[0] + MS // 2, of.request, b"\x30".ljust(8, b"\0"), 0)] if others else []
    return [asked, first, *control, *others]


def polled_ride(seconds: float, **changed: Any) -> list[Frame]:
    """A steady ride of the Kona that another tool has polled."""
    frames: list[Frame] = []
    for i in range(round(seconds * 5)):
        time_ns = EPOCH + i * S // 5
        frames += exchange(request("Battery"), time_ns, **(STEADY | changed))
        if i % 50 == 0:
            frames += exchange(request("BatteryShown"), time_ns + 60 * MS, BatteryCharge=CHARGE)
    return frames
