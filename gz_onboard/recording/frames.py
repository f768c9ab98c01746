"""CAN frames as numpy columns, which every reader of a log returns; their times on one clock."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gz_onboard.can.codec import AHEAD_NS, BACK_NS, CONFIRM, Codec
from gz_onboard.events import EFF_FLAG, ERR_FLAG, MOST_EXTENDED, MOST_STANDARD, TRANSMITTED, Frame

BATCH = 1000
"""Frames that `FrameColumns.batches` hands out at once."""

FD_LENGTHS = frozenset((*range(9), 12, 16, 20, 24, 32, 48, 64))
"""Numbers of data bytes that a frame can have."""

TIME_LIMIT_NS = 1 << 63
"""Times are from 0 to before this [ns since the epoch], the year 2262: the range of all formats that we write."""

LATEST_NS = TIME_LIMIT_NS - 1
_NO_TIME = -1
_HAS_LENGTH = np.array([length in FD_LENGTHS for length in range(256)])
_GAP_NS = 500_000_000  # ahead by less is no gap
_DENSE = 20  # frames without a gap: a bus that sends as many does not end in a gap and one frame or two


@dataclass(frozen=True, eq=False)
class FrameColumns:
    """n frames in the order of their log.

    identifier: with the flags of Linux, as in `events.Frame`. data: shape (n, width), the bytes of a frame at the start
    of its row; those beyond its length have no meaning.
    """

    time_ns: NDArray[np.int64]
    identifier: NDArray[np.uint32]
    channel: NDArray[np.uint8]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]

    @classmethod
    def of(cls, frames: Sequence[Frame]) -> FrameColumns:
        """Columns of frame tuples; a time beyond 64 bits becomes one that `impossible` reports."""
        times, identifiers, datas, channels = zip(*frames, strict=True) if frames else ((), (), (), ())
        width = max(map(len, datas), default=0)
        return cls(
            np.array([t if -TIME_LIMIT_NS <= t < TIME_LIMIT_NS else _NO_TIME for t in times], np.int64),
            np.array(identifiers, np.uint32),
            np.array(channels, np.uint8),
            np.array(list(map(len, datas)), np.uint8),
            np.frombuffer(b"".join([d.ljust(width, b"\0") for d in datas]), np.uint8).reshape(len(frames), width),
        )

    @classmethod
    def empty(cls, count: int, width: int) -> FrameColumns:
        """Zeros for `count` frames of up to `width` bytes, to be filled in."""
        return cls(
            np.zeros(count, np.int64),
            np.zeros(count, np.uint32),
            np.zeros(count, np.uint8),
            np.zeros(count, np.uint8),
            np.zeros((count, width), np.uint8),
        )

    @classmethod
    def concatenate(cls, parts: Sequence[FrameColumns]) -> FrameColumns:
        """The frames of all parts, one part after the other."""
        if len(parts) < 2:
            return parts[0] if parts else cls.of([])
        whole = cls.empty(sum(map(len, parts)), max(part.data.shape[1] for part in parts))
        end = 0
        for part in parts:
            start, end = end, end + len(part)
            for name in _SCALARS:
                getattr(whole, name)[start:end] = getattr(part, name)
            whole.data[start:end, : part.data.shape[1]] = part.data
        return whole

    def __len__(self) -> int:
        return len(self.time_ns)

    def __getitem__(self, rows: Any) -> FrameColumns:
        """The frames that a slice, a mask or an array of indices selects."""
        return replace(self, **{name: getattr(self, name)[rows] for name in (*_SCALARS, "data")})

    @property
    def bus(self) -> NDArray[np.uint8]:
        """The channel without the flag of frames that we sent."""
        return self.channel & ~np.uint8(TRANSMITTED)

    def between(self, start_ns: int | None, end_ns: int | None) -> FrameColumns:
        """The frames with start_ns <= time < end_ns; None: no limit."""
        if start_ns is None and end_ns is None:
            return self
        low = 0 if start_ns is None else start_ns
        high = TIME_LIMIT_NS if end_ns is None else end_ns
        return self[(self.time_ns >= low) & (self.time_ns < high)]

    def impossible(self) -> NDArray[np.bool_]:
        """Mask of the frames that no bus carries: without a time, of an impossible length or identifier."""
        standard = self.identifier & (EFF_FLAG | ERR_FLAG) == 0
        too_wide = standard & (self.identifier & MOST_EXTENDED > MOST_STANDARD)
        found: NDArray[np.bool_] = (self.time_ns < 0) | ~_HAS_LENGTH[self.length] | too_wide
        return found

    def tuples(self) -> list[Frame]:
        """The frames as tuples."""
        width = max(self.data.shape[1], 1)
        raw = self.data.tobytes()
        starts = range(0, width * len(self), width)
        rows = [raw[at : at + length] for at, length in zip(starts, self.length.tolist(), strict=True)]
        return list(zip(self.time_ns.tolist(), self.identifier.tolist(), rows, self.channel.tolist(), strict=True))

    def batches(self) -> Iterator[list[Frame]]:
        """The frames as tuples, in lists of up to `BATCH`."""
        for start in range(0, len(self), BATCH):
            yield self[start : start + BATCH].tuples()


@dataclass(frozen=True, eq=False)
class SignalColumns:
    """The n values of a table of signals, in the order of its rows.

    group: of each, which of the `BusMapping.groups` it belongs to; value: in the unit of its column.
    """

    time_ns: NDArray[np.int64]
    group: NDArray[np.int64]
    value: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.time_ns)


_SCALARS = ("time_ns", "identifier", "channel", "length")


# --- times ----------------------------------------------------------------------------------------------------------


def stray(time_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask of the few frames whose time is ahead of all others.

    One or two frames after a gap are stray if the next frame continues from before the gap, or if the log ends with
    them after many frames without a gap. Longer leaps, and leaps back, are left to `on_timeline`. On a live bus, where
    nobody can wait, the codec takes such a frame for a gap.
    """
    found = np.zeros(len(time_ns), bool)
    steps = np.diff(time_ns)
    before = 0  # the last gap
    for place in (np.flatnonzero((steps > _GAP_NS) & (steps <= AHEAD_NS)) + 1).tolist():
        following = time_ns[place : place + CONFIRM]
        back = np.flatnonzero((following >= time_ns[place - 1] - BACK_NS) & (following < time_ns[place] - BACK_NS))
        if len(back):
            found[place : place + back[0]] = True
        elif len(following) < CONFIRM and place - before >= _DENSE:
            found[place:] = True
        before = place
    return found


