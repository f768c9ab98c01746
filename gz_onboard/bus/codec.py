"""Decode CAN frames and accumulate their signals, through a cantools database compiled once.

A frame costs a check and an addition: its raw values go into sums, which `Codec.windows` scales and hands over about
twice a second.

Whole frame or nothing: what fails a check is dropped, counted by message and reason, and never becomes a
number. Nothing here raises on whatever the bus brings.

Each mapped message becomes a function generated from its layout in the database: one ``struct`` call, shifts and
masks take 0.4 µs where ``decode_message`` takes 4. A test holds both equal over random frames and random layouts;
multiplexed and floating-point signals go through cantools itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from gz_onboard.bus.answers import INTERRUPTED, MALFORMED, SEQUENCE, AnswerReader, Take, by_response
from gz_onboard.bus.checksum import sae_j1850_tables
from gz_onboard.bus.layout import MappedMessage, identifier_of, is_not_available, raw_values
from gz_onboard.bus.mapping import BusMapping, Protection, Source
from gz_onboard.bus.origins import RECENT, Origins
from gz_onboard.bus.requests import FUNCTIONAL
from gz_onboard.bus.signals import MessageSignals, Values
from gz_onboard.events import (
    ERR_FLAG,
    RTR_FLAG,
    SQUARED,
    STALE_PERIODS,
    TRANSMITTED,
    Frame,
    Group,
    MessageWindow,
    RoleWindow,
)

if TYPE_CHECKING:
    from cantools.database.can import Message

# Why a frame or a signal was dropped
LENGTH = "wrong length"
CRC = "wrong checksum"
COUNTER = "counter jump"
NOT_AVAILABLE = "not available"
RANGE = "out of range"
TIME = "implausible time"
UNDECODABLE = "undecodable"
CONFLICT = "different data from two channels or senders"
DROPPING = (
    LENGTH,
    CRC,
    COUNTER,
    TIME,
    UNDECODABLE,
    CONFLICT,
    SEQUENCE,
    INTERRUPTED,
    MALFORMED,
)  # that drop a frame or an answer

SILENT = 2.0  # s: a message's own place that sends nothing for so long, and ten periods, has fallen silent
BACK_NS = 50_000_000  # frames of two channels may overtake each other by a little
AHEAD_NS = 30_000_000_000
LONGEST_PAUSE_NS = 30 * 86_400 * 1_000_000_000
"""Of a log: a leap ahead by more is a clock that was set. A live bus may be silent for as long as it likes."""
_MOST_LEAPS = 100  # are remembered
CONFIRM = 3  # so many frames in a row agree on a new time before it is believed
_MOST_IDENTIFIERS = 4096  # are remembered: a babbling node must not fill the memory

Handler = Callable[[int, bytes], bool | None]
"""Takes the time [ns, on the codec's timeline] and data of a frame; True if the frame was dropped."""
Drained = tuple[int, int, tuple[float, ...], tuple[float, ...], tuple[float, ...]]
"""Frames, time of the last [ns], and of each signal the last raw value, the sum, and the sum of squares."""


@dataclass(slots=True)
class Spill:
    """Valid samples of one signal from frames in which another signal was missing or not valid; raw values."""

    count: int = 0
    time: int = -1  # ns
    value: float = 0.0
    total: float = 0.0
    square: float = 0.0

    def add(self, time: int, value: float) -> None:
        """Take a raw value at `time` [ns]."""
        self.time, self.value, self.count = time, value, self.count + 1
        self.total += value
        self.square += value * value


class Accumulator:
    """Samples of one message since the last window.

    fault: counts (place, reason).
    """

    def __init__(self, mapped: MappedMessage, group: int, fault: Callable[[str, str], None]) -> None:
        self.mapped, self.group, self._fault = mapped, group, fault
        self.drain: Callable[[], Drained]
        self._spilled = 0  # frames
        self._spill_time = -1  # ns
        self._spills = [Spill() for _ in mapped.sources]

    def spill(self, time: int, raw: Sequence[float | None]) -> None:
        """Take a frame at `time` [ns] in which some raw values are absent or not within their limits."""
        self._spilled, self._spill_time, mapped = self._spilled + 1, time, self.mapped
        for spill, source, signal, (low, high), value in zip(
            self._spills, mapped.sources, mapped.signals, mapped.limits, raw, strict=True
        ):
            if value is not None and low <= value <= high:  # False for NaN
                spill.add(time, value)
            elif value is not None:
                absent = mapped.not_available and is_not_available(signal, value)
                self._fault(f"{source.message}.{source.signal}", NOT_AVAILABLE if absent else RANGE)

    def spill_undecoded(self, time: int, data: bytes) -> bool | None:
        """Take a frame at `time` [ns] that cantools has to decode; True if it cannot."""
        values = raw_values(self.mapped.message, data)
        if values is None:
            self._fault(self.mapped.message.name, UNDECODABLE)
            return True
        raw = [values.get(source.signal) for source in self.mapped.sources]  # absent: another multiplexed branch
        if any(value is not None for value in raw):
            self.spill(time, raw)
        return None

    def window(self) -> MessageWindow | None:
        """The samples since the last call; None if no frame came."""
        n, last, values, sums, squares = self.drain()
        if not n and not self._spilled:
            return None
        roles: list[RoleWindow | None] = []
        square = iter(squares)
        for i, (source, spill) in enumerate(zip(self.mapped.sources, self._spills, strict=True)):
            squared = source.role in SQUARED
            total, raw, time = (sums[i], values[i], last) if n else (0, 0.0, -1)
            square_total = next(square) if squared and n else 0
            count, scale, offset = n + spill.count, source.factor, source.offset
            if spill.count:
                total, square_total = total + spill.total, square_total + spill.square
                if spill.time >= time:
                    time, raw = spill.time, spill.value
            if not count:
                roles.append(None)
                continue
            mean = total / count
            mean_square = scale * scale * square_total / count + offset * (2 * scale * mean + offset)
            roles.append(
                RoleWindow(
                    time * 1e-9, raw * scale + offset, count, mean * scale + offset, mean_square if squared else None
                )
            )
        time, count = max(last if n else -1, self._spill_time if self._spilled else -1), n + self._spilled
        if self._spilled:
            self._spilled, self._spills = 0, [Spill() for _ in self._spills]
        return MessageWindow(self.group, time * 1e-9, count, tuple(roles))


class Codec:
    """Decodes frames of one vehicle. Its state is what the checks need: counters, the last time, the counts."""

    def __init__(self, mapping: BusMapping, longest_pause_ns: int | None = None) -> None:
        self.mapping = mapping
        self.longest_pause_ns = longest_pause_ns  # None: any leap ahead is a pause
        self.leaps: list[tuple[float, float]] = []  # of the clock: when [s on our timeline], by how much [s]
        self.groups: list[Group] = []
        self.faults: dict[tuple[str, str], int] = {}  # (message, reason) -> frames or signals dropped
        self.lost: dict[str, int] = {}  # message -> frames that its counter shows as missing
        self.unknown: dict[int, int] = {}  # identifier -> frames, of the first few thousand identifiers
        self.unknown_others = 0  # frames of further identifiers
        self.copies = 0  # frames of known messages from another channel or sender than they are taken from
        self.error_frames = 0
        self.received = 0
        self.latest: dict[int, tuple[int, bytes]] = {}  # identifier -> time [ns], data of the last good frame
        # Likewise, below zero, of the last good answer to a request: -1 for the first request, and so on.
        self.wrong_lengths: dict[str, int] = {}  # message of an answer -> bytes of the last that has another length
        self._accumulators: list[Accumulator] = []
        self._origin_ns: int | None = None
        self._signals: dict[str, MessageSignals] = {}  # by message, of those that were asked for
        self._last_ns = -(1 << 80)  # before any frame: far from every time
        self._suspects = 0
        self._suspect_ns = 0  # the time of the last suspect
        self._before_ns = 0  # `_last_ns` when it came: a good frame in between clears the suspicion
        self.origins = Origins(mapping)
        self._own_times: dict[str, int] = {}  # ns, of the last frame of messages that are heard elsewhere as well
        self._handlers: dict[int, dict[int, Handler]] = {}  # by channel and identifier, of what was heard
        self._channel, self._room = -1, _MOST_IDENTIFIERS  # of the last frame; further handlers to keep
        self._decoders: dict[str, Handler] = {}
        self._mapped = {source.message for source in mapping.sources}
        by_message: dict[str, list[Source]] = {}
        for source in mapping.sources:
            by_message.setdefault(source.message, []).append(source)
        for message in mapping.database.messages:
            self._decoders[message.name] = self._handler(message, by_message.get(message.name, []))
        self._answers = self._answer_handlers(by_message)
        self._answering: dict[int, int] = {}  # channel by identifier of an answer: the first, as a gateway may copy it

    # --- frames ---------------------------------------------------------------------------------------------

    def decode(self, frames: Iterable[Frame]) -> None:
        """Decode `frames` and add their values to the window. Times are since the first frame ever decoded."""
        latest, heard = self.latest, self._channel
        handlers = self._handlers.setdefault(heard & ~TRANSMITTED, {})
        origin, last = self._origin_ns, self._last_ns
        back, ahead = -BACK_NS, AHEAD_NS
        count = 0
        for time_ns, identifier, data, channel in frames:
            count += 1
            step = time_ns - last
            if step < 0 or step > ahead:
                if step < back or step > ahead:
                    self._last_ns = last
                    if not self._retime(time_ns):
                        continue
                    origin, last = self._origin_ns, self._last_ns
            else:
                last = time_ns
            if channel != heard:
                heard, handlers = channel, self._handlers.setdefault(channel & ~TRANSMITTED, {})
            try:
                handler = handlers[identifier]
            except KeyError:
                handler = self._first_heard(channel & ~TRANSMITTED, identifier)
            if handler(time_ns - origin, data):  # type: ignore[operator]
                continue
            latest[identifier] = (time_ns, data)
        self._last_ns, self._channel = last, heard
        self.received += count

    def windows(self) -> list[MessageWindow]:
        """The values of each message since the last call, of those that came."""
        return [window for accumulator in self._accumulators if (window := accumulator.window())]

    @property
    def started(self) -> bool:
        """Whether any frame has come."""
        return self._origin_ns is not None

    @property
    def passed(self) -> float:
        """The time of the last frame on the timeline [s]."""
        return self.seconds(self._last_ns)

    def seconds(self, time_ns: int) -> float:
        """`time_ns` on the timeline [s]."""
        return 0.0 if self._origin_ns is None else (time_ns - self._origin_ns) * 1e-9

    def time_ns(self, seconds: float) -> int:
        """`seconds` of the timeline by the clock of the frames, as it is set now [ns]; 0 before the first frame."""
        return 0 if self._origin_ns is None else max(self._origin_ns + round(seconds * 1e9), 0)

    @property
    def last_ns(self) -> int:
        """The time of the last frame by their clock as it is set now [ns]; 0 before the first."""
        return 0 if self._origin_ns is None else self._last_ns

    def clock_set(self, delta_ns: int) -> None:
        """The clock that stamps the frames was set by `delta_ns`; the timeline goes on."""
        if self._origin_ns is not None:
            self._origin_ns += delta_ns
            self._last_ns += delta_ns

    def _retime(self, time_ns: int) -> bool:
        """Take a time that does not follow the last one: True if the frame is to be used.

        One odd stamp is dropped. Several in a row that follow each other mean that the clock was set: back, or ahead by
        more than the longest pause, and the timeline goes on from where it was; else ahead, and it is taken as a gap in
        the recording.
        """
        if self._origin_ns is None:
            self._origin_ns = self._last_ns = time_ns
            return True
        follows = self._before_ns == self._last_ns and -BACK_NS <= time_ns - self._suspect_ns <= AHEAD_NS
        self._suspects = self._suspects + 1 if follows and self._suspects else 1
        self._suspect_ns, self._before_ns = time_ns, self._last_ns
        if self._suspects < CONFIRM:
            self._fault("", TIME)
            return False
        self._suspects = 0
        leap = time_ns - self._last_ns
        if leap < 0 or (self.longest_pause_ns is not None and leap > self.longest_pause_ns):
            if len(self.leaps) < _MOST_LEAPS:
                self.leaps.append((self.seconds(self._last_ns), leap * 1e-9))
            self._origin_ns += leap
        self._last_ns = time_ns
        return True

    def _first_heard(self, channel: int, identifier: int) -> Handler:
        """The handler of frames with this identifier on this channel; kept for the next of them while there is room."""
        message = None if identifier & (ERR_FLAG | RTR_FLAG) else self.origins.message(identifier)
        handler: Handler
        if identifier & ERR_FLAG:
            handler = self._count_error
        elif identifier in self._answers:
            first = self._answering.setdefault(identifier, channel) == channel
            handler = self._answers[identifier] if first else self._count_copy
        elif message is None:
            handler = self._count_unknown(identifier) if self._room else self._count_others
        elif self.origins.claim(message, channel, identifier):
            handler = self._own(message, channel, identifier)
        else:
            handler = self._elsewhere(message, channel, identifier)
        if self._room or (message and identifier == identifier_of(message)):
            self._room = max(self._room - 1, 0)
            self._handlers[channel][identifier] = handler
        elif message:  # used, but not kept as the latest of its identifier
            return lambda time, data: handler(time, data) or True
        return handler

    def _own(self, message: Message, channel: int, identifier: int) -> Handler:
        """The handler where `message` is taken from. It may replace another place, which is then looked at anew."""
        for heard, handlers in self._handlers.items():
            for other in [i for i in handlers if self._is(message, i) and not self.origins.claim(message, heard, i)]:
                del handlers[other]
                self._room += 1
        decode = self._decoders[message.name]
        if message.name not in self.origins.recent:
            return decode

        def handler(time: int, data: bytes) -> bool | None:
            self.origins.own(message.name, data)
            self._own_times[message.name] = time
            return decode(time, data)

        return handler

    def _is(self, message: Message | None, identifier: int) -> bool:
        return not identifier & (ERR_FLAG | RTR_FLAG) and self.origins.message(identifier) is message

    def heard(self, name: str) -> list[tuple[int, int]]:
        """(channel, identifier) of all frames of a message that were heard, also where it is not taken from."""
        message = next((m for m in self.mapping.database.messages if m.name == name), None)
        return [(channel, i) for channel, known in self._handlers.items() for i in known if self._is(message, i)]

    def _elsewhere(self, message: Message, channel: int, identifier: int) -> Handler:
        """The handler of frames that are not from where `message` is taken: left out, or a contradiction."""
        name, origins = message.name, self.origins
        if name not in self._mapped:
            return self._count_copy
        recent = origins.recent.setdefault(name, deque(maxlen=RECENT))
        for heard, handlers in self._handlers.items():  # from now on its own frames are kept, to be compared
            for own in [i for i in handlers if self._is(message, i) and origins.claim(message, heard, i)]:
                handlers[own] = self._own(message, heard, own)
                time_ns, data = self.latest.get(own, (0, b""))
                recent.append(data)
                self._own_times[name] = time_ns - (self._origin_ns or 0)
        stale = 1e9 * max(SILENT, STALE_PERIODS * self.mapping.periods.get(name, 0.0))  # ns

        def contradicted(_time: int, _data: bytes) -> bool:
            self._fault(name, CONFLICT)
            return True

        def handler(time: int, data: bytes) -> bool:
            silent = time - self._own_times.get(name, time) > stale
            if silent and origins.take_over(message, channel, identifier):
                for handlers in self._handlers.values():
                    for known in [i for i in handlers if self._is(message, i)]:
                        del handlers[known]
                        self._room += 1
                return self._count_copy(time, data)
            if origins.differs(message, channel, identifier, data, silent):
                for handlers in self._handlers.values():
                    handlers.update({i: contradicted for i in handlers if self._is(message, i)})
                return contradicted(time, data)
            return self._count_copy(time, data)

        return handler

    def _count_copy(self, _time: int, _data: bytes) -> bool:
        self.copies += 1
        return True

    def _count_error(self, _time: int, _data: bytes) -> bool:
        self.error_frames += 1
        return True

    def _count_others(self, _time: int, _data: bytes) -> bool:
        self.unknown_others += 1
        return True

    def _count_unknown(self, identifier: int) -> Handler:
        unknown = self.unknown

        def handler(_time: int, _data: bytes) -> bool:
            unknown[identifier] = unknown.get(identifier, 0) + 1
            return True

        return handler

    def _fault(self, message: str, reason: str) -> None:
        key = (message, reason)
        self.faults[key] = self.faults.get(key, 0) + 1

    # --- what is known of a message ---------------------------------------------------------------------------

    def values(self, identifier: int, data: bytes) -> Values:
        """Every signal of a frame in the units of the DBC, see `MessageSignals.values`; none of an unknown frame."""
        message = self._message(identifier)
        if message is None:
            return {}
        if (signals := self._signals.get(message.name)) is None:
            not_available = self.mapping.not_available and identifier >= 0
            self._signals[message.name] = signals = MessageSignals(message, not_available)
        return signals.values(data) or {}

    def message_name(self, identifier: int) -> str | None:
        """The name of the message with this identifier."""
        message = self._message(identifier)
        return message.name if message else None

    def _message(self, identifier: int) -> Message | None:
        return self.mapping.requests[-identifier - 1].message if identifier < 0 else self.origins.message(identifier)

    # --- compiling ----------------------------------------------------------------------------------------------

    def _answer_handlers(self, by_message: dict[str, list[Source]]) -> dict[int, Handler]:
        """The handlers of the frames of requests and answers."""
        requests = self.mapping.requests
        asked = {*FUNCTIONAL, *(request.request for request in requests)} if requests else ()
        handlers: dict[int, Handler] = dict.fromkeys(asked, lambda _time, _data: True)
        for response, those in by_response(requests).items():
            takers = [self._answer(-1 - requests.index(one), by_message.get(one.name, [])) for one in those]
            answers = AnswerReader(those, takers, self._fault)
            handlers[response] = lambda time, data, answers=answers: answers.take(time * 1e-9, data)  # type: ignore[misc]
        return handlers

    def _answer(self, key: int, sources: list[Source]) -> Take:
        """What takes the data of the answer whose `latest` is that of `key`."""
        message = self.mapping.requests[-1 - key].message
        decode = self._handler(message, sources, not_available=False)  # all ones are a value: what limits are for

        def take(seconds: float, data: bytes) -> None:
            time = round(seconds * 1e9)
            if len(data) != message.length:
                self.wrong_lengths[message.name] = len(data)
            if not decode(time, data) and self._origin_ns is not None:
                self.latest[key] = (self._origin_ns + time, data)

        return take

    def _handler(self, message: Message, sources: list[Source], not_available: bool | None = None) -> Handler:
        if not sources:
            return self._check_length_only(message)
        mapping, name = self.mapping, message.name
        protection = mapping.protection.get(name, Protection())
        codes = mapping.not_available if not_available is None else not_available
        mapped = MappedMessage(message, sources, protection, mapping.periods.get(name), codes)
        group = len(self.groups)
        self.groups.append(Group(name, tuple(source.role for source in sources), mapped.period))
        accumulator = Accumulator(mapped, group, self._fault)
        self._accumulators.append(accumulator)
        scope: dict[str, Any] = {"LENGTH": LENGTH, "CRC": CRC, "COUNTER": COUNTER}
        exec(compile(mapped.source(), f"<layout of {name}>", "exec"), scope)
        spill = accumulator.spill if mapped.plain else accumulator.spill_undecoded
        constant, tables = sae_j1850_tables(message.length - 1) if protection.crc else (0, [])
        handler: Handler
        handler, accumulator.drain = scope["make"](self, spill, *([constant, *tables] if protection.crc else []))
        return handler

    def _check_length_only(self, message: Message) -> Handler:
        name, length = message.name, message.length

        def handler(_time: int, data: bytes) -> bool | None:
            if len(data) == length:
                return None
            self._fault(name, LENGTH)
            return True

        return handler

    def _jumped(self, message: str, lost: int) -> None:
        """Count the `lost` frames that a message's counter shows as missing."""
        self.lost[message] = self.lost.get(message, 0) + lost


def known_identifiers(mapping: BusMapping) -> list[int] | None:
    """The identifiers (with flags) that the database knows, for the kernel's filters; None if it goes by PGN."""
    if mapping.j1939:
        return None
    asked = {one for request in mapping.requests for one in (request.request, request.response, *FUNCTIONAL)}
    return [*(identifier_of(message) for message in mapping.database.messages), *sorted(asked)]
