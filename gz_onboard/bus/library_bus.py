"""A bus of any of python-can's interfaces. Importing this imports python-can."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING, Any

from gz_onboard.bus._can import MULTICAST, can, check_interface, flagged, open_bus
from gz_onboard.errors import InputError
from gz_onboard.events import EFF_FLAG, ERR_FLAG, RTR_FLAG, Frame

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

MAX_ECHOES = 200


class LibraryBus:
    """An open bus. InputError for an unknown interface, OSError for a bus that is down.

    identifiers: the only ones to be received, if given; options: for python-can.
    """

    def __init__(
        self, interface: str, channel: str, identifiers: Sequence[int] | None, options: Mapping[str, Any]
    ) -> None:
        check_interface(interface)
        self.overflow = 0
        self._wanted = None if identifiers is None else {*identifiers, *(ERR_FLAG | bit for bit in (0, EFF_FLAG))}
        self._echoing = interface == MULTICAST or bool(options.get("receive_own_messages"))
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=MAX_ECHOES)  # frames of our own that will come back
        try:
            self._bus: Any = open_bus(interface, channel, **options)
        except (can.CanInterfaceNotImplementedError, ValueError, ImportError) as error:
            raise InputError(f"--interface {interface}: {error}") from error
        except can.CanError as error:
            raise _os_error(error) from error

    def drain(self, frames: list[Frame], index: int, limit: int, until: float) -> bool:
        """Append the waiting frames, at most `limit`, until a monotonic time [s]; whether more may be waiting."""
        for _ in range(limit):
            if time.monotonic() > until:
                break
            try:
                message = self._bus.recv(0)
            except can.CanError as error:
                raise _os_error(error) from error
            if message is None:
                return False
            identifier, data = flagged(message), bytes(message.data)
            # Filtered here: with filters of its own python-can's recv(0) returns None for each frame it rejects.
            unwanted = self._wanted is not None and identifier & ~RTR_FLAG not in self._wanted
            if not unwanted and not self._is_echo(identifier, data):
                # Only the kernel's time stamps share a clock; other interfaces have clocks of their own.
                frames.append((time.time_ns(), identifier, data, index))
        return True

    def _is_echo(self, identifier: int, data: bytes) -> bool:
        """Whether that is a frame of our own, which comes back once."""
        if (identifier, data) not in self._sent:
            return False
        self._sent.remove((identifier, data))
        return True

    def send(self, identifier: int, data: bytes) -> None:
        """Send a frame. OSError if the bus does not take it now."""
        extended = bool(identifier & EFF_FLAG)
        try:
            self._bus.send(can.Message(arbitration_id=identifier & 0x1FFFFFFF, data=data, is_extended_id=extended))
        except can.CanError as error:
            raise _os_error(error) from error
        if self._echoing:
            self._sent.append((identifier, data))

    def close(self) -> None:
        """Shut the bus down. OSError."""
        try:
            self._bus.shutdown()
        except can.CanError as error:
            raise _os_error(error) from error


def _os_error(error: can.CanError) -> OSError:
    code = error.error_code
    return OSError(str(error)) if code is None else OSError(code, str(error))
