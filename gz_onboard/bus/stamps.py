"""Frames of a log whose time is ahead of all others: a few that stand alone do not move time.

The frames that follow tell. On a live bus, where nobody can wait for them, the codec takes such a frame for a gap.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from gz_onboard.bus.codec import AHEAD_NS, BACK_NS, CONFIRM
from gz_onboard.events import Frame

_GAP_NS = 500_000_000  # ahead by less is no gap
_DENSE = 20  # frames without a gap: a bus that sends as many does not end in a gap and one frame or two


def without_lone(
    batches: Iterable[Iterable[Frame]], odd: Callable[[list[Frame]], None]
) -> Iterator[tuple[list[Frame], int]]:
    """(frames, how many of `batches` they are from) without those ahead of all others, which are given to `odd`.

    A frame after a gap waits for the next ones. If `CONFIRM` in a row agree, it was a gap; if one goes on where the
    frames before it were, the time of those that wait is wrong. Longer leaps, and those back, are for the codec.
    """
    last, since = -(1 << 80), 0  # time of the last frame; frames since the last gap
    waiting: list[Frame] = []
    for batch in batches:
        kept: list[Frame] = []
        count = 0
        for frame in batch:
            count += 1
            step = frame[0] - last
            if waiting:
                if -BACK_NS <= frame[0] - waiting[-1][0] <= AHEAD_NS:
                    waiting.append(frame)
                    if len(waiting) == CONFIRM:
                        last, since = frame[0], 0
                        kept += waiting
                        waiting = []
                    continue
                if -BACK_NS <= step < waiting[0][0] - last:
                    odd(waiting)
                else:
                    kept += waiting
                    last, since = waiting[-1][0], 0
                    step = frame[0] - last
                waiting = []
            if _GAP_NS < step <= AHEAD_NS:
                waiting = [frame]
                continue
            last = frame[0] if not -BACK_NS <= step < 0 else last
            since += 1
            kept.append(frame)
        yield kept, count
    if waiting and since >= _DENSE:
        odd(waiting)
    elif waiting:
        yield waiting, 0
