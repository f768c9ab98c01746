"""Import python-can without asammdf: use ``from gz_onboard.bus._can import can`` on board.

Where asammdf is installed, ``import can`` loads it for its MF4 reader, and with it pandas: 86 MB and 0.9 s that
a daemon which never reads an MF4 file would pay at each start.
"""

from __future__ import annotations

import importlib
import os
import socket
import sys
from typing import Any

from gz_onboard.errors import InputError, nearest
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG
from gz_onboard.imports import require


def _import_without_asammdf() -> None:
    """Import python-can with asammdf hidden from it, unless either is there already."""
    if "can" in sys.modules or "asammdf" in sys.modules:
        return
    sys.modules["asammdf"] = None  # type: ignore[assignment]  # an import then raises ModuleNotFoundError
    try:
        importlib.import_module("can")
    finally:
        del sys.modules["asammdf"]


_import_without_asammdf()

import can  # noqa: E402

__all__ = ["can", "check_interface", "flagged", "open_bus"]

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
