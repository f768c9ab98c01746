"""``gz-onboard dashboard --web``: gives the server the pictures of the bus."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from gz_onboard import notify
from gz_onboard.bus.channel import CanChannel
from gz_onboard.dashboard.pictures import pictures
from gz_onboard.dashboard.server import Feed, address_of, opened
from gz_onboard.dashboard.stopping import until_signalled
from gz_onboard.dashboard.view import View
from gz_onboard.errors import OK


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


def feed_from(view: View, channel: CanChannel, feed: Feed, stopped: Callable[[], bool]) -> None:
    """Drain the channel into the view, and the view into the feed, until it is time to stop."""
    for new in pictures(view, channel, stopped):
        feed.publish(new.encoded())
