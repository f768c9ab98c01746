"""Where a message's signals stand in its bytes, and the handler of its frames as Python source made from that."""

from __future__ import annotations

import math
import struct
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, cast

from gz_onboard.bus.dbc import FARTHEST
from gz_onboard.bus.mapping import BusMapping, Protection, Source
from gz_onboard.events import EFF_FLAG, PLAUSIBLE, PLAUSIBLE_OF, ROLES, SQUARED, STALE_PERIODS

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

PAUSE = 1.0  # s: after that any counter goes, where the message's period is not known


def identifier_of(message: Message) -> int:
    """The identifier of the message's frames, with its flag."""
    return int(message.frame_id) | (EFF_FLAG if message.is_extended_frame else 0)


def identifiers_of(mapping: BusMapping, messages: Collection[str]) -> list[int] | None:
    """Of the frames that bring `messages`, answers too; None: any, as a J1939 sender may have any."""
    if mapping.j1939:
        return None
    found = [identifier_of(m) for m in mapping.database.messages if m.name in messages]
    return found + [request.response for request in mapping.requests if request.name in messages]


def raw_values(message: Message, data: bytes) -> dict[str, float] | None:
    """The raw value of each signal in `data`, by cantools; None if the data do not fit the message.

    On a multiplexer page that the DBC file does not list, the signals of every page are still there.
    """
    if len(data) != message.length:
        return None
    try:
        return cast("dict[str, float]", message.decode_simple(data, decode_choices=False, scaling=False))
    except Exception:  # cantools raises several types of its own on data that does not fit
        return _on_every_page(message, data) if message.is_multiplexed() else None


def _on_every_page(message: Message, data: bytes) -> dict[str, float] | None:
    """The raw values of the signals whose multiplexers, if they have any, are on their page."""
    values: dict[str, float] = {}
    for signal in sorted(message.signals, key=lambda signal: signal.multiplexer_ids is not None):
        pages = signal.multiplexer_ids
        if pages is None or values.get(signal.multiplexer_signal or "") in pages:
            values[signal.name] = _raw(signal, data)
    return values


