"""``gz-onboard dashboard --web``: the loop that reads the bus and gives the server its pictures.

The loop is all that makes pictures. If it hangs, none come, and the page says so instead of showing old ones.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from gz_onboard import notify
from gz_onboard.bus.channel import CanChannel
from gz_onboard.dashboard.picture import Picture, picture
from gz_onboard.dashboard.server import Feed, address_of, opened
from gz_onboard.dashboard.stopping import until_signalled
from gz_onboard.dashboard.view import View
from gz_onboard.errors import OK

POLL = 0.05  # s
AGE = 0.2  # s: without a frame the view is looked at so often, to see what has become stale
AT_LEAST = 1.0  # s: a picture is sent so often though nothing has changed; the page waits for it


def serve(view: View, channel: CanChannel, listen: str, duration: float | None) -> int:
    """Serve what `view` makes of the open `channel` for `duration` [s], or until a signal; InputError for `listen`."""
    end = time.monotonic() + (duration or math.inf)
    feed = Feed()
    with served(feed, listen) as address, until_signalled() as stopped:
        told = f"{address} shows {channel.name} ({channel.interface})"
        if sys.stdout is not None:
            print(f"dashboard: {told}", flush=True)
        notify.ready(told)
        feed_from(view, channel, feed, lambda: stopped() or time.monotonic() >= end)
        notify.stopping()
    return OK


@contextmanager
def served(feed: Feed, listen: str) -> Iterator[str]:
    """Serve `feed` at `listen` on a thread of its own; yields the address for a browser. InputError for `listen`."""
    server = opened(listen, feed)
    threading.Thread(target=server.serve_forever, name="web", daemon=True).start()
    try:
        yield address_of(server)
    finally:
        feed.close()
        server.shutdown()
        server.server_close()


def clock() -> float:
    """[s], also while the board sleeps: what came before is then old."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def feed_from(view: View, channel: CanChannel, feed: Feed, stopped: Callable[[], bool]) -> None:
    """Drain the channel into the view, and the view into the feed, until it is time to stop."""
    source = channel.name, channel.interface
    shown: Picture | None = None
    looked = sent = fed = -math.inf
    interval = notify.watchdog_interval() or math.inf
    while not stopped():
        frames = channel.drain()
        now = clock()
        for frame in frames:
            view.take(frame, now)
        if frames or now - looked >= AGE:
            looked = now
            new = picture(view, now, source, channel.up, shown.alerts if shown else ())
            if new != shown or now - sent >= AT_LEAST:
                feed.publish(new.encoded())
                shown, sent = new, now
        if now - fed >= interval:
            notify.alive()
            fed = now
        time.sleep(POLL)
