"""Run a Python program whose SocketCAN sockets are UDP sockets on the loopback device: for kernels without AF_CAN.

    python benchmarks/stand_in.py RECEIVE_PORT SEND_PORT MODULE ARGUMENT...

Only how python-can makes and binds its socket is replaced. Everything that the program then does with it is what it
does on a real bus: `recvmsg` of 16-byte frames with the kernel's time stamps (SO_TIMESTAMPNS) and drop counter
(SO_RXQ_OVFL), one queue in the kernel of the same bookkeeping, `send` of 16 bytes, `select`. What only AF_CAN knows
(filters, loopback) is passed over: the frames sent here are all known to the vehicle.
"""

from __future__ import annotations

import runpy
import socket
import sys
from typing import Any

from gz_onboard.bus._can import can

SOL_CAN_RAW = 101


class StandIn(socket.socket):
    """A UDP socket that lets options of CAN sockets pass."""

    def setsockopt(self, level: int, *arguments: Any) -> None:
        """As a socket's, without those of AF_CAN."""
        if level != SOL_CAN_RAW:
            super().setsockopt(level, *arguments)


def install(receive_port: int, send_port: int) -> None:
    """From now on python-can's socketcan bus receives on one port of 127.0.0.1 and sends to the other."""
    from can.interfaces.socketcan import socketcan

    def create() -> socket.socket:
        return StandIn(socket.AF_INET, socket.SOCK_DGRAM)

    def bind(sock: socket.socket, channel: str = "") -> None:
        sock.bind(("127.0.0.1", receive_port))
        sock.connect(("127.0.0.1", send_port))

    socketcan.create_socket = create
    socketcan.bind_socket = bind


if __name__ == "__main__":
    assert can
    install(int(sys.argv[1]), int(sys.argv[2]))
    del sys.argv[1:3]
    module = sys.argv.pop(1)
    runpy.run_module(module, run_name="__main__", alter_sys=True)
