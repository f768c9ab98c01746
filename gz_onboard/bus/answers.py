"""Assemble the answers to diagnostic requests from the frames that carry them (ISO 15765-2), whoever asked.

There is no clock, so a log gives the same answers as the live bus. An answer is complete or dropped and counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gz_onboard.bus.requests import Request
from gz_onboard.events import Frame

# Why an answer was dropped
SEQUENCE = "answer with frames missing or out of order"
INTERRUPTED = "answer cut off"
MALFORMED = "no frame of an answer"
NEGATIVE = "negative response"  # and its code

NEGATIVE_RESPONSE = 0x7F
PENDING = 0x78  # the answer comes later
LONGEST_PAUSE = 1.0  # s between the frames of an answer: N_Cr of ISO 15765-2
_SINGLE, _FIRST, _CONSECUTIVE, _FLOW_CONTROL = range(4)


class Assembler:
    """Assembles the answers on one identifier. address: the first byte of each frame, if it has one."""

    def __init__(self, address: int | None, fault: Callable[[str], None]) -> None:
        self._address = address
        self._fault = fault
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
        self._fault(reason)
        self._length, self._skips = 0, True


class AnswerReader:
    """Finds the answers to `requests`, all on one identifier. fault: counts (identifier, reason)."""

    def __init__(self, requests: Sequence[Request], fault: Callable[[str, str], None]) -> None:
        self.inbox: list[Frame] = []
        self._requests, self._fault = requests, fault
        self._place, addresses = f"{requests[0].response & 0x1FFFFFFF:#x}", requests[0].addresses
        self._assembler = Assembler(addresses[1] if addresses else None, lambda reason: fault(self._place, reason))

    def take(self, time: float, data: bytes) -> list[tuple[Request, bytes]]:
        """The request and the bytes behind its data identifier if the frame of `time` [s] completes an answer."""
        payload = self._assembler.take(time, data) or b""
        if payload[:1] == bytes([NEGATIVE_RESPONSE]) and payload[2:3] and payload[2] != PENDING:
            self._fault(self._place, f"{NEGATIVE} {payload[2]:#04x}")
        return [(one, payload[len(one.prefix) :]) for one in self._requests if payload.startswith(one.prefix)]


def by_response(requests: Sequence[Request]) -> dict[int, list[Request]]:
    """The requests by the identifier of their answers."""
    found: dict[int, list[Request]] = {}
    for request in requests:
        found.setdefault(request.response, []).append(request)
    return found
