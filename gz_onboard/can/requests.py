"""Answers to the diagnostic requests of another tester: what a vehicle file says of them, and how frames become them.

Nothing is ever sent. docs/reference/vehicle-file.md describes the ``[[request]]`` tables. ISO 15765-2 describes how an
answer is spread over frames; it is complete or dropped and counted. No clock is read: a log
gives the same as the live bus.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from gz_onboard.can.dbc import FARTHEST, LARGEST, SMALLEST
from gz_onboard.errors import shown
from gz_onboard.events import EFF_FLAG, MOST_EXTENDED, MOST_STANDARD, Frame

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

    from gz_onboard.toml import Table

IDENTIFIER_BYTES = {0x01: 1, 0x21: 1, 0x22: 2}
"""Length of the data identifier by service: SAE J1979, readDataByLocalIdentifier (ISO 14230), ReadDataByIdentifier."""
POSITIVE = 0x40  # is added to the service in its answer
FUNCTIONAL = (0x7DF, 0x18DB_33F1 | EFF_FLAG)  # on which all ECUs are asked together (ISO 15765-4)
MOST_REQUESTS = 100
LONGEST_ANSWER = 4092  # bytes behind a data identifier: ISO-TP has at most 4095
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")
_KEYS = ["name", "service", "data_identifier", "length", "period", "signals"]
_IDENTIFIERS, _ADDRESSES = ("request_identifier", "response_identifier"), ("request_address", "response_address")

# Why an answer was dropped
SEQUENCE = "answer with frames missing or out of order"
INTERRUPTED = "answer cut off"
MALFORMED = "no frame of an answer"
NEGATIVE = "negative response"  # and its code

NEGATIVE_RESPONSE = 0x7F
PENDING = 0x78  # the answer comes later
LONGEST_PAUSE = 1.0  # s between the frames of an answer: N_Cr of ISO 15765-2
_SINGLE, _FIRST, _CONSECUTIVE, _FLOW_CONTROL = range(4)


@dataclass(frozen=True)
class Request:
    """A question to one ECU, and the message that its answer becomes."""

    request: int  # identifier with its flag
    response: int
    addresses: tuple[int, ...] | None  # the first byte of the frames of request and response, if they have one
    prefix: bytes  # of a positive answer: service and data identifier
    period: float  # s
    message: Message  # of the bytes behind the data identifier

    @property
    def name(self) -> str:
        """The name of the message."""
        return self.message.name


def read_requests(vehicle: Table, taken: Mapping[int, str]) -> tuple[Request, ...]:
    """The requests of a vehicle file; InputError where an answer cannot be told from a message or another answer.

    taken: names of the messages of its DBC files, by identifier with flag.
    """
    requests: list[Request] = []
    for table in vehicle.tables("request", MOST_REQUESTS):
        request = _request(table)
        for key, identifier in zip(_IDENTIFIERS, (request.request, request.response), strict=True):
            if identifier in taken:
                taken_by = f"message {taken[identifier]} of the DBC files"
                raise table.error(f"{identifier & ~EFF_FLAG:#x} is that of {taken_by}", key)
        for other in requests:
            if request.name == other.name:
                raise table.error(f"two requests are called {other.name}", "name")
            if request.response == other.response and request.addresses != other.addresses:
                raise table.error(f"is that of {other.name} too, which has another address", "response_identifier")
            if request.response == other.response and request.prefix == other.prefix:
                raise table.error(f"{other.name} asks for it too", "data_identifier")
        requests.append(request)
    return tuple(requests)


def _request(table: Table) -> Request:
    table.only([*_KEYS, *_IDENTIFIERS, *_ADDRESSES])
    service = table.integer("service", 0, 255)
    if service not in IDENTIFIER_BYTES:
        known = ", ".join(f"{one:#04x}" for one in IDENTIFIER_BYTES)
        raise table.error(f"is {service:#04x}; the answers of services {known} are read", "service")
    size = IDENTIFIER_BYTES[service]
    data_identifier = table.integer("data_identifier", 0, 256**size - 1)
    request, response = (table.integer(key, 0, MOST_EXTENDED) for key in _IDENTIFIERS)
    has_addresses = any(key in table.values for key in _ADDRESSES)
    addresses = tuple(table.integer(key, 0, 255) for key in _ADDRESSES) if has_addresses else None
    return Request(
        request | EFF_FLAG if request > MOST_STANDARD else request,
        response | EFF_FLAG if response > MOST_STANDARD else response,
        addresses,
        bytes([service + POSITIVE]) + data_identifier.to_bytes(size, "big"),
        table.number("period", low=0.1, high=3600.0),
        _message(table),
    )


def _message(table: Table) -> Message:
    """The message of the bytes behind the data identifier."""
    from cantools.database.can import Message

    name, signals = table.text("name"), table.table("signals")
    if wrong := next((key for key in (name, *signals.values) if not _NAME.fullmatch(key)), None):
        raise table.error(
            f"{shown(wrong)} must be 1 to 64 letters, digits and _", "name" if wrong == name else "signals"
        )
    if not signals.values:
        raise table.error("is missing: the values to read from the answer", "signals")
    length = table.integer("length", 1, LONGEST_ANSWER)
    found = [_signal(key, signals.table(key), length) for key in signals.values]
    return Message(frame_id=0, name=name, length=length, signals=found, strict=False)  # signals may share bytes


def _signal(name: str, table: Table, length: int) -> Signal:
    from cantools.database.can.signal import Signal
    from cantools.database.conversion import BaseConversion

    table.only(["byte", "bit", "bits", "order", "signed", "factor", "offset", "unit", "limits"])
    first = _first_byte(table)
    bit = table.integer("bit", 0, 7) if "bit" in table.values else 0
    bits = table.integer("bits", 1, 64) if "bits" in table.values else 1 if "bit" in table.values else 8
    size = (bit + bits + 7) // 8
    if first + size > length:
        raise table.error(f"reaches to byte {first + size - 1}; the answer has bytes 0 to {length - 1}", "byte")
    is_little = table.text("order", "big", ["big", "little"]) == "little"
    if not isinstance(signed := table.values.get("signed", False), bool):
        raise table.error(f"must be true or false, is {shown(signed)}", "signed")
    factor = table.number("factor", 1.0, -LARGEST, LARGEST)
    if abs(factor) < SMALLEST:
        raise table.error(f"must not be 0, is {factor:g}", "factor")
    limits = table.numbers("limits", -FARTHEST, FARTHEST) if "limits" in table.values else (None, None)
    if len(limits) != 2 or (limits[0] is not None and not limits[0] < limits[1]):
        raise table.error(f"must be the least and the greatest value, is {shown(table.values['limits'])}", "limits")
    return Signal(
        name,
        # In big-endian order the DBC counts from the most significant bit, which is in the first byte.
        start=8 * first + (bit if is_little else bit + bits - 1 - 8 * (size - 1)),
        length=bits,
        byte_order="little_endian" if is_little else "big_endian",
        is_signed=signed,
        conversion=BaseConversion.factory(factor, table.number("offset", 0.0, -LARGEST, LARGEST)),
        minimum=limits[0],
        maximum=limits[1],
        unit=table.text("unit", "") or None,
    )


def _first_byte(table: Table) -> int:
    """The first byte: a number from 0, or letters as in lists of PIDs, A to Z, AA, AB, ..."""
    text = table.values.get("byte")
    if not isinstance(text, str):
        return table.integer("byte", 0, LONGEST_ANSWER - 1)
    if not re.fullmatch(r"[A-Za-z]{1,2}", text):
        raise table.error(f"must be a number from 0, or A to Z, AA, AB, ... ZZ, is {shown(text)}", "byte")
    *tens, units = (ord(letter) - ord("A") for letter in text.upper())
    return 26 * (tens[0] + 1) + units if tens else units


# --- frames -----------------------------------------------------------------------------------------------------------


class Assembler:
    """Assembles the answers on one identifier. address: the first byte of each frame, if it has one.

    faults: counts the answers that are dropped, by (place, reason).
    """

    def __init__(self, address: int | None, place: str, faults: Counter[tuple[str, str]]) -> None:
        self._address, self._place, self._faults = address, place, faults
        self._data = bytearray()
        self._length = 0  # of the answer that is being assembled; 0: none is
        self._skips = True  # consecutive frames of an answer that was dropped, or started before we listened
        self._next = 0  # sequence number
        self._time = 0.0  # s, of the last frame

    def take(self, time: float, data: bytes) -> bytes | None:
        """The answer that the frame `data` of `time` [s] completes, or None."""
        is_full = len(data) == 8
        if self._address is not None:
            if data[:1] != bytes([self._address]):
                return None  # to another tester
            data = data[1:]
        kind = data[0] >> 4 if data and len(data) <= 8 else None
        if kind == _CONSECUTIVE:
            return self._consecutive(time, data, is_full)
        if kind == _FLOW_CONTROL:
            return None
        if is_interrupted := self._length > 0:
            self._drop(INTERRUPTED)
        if kind == _SINGLE and 0 < data[0] < len(data):
            self._skips = False
            return data[1 : 1 + data[0]]
        if kind == _FIRST and is_interrupted:  # whose frames will follow? drop both
            return None
        length = (data[0] & 0xF) << 8 | data[1] if kind == _FIRST and is_full else 0
        if length < len(data):  # a shorter answer comes in a single frame
            self._drop(MALFORMED)
        else:
            self._data, self._length, self._next, self._time, self._skips = bytearray(data[2:]), length, 1, time, False
        return None

    def _consecutive(self, time: float, data: bytes, is_full: bool) -> bytes | None:
        if self._skips:
            return None
        missing = self._length - len(self._data)
        in_time = 0 <= time - self._time < LONGEST_PAUSE
        if not self._length or not in_time or data[0] & 0xF != self._next or (len(data) <= missing and not is_full):
            self._drop(SEQUENCE)
            return None
        self._data += data[1 : 1 + missing]
        self._next, self._time = self._next + 1 & 0xF, time
        if len(self._data) < self._length:
            return None
        self._length = 0
        return bytes(self._data)

    def _drop(self, reason: str) -> None:
        self._faults[self._place, reason] += 1
        self._length, self._skips = 0, True


class AnswerReader:
    """Finds the answers to `requests`, all on one identifier. faults: counts (identifier, reason) of those dropped."""

    def __init__(self, requests: Sequence[Request], faults: Counter[tuple[str, str]]) -> None:
        self.inbox: list[Frame] = []
        self._requests, self._faults = requests, faults
        self._place, addresses = f"{requests[0].response & 0x1FFFFFFF:#x}", requests[0].addresses
        self._assembler = Assembler(addresses[1] if addresses else None, self._place, faults)

    def take(self, time: float, data: bytes) -> list[tuple[Request, bytes]]:
        """The request and the bytes behind its data identifier if the frame of `time` [s] completes an answer."""
        payload = self._assembler.take(time, data) or b""
        if payload[:1] == bytes([NEGATIVE_RESPONSE]) and payload[2:3] and payload[2] != PENDING:
            self._faults[self._place, f"{NEGATIVE} {payload[2]:#04x}"] += 1
        return [(one, payload[len(one.prefix) :]) for one in self._requests if payload.startswith(one.prefix)]


def answer_readers(requests: Sequence[Request], faults: Counter[tuple[str, str]]) -> dict[int, AnswerReader]:
    """A reader for each identifier on which answers to `requests` come."""
    responses = dict.fromkeys(request.response for request in requests)
    return {i: AnswerReader([one for one in requests if one.response == i], faults) for i in responses}
