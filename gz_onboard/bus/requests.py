"""What a vehicle tells only when it is asked: the requests that a vehicle file lists, and how their answers are read.

[[request]]
name = "BMS"                      # of the message that its answer becomes
request_identifier = 0x7E4        # 11 bits, or 29 from 0x14000000 on
response_identifier = 0x7EC
service = 0x22                    # ReadDataByIdentifier (ISO 14229), or 0x01 (SAE J1979)
data_identifier = 0x0101          # of service 0x01 the PID
length = 59                       # bytes of the answer behind the data identifier
period = 1.0                      # s

[request.signals]
BMS_Voltage = { byte = "M", bits = 16, factor = 0.1, unit = "V", limits = [200, 450] }

[poll]                            # all of it may be left out
bitrate = 500000
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gz_onboard.bus.dbc import FARTHEST, LARGEST, SMALLEST
from gz_onboard.errors import shown
from gz_onboard.events import EFF_FLAG

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

    from gz_onboard.toml import Table

CURRENT_DATA, READ_DATA = 0x01, 0x22
SERVICES = (CURRENT_DATA, READ_DATA)
"""All that is ever asked: both only read. Nothing else can be sent, whatever a vehicle file says."""
POSITIVE = 0x40  # is added to the service in its answer
FUNCTIONAL = (0x7DF, 0x18DB_33F1 | EFF_FLAG)  # all ECUs together are asked there (ISO 15765-4)
_FUNCTIONAL_GROUP = 0x18DB  # the upper half of 29-bit functional identifiers
LOWEST_STANDARD, MOST_STANDARD = 0x600, 0x7FF
LOWEST_EXTENDED, MOST_EXTENDED = 0x1400_0000, 0x1FFF_FFFF
MOST_REQUESTS = 100
LONGEST_ANSWER = 4092  # bytes behind a data identifier: ISO-TP has at most 4095
PERIODS = 0.1, 3600.0  # s
_FRAME_BITS = {False: 135, True: 160}  # of eight bytes, with the most stuffing there can be and the gap, by extended
_FIRST, _FOLLOWING = 6, 7  # bytes in the first frame of a longer answer, and in each that follows
_IDENTIFIERS = "request_identifier", "response_identifier"
_ADDRESSES = "request_address", "response_address"
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")


@dataclass(frozen=True)
class Request:
    """What one ECU is asked for, and the message that its answer becomes."""

    request: int  # identifier with its flag
    response: int
    addresses: tuple[int, int] | None  # the first byte of the frames of request and response, where they have one
    service: int
    data_identifier: int
    period: float  # s
    message: Message  # of the bytes behind the data identifier

    @property
    def name(self) -> str:
        """That of its message."""
        return self.message.name

    @property
    def payload(self) -> bytes:
        """What is sent: service and data identifier."""
        return bytes([self.service]) + self._identifier

    @property
    def prefix(self) -> bytes:
        """What its answer begins with."""
        return bytes([self.service + POSITIVE]) + self._identifier

    @property
    def _identifier(self) -> bytes:
        return self.data_identifier.to_bytes(1 if self.service == CURRENT_DATA else 2, "big")

    @property
    def bits(self) -> int:
        """What asking once costs the bus: request, answer and flow control, at most."""
        spare = 1 if self.addresses else 0
        rest = len(self.prefix) + self.message.length - (_FIRST - spare)
        frames = 2 if rest <= 1 else 3 - -rest // (_FOLLOWING - spare)
        return frames * _FRAME_BITS[bool(self.request & EFF_FLAG)]


@dataclass(frozen=True)
class Polling:
    """How a vehicle is asked."""

    bitrate: float = 500_000.0  # bit/s, of the bus
    bus_share: float = 0.05  # of it that requests and answers may take
    timeout: float = 0.5  # s, for an answer to begin
    padding: int | None = 0xCC  # of requests that are shorter than a frame; None: shorter frames


def read_requests(vehicle: Table, taken: Mapping[int, str]) -> tuple[Request, ...]:
    """The requests of the vehicle file `vehicle`; InputError for what can be none.

    taken: names of the messages of its DBC files, by identifier with flag.
    """
    requests: list[Request] = []
    for table in vehicle.tables("request", MOST_REQUESTS):
        request = _request(table)
        for key, identifier in zip(_IDENTIFIERS, (request.request, request.response), strict=True):
            if identifier in taken:
                raise table.error(
                    f"{identifier & ~EFF_FLAG:#x} is that of message {taken[identifier]} of the DBC files", key
                )
        for other in requests:
            _check_pair(table, request, other)
        requests.append(request)
    return tuple(requests)


def read_polling(vehicle: Table, requests: Iterable[Request]) -> Polling:
    """How `requests` are sent; InputError if they take more of the bus than they may."""
    table, usual = vehicle.table("poll"), Polling()
    table.only(["bitrate", "bus_share", "timeout", "padding"])
    bitrate = table.number("bitrate", usual.bitrate, 10_000, 1_000_000)
    share = table.number("bus_share", usual.bus_share, 0.001, 0.3)
    padding = usual.padding
    if "padding" in table.values:
        padding = None if table.values["padding"] == "none" else table.integer("padding", 0, 255)
    needed = share_of_bus(requests, bitrate)
    if needed > share:
        raise (table if "bus_share" in table.values else vehicle).error(
            f"the requests and their answers take {100 * needed:.1f} % of a bus of {bitrate / 1000:g} kbit/s, and "
            f"poll.bus_share allows {100 * share:g} %: ask less often, by longer periods",
            "bus_share" if "bus_share" in table.values else "request",
        )
    return Polling(bitrate, share, table.number("timeout", usual.timeout, 0.05, 5.0), padding)


def share_of_bus(requests: Iterable[Request], bitrate: float) -> float:
    """The share of a bus of `bitrate` [bit/s] that `requests` and their answers take at most."""
    return sum(request.bits / request.period for request in requests) / bitrate


def _request(table: Table) -> Request:
    table.only(["name", "service", "data_identifier", "length", "period", "signals", *_IDENTIFIERS, *_ADDRESSES])
    service = table.integer("service", 0, 255)
    if service not in SERVICES:
        raise table.error(f"is {service:#04x}; only 0x01 and 0x22 are ever sent, which change nothing", "service")
    data_identifier = table.integer("data_identifier", 0, 0xFF if service == CURRENT_DATA else 0xFFFF)
    request = _identifier(table, "request_identifier", LOWEST_STANDARD, LOWEST_EXTENDED)
    plain = request & ~EFF_FLAG
    if request in FUNCTIONAL or (request & EFF_FLAG and plain >> 16 == _FUNCTIONAL_GROUP):
        raise table.error(
            f"{plain:#x} is that of all ECUs together; give that of the one to be asked, such as 0x7e0 or 0x18da10f1",
            "request_identifier",
        )
    response = _identifier(table, "response_identifier", 0, 0)
    if (request ^ response) & EFF_FLAG:
        raise table.error("must have as many bits as that of the request, 11 or 29", "response_identifier")
    if request == response:
        raise table.error("is that of the request too", "response_identifier")
    return Request(
        request,
        response,
        _addresses(table),
        service,
        data_identifier,
        table.number("period", low=PERIODS[0], high=PERIODS[1]),
        _message(table),
    )


def _identifier(table: Table, key: str, standard: int, extended: int) -> int:
    """The identifier `key` with its flag; at least `standard`, or of 29 bits `extended`."""
    value = table.integer(key, 0, MOST_EXTENDED)
    least = standard if value <= MOST_STANDARD else extended
    if value < least:
        raise table.error(
            f"{value:#x} is below {least:#x}: diagnosis has identifiers of low priority, others are left alone", key
        )
    return value if value <= MOST_STANDARD else value | EFF_FLAG


def _addresses(table: Table) -> tuple[int, int] | None:
    if not any(key in table.values for key in _ADDRESSES):
        return None
    first, second = (table.integer(key, 0, 255) for key in _ADDRESSES)
    return first, second


def _check_pair(table: Table, request: Request, other: Request) -> None:
    """InputError where two requests cannot be told apart, or would speak to two ECUs by one identifier."""
    if request.name == other.name:
        raise table.error(f"two requests are called {other.name}", "name")
    if request.response == other.request or request.request == other.response:
        raise table.error(f"{other.name} has it for the other direction", "response_identifier")
    if request.response != other.response:
        return
    if (request.request, request.addresses) != (other.request, other.addresses):
        raise table.error(
            f"is that of {other.name} too, which is asked by another identifier or address", "response_identifier"
        )
    if request.payload == other.payload:
        raise table.error(f"{other.name} asks for it too", "data_identifier")


def _message(table: Table) -> Message:
    """What the answer becomes: a message of the bytes behind the data identifier."""
    from cantools.database.can import Message

    name = table.text("name")
    if not _NAME.fullmatch(name):
        raise table.error(f"must be 1 to 64 letters, digits and _, is {shown(name)}", "name")
    length = table.integer("length", 1, LONGEST_ANSWER)
    signals = table.table("signals")
    if not signals.values:
        raise table.error("is missing: what is read of the answer", "signals")
    for key in signals.values:
        if not _NAME.fullmatch(key):
            raise signals.error("must be 1 to 64 letters, digits and _", key)
    found = [_signal(key, signals.table(key), length) for key in signals.values]
    return Message(frame_id=0, name=name, length=length, signals=found, strict=False)  # signals may share bytes


def _signal(name: str, table: Table, length: int) -> Signal:
    """A signal of an answer of `length` bytes."""
    from cantools.database.can.signal import Signal
    from cantools.database.conversion import BaseConversion

    table.only(["byte", "bit", "bits", "order", "signed", "factor", "offset", "unit", "limits"])
    first = _byte(table)
    bit = table.integer("bit", 0, 7) if "bit" in table.values else 0
    bits = table.integer("bits", 1, 64) if "bits" in table.values else 1 if "bit" in table.values else 8
    size = (bit + bits + 7) // 8
    if first + size > length:
        raise table.error(f"reaches to byte {first + size - 1}; the answer has bytes 0 to {length - 1}", "byte")
    little = table.text("order", "big", ["big", "little"]) == "little"
    signed = table.values.get("signed", False)
    if not isinstance(signed, bool):
        raise table.error(f"must be true or false, is {shown(signed)}", "signed")
    factor = table.number("factor", 1.0, -LARGEST, LARGEST)
    if abs(factor) < SMALLEST:
        raise table.error(f"must not be 0, is {factor:g}", "factor")
    low, high = _limits(table)
    return Signal(
        name,
        # In big-endian order the DBC counts from the most significant bit, which stands in the first byte.
        start=8 * first + (bit if little else bit + bits - 1 - 8 * (size - 1)),
        length=bits,
        byte_order="little_endian" if little else "big_endian",
        is_signed=signed,
        conversion=BaseConversion.factory(factor, table.number("offset", 0.0, -LARGEST, LARGEST)),
        minimum=low,
        maximum=high,
        unit=table.text("unit", "") or None,
    )


def _byte(table: Table) -> int:
    """The place of the first byte: a number from 0, or letters as lists of PIDs have them, A to Z, AA, AB, ..."""
    text = table.values.get("byte")
    if not isinstance(text, str):
        return table.integer("byte", 0, LONGEST_ANSWER - 1)
    if not re.fullmatch(r"[A-Za-z]{1,2}", text):
        raise table.error(f"must be a number from 0, or A to Z, AA, AB, ... ZZ, is {shown(text)}", "byte")
    place = 0
    for letter in text.upper():
        place = 26 * place + ord(letter) - ord("A") + 1
    return place - 1


def _limits(table: Table) -> tuple[float | None, float | None]:
    if "limits" not in table.values:
        return None, None
    limits = table.numbers("limits", -FARTHEST, FARTHEST)
    if len(limits) != 2 or not limits[0] < limits[1]:
        raise table.error(f"must be the least and the greatest value, is {shown(table.values['limits'])}", "limits")
    return limits[0], limits[1]
