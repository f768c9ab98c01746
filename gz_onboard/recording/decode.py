"""Decode recorded frames by columns, with the values, windows and fault counts of the live codec.

The frames are grouped by channel and identifier, and each signal is extracted from all frames of its message at once.
Rare cases go frame by frame through the live codec: answers to requests, and messages that come from more than one
channel or sender, of which the codec chooses one.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise, repeat
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gz_onboard.arrays import Array, Mask
from gz_onboard.can.codec import AHEAD_NS, COUNTER, CRC, LENGTH, NOT_AVAILABLE, RANGE, TIME, Codec, MessageDecoder
from gz_onboard.can.layout import crc_differences, first_bit, is_not_available, plausible_range
from gz_onboard.can.mapping import Source
from gz_onboard.events import ERR_FLAG, RTR_FLAG, SQUARED, Frame, MessageWindow, RoleWindow
from gz_onboard.pipeline import TICK_NS, WINDOW_NS, Pipeline
from gz_onboard.progress import Progress
from gz_onboard.recording.frames import FrameColumns, SignalColumns, on_timeline, stray

if TYPE_CHECKING:
    from cantools.database.can import Message
    from cantools.database.can.signal import Signal

Column = tuple[Array, Array]
"""Times [s] and values (SI)."""
Rows = NDArray[np.int64]
"""Indices of frames in their log, ascending."""
_LONGEST_GAP_NS = AHEAD_NS
"""Without frames for longer the recording was stopped; in a shorter gap windows without frames end."""
_WINDOWS_AT_ONCE = 1024  # that are made of the columns of all messages
_WIDEST_SUM = 40  # bits of integers that can be added up as such: 8 million of them have 63
_MOST_PLACES = 4096  # channels and identifiers: beyond this the codec itself decides which of them it remembers
_NEVER_NS = -1 << 62
_NO_DATA = ERR_FLAG | RTR_FLAG


class LogWindow(NamedTuple):
    """One window: what came between two steps of the estimator."""

    end_ns: int  # on the timeline
    clock_ns: int  # the same by the clock of the frames
    end: int  # the first frame of the log behind it
    windows: list[MessageWindow]


@dataclass
class _RawColumn:
    """The raw values of a signal in the frames of its message, and which of them are real; shape (n,)."""

    source: Source
    raw: NDArray[Any]
    real: Mask


@dataclass
class _Decoded:
    """The n good frames of a message that roles come from. rows, time_ns: shape (n,)."""

    group: int
    rows: Rows
    time_ns: NDArray[np.int64]  # on the timeline
    columns: list[_RawColumn]

    def windows(self, number: NDArray[np.int64], begin: int, end: int) -> Iterator[tuple[int, MessageWindow]]:
        """The windows of its frames in the rows from `begin` to before `end` of the log, and the number of each.

        number: of the window of each frame of the log.
        """
        part = slice(*np.searchsorted(self.rows, (begin, end)))
        number, time_ns = number[self.rows[part]], self.time_ns[part]
        edges = _edges(number)
        known = number[edges[:-1]]
        times = (time_ns[edges[1:] - 1] * 1e-9).tolist()
        roles = [_role_windows(column, part, number, time_ns, known) for column in self.columns]
        fields = zip(repeat(self.group), times, np.diff(edges).tolist(), zip(*roles, strict=True), strict=False)
        return zip(known.tolist(), map(MessageWindow._make, fields), strict=True)


class DecodedLog:
    """A log, decoded by columns: either the samples of each role, or windows for the estimator.

    frames: its frames, or the values of a table of signals.

    codec: one that has decoded nothing yet. It is left as if it had decoded all frames one by one: with the faults,
    the frames lost, unknown and copied, the leaps of the clock, the latest frames and the origins of the messages.
    Times are since the first frame. is_stray: mask of frames whose time is wrong, which are not decoded.
    """

    def __init__(self, frames: FrameColumns | SignalColumns, codec: Codec, is_stray: Mask | None = None) -> None:
        self.frames = frames if isinstance(frames, FrameColumns) else FrameColumns.of([])
        self.codec, self._time_ns = codec, frames.time_ns
        self._is_stray = np.zeros(len(frames), bool) if is_stray is None else is_stray
        timed = np.flatnonzero(~self._is_stray)
        is_kept, self._passed_ns = np.zeros(len(frames), bool), np.zeros(len(frames), np.int64)
        is_kept[timed], self._passed_ns[timed] = on_timeline(frames.time_ns[timed], codec)
        kept = np.flatnonzero(is_kept)
        following = (np.cumsum(is_kept) - is_kept).clip(max=max(len(kept) - 1, 0))
        latest = np.maximum.accumulate(self._passed_ns[kept])
        self._now_ns = latest[following]  # when each frame came: one of a wrong time with the next of a good one
        codec.faults.clear()  # of stray times, counted here with their frames
        self._events: list[tuple[dict[Any, int], Any, Rows, NDArray[np.int64]]] = []
        self._count(vars(codec), "received", np.arange(len(frames)))
        self._count(codec.faults, ("", TIME), np.flatnonzero(~is_kept))
        self._good: dict[str, Rows] = {}  # by message
        self._decoded: list[_Decoded] = []
        self._one_by_one: Rows = np.zeros(0, np.int64)
        if isinstance(frames, FrameColumns):
            self._decode(kept)
        else:
            self._take_table(frames, kept)
        self._origin_ns = codec.origin_ns

    def samples(self) -> dict[str, Column]:
        """(times [s], values in SI units) by role, in the order of the frames.

        A frame whose time is a little before that of an earlier one, as from two channels, has the time of that one:
        times never decrease.
        """
        found: dict[str, Column] = {}
        for message in self._decoded:
            time = message.time_ns.astype(float) * 1e-9
            for column in message.columns:
                source, real = column.source, column.real
                if real.any():
                    found[source.role] = time[real], column.raw[real].astype(float) * source.factor + source.offset
        found |= self._samples_one_by_one()
        for counts, key, _, numbers in self._events:
            counts[key] = counts.get(key, 0) + int(numbers.sum())
        self.see_latest(len(self._time_ns))
        roles = [role for group in self.codec.groups for role in group.roles if role in found]
        return {role: (np.maximum.accumulate(found[role][0]), found[role][1]) for role in roles}

    def steps(self) -> Iterator[LogWindow]:
        """The windows of the live pipeline; with each the codec has counted what it would have counted until then.

        They end on a grid that begins with the first frame. In a gap between frames windows without any end, in a
        longer one the recording was stopped.
        """
        now = self._now_ns
        number = (now - TICK_NS) // WINDOW_NS + 1  # of the window of each frame
        edges = _edges(number).tolist()
        events, decoded = self._events_of(number), dict[int, list[MessageWindow]]()
        for place, (begin, end) in enumerate(pairwise(edges)):
            if place % _WINDOWS_AT_ONCE == 0:
                decoded = self._windows(number, begin, edges[place : place + _WINDOWS_AT_ONCE + 1][-1])
            window = int(number[begin])
            for counts, key, count in events[window]:
                counts[key] = counts.get(key, 0) + count
            windows = []
            if len(self._one_by_one):
                self._take(self._one_by_one[slice(*np.searchsorted(self._one_by_one, (begin, end)))])
                windows = self.codec.windows()
                self.codec.begin_at(self._origin_ns)
            if end == len(now):  # a window that has not ended
                break
            windows += decoded.get(window, [])
            clock_ns = int(self._time_ns[end - 1] - self._passed_ns[end - 1])
            paused = now[end] - now[end - 1] > _LONGEST_GAP_NS
            for ended in range(window, window + 1 if paused else int(number[end])):
                end_ns = TICK_NS + ended * WINDOW_NS
                yield LogWindow(end_ns, end_ns + clock_ns, end, windows)
                windows = []
        self.see_latest(len(now))

    def see_latest(self, end: int) -> None:
        """Let the codec know the latest good frame of each message among those before row `end` of the log."""
        for name, rows in self._good.items():
            if count := int(np.searchsorted(rows, end)):
                (self.codec.latest[name],) = self.frames[rows[count - 1 : count]].tuples()

    def tuples(self, rows: slice) -> list[Frame]:
        """The frames of a part of the log but those of wrong times."""
        return self.frames[rows][~self._is_stray[rows]].tuples()

    def _count(self, counts: dict[Any, int], key: Any, rows: Rows, numbers: NDArray[np.int64] | None = None) -> None:
        """Have `counts[key]` count the frames in these rows, or these numbers at them."""
        if len(rows):
            self._events.append((counts, key, rows, np.ones(len(rows), np.int64) if numbers is None else numbers))

    def _events_of(self, number: NDArray[np.int64]) -> dict[int, list[tuple[dict[Any, int], Any, int]]]:
        """(counts, key, how many more) for all that is counted, by the number of the window."""
        found = defaultdict[int, list[tuple[dict[Any, int], Any, int]]](list)
        for counts, key, rows, numbers in self._events:
            begins = _edges(number[rows])[:-1]
            many = np.add.reduceat(numbers, begins)
            for window, count in zip(number[rows[begins]].tolist(), many.tolist(), strict=True):
                found[window].append((counts, key, count))
        return found

    def _windows(self, number: NDArray[np.int64], begin: int, end: int) -> dict[int, list[MessageWindow]]:
        """The windows of all messages decoded by columns, by the number of the window; see `_Decoded.windows`."""
        found = defaultdict[int, list[MessageWindow]](list)
        for message in self._decoded:
            for place, window in message.windows(number, begin, end):
                found[place].append(window)
        return found

    # --- decoding ---------------------------------------------------------------------------------------------

    def _take_table(self, signals: SignalColumns, rows: Rows) -> None:
        """Take the values of a table in these rows, which are decoded already."""
        for number, group in enumerate(self.codec.groups):
            those = rows[signals.group[rows] == number]
            raw, columns = signals.value[those], []
            for source in (source for source in self.codec.mapping.sources if source.signal == group.message):
                low, high = plausible_range(source, -math.inf, math.inf)
                real = (raw >= low) & (raw <= high)
                self._count(self.codec.faults, (source.signal, RANGE), those[~real])
                columns.append(_RawColumn(source, raw, real))
            if len(those):
                self._decoded.append(_Decoded(number, those, self._passed_ns[those], columns))

    def _decode(self, rows: Rows) -> None:
        """Decode the frames in these rows, as far as it can be done by columns."""
        codec, mapping = self.codec, self.codec.mapping
        places = _by_place(self.frames, rows)
        origins = [None if identifier & _NO_DATA else codec.origins.find(identifier) for _, identifier, _ in places]
        heard = Counter(origin.message.name for origin in origins if origin)
        asked = {*codec.asked, *(request.response for request in mapping.requests)}
        one_by_one = []
        for (channel, identifier, those), origin in zip(places, origins, strict=True):
            decoder = codec.decoders[origin.message.name] if origin else None
            several = decoder is not None and heard[decoder.name] > 1
            if len(places) > _MOST_PLACES or identifier in asked or several:
                one_by_one.append(those)
                continue
            codec.inbox(channel, identifier)
            if identifier & ERR_FLAG:
                self._count(vars(codec), "error_frames", those)
            elif decoder is None:
                self._count(codec.unknown, identifier, those)
            elif decoder.is_sole:
                self._decode_message(decoder, those)
            else:
                one_by_one.append(those)
        if one_by_one:
            self._one_by_one = np.sort(np.concatenate(one_by_one))

    def _decode_message(self, mapped: MessageDecoder, rows: Rows) -> None:
        """Decode all frames of one message."""
        message, n, protection, faults = mapped.message, mapped.message.length, mapped.protection, self.codec.faults
        right = self.frames.length[rows] == n
        self._count(faults, (message.name, LENGTH), rows[~right])
        rows = rows[right]
        data = self.frames.data[rows, :n]
        if protection.crc and len(rows):
            right = np.frombuffer(crc_differences(data.tobytes(), n), np.uint8) == 0
            self._count(faults, (message.name, CRC), rows[~right])
            rows, data = rows[right], data[right]
        if protection.counter:
            wrong, missing = _follow_counter(mapped, data, self._passed_ns[rows])
            self._count(faults, (message.name, COUNTER), rows[wrong])
            jumps = np.flatnonzero(missing)
            self._count(self.codec.lost, message.name, rows[jumps], missing[jumps])
            rows, data = rows[~wrong], data[~wrong]
        if not len(rows):
            return
        self._good[message.name] = rows
        if mapped.group is None:
            return
        columns: list[_RawColumn] = []
        seen: Mask = np.zeros(len(rows), bool)  # with a signal of ours, on a page of a multiplexer
        for source, signal, limits in zip(mapped.sources, mapped.signals, mapped.limits, strict=True):
            raw, present = _raw(signal, data), _is_present(message, signal, data)
            real = present & _within(raw, signal, limits)
            absent = present & ~real & (mapped.not_available and is_not_available(signal, raw))
            place = f"{source.message}.{source.signal}"
            self._count(faults, (place, NOT_AVAILABLE), rows[absent])
            self._count(faults, (place, RANGE), rows[present & ~real & ~absent])
            wide = signal.length > _WIDEST_SUM
            columns.append(_RawColumn(source, raw.astype(float) if wide else raw, real))
            seen |= present
        if not seen.all():
            rows, columns = rows[seen], [_RawColumn(c.source, c.raw[seen], c.real[seen]) for c in columns]
        if len(rows):
            self._decoded.append(_Decoded(mapped.group, rows, self._passed_ns[rows], columns))

    def _take(self, rows: Rows) -> None:
        """Let the codec take the frames in these rows, at their times on the timeline."""
        for row, frame in zip(rows.tolist(), self.frames[rows].tuples() if len(rows) else (), strict=True):
            self.codec.begin_at(frame[0] - int(self._passed_ns[row]))
            self.codec.inbox(frame[3], frame[1]).append(frame)

    def _samples_one_by_one(self) -> dict[str, Column]:
        """The samples of the frames that the codec decodes itself."""
        codec, samples = self.codec, dict[str, list[tuple[float, float]]]()
        for i in range(len(self._one_by_one)):
            self._take(self._one_by_one[i : i + 1])
            for window in codec.windows():
                for role, sample in zip(codec.groups[window.group].roles, window.roles, strict=True):
                    if sample:
                        samples.setdefault(role, []).append((sample.time, sample.value))
        codec.begin_at(self._origin_ns)
        columns = {role: np.array(pairs) for role, pairs in samples.items()}
        return {role: (column[:, 0], column[:, 1]) for role, column in columns.items()}


def decode_columns(
    frames: FrameColumns | SignalColumns, codec: Codec, is_stray: Mask | None = None
) -> dict[str, Column]:
    """Decode `frames`: see `DecodedLog.samples`."""
    return DecodedLog(frames, codec, is_stray).samples()


def feed(pipeline: Pipeline, frames: FrameColumns | SignalColumns, progress: Progress | None = None) -> None:
    """Take all frames of a log through a new `pipeline`, in the windows of the daemon.

    Of the status frames that the daemon sends, only those at the end of a window are made. progress: called with
    numbers of frames taken.
    """
    decoded, done = DecodedLog(frames, pipeline.codec, stray(frames.time_ns)), 0
    for step in decoded.steps():
        rows, done = slice(done, step.end), step.end
        if pipeline.signal_log:
            decoded.see_latest(done)
        if pipeline.frame_log:
            pipeline.frame_log.frames(decoded.tuples(rows))
        pipeline.end_window(step.windows, step.end_ns * 1e-9, step.clock_ns)
        if pipeline.frame_log:
            pipeline.publish(step.clock_ns)
        if progress:
            progress(rows.stop - rows.start)
    if pipeline.frame_log:
        pipeline.frame_log.frames(decoded.tuples(slice(done, None)))
    if progress:
        progress(len(frames) - done)


def _edges(number: NDArray[np.int64]) -> NDArray[np.int64]:
    """The rows where another number begins, and the length of `number`."""
    edges: NDArray[np.int64] = np.append(np.flatnonzero(np.diff(number, prepend=number[:1] - 1)), len(number))
    return edges


def _role_windows(
    column: _RawColumn, part: slice, number: NDArray[np.int64], time_ns: NDArray[np.int64], known: NDArray[np.int64]
) -> list[RoleWindow | None]:
    """The samples of a signal in each of the windows `known`; None where there are none.

    part: of its message's frames; number, time_ns: of the window of each of them, and when it came.
    """
    source, raw, real = column.source, column.raw[part], column.real[part]
    if not real.all():
        raw, number, time_ns = raw[real], number[real], time_ns[real]
    edges = _edges(number)
    begins, last, count = edges[:-1], edges[1:] - 1, np.diff(edges)
    mean = np.add.reduceat(raw, begins) / count
    squares: Any = repeat(None)
    if source.role in SQUARED:
        square = source.factor * source.factor * np.add.reduceat(raw.astype(float) ** 2, begins) / count
        squares = (square + source.offset * (2 * source.factor * mean + source.offset)).tolist()
    fields = zip(
        (time_ns[last] * 1e-9).tolist(),
        (raw[last] * source.factor + source.offset).tolist(),
        count.tolist(),
        (mean * source.factor + source.offset).tolist(),
        squares,
        strict=False,
    )
    made = map(RoleWindow._make, fields)  # a third faster than by its constructor
    if len(begins) == len(known):
        return list(made)
    return [next(made) if shown else None for shown in np.isin(known, number[begins]).tolist()]


def _by_place(frames: FrameColumns, rows: Rows) -> list[tuple[int, int, Rows]]:
    """Group the frames in these rows: (channel, identifier, rows of those), in the order of their first frames."""
    places = (frames.bus.astype(np.int64) << 32 | frames.identifier)[rows]
    known = np.unique(places)
    number = np.searchsorted(known, places).astype(np.uint16 if len(known) < 1 << 16 else np.int64)
    order = rows[np.argsort(number, kind="stable")]  # of 16 bits: a radix sort
    ends = np.cumsum(np.bincount(number, minlength=len(known)))
    parts = np.split(order, ends[:-1]) if len(known) else []
    found = [(place >> 32, place & 0xFFFF_FFFF, those) for place, those in zip(known.tolist(), parts, strict=True)]
    return sorted(found, key=lambda place: int(place[2][0]))


def _is_present(message: Message, signal: Signal, data: NDArray[np.uint8]) -> Mask:
    """Whether each row has the signal: those of the pages of a multiplexer that it is on."""
    if signal.multiplexer_ids is None:
        return np.ones(len(data), bool)
    if not signal.multiplexer_signal:
        return np.zeros(len(data), bool)
    pager = message.get_signal_by_name(signal.multiplexer_signal)
    return _is_present(message, pager, data) & np.isin(_raw(pager, data), list(signal.multiplexer_ids))


def _follow_counter(
    mapped: MessageDecoder, data: NDArray[np.uint8], passed_ns: NDArray[np.int64]
) -> tuple[Mask, NDArray[np.int64]]:
    """(mask of frames whose counter is wrong, frames that it shows as missing before each); rules of the live codec."""
    assert mapped.protection.counter
    counter = mapped.message.get_signal_by_name(mapped.protection.counter)
    low, high = mapped.counts
    counts = _raw(counter, data)
    wrong = (counts < low) | (counts > high)
    rows = np.flatnonzero(~wrong)
    counts, modulo = counts[rows], high - low + 1
    expected = np.concatenate(([low], np.where(counts < high, counts + 1, low)[:-1]))[: len(rows)]
    since_ns = np.diff(passed_ns[rows], prepend=_NEVER_NS)
    missing = np.where(since_ns < mapped.pause_ns, (counts - expected) % modulo, 0)
    far = (missing > 0) & (missing >= modulo // 2)
    wrong[rows[far]] = True
    lost = np.zeros(len(data), np.int64)
    lost[rows] = np.where(far, 0, missing)
    return wrong, lost


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
        low, high = math.ceil(low), math.floor(high)
    within: Mask = (raw >= low) & (raw <= high)
    return within
