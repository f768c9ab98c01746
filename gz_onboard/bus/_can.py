"""python-can, imported so that it stays small: use ``from gz_onboard.bus._can import can`` on board.

Where asammdf is installed, ``import can`` loads it for its MF4 reader, and with it pandas: 86 MB and 0.9 s that
a daemon which never reads an MF4 file would pay at each start.
"""

from __future__ import annotations

import importlib
import sys

from gz_onboard.errors import InputError, nearest
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG


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

__all__ = ["NO_MSGPACK", "NO_SOCKETS", "PIP_MSGPACK", "can", "check_interface", "flagged"]

NO_MSGPACK, PIP_MSGPACK = "msgpack not installed", "; pip install msgpack"  # of `udp_multicast`
NO_SOCKETS = "this kernel has no CAN sockets (AF_CAN)"  # what EAFNOSUPPORT of socketcan means


def check_interface(name: str) -> None:
    """InputError if python-can has no such interface."""
    if name not in can.VALID_INTERFACES:
        known = sorted(can.VALID_INTERFACES)
        raise InputError(f"--interface {name}: unknown{nearest(name, known)}; known are {', '.join(known)}")


def flagged(message: can.Message) -> int:
    """The identifier of a message with the kernel's flags."""
    identifier = message.arbitration_id | (EFF_FLAG if message.is_extended_id else 0)
    return identifier | (RTR_FLAG if message.is_remote_frame else 0) | (ERR_FLAG if message.is_error_frame else 0)
