"""Asks the vehicle what it tells only when asked: ``gz-onboard run --poll``.

Only the requests of the vehicle file are sent, of services that read, each at its period or less often, one at a time
to an ECU, and none while someone else asks. What is answered goes the way of all frames, through the codec; here it
only says when to ask again.

The transport is that of can-isotp, without its threads: `process` is called in the daemon's loop, with the frames that
the loop has read anyway. A thread of its own would need a second socket, and its frames would stand in no log.
"""

from __future__ import annotations

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence

import isotp

from gz_onboard.bus.answers import NEGATIVE_RESPONSE, PENDING, by_response
from gz_onboard.bus.requests import FUNCTIONAL, SERVICES, Polling, Request, share_of_bus
from gz_onboard.events import EFF_FLAG, Frame

LISTEN = 1.0  # s at the start, in which whoever asks already, or sends on our identifiers, is noticed
QUIET = 300.0  # s without a frame of another tester until we ask again
PENDING_S = 5.0  # s that an ECU takes for an answer which it has announced: P2* of ISO 14229
MOST_PENDING = 20  # such announcements for one answer
LONGEST = 10.0  # s that an answer may take to come
PAUSE = 1.2  # s after an answer of which frames were lost: then nothing of it comes any more
MOST_FLOW_CONTROLS = 3  # for one request
REFUSED_S = 600.0  # s until what an ECU refused is asked for again
SILENT_S = 60.0  # s, the longest that an ECU is left alone which does not answer
SILENT = 3  # times without an answer until it is said
QUICK = 0.3  # s after a request in which an answer is looked for often
REFUSALS = {
    0x11: "service not supported",
    0x12: "not supported",
    0x13: "wrong length or format",
    0x31: "request out of range",
    0x33: "security access denied",
    0x7E: "not supported in the active session",
    0x7F: "service not supported in the active session",
}
"""Negative responses that will be the same the next time; after any other it is asked again after twice the time."""
_BROKEN = (
    isotp.ConsecutiveFrameTimeoutError,
    isotp.WrongSequenceNumberError,
    isotp.InvalidCanDataError,
    isotp.FrameTooLongError,
)
_FLOW_CONTROL = 3  # of the first half byte

log = logging.getLogger("gz-onboard")
logging.getLogger(isotp.TransportLayerLogic.LOGGER_NAME).setLevel(logging.CRITICAL)  # what it warns of is counted here

Send = Callable[[int, bytes], bool]
"""Sends identifier and data; False if the bus does not take it."""


