"""Decode recorded frames by columns, with the same values and fault counts as the live codec.

The frames are grouped by channel and identifier, and each signal is extracted from all frames of its message at once.
Rare cases go frame by frame through the live codec: answers to requests, and messages that come from more than one
channel or sender, of which the codec chooses one.
"""

from __future__ import annotations

import math
from collections import Counter
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from gz_onboard.arrays import Array, Mask
from gz_onboard.bus.checksum import sae_j1850_tables
from gz_onboard.bus.codec import COUNTER, CRC, LENGTH, NOT_AVAILABLE, RANGE, Accumulator, Codec, Handler
from gz_onboard.bus.layout import PAUSE, MappedMessage, first_bit, is_not_available, raw_range
from gz_onboard.bus.mapping import BusMapping, Protection
from gz_onboard.bus.requests import FUNCTIONAL
from gz_onboard.events import ERR_FLAG, RTR_FLAG, STALE_PERIODS, TRANSMITTED
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.timeline import on_timeline

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

Column = tuple[Array, Array]
"""Times [s] and values (SI)."""
_WIDEST_COUNTER = 32  # bits
_MOST_PLACES = 4096  # channels and identifiers: beyond this the codec itself decides which of them it remembers
_NEVER_NS = -1 << 62
_NO_DATA = ERR_FLAG | RTR_FLAG


def decode_columns(frames: FrameColumns, codec: Codec) -> dict[str, Column]:
    """Decode `frames`: (times [s], values in SI units) by role, in the order of the frames.

    codec: one that has decoded nothing yet. It is left as if it had decoded all frames one by one: with the faults,
    the frames lost, unknown and copied, the leaps of the clock, the latest frames and the origins of the messages.
    Times are since the first frame.
    """
    codec.received += len(frames)
    kept, passed_ns = on_timeline(frames.time_ns, codec)
    frames = frames if len(kept) == len(frames) else frames[kept]
    places = list(_by_place(frames))
    messages = [None if identifier & _NO_DATA else codec.origins.message(identifier) for _, identifier, _ in places]
    heard = Counter(message.name for message in messages if message)
    asked = {*FUNCTIONAL, *(r.request for r in codec.mapping.requests), *(r.response for r in codec.mapping.requests)}
    asked = asked if codec.mapping.requests else set()
    found: dict[str, Column] = {}
    one_by_one = []
    for (channel, identifier, rows), message in zip(places, messages, strict=True):
        several = message is not None and heard[message.name] > 1
        if len(places) > _MOST_PLACES or identifier in asked or several:
            one_by_one.append(rows)
            continue
        handler = _handler(codec, channel, identifier)
        if identifier & ERR_FLAG:
            codec.error_frames += len(rows)
        elif message is None:
            codec.unknown[identifier] = codec.unknown.get(identifier, 0) + len(rows)
        elif handler is codec._decoders[message.name] and (layout := _layout(message, codec.mapping)):
            found |= _decode_message(layout, codec, identifier, frames[rows], passed_ns[rows])
        else:
            one_by_one.append(rows)
    if one_by_one:
        rows = np.sort(np.concatenate(one_by_one))
        found |= _decode_one_by_one(frames[rows], passed_ns[rows], codec)
    return {role: found[role] for group in codec.groups for role in group.roles if role in found}


def _by_place(frames: FrameColumns) -> list[tuple[int, int, NDArray[np.int64]]]:
    """Group the frames: (channel, identifier, rows in ascending order), in the order of their first frames."""
    places = frames.bus.astype(np.int64) << 32 | frames.identifier
    known = np.unique(places)
    number = np.searchsorted(known, places).astype(np.uint16 if len(known) < 1 << 16 else np.int64)
    order = np.argsort(number, kind="stable")  # of 16 bits: a radix sort
    ends = np.cumsum(np.bincount(number, minlength=len(known)))
    parts = np.split(order, ends[:-1]) if len(known) else []
    found = [(place >> 32, place & 0xFFFF_FFFF, rows) for place, rows in zip(known.tolist(), parts, strict=True)]
    return sorted(found, key=lambda place: int(place[2][0]))


def _handler(codec: Codec, channel: int, identifier: int) -> Handler:
    """The codec's handler for frames from a place; the first call for a place lets the codec choose the origin."""
    return codec._handlers.setdefault(channel, {}).get(identifier) or codec._first_heard(channel, identifier)