def on_timeline(time_ns: NDArray[np.int64], codec: Codec) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Place frames on the codec's timeline: (mask of those with a plausible time, times [ns]).

    The codec judges each time that does not follow the one before, and those after it until it takes one; it is left
    at the time of the last frame.
    """
    kept = np.ones(len(time_ns), bool)
    origins = np.zeros(len(time_ns), np.int64)
    if codec.origin_ns is None and len(time_ns):
        codec.origin_ns = codec.last_ns = int(time_ns[0])
    steps = np.diff(time_ns)
    breaks = np.flatnonzero((steps < 0) | (steps > AHEAD_NS)) + 1
    for begin, end in pairwise([0, *breaks.tolist(), len(time_ns)]):
        for place in range(begin, end):
            time = int(time_ns[place])
            kept[place] = -BACK_NS <= time - codec.last_ns <= AHEAD_NS or codec.retime(time)
            origins[place] = _wrapped(codec.origin_ns or 0)
            if kept[place]:
                origins[place:end] = origins[place]
                codec.last_ns = max(codec.last_ns, int(time_ns[end - 1]))
                break
    return kept, time_ns - origins


def _wrapped(origin_ns: int) -> int:
    """`origin_ns` as an int64, which wraps around; so does the difference from a time, which is right again."""
    return (origin_ns + (1 << 63)) % (1 << 64) - (1 << 63)