class Poller:
    """Asks by `requests`. send: puts a frame on the bus; counts: what came of it, by the name of the request."""

    def __init__(self, requests: Sequence[Request], polling: Polling, send: Send) -> None:
        self.counts: dict[str, Counter[str]] = {request.name: Counter() for request in requests}
        self._requests = requests
        self._bitrate = polling.bitrate
        self._ecus = {
            response: _Ecu(those, polling, send, self.counts) for response, those in by_response(requests).items()
        }
        self._asked = {*FUNCTIONAL, *(request.request for request in requests)}
        self._quiet_until: float | None = None  # s, monotonic
        self._stopped = False

    @property
    def text(self) -> str:
        """What is asked."""
        share = share_of_bus(self._requests, self._bitrate)
        asked, ecus = len(self._requests), len(self._ecus)
        return f"asking {ecus} ECU{'s' * (ecus > 1)} for {asked} of their data, {100 * share:.1f} % of the bus at most"

    @property
    def summary(self) -> str:
        """What came of it."""
        each = (
            f"{name} {', '.join(f'{what} {n}' for what, n in of.items())}" for name, of in self.counts.items() if of
        )
        return "; ".join([*each, *(["nothing more: someone else asks"] if self._stopped else [])])

    def waiting(self, now: float) -> bool:
        """Whether an answer is expected soon."""
        return any(ecu.waiting(now) for ecu in self._ecus.values())

    def step(self, frames: Iterable[Frame], now: float) -> None:
        """Take in what was received on the channel that requests are sent on; ask what is due. now: monotonic [s]."""
        for _, identifier, data, channel in frames:
            if channel:
                continue
            if identifier in self._asked:
                self._stop(identifier, now)
            elif ecu := self._ecus.get(identifier):
                ecu.hear(data)
        if self._quiet_until is None:
            self._quiet_until = now + LISTEN
        quiet = now >= self._quiet_until
        if self._stopped and quiet:
            self._stopped = False
            log.info("quiet for %d minutes: asking again", QUIET // 60)
        for ecu in self._ecus.values():
            ecu.step(now, quiet)

    def _stop(self, identifier: int, now: float) -> None:
        """Someone else asks: he needs the ECUs for himself, and what he is at is none of our business."""
        self._quiet_until = now + QUIET
        for ecu in self._ecus.values():
            ecu.stop()
        if not self._stopped:
            self._stopped = True
            text = "someone else asks on %#x: nothing is asked until that has been quiet for %d minutes"
            log.warning(text, identifier & ~EFF_FLAG, QUIET // 60)


class _Ecu:
    """One ECU, which is asked for one thing at a time."""

    def __init__(
        self, requests: Sequence[Request], polling: Polling, send: Send, counts: dict[str, Counter[str]]
    ) -> None:
        self._requests = requests
        self._timeout, self._send, self._counts = polling.timeout, send, counts
        self._due = dict.fromkeys(requests, 0.0)  # s, monotonic
        self._failures = dict.fromkeys(requests, 0)  # in a row
        self._asked: Request | None = None
        self._since = self._deadline = 0.0
        self._pending = self._controls = self._silent = 0
        self._not_before = 0.0
        self._error: Exception | None = None
        self._sent = False
        self._inbox: deque[isotp.CanMessage] = deque()
        self._said: set[str] = set()
        self._layer = isotp.TransportLayerLogic(
            lambda _timeout: self._inbox.popleft() if self._inbox else None,
            self._transmit,
            _address(requests[0]),
            self._failed,
            {
                "blocksize": 0,  # one flow control for the whole answer
                "stmin": 0,
                "tx_padding": polling.padding,
                "max_frame_size": max(len(one.prefix) + one.message.length for one in requests),
                "rx_consecutive_frame_timeout": 1000,
            },
        )

    def waiting(self, now: float) -> bool:
        """Whether an answer is expected soon."""
        return self._asked is not None and now - self._since < QUICK

    def hear(self, data: bytes) -> None:
        """Take a frame of the ECU; without a request of ours it is another's, and no flow control answers it."""
        if self._asked:
            one = self._requests[0]
            response, extended = one.response & ~EFF_FLAG, bool(one.response & EFF_FLAG)
            self._inbox.append(isotp.CanMessage(response, len(data), data, extended_id=extended))

    def stop(self) -> None:
        """Ask no more, and leave alone what comes."""
        self._asked = None
        self._inbox.clear()
        self._layer.reset()

    def step(self, now: float, may_ask: bool) -> None:
        """Go on with the request that is under way, or begin the next one that is due."""
        if self._asked:
            self._listen(self._asked, now)
        if may_ask and self._asked is None and now >= self._not_before:
            request = min(self._requests, key=lambda one: self._due[one])
            if now >= self._due[request]:
                self._ask(request, now)

    def _ask(self, request: Request, now: float) -> None:
        self._asked, self._since, self._deadline = request, now, now + self._timeout
        self._pending = self._controls = 0
        self._error, self._sent = None, False
        self._layer.send(request.payload)
        self._layer.process()
        if self._sent:
            self._counts[request.name]["asked"] += 1
        else:
            self._end(request, "not sent", now, request.period)

    def _transmit(self, message: isotp.CanMessage) -> None:
        """Send a frame of the transport; but nothing except the request under way, and flow control for its answer."""
        request = self._asked
        data = bytes(message.data)
        inside = data[1:] if request and request.addresses else data
        if request is None or request.service not in SERVICES:
            return
        if inside[0] >> 4 == _FLOW_CONTROL:
            self._controls += 1
            if self._controls <= MOST_FLOW_CONTROLS:
                self._send(request.request, data)
        elif inside.startswith(bytes([len(request.payload)]) + request.payload):
            self._sent = self._send(request.request, data)

    def _failed(self, error: Exception) -> None:
        if isinstance(error, _BROKEN):
            self._error = error

    def _listen(self, request: Request, now: float) -> None:
        self._layer.process()
        while self._asked and (payload := self._layer.recv()) is not None:
            self._take(request, bytes(payload), now)
        if self._asked is None:
            return
        if self._error and not self._layer.is_rx_active():
            self._not_before = now + PAUSE
            self._fail(request, "answer broken", now)
        elif now >= self._deadline + (LONGEST if self._layer.is_rx_active() else 0.0):
            self._silent += 1
            self._not_before = now + min(self._timeout * 2 ** min(self._silent, 20), SILENT_S)
            if self._silent == SILENT:
                self._say(f"{request.response & ~EFF_FLAG:#x} does not answer")
            self._end(request, "no answer", now, request.period)

    def _take(self, request: Request, payload: bytes, now: float) -> None:
        """Take a whole answer; one that belongs to something else changes nothing."""
        refused = payload[:2] == bytes([NEGATIVE_RESPONSE, request.service]) and len(payload) == 3
        if payload.startswith(request.prefix):
            self._silent = 0
            if len(payload) == len(request.prefix) + request.message.length:
                self._failures[request] = 0
                self._end(request, "answered", now, request.period)
            else:
                said = len(payload) - len(request.prefix)
                self._say(f"{request.name}: the answer has {said} bytes, the file says {request.message.length}")
                self._fail(request, "wrong length", now)
        elif refused and payload[2] == PENDING:
            self._pending += 1
            if self._pending <= MOST_PENDING:
                self._deadline = now + PENDING_S
        elif refused:
            self._silent = 0
            self._refuse(request, payload[2], now)

    def _refuse(self, request: Request, code: int, now: float) -> None:
        if code not in REFUSALS:
            self._fail(request, f"refused {code:#04x}", now)
            return
        self._say(
            f"{request.name}: the ECU refuses it ({REFUSALS[code]}, {code:#04x}); asked again every "
            f"{REFUSED_S / 60:.0f} minutes"
        )
        self._end(request, f"refused {code:#04x}", now, max(REFUSED_S, request.period))

    def _fail(self, request: Request, what: str, now: float) -> None:
        self._failures[request] = min(self._failures[request] + 1, 20)
        later = min(request.period * 2 ** self._failures[request], max(SILENT_S, request.period))
        self._end(request, what, now, later)

    def _end(self, request: Request, what: str, now: float, later: float) -> None:
        self._counts[request.name][what] += 1
        late = self._since - self._due[request]  # by less than a tick of the loop: then the period is kept in the mean
        self._due[request] = (self._due[request] if late < request.period else self._since) + later
        self.stop()

    def _say(self, text: str) -> None:
        if text not in self._said and len(self._said) < 3 * len(self._requests):
            self._said.add(text)
            log.warning("%s", text)


def _address(request: Request) -> isotp.Address:
    extended = bool(request.request & EFF_FLAG)
    sent, received = request.request & ~EFF_FLAG, request.response & ~EFF_FLAG
    if request.addresses is None:
        mode = isotp.AddressingMode.Normal_29bits if extended else isotp.AddressingMode.Normal_11bits
        return isotp.Address(mode, txid=sent, rxid=received)
    mode = isotp.AddressingMode.Extended_29bits if extended else isotp.AddressingMode.Extended_11bits
    target, source = request.addresses
    return isotp.Address(mode, txid=sent, rxid=received, target_address=target, source_address=source)
