"""The answers to requests, put together from the frames that carry them (ISO 15765-2), whoever asked.

It only listens and knows no clock, so a log gives what the live bus gave. An answer is whole or it is nothing: what
comes out of order, late or mixed with another is dropped and counted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum

from gz_onboard.bus.requests import Request

# Why an answer was dropped
SEQUENCE = "answer with frames missing or out of order"
INTERRUPTED = "answer cut off"
MALFORMED = "no frame of an answer"
NEGATIVE = "negative response"  # and its code

NEGATIVE_RESPONSE = 0x7F
PENDING = 0x78  # the answer comes later
LONGEST_PAUSE = 1.0  # s between the frames of an answer: N_Cr of ISO 15765-2
DOUBTED = 3  # answers are left out where one begins within another: whose are the frames that follow?
_SINGLE, _FIRST, _FOLLOWING, _FLOW_CONTROL = range(4)
_FRAME = 8  # bytes, of a frame that another follows


class _State(Enum):
    IDLE = 0
    TAKING = 1
    LEFT = 2  # what follows belongs to an answer that is dropped already, or began before we listened


class Assembler:
    """Puts the answers on one identifier together. address: the first byte of each frame, if it has one."""

    def __init__(self, address: int | None, fault: Callable[[str], None]) -> None:
        self._address = address
        self._fault = fault
        self._state = _State.LEFT
        self._data = bytearray()
        self._length = 0
        self._next = 0  # sequence number
        self._time = -LONGEST_PAUSE  # s, of the last frame of an answer of several
        self._doubt = 0  # answers of several frames still to be left out

    def take(self, time: float, data: bytes) -> bytes | None:
        """The answer that the frame `data` of `time` [s] completes, or None."""
        whole = len(data) == _FRAME
        if self._address is not None:
            if data[:1] != bytes([self._address]):
                return None  # to another tester
            data = data[1:]
        kind = data[0] >> 4 if data and len(data) <= _FRAME else _FLOW_CONTROL + 1
        if kind == _SINGLE:
            return self._single(data)
        if kind == _FIRST:
            self._first(time, data, whole)
        elif kind == _FOLLOWING:
            return self._following(time, data, whole)
        elif kind > _FLOW_CONTROL:
            self._fault(MALFORMED)
        return None

    def _single(self, data: bytes) -> bytes | None:
        length = data[0] & 0xF
        if self._state is _State.TAKING:
            self._fault(INTERRUPTED)
        self._state = _State.IDLE
        if 0 < length < len(data):
            return data[1 : 1 + length]
        self._fault(MALFORMED)
        return None

    def _first(self, time: float, data: bytes, whole: bool) -> None:
        recent, self._time = 0 <= time - self._time < LONGEST_PAUSE, time
        if self._state is _State.TAKING:
            self._fault(INTERRUPTED)
            self._doubt = DOUBTED
        self._doubt = self._doubt if recent else 0
        self._length = (data[0] & 0xF) << 8 | data[1] if len(data) > 1 else 0
        self._state = _State.LEFT
        if self._doubt:
            self._doubt -= 1
            self._fault(INTERRUPTED)
        elif not whole or self._length < len(data):  # what fits into a single frame comes in one; 0: over 4095 bytes
            self._fault(MALFORMED)
        else:
            self._data[:] = data[2:]
            self._state, self._next = _State.TAKING, 1

    def _following(self, time: float, data: bytes, whole: bool) -> bytes | None:
        recent, self._time = 0 <= time - self._time < LONGEST_PAUSE, time
        if self._state is _State.LEFT:
            return None
        missing = self._length - len(self._data)
        if (
            self._state is _State.IDLE
            or not recent
            or data[0] & 0xF != self._next
            or (len(data) - 1 < missing and not whole)
        ):
            self._fault(SEQUENCE)
            self._state = _State.LEFT
            return None
        self._data += data[1 : 1 + missing]
        self._next = self._next + 1 & 0xF
        if len(self._data) < self._length:
            return None
        self._state = _State.IDLE
        return bytes(self._data)


Take = Callable[[float, bytes], object]
"""Takes the time [s] and the bytes behind the data identifier."""


class Answers:
    """Those on one identifier: of `requests`, each taken by the one of `takers` at its place.

    fault: counts (message, reason).
    """

    def __init__(self, requests: Sequence[Request], takers: Sequence[Take], fault: Callable[[str, str], None]) -> None:
        addresses, self._place = requests[0].addresses, f"{requests[0].response & 0x1FFFFFFF:#x}"
        self._fault = fault
        self._assembler = Assembler(addresses[1] if addresses else None, self._dropped)
        self._takers = {request.prefix: take for request, take in zip(requests, takers, strict=True)}

    def take(self, time: float, data: bytes) -> None:
        """Take the frame `data` of `time` [s]."""
        payload = self._assembler.take(time, data)
        if payload is None:
            return
        if payload[0] == NEGATIVE_RESPONSE:
            if payload[2:3] and payload[2] != PENDING:
                self._fault(self._place, f"{NEGATIVE} {payload[2]:#04x}")
            return
        for prefix, take in self._takers.items():
            if payload.startswith(prefix):
                take(time, payload[len(prefix) :])

    def _dropped(self, reason: str) -> None:
        self._fault(self._place, reason)


def by_response(requests: Sequence[Request]) -> dict[int, list[Request]]:
    """The requests by the identifier of their answers."""
    found: dict[int, list[Request]] = {}
    for request in requests:
        found.setdefault(request.response, []).append(request)
    return found
