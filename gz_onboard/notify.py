"""Reports to systemd (sd_notify(3), sd_watchdog_enabled(3)); without systemd they do nothing."""

from __future__ import annotations

import os
import socket


def notify(**fields: object) -> bool:
    """Send fields such as ``READY=1``, ``WATCHDOG=1`` or ``STATUS=text`` to systemd; False if nobody takes them.

    Never blocks and never raises: neither a full nor a vanished socket may stop the estimate. The next watchdog message
    makes up for one that is lost.
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address.startswith(("/", "@")):
        return False
    # A line break within a value would begin another field.
    message = "\n".join(f"{name}={' '.join(str(value).split())}" for name, value in fields.items())
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as s:
            abstract = address.startswith("@")  # Linux' namespace of sockets without files
            s.sendto(message.encode(errors="replace"), f"\0{address[1:]}" if abstract else address)
    except OSError:
        return False
    return True


def watchdog_interval() -> float | None:
    """Seconds between two ``WATCHDOG=1``: half of the unit's WatchdogSec=; None without a watchdog.

    With a WATCHDOG_PID that is not ours, the variables are meant for another process.
    """
    timeout_us, pid = os.environ.get("WATCHDOG_USEC", "0"), os.environ.get("WATCHDOG_PID", str(os.getpid()))
    return int(timeout_us) / 2e6 if timeout_us.isdecimal() and int(timeout_us) and pid == str(os.getpid()) else None
