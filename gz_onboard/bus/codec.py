"""From CAN frames to events, through a cantools database compiled once.

Whole frame or nothing: what fails a check is dropped, counted by message and reason, and never becomes a
number. Nothing here raises on whatever the bus brings.

Each mapped message becomes a function generated from its layout in the database: one ``struct`` call, shifts and
masks take 0.4 µs where ``decode_message`` takes 4. A test holds both equal over random frames and random layouts;
multiplexed and floating-point signals go through cantools itself.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from gz_onboard.bus.checksum import sae_j1850_tables
from gz_onboard.bus.mapping import Mapping, Protection, Source, pgn
from gz_onboard.events import EFF_FLAG, ERR_FLAG, PLAUSIBLE, ROLES, RTR_FLAG, STALE_PERIODS, Event, Frame, Group

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

# Why a frame or a signal was dropped
LENGTH = "wrong length"
CRC = "wrong checksum"
COUNTER = "counter jump"
NOT_AVAILABLE = "not available"
RANGE = "out of range"
TIME = "implausible time"
UNDECODABLE = "undecodable"
REASONS = (LENGTH, CRC, COUNTER, NOT_AVAILABLE, RANGE, TIME, UNDECODABLE)

_BACK_NS = 50_000_000  # frames of two channels may overtake each other by a little
_AHEAD_NS = 30_000_000_000
_CONFIRM = 3  # so many frames in a row agree on a new time before it is believed
_MOST_IDENTIFIERS = 4096  # are remembered: a babbling node must not fill the memory

Handler = Callable[[float, bytes], bool | None]
"""Takes the time [s] and data of a frame; True if the frame was dropped."""


class Codec:
    """Decodes frames of one vehicle. Its state is what the checks need: counters, the last time, the counts."""

    def __init__(self, mapping: Mapping) -> None:
        self.mapping = mapping
        self.groups: list[Group] = []
        self.faults: dict[tuple[str, str], int] = {}  # (message, reason) -> frames or signals dropped
        self.lost: dict[str, int] = {}  # message -> frames that its counter shows as missing
        self.unknown: dict[int, int] = {}  # identifier -> frames, of the first few thousand identifiers
        self.unknown_others = 0  # frames of further identifiers
        self.error_frames = 0
        self.received = 0
        self.latest: dict[int, tuple[int, bytes]] = {}  # identifier -> time [ns], data of the last good frame
        self._events: list[Event] = []
        self._origin_ns: int | None = None
        self._limits: dict[str, list[tuple[str, Any, float, float]]] = {}  # message -> signal, conversion, low, high
        self._last_ns = -(1 << 80)  # before any frame: far from every time
        self._suspects = 0
        self._suspect_ns = 0  # the time of the last suspect
        self._before_ns = 0  # `_last_ns` when it came: a good frame in between clears the suspicion
        self._handlers: dict[int, Handler] = {}
        self._by_pgn: dict[int, Handler] = {}
        by_message: dict[str, list[Source]] = {}
        for source in mapping.sources:
            by_message.setdefault(source.message, []).append(source)
        for message in mapping.database.messages:
            handler = self._handler(message, by_message.get(message.name, []))
            identifier = message.frame_id | (EFF_FLAG if message.is_extended_frame else 0)
            if mapping.j1939 and message.is_extended_frame:
                self._by_pgn[pgn(message.frame_id)] = handler
            else:
                self._handlers[identifier] = handler

    # --- frames ---------------------------------------------------------------------------------------------

    def decode(self, frames: Iterable[Frame]) -> list[Event]:
        """The events of `frames`, in their order; their times are seconds since the first frame ever decoded."""
        handlers, latest = self._handlers, self.latest
        origin, last = self._origin_ns, self._last_ns
        back, ahead = -_BACK_NS, _AHEAD_NS
        count = 0
        for time_ns, identifier, data, _channel in frames:
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
            try:
                handler = handlers[identifier]
            except KeyError:
                handler = self._unknown(identifier)
            if handler((time_ns - origin) * 1e-9, data):  # type: ignore[operator]
                continue
            latest[identifier] = (time_ns, data)
        self._last_ns = last
        self.received += count
        events = self._events[:]
        self._events.clear()
        return events

    @property
    def started(self) -> bool:
        """Whether any frame has come."""
        return self._origin_ns is not None

    def seconds(self, time_ns: int) -> float:
        """`time_ns` on the timeline of the events."""
        return 0.0 if self._origin_ns is None else (time_ns - self._origin_ns) * 1e-9

    def nanoseconds(self, time: float) -> int:
        """The inverse of `seconds`."""
        return (self._origin_ns or 0) + round(time * 1e9)

    def clock_set(self, delta_ns: int) -> None:
        """The clock that stamps the frames was set by `delta_ns`; the timeline goes on."""
        if self._origin_ns is not None:
            self._origin_ns += delta_ns
            self._last_ns += delta_ns

    def _retime(self, time_ns: int) -> bool:
        """Take a time that does not follow the last one: True if the frame is to be used.

        One odd stamp is dropped. Several in a row that follow each other mean that the clock was set: back, and the
        timeline goes on from where it was; ahead, and it is taken as a gap in the recording.
        """
        if self._origin_ns is None:
            self._origin_ns = self._last_ns = time_ns
            return True
        follows = self._before_ns == self._last_ns and -_BACK_NS <= time_ns - self._suspect_ns <= _AHEAD_NS
        self._suspects = self._suspects + 1 if follows and self._suspects else 1
        self._suspect_ns, self._before_ns = time_ns, self._last_ns
        if self._suspects < _CONFIRM:
            self._fault("", TIME)
            return False
        self._suspects = 0
        if time_ns < self._last_ns:
            self._origin_ns += time_ns - self._last_ns
        self._last_ns = time_ns
        return True

    def _unknown(self, identifier: int) -> Handler:
        """The handler of an identifier that is not in the database as such; kept for the next frame of it."""
        known = self._by_pgn.get(pgn(identifier)) if identifier & EFF_FLAG and not identifier & RTR_FLAG else None
        handler: Handler = known or self._count_unknown(identifier)
        if identifier & ERR_FLAG:
            known, handler = None, self._count_error
        if len(self._handlers) < _MOST_IDENTIFIERS:
            self._handlers[identifier] = handler
            return handler
        if known:
            return lambda time, data: known(time, data) or True  # used, but not kept as the latest of its identifier
        return handler if identifier & ERR_FLAG else self._count_others

    def _count_error(self, _time: float, _data: bytes) -> bool:
        self.error_frames += 1
        return True

    def _count_others(self, _time: float, _data: bytes) -> bool:
        self.unknown_others += 1
        return True

    def _count_unknown(self, identifier: int) -> Handler:
        unknown = self.unknown

        def handler(_time: float, _data: bytes) -> bool:
            unknown[identifier] = unknown.get(identifier, 0) + 1
            return True

        return handler

    def _fault(self, message: str, reason: str) -> None:
        key = (message, reason)
        self.faults[key] = self.faults.get(key, 0) + 1

    # --- what is known of a message ---------------------------------------------------------------------------

    def values(self, identifier: int, data: bytes) -> dict[str, Any]:
        """Every signal of a frame in the units of the DBC; None where not available or out of the DBC's range."""
        message = self._message(identifier)
        if message is None or len(data) != message.length:
            return {}
        try:
            raw = message.decode_simple(data, decode_choices=False, scaling=False)
        except Exception:  # cantools raises several types of its own on data that does not fit
            return {}
        values: dict[str, Any] = {}
        limits = self._limits.get(message.name)
        if limits is None:
            limits = [(s.name, s.conversion, *raw_range(s, self.mapping.not_available)) for s in message.signals]
            self._limits[message.name] = limits
        for name, conversion, low, high in limits:
            value = raw.get(name)
            if isinstance(value, int | float):
                # NaN is not between any limits
                values[name] = conversion.raw_to_scaled(value, False) if low <= value <= high else None
        return values

    def message_name(self, identifier: int) -> str | None:
        """The name of the message with this identifier."""
        message = self._message(identifier)
        return message.name if message else None

    def _message(self, identifier: int) -> Message | None:
        for message in self.mapping.database.messages:
            if self.mapping.j1939 and message.is_extended_frame:
                if identifier & EFF_FLAG and pgn(message.frame_id) == pgn(identifier):
                    return message
            elif message.frame_id | (EFF_FLAG if message.is_extended_frame else 0) == identifier:
                return message
        return None

    # --- compiling ----------------------------------------------------------------------------------------------

    def _handler(self, message: Message, sources: list[Source]) -> Handler:
        protection = self.mapping.protection.get(message.name, Protection())
        period = self.mapping.periods.get(message.name)
        if not sources:
            return self._check_length_only(message)
        group = len(self.groups)
        self.groups.append(Group(message.name, tuple(source.role for source in sources), period))
        signals = [message.get_signal_by_name(source.signal) for source in sources]
        limits = [
            _plausible(source, *raw_range(signal, self.mapping.not_available))
            for source, signal in zip(sources, signals, strict=True)
        ]
        plain = all(_is_plain(signal) for signal in signals)
        code = _generate(message, sources, signals, limits, protection, period, self.mapping.not_available, plain)
        scope: dict[str, Any] = {}
        exec(compile(code, f"<layout of {message.name}>", "exec"), scope)
        partly = self._partly(message.name, group, sources, limits)
        through = partly if plain else self._through_cantools(message, sources, partly)
        handler: Handler = scope["make"](self, group, through, *_crc_arguments(message, protection))
        return handler

    def _check_length_only(self, message: Message) -> Handler:
        name, length = message.name, message.length

        def handler(_time: float, data: bytes) -> bool | None:
            if len(data) == length:
                return None
            self._fault(name, LENGTH)
            return True

        return handler

    def _partly(
        self, message: str, group: int, sources: list[Source], limits: list[tuple[float, float]]
    ) -> Callable[[float, Sequence[float | None]], None]:
        """What makes the event of a frame of which some raw values are absent or not within their limits."""

        def take(time: float, raw: Sequence[float | None]) -> None:
            values: list[float | None] = []
            for source, (low, high), value in zip(sources, limits, raw, strict=True):
                if value is not None and low <= value <= high:  # False for NaN
                    values.append(value * source.factor + source.offset)
                else:
                    values.append(None)
                    if value is not None:
                        self._out_of_range(message, source.signal, value)
            self._events.append((time, group, tuple(values)))

        return take

    def _through_cantools(
        self, message: Message, sources: list[Source], take: Callable[[float, Sequence[float | None]], None]
    ) -> Callable[[float, bytes], bool | None]:
        """What decodes and takes the data of a frame that cantools has to decode."""

        def decode(time: float, data: bytes) -> bool | None:
            try:
                values = message.decode_simple(data, decode_choices=False, scaling=False)
            except Exception:  # cantools raises several types of its own on data that does not fit
                self._fault(message.name, UNDECODABLE)
                return True
            raw = [values.get(source.signal) for source in sources]  # absent: another branch of the multiplexer
            if any(value is not None for value in raw):
                take(time, raw)  # type: ignore[arg-type]  # without choices they are numbers
            return None

        return decode

    def _out_of_range(self, message: str, signal: str, raw: float) -> None:
        """Count a raw value that is not between the limits: is it the code for not available, or implausible?"""
        definition = self.mapping.database.get_message_by_name(message).get_signal_by_name(signal)
        absent = self.mapping.not_available and _is_not_available(definition, raw)
        self._fault(f"{message}.{signal}", NOT_AVAILABLE if absent else RANGE)

    def _jumped(self, message: str, lost: int) -> None:
        """Count the `lost` frames that a message's counter shows as missing."""
        self.lost[message] = self.lost.get(message, 0) + lost