def _decode_one_by_one(frames: FrameColumns, passed_ns: NDArray[np.int64], codec: Codec) -> dict[str, Column]:
    """Decode frames through the handlers of the codec, at these times on its timeline."""
    origin_ns, samples = codec._origin_ns, dict[str, list[tuple[float, float]]]()
    by_name = {accumulator.mapped.message.name: accumulator for accumulator in codec._accumulators}

    @cache
    def accumulators(identifier: int) -> list[Accumulator]:
        """The accumulators that frames with this identifier can add to."""
        message = codec.origins.message(identifier)
        names = [r.name for r in codec.mapping.requests if r.response == identifier]
        names += [message.name] if message else []
        return [by_name[name] for name in names if name in by_name]

    for frame, passed in zip(frames.tuples(), passed_ns.tolist(), strict=True):
        time_ns, identifier, data, channel = frame
        codec._origin_ns = time_ns - passed  # as it was then: a clock that was set moves it
        if _handler(codec, channel & ~TRANSMITTED, identifier)(passed, data):
            continue
        codec.latest[identifier] = (time_ns, data)
        for accumulator in accumulators(identifier):
            if window := accumulator.window():
                for source, sample in zip(accumulator.mapped.sources, window.roles, strict=True):
                    if sample:
                        samples.setdefault(source.role, []).append((sample.time, sample.value))
    codec._origin_ns = origin_ns
    columns = {role: np.array(rows) for role, rows in samples.items()}
    return {role: (column[:, 0], column[:, 1]) for role, column in columns.items()}


def _layout(message: Message, mapping: BusMapping) -> MappedMessage | None:
    """The layout of a message; None for one that columns cannot follow: a wide counter, or pages within pages."""
    sources = [source for source in mapping.sources if source.message == message.name]
    protection = mapping.protection.get(message.name, Protection())
    period = mapping.periods.get(message.name)
    mapped = MappedMessage(message, sources, protection, period, mapping.not_available)
    pagers = [_pager(message, signal) for signal in mapped.signals]
    nested = any(pager is not None and pager.multiplexer_ids is not None for pager in pagers)
    wide = protection.counter and message.get_signal_by_name(protection.counter).length > _WIDEST_COUNTER
    return None if nested or wide else mapped


def _pager(message: Message, signal: Signal) -> Signal | None:
    """The multiplexer of a signal; None if every frame has the signal."""
    if signal.multiplexer_ids is None or not signal.multiplexer_signal:
        return None
    return message.get_signal_by_name(signal.multiplexer_signal)


def _decode_message(
    mapped: MappedMessage, codec: Codec, identifier: int, frames: FrameColumns, passed_ns: NDArray[np.int64]
) -> dict[str, Column]:
    """Decode all frames of one message, at these times on the timeline of the codec: (times, values) by role."""
    message, n, protection = mapped.message, mapped.message.length, mapped.protection

    def drop(bad: Mask, place: str, reason: str) -> None:
        if count := int(bad.sum()):
            codec.faults[place, reason] = codec.faults.get((place, reason), 0) + count

    good = frames.length == n
    drop(~good, message.name, LENGTH)
    data = frames.data[:, :n] if frames.data.shape[1] >= n else np.zeros((len(frames), n), np.uint8)
    if mapped.sources and protection.crc:
        wrong = good & ~_has_right_crc(data)
        drop(wrong, message.name, CRC)
        good &= ~wrong
    if mapped.sources and protection.counter:
        rows = np.flatnonzero(good)
        wrong, lost = _follow_counter(mapped, data[rows], passed_ns[rows])
        drop(wrong, message.name, COUNTER)
        good[rows[wrong]] = False
        if lost:
            codec.lost[message.name] = codec.lost.get(message.name, 0) + lost
    rows = np.flatnonzero(good)
    if not len(rows):
        return {}
    codec.latest[identifier] = frames[rows[-1:]].tuples()[0][0::2]
    data, time = data[rows], passed_ns[rows].astype(float) * 1e-9
    found = {}
    for source, signal, limits in zip(mapped.sources, mapped.signals, mapped.limits, strict=True):
        raw, present = _raw(signal, data), np.ones(len(data), bool)
        if pager := _pager(message, signal):
            present = np.isin(_raw(pager, data), list(signal.multiplexer_ids or ()))
        real = present & _within(raw, signal, limits)
        missing = present & ~real & _is_code(raw, signal, mapped.not_available)
        place = f"{source.message}.{source.signal}"
        drop(missing, place, NOT_AVAILABLE)
        drop(present & ~real & ~missing, place, RANGE)
        if real.any():
            found[source.role] = time[real], raw[real].astype(float) * source.factor + source.offset
    return found


