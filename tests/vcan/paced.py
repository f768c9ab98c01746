"""``gz-onboard`` with its clock in the hands of a test: an hour of the bus's time takes seconds of the machine's.

    python -m tests.vcan.paced FD run --channel vcan0 ...

FD is a socket of packets. On it the loop says that it waits for its next round, and reads until when it has waited and
when the frames of that time came. All else is as it always is; what waits for a disk or for a client keeps the
machine's clock.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
from collections.abc import Sequence
from unittest.mock import patch

from gz_onboard.can.channel import CanChannel
from gz_onboard.cli import main
from gz_onboard.events import Frame
from tests.support import EPOCH

WAITING = b"waiting"
LARGEST = 1 << 16  # bytes of a packet
PATIENCE = 60.0  # s until frames that were sent have come


def packet(now_ns: int, stamps: Sequence[int]) -> bytes:
    """What the loop reads: the time, and that of each frame that was sent, in their order [ns]."""
    return struct.pack(f"={1 + len(stamps)}q", now_ns, *stamps)


class PacedClock:
    """Stands for the module `time` in the loop; it goes on only while the loop sleeps, and as far as it is told."""

    CLOCK_BOOTTIME = time.CLOCK_BOOTTIME
    process_time = staticmethod(time.process_time)
    thread_time = staticmethod(time.thread_time)

    def __init__(self, pace: socket.socket) -> None:
        self._pace = pace
        self._now_ns = 0
        self.stamps: list[int] = []
        self._read()

    def _read(self) -> None:
        text = self._pace.recv(LARGEST)
        if text:
            self._now_ns, *self.stamps = struct.unpack(f"={len(text) // 8}q", text)
        else:  # nobody keeps the time any more: the loop is to end
            time.sleep(0.01)

    def sleep(self, _seconds: float) -> None:
        self._pace.send(WAITING)
        self._read()

    def time_ns(self) -> int:
        return self._now_ns

    def time(self) -> float:
        return self._now_ns * 1e-9

    def clock_gettime_ns(self, _clock: int) -> int:
        return self._now_ns - EPOCH

    def clock_gettime(self, _clock: int) -> float:
        return (self._now_ns - EPOCH) * 1e-9

    monotonic = time


class PacedChannel(CanChannel):
    """A channel whose frames have come when the clock says; all that were sent are waited for."""

    clock: PacedClock

    def drain(self) -> list[Frame]:
        frames = super().drain()
        until = time.monotonic() + PATIENCE
        while len(frames) < len(self.clock.stamps) and time.monotonic() < until:
            time.sleep(0.001)
            frames += super().drain()
        stamped = [(at, *frame[1:]) for at, frame in zip(self.clock.stamps, frames, strict=True)]
        self.clock.stamps = []
        return stamped


def run(pace: socket.socket, arguments: Sequence[str]) -> int:
    """The command, with its loop paced."""
    PacedChannel.clock = clock = PacedClock(pace)
    with patch("gz_onboard.daemon.loop.time", clock), patch("gz_onboard.daemon.command.CanChannel", PacedChannel):
        return main(list(arguments))


if __name__ == "__main__":
    with socket.socket(fileno=int(sys.argv[1])) as given:
        sys.exit(run(given, sys.argv[2:]))
