"""A CAN channel: python-can's bus, drained once a tick instead of waking for each frame.

On SocketCAN the bus's own socket is read with the kernel's filters, time stamps and drop counter: one wake-up for all
frames of a tick takes a fifth of the time of python-can's reader thread. A bus that goes down is closed, and opened
again once it is back; nothing here raises for it.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
import time
from collections import deque
from typing import TYPE_CHECKING, Any

from gz_onboard.bus._can import MULTICAST, NO_SOCKETS, can, check_interface, flagged, open_bus
from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, Frame

if TYPE_CHECKING:
    from collections.abc import Sequence

SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
SO_RCVBUFFORCE = 33
BUFFER = 4 << 20  # bytes; a frame takes some 800 of them in the kernel: 5000 frames
MOST, READ_S = 5000, 0.08
"""Frames, and time [s], that one call of `drain` takes at most: what more comes waits, and is dropped by the kernel."""
RETRY = 1.0  # s between attempts to open a bus that is down
MOST_ECHOES = 200  # frames that a bus may still give back to us, their sender
_FRAME = struct.Struct("=IB3x8s")
_TIMESPEC = struct.Struct("=qq")
_COUNT = struct.Struct("=I")
_ANCILLARY = socket.CMSG_SPACE(16) + socket.CMSG_SPACE(4)


class CanChannel:
    """One channel. `index` is put into its frames; `identifiers` are all that the kernel shall let through."""

    def __init__(
        self, interface: str, channel: str, index: int = 0, identifiers: Sequence[int] | None = None, **options: Any
    ) -> None:
        self.interface = interface
        self.name = channel
        self.index = index
        self.up = False
        self.behind = False  # whether `drain` had no time for all that had come
        self.overflow = 0  # frames that the kernel had to drop, as it counts them
        self.send_failures = 0
        self._identifiers = identifiers
        self._wanted = None if identifiers is None else {*identifiers, *(ERR_FLAG | bit for bit in (0, EFF_FLAG))}
        self._options = options
        self._echoes = interface == MULTICAST or bool(options.get("receive_own_messages"))
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=MOST_ECHOES)  # identifier, data: that will come back
        self._bus: Any = None
        self._socket: socket.socket | None = None
        self._kernel_count = 0
        self._retry_at = 0.0

    def open(self) -> None:
        """Open for the first time; InputError if there is no such interface or channel at all."""
        check_interface(self.interface)
        try:
            self._open()
        except (can.CanInterfaceNotImplementedError, ValueError, ImportError) as error:
            raise InputError(f"--interface {self.interface}: {error}") from error
        except (OSError, can.CanError) as error:
            if self.interface == "socketcan" and getattr(error, "errno", None) == errno.EAFNOSUPPORT:
                raise InputError(f"--interface socketcan: {NO_SOCKETS}") from error
            self.close()  # not there yet: a bus may come up later

    def _open(self) -> None:
        filters: list[dict[str, Any]] | None = None
        if self._identifiers is not None and self.interface == "socketcan":
            filters = [
                {
                    "can_id": i & 0x1FFFFFFF,
                    "can_mask": 0x1FFFFFFF if i & EFF_FLAG else 0x7FF,
                    "extended": bool(i & EFF_FLAG),
                }
                for i in self._identifiers
            ]
        bus: Any = open_bus(self.interface, self.name, can_filters=filters, **self._options)
        self._bus = bus
        raw = getattr(bus, "socket", None)
        if self.interface == "socketcan" and isinstance(raw, socket.socket):
            raw.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            raw.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
            try:
                raw.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER)
            except OSError:  # needs CAP_NET_ADMIN; else as much as the system allows
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
            self._socket = raw
            self._kernel_count = 0
        self.up = True

    def close(self) -> None:
        """Close; the next `drain` after a while opens it again."""
        self.up = False
        self._socket = None
        self._retry_at = time.monotonic() + RETRY
        bus, self._bus = self._bus, None
        if bus is not None:
            with contextlib.suppress(OSError, can.CanError):
                bus.shutdown()

    def reopen(self) -> bool:
        """If the channel is down and it is time to try again, try; True if it is up."""
        if not self.up and time.monotonic() >= self._retry_at:
            try:
                self._open()
            except (OSError, can.CanError, ValueError):
                self.close()
        return self.up

    def drain(self) -> list[Frame]:
        """The frames that have come since the last call, without waiting, as far as `READ_S` and `MOST` allow."""
        self.behind = False
        frames: list[Frame] = []
        if self.up or self.reopen():
            try:
                if self._socket is not None:
                    self._drain_socket(self._socket, frames)
                else:
                    self._drain_bus(frames)
            except (OSError, can.CanError):  # ENETDOWN, ENODEV: the frames read before are still good
                self.close()
        return frames

    def _drain_socket(self, source: socket.socket, frames: list[Frame]) -> None:
        until = time.monotonic() + READ_S
        for number in range(MOST):
            try:
                data, ancillary, _, _ = source.recvmsg(_FRAME.size, _ANCILLARY, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return
            time_ns = 0
            for _level, kind, value in ancillary:
                if kind == SO_TIMESTAMPNS:
                    seconds, nanoseconds = _TIMESPEC.unpack(value)
                    time_ns = seconds * 1_000_000_000 + nanoseconds
                elif kind == SO_RXQ_OVFL:
                    count = _COUNT.unpack(value)[0]
                    self.overflow += (count - self._kernel_count) & 0xFFFFFFFF
                    self._kernel_count = count
            identifier, length, payload = _FRAME.unpack(data)
            frames.append((time_ns or time.time_ns(), identifier, payload[:length], self.index))
            if not number & 31 and time.monotonic() > until:
                break
        self.behind = True

    def _drain_bus(self, frames: list[Frame]) -> None:
        until = time.monotonic() + READ_S
        for _ in range(MOST):
            if time.monotonic() > until:
                break
            if (message := self._bus.recv(0)) is None:
                return
            identifier = flagged(message)
            # Filtered here: with filters of its own python-can's recv(0) says "nothing" at each frame it rejects.
            if self._wanted is not None and identifier & ~RTR_FLAG not in self._wanted:
                continue
            data = bytes(message.data)
            if (identifier, data) in self._sent:
                self._sent.remove((identifier, data))
                continue
            # Only the kernel's stamps are of one clock; other interfaces have clocks of their own.
            frames.append((time.time_ns(), identifier, data, self.index))
        self.behind = True

    def send(self, frame: Frame) -> bool:
        """Send `frame`; False if the bus does not take it now."""
        if not self.up:
            return False
        _, identifier, data, _ = frame
        try:
            if self._socket is not None:
                self._socket.send(_FRAME.pack(identifier, len(data), data), socket.MSG_DONTWAIT)
            else:
                extended = bool(identifier & EFF_FLAG)
                self._bus.send(can.Message(arbitration_id=identifier & 0x1FFFFFFF, data=data, is_extended_id=extended))
                if self._echoes:
                    self._sent.append((identifier, data))
            return True
        except (OSError, can.CanError) as error:
            self.send_failures += 1
            code = getattr(error, "errno", None) or getattr(error, "error_code", None)
            if code not in (errno.ENOBUFS, errno.EAGAIN, None):
                self.close()
            return False
