"""The loop that reads the bus and makes pictures of it, for whatever shows them: a page, a broker, Foxglove.

The loop is all that makes pictures. If it hangs, none come, and who shows them says so instead of showing old ones.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence

from gz_onboard import notify
from gz_onboard.bus.channel import CanChannel
from gz_onboard.dashboard.picture import Picture, picture
from gz_onboard.dashboard.view import View
from gz_onboard.events import Frame

POLL = 0.05  # s
AGE = 0.2  # s: without a frame the view is looked at so often, to see what has become stale
AT_LEAST = 1.0  # s: a picture is made so often though nothing has changed; who shows it waits for it


def clock() -> float:
    """[s], also while the board sleeps: what came before is then old."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def pictures(
    view: View,
    channel: CanChannel,
    stopped: Callable[[], bool],
    heard: Callable[[Sequence[Frame]], None] = lambda _: None,
) -> Iterator[Picture]:
    """Drain the channel into the view until it is time to stop: a picture when it has changed, and each second.

    heard: gets all frames that the channel lets through, before the picture that they change.
    """
    source = channel.name, channel.interface
    shown: Picture | None = None
    looked = given = fed = -math.inf
    interval = notify.watchdog_interval() or math.inf
    while not stopped():
        frames = channel.drain()
        now = clock()
        for frame in frames:
            view.take(frame, now)
        if frames:
            heard(frames)
        if frames or now - looked >= AGE:
            looked = now
            new = picture(view, now, source, channel.up, shown.alerts if shown else ())
            if new != shown or now - given >= AT_LEAST:
                shown, given = new, now
                yield new
        if now - fed >= interval:
            notify.alive()
            fed = now
        time.sleep(POLL)
