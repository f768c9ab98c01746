"""A dashboard's server in a thread, on python-can's in-process bus, and a daemon's frames on that bus."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from gz_onboard.bus._can import can
from gz_onboard.bus.channel import CanChannel
from gz_onboard.bus.publisher import Publisher
from gz_onboard.dashboard.server import Feed
from gz_onboard.dashboard.view import View
from gz_onboard.dashboard.web import feed_from, served
from gz_onboard.events import Estimate
from tests.dashboard.test_terminal import COUNTS, send


@contextmanager
def dashboard(channel: str, listen: str = "127.0.0.1:0") -> Iterator[str]:
    """The address of a dashboard of the virtual bus `channel`."""
    view, stop, feed = View(), threading.Event(), Feed()
    bus = CanChannel("virtual", channel, identifiers=view.identifiers)
    bus.open()
    with served(feed, listen) as address:
        loop = threading.Thread(target=feed_from, args=(view, bus, feed, stop.is_set))
        loop.start()
        try:
            yield address
        finally:
            stop.set()
            loop.join()
            bus.close()


class Sender:
    """What a daemon sends, in its rhythm, of an estimate that can be changed meanwhile."""

    def __init__(self, channel: str, estimate: Estimate) -> None:
        self.estimate = estimate
        self._channel = channel
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def _run(self) -> None:
        publisher, number = Publisher(), 0
        with can.Bus(interface="virtual", channel=self._channel) as bus:
            while not self._stop.wait(0.1):
                if number % 10 == 0:
                    send(bus, publisher.range(self.estimate, COUNTS, 0))
                send(bus, publisher.status(self.estimate, 0))
                number += 1

    def __enter__(self) -> Sender:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
