"""Answers to diagnostic requests: what the requests of a vehicle file say of them. Nothing is ever sent.

[[request]]                       # that another tester sends
name = "BMS"                      # of the message that its answer becomes
request_identifier = 0x7E4        # 11 bits, or 29 from 0x14000000 on
response_identifier = 0x7EC
service = 0x22                    # ReadDataByIdentifier (ISO 14229), 0x01 (SAE J1979) or 0x21 (ISO 14230)
data_identifier = 0x0101          # of service 0x01 the PID, of 0x21 the local identifier
length = 59                       # bytes of the answer behind the data identifier
period = 1.0                      # s

[request.signals]
BMS_Voltage = { byte = "M", bits = 16, factor = 0.1, unit = "V", limits = [200, 450] }
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gz_onboard.bus.dbc import FARTHEST, LARGEST, SMALLEST
from gz_onboard.errors import shown
from gz_onboard.events import EFF_FLAG, MOST_EXTENDED, MOST_STANDARD

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

    from gz_onboard.toml import Table

IDENTIFIER_BYTES = {0x01: 1, 0x21: 1, 0x22: 2}
"""Length of the data identifier by service: SAE J1979, readDataByLocalIdentifier (ISO 14230), ReadDataByIdentifier."""
POSITIVE = 0x40  # is added to the service in its answer
FUNCTIONAL = (0x7DF, 0x18DB_33F1 | EFF_FLAG)  # all ECUs together are asked there (ISO 15765-4)
MOST_REQUESTS = 100
LONGEST_ANSWER = 4092  # bytes behind a data identifier: ISO-TP has at most 4095
PERIODS = 0.1, 3600.0  # s
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
    def prefix(self) -> bytes:
        """The first bytes of its positive answer."""
        identifier = self.data_identifier.to_bytes(IDENTIFIER_BYTES[self.service], "big")
        return bytes([self.service + POSITIVE]) + identifier


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


def _request(table: Table) -> Request:
    table.only(["name", "service", "data_identifier", "length", "period", "signals", *_IDENTIFIERS, *_ADDRESSES])
    service = table.integer("service", 0, 255)
    if service not in IDENTIFIER_BYTES:
        known = ", ".join(f"{one:#04x}" for one in IDENTIFIER_BYTES)
        raise table.error(f"is {service:#04x}; the answers of services {known} are read", "service")
    data_identifier = table.integer("data_identifier", 0, 256 ** IDENTIFIER_BYTES[service] - 1)
    request = _identifier(table, "request_identifier")
    response = _identifier(table, "response_identifier")
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


def _identifier(table: Table, key: str) -> int:
    """The identifier `key`, with the flag of 29 bits where it needs them."""
    value = table.integer(key, 0, MOST_EXTENDED)
    return value if value <= MOST_STANDARD else value | EFF_FLAG


def _addresses(table: Table) -> tuple[int, int] | None:
    if not any(key in table.values for key in _ADDRESSES):
        return None
    first, second = (table.integer(key, 0, 255) for key in _ADDRESSES)
    return first, second


def _check_pair(table: Table, request: Request, other: Request) -> None:
    """InputError where the answers of two requests cannot be told apart."""
    if request.name == other.name:
        raise table.error(f"two requests are called {other.name}", "name")
    if request.response == other.request or request.request == other.response:
        raise table.error(f"{other.name} has it for the other direction", "response_identifier")
    if request.response != other.response:
        return
    if request.addresses != other.addresses:
        raise table.error(f"is that of {other.name} too, which has another address", "response_identifier")
    if request.prefix == other.prefix:
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
