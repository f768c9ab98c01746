"""A bus of any of python-can's interfaces, and python-can itself: ``from gz_onboard.can.python_can import can``.

Where asammdf is installed, ``import can`` loads it for its MF4 reader, and with it pandas: 86 MB and 0.9 s that
a daemon which never reads an MF4 file would pay at each start.
"""

from __future__ import annotations

import os
import socket
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from gz_onboard.errors import InputError, nearest
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, Frame
from gz_onboard.imports import require, without

with without("asammdf", "numpy"):
    import can

__all__ = ["LibraryBus", "can", "check_interface", "flagged", "open_bus"]

MAX_ECHOES = 200  # frames of our own that may not have come back yet
MULTICAST = "udp_multicast"
ALL_GROUPS = {
    socket.AF_INET: (socket.IPPROTO_IP, 49),
    socket.AF_INET6: (socket.IPPROTO_IPV6, 29),
}  # IP(V6)_MULTICAST_ALL


def check_interface(name: str) -> None:
    """InputError if python-can has no such interface."""
    if name not in can.VALID_INTERFACES:
        known = sorted(can.VALID_INTERFACES)
        raise InputError(f"--interface {name}: unknown{nearest(name, known)}; known are {', '.join(known)}")
    require("msgpack", name == MULTICAST)


def open_bus(interface: str, channel: str, **options: Any) -> can.BusABC:
    """Open a bus of python-can. Of `udp_multicast` the channel may be GROUP:PORT, and only its group is heard.

    Linux gives a socket those of every group that any process of the machine has joined on its port.
    """
    if interface != MULTICAST:
        return can.Bus(channel=channel, interface=interface, **options)
    group, _, port = channel.partition(":") if channel.count(":") == 1 else (channel, "", "")
    options |= {"port": int(port)} if port else {}
    bus = can.Bus(channel=group, interface=interface, **options)
    with socket.socket(fileno=os.dup(bus.fileno())) as same:
        same.setsockopt(*ALL_GROUPS[same.family], 0)
    return bus


def flagged(message: can.Message) -> int:
    """The identifier of a message with the kernel's flags."""
    identifier = message.arbitration_id | (EFF_FLAG if message.is_extended_id else 0)
    return identifier | (RTR_FLAG if message.is_remote_frame else 0) | (ERR_FLAG if message.is_error_frame else 0)


@contextmanager
def _os_errors() -> Iterator[None]:
    """Turn python-can's errors within into OSError; of interfaces that it cannot make, leave them."""
    try:
        yield
    except can.CanInterfaceNotImplementedError:
        raise
    except can.CanError as error:
        code = error.error_code
        raise (OSError(str(error)) if code is None else OSError(code, str(error))) from error


class LibraryBus:
    """An open bus. InputError for an unknown interface, OSError for a bus that is down.

    identifiers: the only ones to be received, if given.
    """

    def __init__(self, interface: str, channel: str, identifiers: Sequence[int] | None) -> None:
        check_interface(interface)
        self.overflow = 0
        self._wanted = None if identifiers is None else {*identifiers, *(ERR_FLAG | bit for bit in (0, EFF_FLAG))}
        self._echoing = interface == MULTICAST
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=MAX_ECHOES)  # frames of our own that will come back
        try:
            with _os_errors():
                self._bus: Any = open_bus(interface, channel)
        except (can.CanInterfaceNotImplementedError, ValueError, ImportError) as error:
            raise InputError(f"--interface {interface}: {error}") from error

    def drain(self, frames: list[Frame], index: int, limit: int, until: float) -> bool:
        """Append the waiting frames, at most `limit`, until a monotonic time [s]; whether more may be waiting."""
        for _ in range(limit):
            if time.monotonic() > until:
                break
            with _os_errors():
                message = self._bus.recv(0)
            if message is None:
                return False
            identifier, data = flagged(message), bytes(message.data)
            if (identifier, data) in self._sent:
                self._sent.remove((identifier, data))
            # Filtered here: with filters of its own python-can's recv(0) returns None for each frame it rejects.
            elif self._wanted is None or identifier & ~RTR_FLAG in self._wanted:
                # Only the kernel's time stamps share a clock; other interfaces have clocks of their own.
                frames.append((time.time_ns(), identifier, data, index))
        return True

    def send(self, identifier: int, data: bytes) -> None:
        """Send a frame. OSError if the bus does not take it now."""
        extended = bool(identifier & EFF_FLAG)
        with _os_errors():
            self._bus.send(can.Message(arbitration_id=identifier & 0x1FFFFFFF, data=data, is_extended_id=extended))
        if self._echoing:
            self._sent.append((identifier, data))

    def close(self) -> None:
        """Shut the bus down. OSError."""
        with _os_errors():
            self._bus.shutdown()
