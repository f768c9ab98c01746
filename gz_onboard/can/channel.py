"""A CAN channel, drained once for each tick of its reader instead of waking up for each frame.

A SocketCAN bus is read by its socket, all others by python-can (`gz_onboard.can.python_can`), which is imported for
them only: it costs 9 MB and a fifth of the daemon's start. A bus that goes down is closed, and reopened once it is
back; nothing here raises for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import socket
import struct
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG, Frame

if TYPE_CHECKING:
    from gz_onboard.can.python_can import LibraryBus

SOCKETCAN = "socketcan"
MAX_FRAMES, READ_S = 5000, 0.08
"""Frames, and time [s], that one call of `drain` takes at most; the kernel keeps the others, or drops them."""
RETRY_S = 1.0  # between attempts to open a bus that is down
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
_CONTROL = struct.Struct("@NiillNiiI0N")
"""Two control messages: length, level, SO_TIMESTAMPNS, s, ns; length, level, SO_RXQ_OVFL, count. In the machine's own
longs: 32 bits on a 32-bit board."""
BATCH = 128  # frames that one call of recvmmsg(2) reads at most


def create_socket() -> socket.socket:
    """Return an unbound raw CAN socket. OSError if the kernel has none."""
    return socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)


def bind_socket(raw: socket.socket, channel: str) -> None:
    """Bind a socket to a CAN interface. OSError if there is none, or if it is down."""
    raw.bind((channel,))


class _IoVec(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("size", ctypes.c_size_t))


class _Header(ctypes.Structure):
    """``struct msghdr``."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_size", ctypes.c_uint32),
        ("io_vector", ctypes.POINTER(_IoVec)),
        ("io_vectors", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_size", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    """``struct mmsghdr``."""

    _fields_ = (("header", _Header), ("received", ctypes.c_uint))


class SocketCanBus:
    """An open SocketCAN interface, read by its raw socket with the kernel's filters, time stamps and drop counter.

    The kernel buffers the frames between two ticks, and recvmmsg(2) reads up to `BATCH` at once: a fifth of the time of
    python-can's reader thread. OSError if there is no such interface. identifiers: the only ones to be received.
    """

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
        self._receive = ctypes.CDLL(None, use_errno=True).recvmmsg
        self._data = ctypes.create_string_buffer(BATCH * _FRAME.size)
        self._control = ctypes.create_string_buffer(BATCH * _CONTROL.size)
        data, control = ctypes.addressof(self._data), ctypes.addressof(self._control)
        self._vectors = (_IoVec * BATCH)(*(_IoVec(data + i * _FRAME.size, _FRAME.size) for i in range(BATCH)))
        self._messages = (_Message * BATCH)()
        for i, message in enumerate(self._messages):
            header = message.header
            header.io_vector, header.io_vectors = ctypes.pointer(self._vectors[i]), 1
            header.control, header.control_size = control + i * _CONTROL.size, _CONTROL.size
        self._unread = bytes(self._messages)
        self._read = 0  # frames, by the last call

    def _receive_batch(self) -> Iterator[tuple[tuple[int, int, bytes], tuple[int, ...]]]:
        """`_FRAME` and `_CONTROL` of the waiting frames, at most `BATCH`. OSError for a bus that is down."""
        # The kernel has shortened what it used. Control messages that it leaves out now it has never written.
        ctypes.memmove(self._messages, self._unread, self._read * ctypes.sizeof(_Message))
        count = self._receive(self._socket.fileno(), self._messages, BATCH, socket.MSG_DONTWAIT, None)
        if count < 0 and (number := ctypes.get_errno()) != errno.EAGAIN:
            raise OSError(number, os.strerror(number))
        self._read = count = max(count, 0)
        frames = ctypes.string_at(self._data, count * _FRAME.size)
        control = ctypes.string_at(self._control, count * _CONTROL.size)
        return zip(_FRAME.iter_unpack(frames), _CONTROL.iter_unpack(control), strict=True)

    def drain(self, frames: list[Frame], index: int, limit: int, until: float) -> bool:
        """Append the waiting frames, at most `limit`, until a monotonic time [s]; whether more may be waiting."""
        for _ in range(0, limit, BATCH):
            before = len(frames)
            for (identifier, length, payload), (_, _, kind, seconds, ns, _, _, counted, lost) in self._receive_batch():
                time_ns = seconds * 1_000_000_000 + ns if kind == SO_TIMESTAMPNS else time.time_ns()
                frames.append((time_ns, identifier, payload[:length], index))
                if counted == SO_RXQ_OVFL:  # the kernel's counter wraps
                    self.overflow += (lost - self.overflow) & 0xFFFFFFFF
            if len(frames) < before + BATCH:
                return False
            if time.monotonic() > until:
                break
        return True

    def send(self, identifier: int, data: bytes) -> None:
        """Send a frame. OSError if the bus does not take it now."""
        self._socket.send(_FRAME.pack(identifier, len(data), data), socket.MSG_DONTWAIT)

    def close(self) -> None:
        """Close the socket."""
        with contextlib.suppress(OSError):
            self._socket.close()


class CanChannel:
    """One channel. index: is put into its frames; identifiers: the only ones to be received, if given."""

    def __init__(self, interface: str, channel: str, index: int = 0, identifiers: Sequence[int] | None = None) -> None:
        self.interface = interface
        self.name = channel
        self.index = index
        self.behind = False  # whether `drain` had no time for all frames
        self.send_failures = 0
        self._identifiers = identifiers
        self._bus: SocketCanBus | LibraryBus | None = None
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
            self.close()

    def _open(self) -> None:
        if self.interface == SOCKETCAN:
            self._bus = SocketCanBus(self.name, self._identifiers)
        else:
            from gz_onboard.can.python_can import LibraryBus  # only here: a slow import

            self._bus = LibraryBus(self.interface, self.name, self._identifiers)

    def close(self) -> None:
        """Close the bus; `drain` opens it again, `RETRY_S` later."""
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
            self.close()
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
                self.close()
            return False
        return True