def _raw(signal: Signal, data: bytes) -> float:
    """The raw value of one signal."""
    little = signal.byte_order == "little_endian"
    whole = int.from_bytes(data, "little" if little else "big")
    first = first_bit(signal)
    raw = whole >> (first if little else 8 * len(data) - first - signal.length) & (1 << signal.length) - 1
    if signal.conversion.is_float:
        code = {16: "<e", 32: "<f", 64: "<d"}[signal.length]
        return float(struct.unpack(code, raw.to_bytes(signal.length // 8, "little"))[0])
    return raw - (1 << signal.length) if signal.is_signed and raw >> (signal.length - 1) else raw


def raw_range(signal: Signal, not_available: bool) -> tuple[float, float]:
    """The raw values that are physical: within the DBC's limits, without the code for not available."""
    conversion = signal.conversion
    scale, offset = float(conversion.scale), float(conversion.offset)
    low, high = _representable(signal)
    if not_available and not conversion.is_float and signal.length >= 8:
        low, high = (low + 1, high) if signal.is_signed else (low, high - 1)
    if signal.minimum is not None and signal.maximum is not None and signal.minimum < signal.maximum:
        limits = max(float(signal.minimum), -FARTHEST), min(float(signal.maximum), FARTHEST)
        ends = sorted((limit - offset) / scale for limit in limits)
        slack = 0 if conversion.is_float else 1e-6  # limits are decimal fractions
        low, high = max(low, ends[0] - slack), min(high, ends[1] + slack)
        if not conversion.is_float:
            low, high = -int(-low // 1), int(high // 1)
    return low, high


def plausible_range(source: Source, low: float, high: float) -> tuple[float, float]:
    """The raw values from `low` to `high` that a road vehicle can have, too."""
    if source.role not in ROLES:  # of an instrument that is not on board
        return low, high
    limits = PLAUSIBLE_OF.get(source.role, PLAUSIBLE[ROLES[source.role]])
    ends = sorted((value - source.offset) / source.factor for value in limits)
    return (low if low >= ends[0] else ends[0]), (high if high <= ends[1] else ends[1])


def _representable(signal: Signal) -> tuple[float, float]:
    """The least and the greatest raw value that the bits of `signal` can hold."""
    if signal.conversion.is_float:
        return -3.4e38, 3.4e38
    if signal.is_signed:
        return -(2 ** (signal.length - 1)), 2 ** (signal.length - 1) - 1
    return 0, 2**signal.length - 1


def is_not_available(signal: Signal, raw: float) -> bool:
    """Whether a raw value is the code for not available: all ones, the least of a signed signal, or NaN."""
    if signal.conversion.is_float:
        return math.isnan(raw)
    return signal.length >= 8 and raw == (-(2 ** (signal.length - 1)) if signal.is_signed else 2**signal.length - 1)


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


@dataclass(frozen=True)
class MappedMessage:
    """A message that roles come from, with what is known of its frames."""

    message: Message
    sources: list[Source]
    protection: Protection
    period: float | None  # s
    not_available: bool  # whether all ones stand for it

    @cached_property
    def signals(self) -> list[Signal]:
        """Those of `sources`, in their order."""
        return [self.message.get_signal_by_name(source.signal) for source in self.sources]

    @cached_property
    def limits(self) -> list[tuple[float, float]]:
        """The least and the greatest raw value of each of `signals` that is taken for real."""
        ranges = [raw_range(signal, self.not_available) for signal in self.signals]
        return [plausible_range(source, *limits) for source, limits in zip(self.sources, ranges, strict=True)]

    @cached_property
    def plain(self) -> bool:
        """Whether all signals are integers that are in every frame."""
        return not any(s.is_multiplexer or s.multiplexer_ids is not None or s.conversion.is_float for s in self.signals)

    def source(self) -> str:
        """Python source of ``make(codec, spill, constant, *tables)``, which returns ``(handler, drain)``.

        ``handler(time, data)`` takes a frame at `time` [ns] and returns True if the frame is dropped. Sums are of raw
        integers, so that they are exact; they are scaled once a window. ``drain()`` returns (frames, time of the last,
        raw last values, raw sums, raw sums of squares) and starts a new window. ``spill(time, raw values)`` takes
        frames with a value beyond its limits, and ``spill(time, data)`` those that are not `plain`. constant, tables:
        of the CRC. The names LENGTH, CRC and COUNTER are the codec's reasons for dropping a frame.
        """
        n, protection = self.message.length, self.protection
        crc = ["constant", *(f"t{i}" for i in range(n - 1))] if protection.crc else []
        counter = self.message.get_signal_by_name(protection.counter) if protection.counter else None
        signals = self.signals if self.plain else []
        setup, body, raw = _unpacking([*signals, *([counter] if counter else [])], n)
        if protection.crc:
            sum_ = " ^ ".join([crc[0], *(f"{table}[d[{i}]]" for i, table in enumerate(crc[1:]))])
            body = [f"if {sum_} != d[{n - 1}]:", "    fault(name, CRC)", "    return True", *body]
        state = ["following", "seen"] if counter else []
        if counter:
            low, high = raw_range(counter, self.not_available)
            setup += [f"    following, seen = {low}, -1 << 80"]
            pause = round((STALE_PERIODS * self.period if self.period else PAUSE) * 1e9)
            body += _follow_counter(raw.pop(), int(low), int(high), pause)
        numbers = range(len(signals))
        squared = [i for i in numbers if self.sources[i].role in SQUARED]
        last, sums = ([f"{name}{i}" for i in numbers] for name in "vs")
        squares = [f"q{i}" for i in squared]
        if signals:
            state += ["n", "last", *last, *sums, *squares]
            body += self._accumulate(raw, squared)
        else:
            body.append("return spill(t, d)")
        zero = " = ".join(["n", *sums, *squares, "0"])
        returned = ", ".join(f"({''.join(f'{x}, ' for x in those)})" for those in (last, sums, squares))
        lines = [
            f"def make({', '.join(['codec', 'spill', *crc])}):",
            f"    name = {self.message.name!r}",
            "    fault = codec._fault",
            f"    {' = '.join(['n', 'last', *last, *sums, *squares, '0'])}",
            *setup,
            "    def handler(t, d):",
            *([f"        nonlocal {', '.join(state)}"] if state else []),
            f"        if len(d) != {n}:",
            "            fault(name, LENGTH)",
            "            return True",
            *(f"        {line}" for line in body),
            "    def drain():",
            f"        nonlocal {', '.join(['n', *sums, *squares])}",
            f"        window = n, last, {returned}",
            f"        {zero}",
            "        return window",
            "    return handler, drain",
        ]
        return "\n".join([*lines, ""])

    def _accumulate(self, raw: list[str], squared: list[int]) -> list[str]:
        """Lines that add the raw values given by these expressions to the sums, if they are within their limits."""
        names = [f"r{i}" for i in range(len(raw))]
        checks = [_check(*arguments) for arguments in zip(names, self.signals, self.limits, strict=True)]
        return [
            *(f"{name} = {expression}" for name, expression in zip(names, raw, strict=True)),
            f"if {' and '.join(check for check in checks if check) or 'True'}:",
            "    n += 1",
            "    last = t",
            *(f"    v{i} = r{i}" for i in range(len(raw))),
            *(f"    s{i} += r{i}" for i in range(len(raw))),
            *(f"    q{i} += r{i} * r{i}" for i in squared),
            "else:",
            f"    spill(t, ({', '.join(names)},))",
        ]


def _unpacking(signals: list[Signal], length: int) -> tuple[list[str], list[str], list[str]]:
    """(lines before the handler, lines in it, an expression for the raw value of each signal after these)."""
    if words := _words(signals, length):
        form, raw = words
        count = len(struct.unpack(form, bytes(length)))
        unpack = [f"{', '.join(f'w{i}' for i in range(count))}, = unpack(d)"] if count else []
        return ["    from struct import Struct", f"    unpack = Struct({form!r}).unpack"], unpack, raw
    names = {"little_endian": "x", "big_endian": "y"}
    orders = sorted({s.byte_order for s in signals})
    whole = [f"{names[order]} = from_bytes(d, {order.partition('_')[0]!r})" for order in orders]
    return ["    from_bytes = int.from_bytes"], whole, [_extract(s, names[s.byte_order], 0, length) for s in signals]


def _follow_counter(raw: str, low: int, high: int, pause: float) -> list[str]:
    """Lines that check a counter from `low` to `high`.

    As AUTOSAR's E2E: a repeated or far-off counter is wrong, a small step shows lost frames; after a pause [ns] any
    value is taken.
    """
    modulo = high - low + 1
    step = f"following, seen = c + 1 if c < {high} else {low}, t"
    return [
        f"c = {raw}",
        "if c != following:",
        f"    if not {low} <= c <= {high}:",
        "        fault(name, COUNTER)",
        "        return True",
        f"    if t - seen < {pause}:",
        f"        lost = (c - following) % {modulo}",
        f"        {step}",
        f"        if lost >= {modulo // 2}:",
        "            fault(name, COUNTER)",
        "            return True",
        "        codec._jumped(name, lost)",
        step,
    ]