def _has_right_crc(data: NDArray[np.uint8]) -> Mask:
    """Whether the last byte of each row is the CRC of the others."""
    constant, tables = sae_j1850_tables(data.shape[1] - 1)
    crc = np.full(len(data), constant, np.uint8)
    for column, table in zip(data.T, tables, strict=False):
        crc ^= np.array(table, np.uint8)[column]
    right: Mask = crc == data[:, -1]
    return right


def _follow_counter(mapped: MappedMessage, data: NDArray[np.uint8], passed_ns: NDArray[np.int64]) -> tuple[Mask, int]:
    """(mask of the frames whose counter is wrong, how many frames it shows as missing); rules as of the live codec."""
    assert mapped.protection.counter
    counter = mapped.message.get_signal_by_name(mapped.protection.counter)
    low, high = map(int, raw_range(counter, mapped.not_available))
    pause_ns = round((STALE_PERIODS * mapped.period if mapped.period else PAUSE) * 1e9)
    counts = _raw(counter, data)
    wrong = (counts < low) | (counts > high)
    rows = np.flatnonzero(~wrong)
    counts, modulo = counts[rows], high - low + 1
    expected = np.concatenate(([low], np.where(counts < high, counts + 1, low)[:-1]))[: len(rows)]
    since_ns = np.diff(passed_ns[rows], prepend=_NEVER_NS)
    missing = np.where(since_ns < pause_ns, (counts - expected) % modulo, 0)
    far = (missing > 0) & (missing >= modulo // 2)
    wrong[rows[far]] = True
    return wrong, int(missing[~far].sum())


def _raw(signal: Signal, data: NDArray[np.uint8]) -> NDArray[Any]:
    """Extract a signal from the rows of `data`: int64, uint64 if it has 64 bits without a sign, or float64."""
    first, length, little = first_bit(signal), signal.length, signal.byte_order == "little_endian"
    begin, end = first // 8, (first + length - 1) // 8 + 1
    columns = range(begin, end) if little else range(end - 1, begin - 1, -1)  # least significant first
    shift = first - 8 * begin if little else 8 * end - first - length
    word = np.zeros(len(data), np.uint64)
    for place, column in enumerate(columns):
        byte, up = data[:, column].astype(np.uint64), 8 * place - shift
        word |= byte << np.uint64(up) if up >= 0 else byte >> np.uint64(-up)
    word &= np.uint64((1 << length) - 1)
    if signal.conversion.is_float:
        return word.astype(f"<u{length // 8}").view(f"<f{length // 8}").astype(float)
    if signal.is_signed:
        unused = np.int64(64 - length)
        return (word << unused.astype(np.uint64)).view(np.int64) >> unused
    return word if length == 64 else word.view(np.int64)


def _within(raw: NDArray[Any], signal: Signal, limits: tuple[float, float]) -> Mask:
    """Whether raw values are within their limits; of integers exactly, which floats above 2^53 are not."""
    low, high = limits
    if not signal.conversion.is_float:
        least, most = np.iinfo(raw.dtype).min, np.iinfo(raw.dtype).max
        if low > most or high < least:
            return np.zeros(len(raw), bool)
        low, high = math.ceil(max(low, least)), math.floor(min(high, most))
    within: Mask = (raw >= low) & (raw <= high)
    return within


def _is_code(raw: NDArray[Any], signal: Signal, not_available: bool) -> Mask:
    """Whether raw values are the code for not available."""
    if not not_available:
        return np.zeros(len(raw), bool)
    if signal.conversion.is_float:
        is_nan: Mask = np.isnan(raw)
        return is_nan
    code = -(1 << signal.length - 1) if signal.is_signed else (1 << signal.length) - 1
    is_code: Mask = (raw == code) & is_not_available(signal, code)
    return is_code
