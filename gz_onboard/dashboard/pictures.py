"""The loop that reads the bus and makes pictures of it, for the terminal, the page, a broker and Foxglove."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from gz_onboard import notify
from gz_onboard.bus.channel import CanChannel
from gz_onboard.dashboard.picture import Picture, picture
from gz_onboard.dashboard.view import View
from gz_onboard.events import Frame

POLL = 0.05  # s
AGE = 0.2  # s between two looks at what has become stale, while no frame comes
AT_LEAST = 1.0  # s between two pictures though nothing has changed; without one the loop hangs


def clock() -> float:
    """Time since boot [s], suspended or not: numbers from before the board slept are old."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def pictures(
    view: View,
    channel: CanChannel,
    stopped: Callable[[], bool],
    on_frames: Callable[[Sequence[Frame]], None] = lambda _: None,
) -> Iterator[Picture]:
    """Drain the channel into the view until it is time to stop: a picture when it has changed, and each second.

    on_frames: gets all frames that the channel lets through, before the picture that they change.
    """
    shown: Picture | None = None
    looked = given = fed = -math.inf
    interval = notify.watchdog_interval() or math.inf
    while not stopped():
        frames = channel.drain()
        now = clock()
        for frame in frames:
            view.take(frame, now)
        if frames:
            on_frames(frames)
        if frames or now - looked >= AGE:
            looked = now
            new = picture(view, now, (channel.name, channel.interface), channel.up, shown.alerts if shown else ())
            if new != shown or now - given >= AT_LEAST:
                shown, given = new, now
                yield new
        if now - fed >= interval:
            notify.alive()
            fed = now
        time.sleep(POLL)


@contextmanager
def until_signalled(duration: float | None = None) -> Iterator[Callable[[], bool]]:
    """Yield a function that tells when to stop: after `duration` [s], or at SIGINT, SIGTERM or SIGHUP."""
    end = time.monotonic() + (duration or math.inf)
    stopping = threading.Event()
    in_front = threading.current_thread() is threading.main_thread()  # only there can signals be handled
    wanted = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP) if in_front else ()
    before = {number: signal.signal(number, lambda *_: stopping.set()) for number in wanted}
    try:
        yield lambda: stopping.is_set() or time.monotonic() >= end
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
