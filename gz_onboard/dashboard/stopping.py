"""When to end: at the signals that ask for it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def until_signalled() -> Iterator[Callable[[], bool]]:
    """Whether to stop: SIGINT and SIGTERM ask for it, so that what is open is closed in order."""
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    stopping = threading.Event()
    wanted = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, lambda *_: stopping.set()) for number in wanted}
    try:
        yield stopping.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
