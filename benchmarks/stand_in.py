"""Run a Python program whose SocketCAN sockets are UDP sockets on the loopback device: for kernels without AF_CAN.

    python benchmarks/stand_in.py RECEIVE_PORT SEND_PORT MODULE ARGUMENT...

Only how the socket is made and bound is replaced, ours or python-can's. The program then works as
on a real bus: `recvmsg` of 16-byte frames with the kernel's time stamps (SO_TIMESTAMPNS) and drop counter
(SO_RXQ_OVFL), one queue in the kernel of the same bookkeeping, `send` of 16 bytes, `select`. What only AF_CAN knows
(filters, loopback) is passed over: the frames sent here are all known to the vehicle.
"""

from __future__ import annotations

import importlib
import runpy
import socket
import sys
from typing import Any

SOL_CAN_RAW = 101


class StandIn(socket.socket):
    """A UDP socket that lets options of CAN sockets pass."""

    def setsockopt(self, level: int, *arguments: Any) -> None:
        """As a socket's, without those of AF_CAN."""
        if level != SOL_CAN_RAW:
            super().setsockopt(level, *arguments)


def install(receive_port: int, send_port: int, library: bool) -> None:
    """From now on a SocketCAN bus receives on one port of 127.0.0.1 and sends to the other; library: python-can's."""
    if library:
        importlib.import_module("gz_onboard.can.python_can")  # python-can without its large imports
        module = importlib.import_module("can.interfaces.socketcan.socketcan")
    else:
        module = importlib.import_module("gz_onboard.can.channel")

    def create() -> socket.socket:
        return StandIn(socket.AF_INET, socket.SOCK_DGRAM)

    def bind(sock: socket.socket, channel: str = "") -> None:
        sock.bind(("127.0.0.1", receive_port))
        sock.connect(("127.0.0.1", send_port))

    for name, function in ("create_socket", create), ("bind_socket", bind):
        setattr(module, name, function)


if __name__ == "__main__":
    install(int(sys.argv[1]), int(sys.argv[2]), library=sys.argv[3] != "gz_onboard")
    del sys.argv[1:3]
    runpy.run_module(sys.argv.pop(1), run_name="__main__", alter_sys=True)
