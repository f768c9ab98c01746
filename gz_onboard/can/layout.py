"""Signals and checksums in the bytes of many frames at once, and which raw values of a signal are physical."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterable, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from gz_onboard.can.dbc import FARTHEST
from gz_onboard.events import EFF_FLAG, PLAUSIBLE, PLAUSIBLE_OF, ROLES

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

    from gz_onboard.can.mapping import BusMapping, Source


def identifier_of(message: Message) -> int:
    """The identifier of the message's frames, with its flag."""
    return int(message.frame_id) | (EFF_FLAG if message.is_extended_frame else 0)


def identifiers_of(mapping: BusMapping, messages: Collection[str] | None = None) -> list[int] | None:
    """Of the frames that bring `messages`, by default all, and of requests; None: any, as of a J1939 sender."""
    if mapping.j1939:
        return None
    found = [identifier_of(m) for m in mapping.database.messages if messages is None or m.name in messages]
    requests = [request for request in mapping.requests if messages is None or request.name in messages]
    return found + [one for request in requests for one in (request.request, request.response)]


def raw_range(signal: Signal, not_available: bool) -> tuple[float, float]:
    """The raw values that are physical: within the DBC's limits, without the code for not available."""
    conversion, bits = signal.conversion, signal.length
    scale, offset = float(conversion.scale), float(conversion.offset)
    low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signal.is_signed else (0, 2**bits - 1)
    if conversion.is_float:
        low, high = -3.4e38, 3.4e38
    elif not_available and bits >= 8:
        low, high = (low + 1, high) if signal.is_signed else (low, high - 1)
    if signal.minimum is not None and signal.maximum is not None and signal.minimum < signal.maximum:
        limits = float(max(signal.minimum, -FARTHEST)), float(min(signal.maximum, FARTHEST))  # some have 400 digits
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


def is_not_available(signal: Signal, raw: Any) -> Any:
    """Whether a raw value, or each of an array, is the code for not available.

    That is all ones, the least of a signed signal, or NaN.
    """
    if signal.conversion.is_float:
        return raw != raw  # noqa: PLR0124  # as is NaN alone
    return signal.length >= 8 and raw == (-(2 ** (signal.length - 1)) if signal.is_signed else 2**signal.length - 1)


