"""The range in a terminal, from nothing but the range frames on the bus.

On a terminal a screen, redrawn at most five times a second; anywhere else a line of JSON a second.
"""

from __future__ import annotations

import errno
import math
import os
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from typing import TextIO

from gz_onboard.bus.channel import CanChannel
from gz_onboard.bus.publisher import reason_signal
from gz_onboard.dashboard.picture import Picture
from gz_onboard.dashboard.pictures import pictures, until_signalled
from gz_onboard.dashboard.screen import Line, Style, rendered, screen
from gz_onboard.dashboard.view import View
from gz_onboard.errors import FAILED, OK, InputError
from gz_onboard.events import Reason

REDRAW_S, LINE_S = 0.2, 0.95  # at least, between two screens, and two lines
ONCE_WITHIN_S = 5.0  # that --once waits for every message


def show(view: View, channel: CanChannel, once: bool, duration: float | None) -> int:
    """Show `view` of the open `channel` for `duration` [s], or until a signal; return the exit status.

    once: one picture as soon as every message has come; 1 if no range frame came at all.
    """
    out: TextIO | None = sys.stdout
    if out is None:  # closed by the caller
        raise InputError("there is no standard output to show anything on")
    try:
        with until_signalled(duration or (ONCE_WITHIN_S if once else None)) as stopped:
            last = _show(view, channel, once, stopped, out)
    except OSError as error:
        if error.errno == errno.EIO:  # the terminal was closed
            return FAILED
        if isinstance(error, BrokenPipeError):
            raise
        raise InputError(f"standard output: {error.strerror}") from error
    return FAILED if once and not (last and last.heard) else OK


def _show(view: View, channel: CanChannel, once: bool, stopped: Callable[[], bool], out: TextIO) -> Picture | None:
    in_front = threading.current_thread() is threading.main_thread()
    terminal = in_front and out.isatty() and os.environ.get("TERM", "dumb") != "dumb"
    style = Style(terminal and "NO_COLOR" not in os.environ, "utf" in (out.encoding or "").lower())
    comments = view.comments
    explained = {str(reason.name).lower(): comments.get(reason_signal(reason), "") for reason in Reason}
    on_screen, shown, drawn = terminal and not once, None, -math.inf
    with _other_screen(out) if on_screen else nullcontext():
        for shown in pictures(view, channel, stopped):
            now = time.monotonic()
            if once:
                if not shown.stale:
                    break
            elif now - drawn >= (REDRAW_S if on_screen else LINE_S):
                drawn = now
                if on_screen:
                    _draw(shown, style, explained, out)
                else:
                    print(shown.encoded().decode(), file=out, flush=True)
    if shown and (once or on_screen):  # the last picture stays
        for line in _lines(shown, explained, shutil.get_terminal_size().columns):
            print(rendered(line, style).rstrip(), file=out)
        out.flush()
    return shown


def _lines(shown: Picture, comments: Mapping[str, str], columns: int) -> list[Line]:
    return screen(shown, f"{shown.channel} ({shown.interface})", columns, comments)


def _draw(shown: Picture, style: Style, comments: Mapping[str, str], out: TextIO) -> None:
    size = shutil.get_terminal_size()
    lines = _lines(shown, comments, size.columns)
    # Over the old picture, not after clearing the screen: no flicker. Each line is cleared before it is written; after
    # one that is as wide as the terminal, clearing would remove its last letter.
    text = "\r\n".join(f"\x1b[K{rendered(line, style)}" for line in lines[: size.lines])
    out.write(f"\x1b[H{text}" + ("\r\n\x1b[J" if len(lines) < size.lines else ""))
    out.flush()


@contextmanager
def _other_screen(out: TextIO) -> Iterator[None]:
    """Switch to the alternate screen, without a cursor, and back."""
    out.write("\x1b[?1049h\x1b[?25l")
    try:
        yield
    finally:
        out.write("\x1b[0m\x1b[?25h\x1b[?1049l")
        out.flush()
