"""A CAN channel, drained once for each tick of its reader instead of waking up for each frame.

A SocketCAN bus is read by its socket (`gz_onboard.bus.socketcan`), all others by python-can
(`gz_onboard.bus.library_bus`), which is imported for them only: it costs 9 MB and a fifth of the daemon's start. A bus
that goes down is closed, and reopened once it is back; nothing here raises for it.
"""

from __future__ import annotations

import contextlib
import errno
import time
from typing import TYPE_CHECKING, Any, Protocol

from gz_onboard.bus.socketcan import NO_SOCKETS, SocketCanBus
from gz_onboard.errors import InputError
from gz_onboard.events import Frame

if TYPE_CHECKING:
    from collections.abc import Sequence

SOCKETCAN = "socketcan"
MAX_FRAMES, READ_S = 5000, 0.08
"""Frames, and time [s], that one call of `drain` takes at most; the kernel keeps the others, or drops them."""
RETRY_S = 1.0  # between attempts to open a bus that is down


class Bus(Protocol):
    """An open bus. Its methods raise OSError if it has gone down."""

    overflow: int  # frames that the kernel had to drop since it was opened

    def drain(self, frames: list[Frame], index: int, limit: int, until: float) -> bool:
        """Append the waiting frames, at most `limit`, until a monotonic time [s]; whether more may be waiting."""

    def send(self, identifier: int, data: bytes) -> None:
        """Send a frame."""

    def close(self) -> None:
        """Close it."""


class CanChannel:
    """One channel. index: is put into its frames; identifiers: the only ones to be received, if given."""

    def __init__(
        self, interface: str, channel: str, index: int = 0, identifiers: Sequence[int] | None = None, **options: Any
    ) -> None:
        self.interface = interface
        self.name = channel
        self.index = index
        self.behind = False  # whether `drain` had no time for all frames
        self.send_failures = 0
        self._identifiers = identifiers
        self._options = options  # for python-can
        self._bus: Bus | None = None
        self._overflow = 0  # of buses that were closed
        self._retry_at = 0.0

    @property
    def up(self) -> bool:
        """Whether the bus is open."""
        return self._bus is not None

    @property
    def overflow(self) -> int:
        """Frames that the kernel had to drop, as it counts them."""
        return self._overflow + (self._bus.overflow if self._bus else 0)

    def open(self) -> None:
        """Open for the first time; a bus that is down may come up later. InputError for an unknown interface."""
        try:
            self._open()
        except OSError as error:
            if self.interface == SOCKETCAN and error.errno == errno.EAFNOSUPPORT:
                raise InputError(f"--interface socketcan: {NO_SOCKETS}") from error
            self._close()

    def _open(self) -> None:
        if self.interface == SOCKETCAN:
            self._bus = SocketCanBus(self.name, self._identifiers)
        else:
            from gz_onboard.bus.library_bus import LibraryBus  # only here: a slow import

            self._bus = LibraryBus(self.interface, self.name, self._identifiers, self._options)

    def _close(self) -> None:
        self._retry_at = time.monotonic() + RETRY_S
        self._overflow = self.overflow
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError):
                bus.close()

    def drain(self) -> list[Frame]:
        """Return the frames that have come since the last call, without waiting, within `READ_S` and `MAX_FRAMES`."""
        self.behind = False
        frames: list[Frame] = []
        try:
            if self._bus is None and time.monotonic() >= self._retry_at:
                self._open()
            if self._bus is not None:
                self.behind = self._bus.drain(frames, self.index, MAX_FRAMES, time.monotonic() + READ_S)
        except OSError:  # ENETDOWN, ENODEV: the frames read before are still good
            self._close()
        return frames

    def send(self, frame: Frame) -> bool:
        """Send `frame`; False if the bus does not take it now."""
        if self._bus is None:
            return False
        try:
            self._bus.send(frame[1], frame[2])
        except OSError as error:
            self.send_failures += 1
            if error.errno not in (errno.ENOBUFS, errno.EAGAIN, None):
                self._close()
            return False
        return True

    def close(self) -> None:
        """Close for good."""
        self._close()
