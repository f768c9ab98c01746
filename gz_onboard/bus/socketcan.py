"""A SocketCAN bus by its raw socket, with the kernel's filters, time stamps and drop counter.

The kernel buffers the frames between two ticks, so a tick costs one wake-up, not hundreds: a fifth of the time of
python-can's reader thread.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import time
from typing import TYPE_CHECKING

from gz_onboard.events import EFF_FLAG, Frame

if TYPE_CHECKING:
    from collections.abc import Sequence

SO_TIMESTAMPNS = 35
SO_RXQ_OVFL = 40
SO_RCVBUFFORCE = 33
CAN_RAW_ERR_FILTER, ALL_ERRORS = 2, 0x1FFF_FFFF
BUFFER = 4 << 20  # bytes; a frame takes some 800 of them in the kernel: 5000 frames
NO_SOCKETS = (  # the meaning of EAFNOSUPPORT
    "this kernel has no CAN sockets (AF_CAN): load them (sudo modprobe can_raw), or join processes without by "
    "--interface udp_multicast --channel 239.74.163.2"
)
_FRAME = struct.Struct("=IB3x8s")
_FILTER = struct.Struct("=II")
_TIMESPEC = struct.Struct("=qq")
_COUNT = struct.Struct("=I")
_ANCILLARY = socket.CMSG_SPACE(16) + socket.CMSG_SPACE(4)


def create_socket() -> socket.socket:
    """Return an unbound raw CAN socket. OSError if the kernel has none."""
    return socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)


def bind_socket(raw: socket.socket, channel: str) -> None:
    """Bind a socket to a CAN interface. OSError if there is none, or if it is down."""
    raw.bind((channel,))


class SocketCanBus:
    """An open SocketCAN interface. OSError if there is none; identifiers: the only ones to be received, if given."""

    def __init__(self, channel: str, identifiers: Sequence[int] | None) -> None:
        self.overflow = 0
        self._socket = raw = create_socket()
        try:
            if identifiers is not None:
                masks = ((i, 0x1FFFFFFF if i & EFF_FLAG else 0x7FF) for i in identifiers)
                filters = [_FILTER.pack(i, mask | EFF_FLAG) for i, mask in masks]
                raw.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"".join(filters))
            raw.setsockopt(socket.SOL_CAN_RAW, CAN_RAW_ERR_FILTER, ALL_ERRORS)
            raw.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
            raw.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
            try:
                raw.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, BUFFER)
            except OSError:  # needs CAP_NET_ADMIN; otherwise as much as the system allows
                raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER)
            bind_socket(raw, channel)
        except OSError:
            raw.close()
            raise

    def drain(self, frames: list[Frame], index: int, limit: int, until: float) -> bool:
        """Append the waiting frames, at most `limit`, until a monotonic time [s]; whether more may be waiting."""
        for number in range(limit):
            try:
                data, ancillary, _, _ = self._socket.recvmsg(_FRAME.size, _ANCILLARY, socket.MSG_DONTWAIT)
            except BlockingIOError:
                return False
            time_ns = 0
            for _level, kind, value in ancillary:
                if kind == SO_TIMESTAMPNS:
                    seconds, nanoseconds = _TIMESPEC.unpack(value)
                    time_ns = seconds * 1_000_000_000 + nanoseconds
                elif kind == SO_RXQ_OVFL:  # the kernel's counter wraps
                    self.overflow += (_COUNT.unpack(value)[0] - self.overflow) & 0xFFFFFFFF
            identifier, length, payload = _FRAME.unpack(data)
            frames.append((time_ns or time.time_ns(), identifier, payload[:length], index))
            if not number & 31 and time.monotonic() > until:
                break
        return True

    def send(self, identifier: int, data: bytes) -> None:
        """Send a frame. OSError if the bus does not take it now."""
        self._socket.send(_FRAME.pack(identifier, len(data), data), socket.MSG_DONTWAIT)

    def close(self) -> None:
        """Close the socket."""
        with contextlib.suppress(OSError):
            self._socket.close()
