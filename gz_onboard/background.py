"""Calls that may have to wait for a disk, on a separate thread: an fsync to an SD card can take seconds."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from queue import Queue
from typing import Any

STUCK_S = 10.0  # no disk takes as long

log = logging.getLogger("gz-onboard")


class Background:
    """Makes calls one after the other on a separate thread; the caller never waits.

    limit: how much may wait, in the weights that `call` is given. An exception of a call is logged, and the next one
    is made.
    """

    def __init__(self, name: str, limit: int = 1) -> None:
        self._limit = limit
        self._calls: Queue[tuple[Callable[..., object], tuple[Any, ...], int] | None] = Queue()
        self._weight = 0
        self._lock = threading.Lock()  # of the weight
        self._began: float | None = None
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)  # started by the first call

    def call(self, function: Callable[..., object], *arguments: Any, weight: int = 1) -> bool:
        """Have `function` called with the arguments, soon; False if too much waits already and it will not be.

        A call without weight is always taken, and while nothing waits, one of any weight.
        """
        with self._lock:
            if weight and self._weight and self._weight + weight > self._limit:
                return False
            self._weight += weight
        self._calls.put((function, arguments, weight))
        if self._thread.ident is None:
            self._thread.start()
        return True

    @property
    def load(self) -> float:
        """Share of the limit that is taken; 0 when all is done."""
        return self._weight / self._limit

    @property
    def error(self) -> str:
        """Why waiting calls may never be made: the present one takes longer than any disk; empty if none does."""
        began = self._began
        is_stuck = began is not None and time.monotonic() - began > STUCK_S
        return "the disk does not answer" if is_stuck else ""

    def wait(self, seconds: float) -> bool:
        """Wait until all calls are done; False if they are not within `seconds`."""
        with self._calls.all_tasks_done:
            return self._calls.all_tasks_done.wait_for(lambda: not self._calls.unfinished_tasks, seconds)

    def close(self, seconds: float) -> bool:
        """Wait until all calls are done, and end the thread; False if they are not within `seconds`."""
        self._calls.put(None)
        if self._thread.ident is not None:
            self._thread.join(seconds)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while waiting := self._calls.get():
            function, arguments, weight = waiting
            self._began = time.monotonic()
            try:
                function(*arguments)
            except Exception:
                log.exception("in the background")
            self._began = None
            with self._lock:
                self._weight -= weight
            self._calls.task_done()
