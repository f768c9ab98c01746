"""Calls that may have to wait for a disk, on a separate thread: an fsync to an SD card can take seconds."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

log = logging.getLogger("gz-onboard")


class Background:
    """Makes calls one after the other on a separate thread; the caller never waits.

    limit: how much may wait, in the weights that `call` is given. An exception of a call is logged, and the next one
    is made.
    """

    def __init__(self, name: str, limit: int = 1) -> None:
        self._limit = limit
        self._calls: deque[tuple[Callable[..., object], tuple[Any, ...], int]] = deque()
        self._weight = 0
        self._changed = threading.Condition()
        self._closing = False
        self._began: float | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._started = False

    def call(self, function: Callable[..., object], *arguments: Any, weight: int = 1) -> bool:
        """Have `function` called with the arguments, soon; False if too much waits and it will not be.

        What weighs nothing is always taken, and while nothing waits, any weight.
        """
        with self._changed:
            if self._closing or (weight and self._weight and self._weight + weight > self._limit):
                return False
            self._weight += weight
            self._calls.append((function, arguments, weight))
            self._changed.notify_all()
            if not self._started:
                self._started = True
                self._thread.start()
        return True

    @property
    def load(self) -> float:
        """How much of the limit is taken; 0 when all is done."""
        return self._weight / self._limit

    @property
    def stuck(self) -> float:
        """For how long [s] the present call has been running; 0 if there is none."""
        began = self._began
        return 0.0 if began is None else time.monotonic() - began

    def wait(self, seconds: float) -> bool:
        """Until all calls asked for are done; False if they are not within `seconds`."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._calls, seconds)

    def close(self, seconds: float) -> bool:
        """Take no more calls, and wait until the rest is done; False if it is not within `seconds`."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        if self._started:
            self._thread.join(seconds)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._calls or self._closing)
                if not self._calls:
                    return
                function, arguments, weight = self._calls[0]
            self._began = time.monotonic()
            try:
                function(*arguments)
            except Exception:
                log.exception("in the background")
            self._began = None
            with self._changed:
                self._calls.popleft()
                self._weight -= weight
                self._changed.notify_all()
