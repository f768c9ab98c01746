"""Reports to systemd: ready, alive, status, stopping (sd_notify(3), sd_watchdog_enabled(3)).

Nothing happens where systemd does not listen: every function works the same in a terminal and in a test.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping


def notify(message: str, environ: Mapping[str, str] = os.environ) -> bool:
    """Send `message`, one ``KEY=value`` a line, to systemd; False if nobody listens or it cannot be sent.

    Never blocks and never raises: neither a full nor a vanished socket may stop the estimate. A watchdog
    message that is lost this way is made up for by the next.
    """
    address = environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return False
    if address.startswith("@"):  # Linux' abstract namespace
        address = "\0" + address[1:]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as s:
            s.sendto(message.encode(errors="replace"), address)
    except OSError:
        return False
    return True


def ready(status: str = "", environ: Mapping[str, str] = os.environ) -> bool:
    """Say that start-up is complete, with a `status` for ``systemctl status``."""
    return notify(f"READY=1\n{_field(status)}" if status else "READY=1", environ)


def alive(environ: Mapping[str, str] = os.environ) -> bool:
    """Feed the watchdog."""
    return notify("WATCHDOG=1", environ)


def status(text: str, environ: Mapping[str, str] = os.environ) -> bool:
    """Set the line that ``systemctl status`` shows."""
    return notify(_field(text), environ)


def stopping(text: str = "", environ: Mapping[str, str] = os.environ) -> bool:
    """Say that the shutdown has begun."""
    return notify(f"STOPPING=1\n{_field(text)}" if text else "STOPPING=1", environ)


def watchdog_interval(environ: Mapping[str, str] = os.environ) -> float | None:
    """Seconds between two calls of `alive`: half of the unit's WatchdogSec=; None without a watchdog.

    A WATCHDOG_PID that is not ours means that the variables were meant for another process.
    """
    try:
        timeout_us = int(environ["WATCHDOG_USEC"])
        pid = int(environ.get("WATCHDOG_PID", os.getpid()))
    except (KeyError, ValueError):
        return None
    return timeout_us / 2e6 if timeout_us > 0 and pid == os.getpid() else None


def _field(status: str) -> str:
    """The status as a field of a message; a line break in it would begin another field."""
    return "STATUS=" + " ".join(status.split())
