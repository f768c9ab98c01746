"""Times of recorded frames: stray stamps, gaps, and a clock that was set."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gz_onboard.bus.codec import AHEAD_NS, BACK_NS, CONFIRM, Codec

_GAP_NS = 500_000_000  # ahead by less is no gap
_DENSE = 20  # frames without a gap: a bus that sends as many does not end in a gap and one frame or two
_INT64 = np.iinfo(np.int64)
_LEAST_WINDOW, _MOST_WINDOW = 16, 1 << 16  # frames that are looked at together


def stray(time_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Mask of the few frames whose time is ahead of all others.

    A frame after a gap waits for the next ones. If `CONFIRM` frames in a row agree, there was a gap; if one continues
    from before the gap, the time of the waiting frames is wrong. Longer leaps, and leaps back, are left to
    `on_timeline`. On a live bus, where nobody can wait, the codec takes such a frame for a gap.
    """
    found = np.zeros(len(time_ns), bool)
    waiting: list[int] = []  # places of frames after a gap, which the next ones confirm or refute
    last, place, since = 0, 0, 0  # since: frames since the last gap
    if len(time_ns):
        last, place, since = int(time_ns[0]), 1, 1
    while place < len(time_ns):
        if not waiting:
            place, last, passed = _follow(time_ns, place, last, _GAP_NS)
            since += passed
            if place == len(time_ns):
                break
        time, step = int(time_ns[place]), int(time_ns[place]) - last
        if waiting:
            if -BACK_NS <= time - int(time_ns[waiting[-1]]) <= AHEAD_NS:
                waiting.append(place)
                if len(waiting) == CONFIRM:
                    last, since, waiting = time, 0, []
                place += 1
                continue
            if -BACK_NS <= step < int(time_ns[waiting[0]]) - last:
                found[waiting] = True
            else:
                last, since = int(time_ns[waiting[-1]]), 0
                step = time - last
            waiting = []
        if _GAP_NS < step <= AHEAD_NS:
            waiting = [place]
        else:
            last = time if not -BACK_NS <= step < 0 else last
            since += 1
        place += 1
    if since >= _DENSE:
        found[waiting] = True
    return found


def on_timeline(time_ns: NDArray[np.int64], codec: Codec) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Place frames on the codec's timeline: (mask of those with a plausible time, times [ns]).

    The codec judges each time that does not follow the one before, and is left at the time of the last frame.
    """
    kept = np.ones(len(time_ns), bool)
    origins = np.zeros(len(time_ns), np.int64)
    if codec.origin_ns is None and len(time_ns):
        codec.origin_ns = codec.last_ns = int(time_ns[0])
    last, place = codec.last_ns, 0
    while place < len(time_ns):
        end, last, _ = _follow(time_ns, place, last, AHEAD_NS)
        origins[place:end] = _wrapped(codec.origin_ns or 0)
        place = end
        if place < len(time_ns):
            codec.last_ns = last
            kept[place] = codec.retime(int(time_ns[place]))
            origins[place] = _wrapped(codec.origin_ns or 0)
            last, place = codec.last_ns, place + 1
    codec.last_ns = last
    return kept, time_ns - origins


def _wrapped(origin_ns: int) -> int:
    """`origin_ns` as an int64, which wraps around; so does the difference from a time, which is right again."""
    return (origin_ns + (1 << 63)) % (1 << 64) - (1 << 63)


def _follow(time_ns: NDArray[np.int64], place: int, last: int, ahead_ns: int) -> tuple[int, int, int]:
    """Pass over frames that follow each other: (index of the first that does not, latest time before it [ns], count).

    Begins at index `place`. A frame follows if its time is from `BACK_NS` before the latest time so far, which begins
    with `last`, to `ahead_ns` after it.
    """
    begin, window = place, _LEAST_WINDOW
    while place < len(time_ns):
        times = time_ns[place : place + window]
        latest = np.maximum.accumulate(np.concatenate(([last], times)))
        earliest = np.maximum(latest[:-1], _INT64.min + BACK_NS) - BACK_NS
        farthest = np.minimum(latest[:-1], _INT64.max - ahead_ns) + ahead_ns
        apart = np.flatnonzero((times < earliest) | (times > farthest))
        if len(apart):
            return place + int(apart[0]), int(latest[apart[0]]), place + int(apart[0]) - begin
        place, last, window = place + len(times), int(latest[-1]), min(2 * window, _MOST_WINDOW)
    return place, last, place - begin
