"""Times of recorded frames: stray stamps, gaps, and a clock that was set."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gz_onboard.can.codec import AHEAD_NS, BACK_NS, CONFIRM, Codec

_GAP_NS = 500_000_000  # ahead by less is no gap
_DENSE = 20  # frames without a gap: a bus that sends as many does not end in a gap and one frame or two


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