def known_identifiers(mapping: Mapping) -> list[int] | None:
    """The identifiers (with flags) that the database knows, for the kernel's filters; None if it goes by PGN."""
    if mapping.j1939:
        return None
    return [m.frame_id | (EFF_FLAG if m.is_extended_frame else 0) for m in mapping.database.messages]


def raw_range(signal: Signal, not_available: bool) -> tuple[float, float]:
    """The raw values that are physical: within the DBC's limits, without the code for not available."""
    conversion = signal.conversion
    scale, offset = float(conversion.scale), float(conversion.offset)
    low, high = _representable(signal)
    if not_available and not conversion.is_float and signal.length >= 8:
        low, high = (low + 1, high) if signal.is_signed else (low, high - 1)
    if signal.minimum is not None and signal.maximum is not None and signal.minimum < signal.maximum:
        ends = sorted(((float(signal.minimum) - offset) / scale, (float(signal.maximum) - offset) / scale))
        slack = 0 if conversion.is_float else 1e-6  # limits are decimal fractions
        low, high = max(low, ends[0] - slack), min(high, ends[1] + slack)
        if not conversion.is_float:
            low, high = -int(-low // 1), int(high // 1)
    return low, high


def _plausible(source: Source, low: float, high: float) -> tuple[float, float]:
    """The raw values from `low` to `high` that a road vehicle can have, too."""
    if source.role not in ROLES:  # of an instrument that is not on board
        return low, high
    ends = sorted((value - source.offset) / source.factor for value in PLAUSIBLE[ROLES[source.role]])
    return (low if low >= ends[0] else ends[0]), (high if high <= ends[1] else ends[1])


def _representable(signal: Signal) -> tuple[float, float]:
    """The least and the greatest raw value that the bits of `signal` can hold."""
    if signal.conversion.is_float:
        return -3.4e38, 3.4e38
    if signal.is_signed:
        return -(2 ** (signal.length - 1)), 2 ** (signal.length - 1) - 1
    return 0, 2**signal.length - 1


def _is_not_available(signal: Signal, raw: float) -> bool:
    if signal.conversion.is_float:
        return math.isnan(raw)
    return signal.length >= 8 and raw == (-(2 ** (signal.length - 1)) if signal.is_signed else 2**signal.length - 1)


def _crc_arguments(message: Message, protection: Protection) -> list[Any]:
    if not protection.crc:
        return []
    constant, tables = sae_j1850_tables(message.length - 1)
    return [constant, *tables]


def _is_plain(signal: Signal) -> bool:
    return not signal.is_multiplexer and signal.multiplexer_ids is None and not signal.conversion.is_float


def first_bit(signal: Signal) -> int:
    """The place of the first bit: in little-endian order the least significant, in big-endian the most.

    The DBC counts bits from the right within each byte; the most significant first they are counted from the left.
    """
    little = signal.byte_order == "little_endian"
    return int(signal.start if little else signal.start // 8 * 8 + 7 - signal.start % 8)


def _words(signals: list[Signal], length: int) -> tuple[str, list[str]] | None:
    """(format for struct, an expression for the raw value of each signal in its words w0, w1, ...).

    Each word holds the signals whose bytes overlap. None where no format does it: words of 3, 5, 6 or 7 bytes,
    both byte orders.
    """
    orders = {signal.byte_order for signal in signals}
    spans: list[list[int]] = []  # first byte, byte after the last
    for begin, end in sorted((first_bit(s) // 8, (first_bit(s) + s.length - 1) // 8 + 1) for s in signals):
        if spans and begin < spans[-1][1]:
            spans[-1][1] = max(spans[-1][1], end)
        else:
            spans.append([begin, end])
    if len(orders) > 1 or any(end - begin not in (1, 2, 4, 8) for begin, end in spans):
        return None
    codes, at = "", 0
    expressions = {}
    for i, (begin, end) in enumerate(spans):
        inside = [s for s in signals if begin <= first_bit(s) // 8 < end]
        code = {1: "B", 2: "H", 4: "I", 8: "Q"}[end - begin]
        whole = inside[0].length == 8 * (end - begin)
        if whole and inside[0].is_signed:
            code = code.lower()
        codes += "x" * (begin - at) + code
        at = end
        for signal in inside:
            expressions[signal.name] = f"w{i}" if whole else _extract(signal, f"w{i}", begin, end)
    order = "<" if orders == {"little_endian"} else ">"
    return f"{order}{codes}{'x' * (length - at)}", [expressions[signal.name] for signal in signals]


def _extract(signal: Signal, word: str, begin: int, end: int) -> str:
    """An expression for the raw value of `signal` in `word`, the integer of the bytes from `begin` up to `end`."""
    first = first_bit(signal)
    shift = first - 8 * begin if signal.byte_order == "little_endian" else 8 * end - first - signal.length
    mask = 2**signal.length - 1
    masked = f"({word} >> {shift} & {mask:#x})" if shift else f"({word} & {mask:#x})"
    if signal.is_signed:
        sign = 2 ** (signal.length - 1)
        return f"({masked} ^ {sign:#x}) - {sign:#x}"
    return masked


def _check(name: str, signal: Signal, limits: tuple[float, float]) -> str:
    """The condition that the raw value `name` is within its limits, as far as it can be beyond them."""
    least, most = _representable(signal)
    low = f"{limits[0]} <= " if limits[0] > least else ""
    high = f" <= {limits[1]}" if limits[1] < most else ""
    return f"{low}{name}{high}" if low or high else ""


def _generate(
    message: Message,
    sources: list[Source],
    signals: list[Signal],
    limits: list[tuple[float, float]],
    protection: Protection,
    period: float | None,
    not_available: bool,
    plain: bool,
) -> str:
    """Python source of ``make(codec, group, through, crc constant, *crc tables)``, which returns the handler.

    ``through`` takes what is not plain: the raw values if some are beyond their limits, or (if not `plain`) the data.
    """
    n = message.length
    tables = [f"t{i}" for i in range(n - 1)] if protection.crc else []
    arguments = ["codec", "group", "through", *(["constant"] if protection.crc else []), *tables]
    lines = [f"def make({', '.join(arguments)}):", f"    name = {message.name!r}"]
    lines += ["    fault, append = codec._fault, codec._events.append"]
    body = [f"if len(d) != {n}:", f"    fault(name, {LENGTH!r})", "    return True"]
    if protection.crc:
        crc = " ^ ".join(["constant", *(f"{t}[d[{i}]]" for i, t in enumerate(tables))])
        body += [f"if {crc} != d[{n - 1}]:", f"    fault(name, {CRC!r})", "    return True"]
    counter = message.get_signal_by_name(protection.counter) if protection.counter else None
    needed = [*(signals if plain else []), *([counter] if counter else [])]
    words = _words(needed, n)
    if words:
        form, raw = words
        lines += ["    from struct import Struct", f"    unpack = Struct({form!r}).unpack"]
        count = len(struct.unpack(form, bytes(n)))
        body += [f"{', '.join(f'w{i}' for i in range(count))}, = unpack(d)"] if count else []
    else:
        names = {"little_endian": "x", "big_endian": "y"}
        lines += ["    from_bytes = int.from_bytes"]
        orders = sorted({s.byte_order for s in needed})
        body += [f"{names[order]} = from_bytes(d, {order.partition('_')[0]!r})" for order in orders]
        raw = [_extract(s, names[s.byte_order], 0, n) for s in needed]
    if counter:
        # As AUTOSAR's E2E: a repeated or far-off counter is wrong, a small step tells of lost frames; after
        # a pause anything goes.
        low, high = raw_range(counter, not_available)
        modulo = int(high - low) + 1
        lines += [f"    following, seen = {low}, -1e9"]
        pause = STALE_PERIODS * period if period else 1.0
        body += [
            f"c = {raw.pop()}",
            "if c != following:",
            f"    if not {low} <= c <= {high}:",
            f"        fault(name, {COUNTER!r})",
            "        return True",
            f"    if t - seen < {pause!r}:",
            f"        lost = (c - following) % {modulo}",
            f"        following, seen = c + 1 if c < {high} else {low}, t",
            f"        if lost >= {modulo // 2}:",
            f"            fault(name, {COUNTER!r})",
            "            return True",
            "        codec._jumped(name, lost)",
            f"following, seen = c + 1 if c < {high} else {low}, t",
        ]
    if plain:
        r = [expression if expression.isidentifier() else f"r{i}" for i, expression in enumerate(raw)]
        body += [f"{name} = {expression}" for name, expression in zip(r, raw, strict=True) if name != expression]
        checks = [_check(*args) for args in zip(r, signals, limits, strict=True)]
        plausible = " and ".join(check for check in checks if check) or "True"
        values = [
            f"{name} * {source.factor!r}" + (f" + {source.offset!r}" if source.offset else "")
            for name, source in zip(r, sources, strict=True)
        ]
        body += [f"if {plausible}:", f"    append((t, group, ({', '.join(values)},)))", "else:"]
        body += [f"    through(t, ({', '.join(r)},))"]
    else:
        body += ["return through(t, d)"]
    lines += ["    def handler(t, d):"]
    lines += ["        nonlocal following, seen"] if counter else []
    lines += [f"        {line}" for line in body]
    return "\n".join([*lines, "    return handler", ""])
