"""The range in a terminal, from nothing but the range frames on the bus.

What is shown is always of now: a message that has not come for ten of its periods is shown as stale, and its
numbers as dashes. On a terminal a screen that is drawn anew five times a second; anywhere else a line a second.
"""

from __future__ import annotations

import errno
import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import IO, TextIO

from gz_onboard.bus.channel import CanChannel
from gz_onboard.dashboard.screen import Style, rendered, screen, summary_line
from gz_onboard.dashboard.stopping import until_signalled
from gz_onboard.dashboard.view import View
from gz_onboard.errors import FAILED, OK, InputError

POLL = 0.05  # s
REDRAW = 0.2  # s
ONCE_WITHIN = 5.0  # s: how long --once waits for every message


def show(view: View, channel: CanChannel, once: bool, duration: float | None) -> int:
    """Show `view` of the open `channel` for `duration` [s], or for ever.

    once: one picture as soon as every message has come. The exit status: 1 if `once` found no range frames.
    """
    out: TextIO | None = sys.stdout
    if out is None:  # closed by who called us
        raise InputError("there is no standard output to show anything on")
    source = f"{channel.name} ({channel.interface})"
    duration = duration or (ONCE_WITHIN if once else math.inf)
    style = Style(
        colour=_is_screen(out) and "NO_COLOR" not in os.environ, unicode="utf" in (out.encoding or "").lower()
    )
    try:
        with until_signalled() as stopped:
            if once:
                for _ in _polled(view, channel, duration, lambda: stopped() or view.complete()):
                    pass
                _print(view, source, style, out)
            elif _is_screen(out):
                _show_screen(view, channel, source, style, duration, stopped, out)
            else:
                _show_lines(view, channel, style, duration, stopped, out)
    except OSError as error:
        if error.errno == errno.EIO:  # the terminal was closed: there is nobody to tell
            return FAILED
        if isinstance(error, BrokenPipeError):
            raise
        raise InputError(f"standard output: {error.strerror}") from error
    return FAILED if once and math.isinf(view.age(time.monotonic())) else OK


def _is_screen(out: IO[str]) -> bool:
    """Whether `out` is a terminal that this process may take over."""
    in_front = threading.current_thread() is threading.main_thread()
    return in_front and out.isatty() and os.environ.get("TERM", "dumb") != "dumb"


def _polled(view: View, channel: CanChannel, duration: float, stopped: Callable[[], bool]) -> Iterator[float]:
    """Drain the channel into the view until it is time to stop; yields the time [s] after each drain."""
    end = time.monotonic() + duration
    while True:
        frames = channel.drain()
        now = time.monotonic()
        for frame in frames:
            view.take(frame, now)
        yield now
        if now >= end or stopped():
            return
        time.sleep(min(POLL, max(end - now, 0)))


def _show_screen(
    view: View,
    channel: CanChannel,
    source: str,
    style: Style,
    duration: float,
    stopped: Callable[[], bool],
    out: IO[str],
) -> None:
    out.write("\x1b[?1049h\x1b[?25l")  # the other screen, without the cursor: what stood here comes back
    try:
        drawn = -math.inf
        for now in _polled(view, channel, duration, stopped):
            if now - drawn < REDRAW:
                continue
            drawn = now
            size = shutil.get_terminal_size()
            lines = screen(view, now, source if channel.up else f"{source} is down", size.columns)
            # Over the old picture, not after clearing it: no flicker. What is erased is erased before a line is
            # written: behind one that is as wide as the terminal, its last letter would go.
            text = "\r\n".join(f"\x1b[K{rendered(line, style)}" for line in lines[: size.lines])
            out.write(f"\x1b[H{text}" + ("\r\n\x1b[J" if len(lines) < size.lines else ""))
            out.flush()
    finally:
        out.write("\x1b[0m\x1b[?25h\x1b[?1049l")
        out.flush()
    _print(view, source, style, out)


def _show_lines(
    view: View, channel: CanChannel, style: Style, duration: float, stopped: Callable[[], bool], out: IO[str]
) -> None:
    printed = time.monotonic()
    for now in _polled(view, channel, duration, stopped):
        if now - printed < 1.0:
            continue
        printed += math.floor(now - printed)
        down = "" if channel.up else f"; {channel.name} is down"
        print(style.plain(f"{time.strftime('%H:%M:%S')} {summary_line(view, now)}{down}"), file=out, flush=True)


def _print(view: View, source: str, style: Style, out: IO[str]) -> None:
    """The picture as it is now, to stay."""
    width = shutil.get_terminal_size().columns
    for line in screen(view, time.monotonic(), source, width):
        print(rendered(line, style).rstrip(), file=out)
    out.flush()