def first_bit(signal: Signal) -> int:
    """The place of the first bit: in little-endian order the least significant, in big-endian the most.

    The DBC counts bits from the right within each byte; the most significant first they are counted from the left.
    """
    little = signal.byte_order == "little_endian"
    return int(signal.start if little else signal.start // 8 * 8 + 7 - signal.start % 8)


Column: TypeAlias = Sequence[float]
"""The raw value of one signal in each of several frames; integers, but for signals of floating point."""
_INTEGERS, _FLOATS = {1: "B", 2: "H", 4: "I", 8: "Q"}, {2: "e", 4: "f", 8: "d"}  # of struct, by bytes


class Layout:
    """Extracts the raw values of some signals of a message, from all frames of a batch at once.

    `signals` are those wanted, and behind them the multiplexers that they need.
    """

    def __init__(self, message: Message, signals: Iterable[Signal]) -> None:
        self.signals = list(signals)
        names = [signal.name for signal in self.signals]
        self._pages: list[tuple[int, Collection[int]] | None] = []  # the place of its multiplexer, and its pages
        for signal in self.signals:  # grows
            pager = signal.multiplexer_signal
            if signal.multiplexer_ids is not None and pager and pager not in names:
                self.signals.append(message.get_signal_by_name(pager))
                names.append(pager)
            ids = signal.multiplexer_ids
            self._pages.append(None if ids is None else (names.index(pager), frozenset(ids)) if pager else (0, ()))
        self.is_paged = any(self._pages)
        self._parts = [
            _Part(list(places), order, message.length)
            for order in ("little", "big")
            if (places := [p for p in enumerate(self.signals) if p[1].byte_order == f"{order}_endian"])
        ]

    def columns(self, data: bytes, frames: int) -> list[Column]:
        """The column of each of `signals` in `data`, the bytes of one frame or more."""
        columns: list[Column] = [()] * len(self.signals)
        for part in self._parts:
            words = struct.unpack(part.order_sign + part.form * frames, data)  # struct keeps the latest formats
            for i, (order, fields) in enumerate(part.words):
                column: Sequence[Any] = words[i :: len(part.words)]
                if order:
                    column = [int.from_bytes(word, order) for word in column]
                for place, extract in fields:
                    columns[place] = extract(column) if extract else column
        return columns

    def rows(self, place: int, columns: Sequence[Column]) -> Sequence[int] | None:
        """The frames that have the signal at `place`; None: all have it."""
        if (page := self._pages[place]) is None:
            return None
        pager, ids = page
        above = self.rows(pager, columns)
        candidates = range(len(columns[pager])) if above is None else above
        return [row for row in candidates if columns[pager][row] in ids]


class _Part:
    """Signals of one byte order. struct reads words of whole bytes; one word holds all signals that share bytes."""

    def __init__(self, signals: list[tuple[int, Signal]], order: Literal["little", "big"], length: int) -> None:
        spans: list[list[int]] = []  # first byte, byte after the last
        for begin, end in sorted(_bytes_of(signal) for _, signal in signals):
            if spans and begin < spans[-1][1]:
                spans[-1][1] = max(spans[-1][1], end)
            else:
                spans.append([begin, end])
        self.order_sign = "<" if order == "little" else ">"
        form, at = "", 0
        self.words: list[tuple[Literal["little", "big", ""], list[tuple[int, _Extract | None]]]] = []
        for begin, end in spans:
            inside = [(place, signal) for place, signal in signals if begin <= _bytes_of(signal)[0] < end]
            signal, size = inside[0][1], end - begin
            is_whole = signal.length == 8 * size and size in _INTEGERS
            code = _INTEGERS.get(size, f"{size}s")
            if is_whole:
                code = _FLOATS[size] if signal.conversion.is_float else code.lower() if signal.is_signed else code
            form += f"{begin - at}x{code}"
            at = end
            fields = [(place, None if is_whole else _extract(signal, begin, end)) for place, signal in inside]
            self.words.append((order if code[-1] == "s" else "", fields))
        self.form = f"{form}{length - at}x"


_Extract: TypeAlias = Callable[[Sequence[int]], Column]


def _bytes_of(signal: Signal) -> tuple[int, int]:
    """The first byte of a signal, and the one after its last."""
    first = first_bit(signal)
    return first // 8, (first + signal.length - 1) // 8 + 1


def _extract(signal: Signal, begin: int, end: int) -> _Extract:
    """Get the raw values of `signal` from the integers of the bytes from `begin` up to `end`."""
    first, length = first_bit(signal), signal.length
    shift = first - 8 * begin if signal.byte_order == "little_endian" else 8 * end - first - length
    mask, sign = (1 << length) - 1, 1 << length - 1
    if signal.conversion.is_float:
        integer, number = struct.Struct(f"<{_INTEGERS[length // 8]}"), struct.Struct(f"<{_FLOATS[length // 8]}")
        return lambda words: [number.unpack(integer.pack(word >> shift & mask))[0] for word in words]
    if signal.is_signed:
        return lambda words: [(word >> shift & mask ^ sign) - sign for word in words]
    return lambda words: [word >> shift & mask for word in words]


Values = dict[str, "float | int | None"]
"""Values in the units of a DBC file, by signal."""


class MessageSignals:
    """Decodes all signals of one message. not_available: whether all ones mean that."""

    def __init__(self, message: Message, not_available: bool = True) -> None:
        self._length = message.length
        self._layout = Layout(message, message.signals)
        self._limits = [raw_range(signal, not_available) for signal in message.signals]

    def values(self, data: bytes) -> Values | None:
        """The value of each signal in the unit of the DBC: None where not available or out of the DBC's range.

        Without those of other branches of the multiplexer; None if the data do not fit the message.
        """
        if len(data) != self._length:
            return None
        columns, values = self._layout.columns(data, 1), Values()
        for place, (signal, (low, high)) in enumerate(zip(self._layout.signals, self._limits, strict=False)):
            if self._layout.rows(place, columns) != []:
                raw = columns[place][0]  # NaN is not between any limits
                values[signal.name] = signal.conversion.raw_to_scaled(raw, False) if low <= raw <= high else None  # type: ignore[assignment]  # a number
        return values


# --- checksums ----------------------------------------------------------------------------------------------------


@cache
def sae_j1850_tables(size: int) -> tuple[int, list[bytes]]:
    """(constant, tables) such that the CRC-8 SAE J1850 of `size` bytes is constant ^ tables[0][b0] ^ tables[1][b1] ...

    Polynomial 0x1D, initial value 0xFF, final XOR 0xFF, as in AUTOSAR E2E profile 1.

    A CRC is linear: that of a message is the XOR of what each of its bytes contributes by itself.
    """
    following = bytearray()  # of a single byte
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D if crc & 0x80 else crc << 1) & 0xFF
        following.append(crc)
    constant, tables = 0xFF, [bytes(following)]
    for _ in range(size):
        constant = following[constant]
        tables.insert(0, tables[0].translate(bytes(following)))
    return constant ^ 0xFF, tables[1:]


def crc8_sae_j1850(data: bytes) -> int:
    """The CRC of `data`."""
    crc, tables = sae_j1850_tables(len(data))
    for table, byte in zip(tables, data, strict=True):
        crc ^= table[byte]
    return crc


def crc_differences(data: bytes, length: int) -> bytes:
    """For each frame of `length` bytes in `data`, its CRC of all bytes but the last, XOR the last: 0 where it is right.

    All frames at once: one look-up and one XOR of whole columns of bytes for each position.
    """
    constant, tables = sae_j1850_tables(length - 1)
    count = len(data) // length
    differences = int.from_bytes(bytes([constant]) * count, "big") ^ int.from_bytes(data[length - 1 :: length], "big")
    for i, table in enumerate(tables):
        differences ^= int.from_bytes(data[i::length].translate(table), "big")
    return differences.to_bytes(count, "big")
