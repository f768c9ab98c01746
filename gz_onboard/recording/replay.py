"""``gz-onboard replay``: send a recorded log onto a bus, in its own timing.

Each frame has its place on an absolute schedule against the monotonic clock, so delays do not add up: a late frame is
sent at once, and the ones behind it are on time again.
"""

from __future__ import annotations

import argparse
import errno
import socket
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.errors import INTERRUPTED, OK, InputError, nearest
from gz_onboard.events import ERR_FLAG, TRANSMITTED, Frame
from gz_onboard.options import add_shared
from gz_onboard.progress import progress_bar
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.logs import log_suffix, read_log
from gz_onboard.recording.readers.contents import LogDamage

if TYPE_CHECKING:
    import can

SLOWEST = 1e-3  # a second in a quarter of an hour
Send = Callable[[Frame], bool]
"""Puts one frame on the bus; False if it could not."""

_FULL_WAIT_S = 0.001
_FULL_ATTEMPTS = 1000
_EARLY_NS = 50_000  # sleeping takes as long: a frame due within this is sent now
_LOOP_GAP_S = 0.001
_PROGRESS_NS = 500_000_000


@dataclass
class Sent:
    """Numbers of frames, duration [s] and largest delay of a frame [s] of a replay."""

    sent: int = 0
    failed: int = 0
    skipped: int = 0
    duration_s: float = 0.0
    worst_lateness_s: float = 0.0

    def __str__(self) -> str:
        return (
            f"{self.sent} frames in {self.duration_s:.1f} s, at worst {self.worst_lateness_s * 1e3:.1f} ms late; "
            f"{self.failed} could not be sent, {self.skipped} left out"
        )


def replay(
    batches: Iterable[Sequence[Frame]],
    send: Send,
    speed: float = 1.0,
    summary: Sent | None = None,
    progress: Callable[[float], None] | None = None,
) -> Sent:
    """Send the frames at the times they have in the log, `speed` times as fast; 0: without waiting.

    progress is called about twice a second with the seconds of log sent. A `summary` that is given is added to,
    and is up to date when KeyboardInterrupt ends the replay.
    """
    summary = summary or Sent()
    begin_ns = shown_ns = time.monotonic_ns()
    before_s = summary.duration_s
    first_ns: int | None = None
    try:
        for frame in chain.from_iterable(batches):
            first_ns = frame[0] if first_ns is None else first_ns
            if speed:
                due_ns = begin_ns + round((frame[0] - first_ns) / speed)
                while (early_ns := due_ns - time.monotonic_ns()) > _EARLY_NS:
                    # In short sleeps, so that Ctrl-C is heard and progress shown in a long gap.
                    time.sleep(min(early_ns, _PROGRESS_NS) * 1e-9)
                summary.worst_lateness_s = max(summary.worst_lateness_s, -early_ns * 1e-9)
            if send(frame):
                summary.sent += 1
            else:
                summary.failed += 1
            if progress and time.monotonic_ns() - shown_ns > _PROGRESS_NS:
                shown_ns = time.monotonic_ns()
                progress((frame[0] - first_ns) * 1e-9)
    finally:
        summary.duration_s = before_s + (time.monotonic_ns() - begin_ns) * 1e-9
    return summary


def bus_sender(*buses: can.BusABC) -> Send:
    """Sends by python-can, on one bus, or on the bus of the frame's channel.

    Waits for room in a full queue; a bus that is down loses frames, as a bus does.
    """
    from gz_onboard.can.python_can import can
    from gz_onboard.recording.readers.python_can import message_of

    def send(frame: Frame) -> bool:
        bus = buses[frame[3] & ~TRANSMITTED] if len(buses) > 1 else buses[0]
        for _ in range(_FULL_ATTEMPTS):
            try:
                bus.send(message_of(frame))
                return True
            except (can.CanError, OSError) as error:
                if getattr(error, "error_code", getattr(error, "errno", None)) not in (errno.ENOBUFS, errno.EAGAIN):
                    return False
            time.sleep(_FULL_WAIT_S)
        return False

    return send


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``gz-onboard replay``."""
    add_shared(parser, "log")
    add_shared(parser, "--interface")
    channel = (
        "where to send (default: %(default)s, so that no recording reaches a vehicle unasked); several by commas: the "
        "log's channels 0, 1, ... in this order"
    )
    add_shared(parser, "--channel", default="vcan0", help=channel)
    parser.add_argument(
        "--speed", type=float, default=1.0, help="speed as a factor (default: %(default)g); 0: as fast as possible"
    )
    parser.add_argument("--loop", action="store_true", help="start again at the end, until interrupted")
    add_shared(parser, "--from", "--to")
    everything = "of our own logs also send the frames that were sent, not received, back then"
    parser.add_argument("--all", action="store_true", help=everything)
    add_shared(parser, "--quiet")


def run(arguments: argparse.Namespace) -> int:
    """Run ``gz-onboard replay``: 0, or 130 when interrupted. Raises InputError for what cannot be used."""
    if arguments.speed and not SLOWEST <= arguments.speed < float("inf"):
        raise InputError(
            f"--speed {arguments.speed:g}: must be 0 (as fast as possible) or a factor of {SLOWEST:g} or more"
        )
    channels = [name for name in arguments.channel.split(",") if name]
    if not channels:
        raise InputError("--channel: no channel is named")
    damages: list[LogDamage] = []
    summary, status = Sent(), OK
    frames = _sendable(arguments, len(channels), summary, damages)  # a missing log is named before a missing bus
    with ExitStack() as buses, progress_bar(lambda: None, quiet=arguments.quiet) as display:
        send = bus_sender(*(buses.enter_context(_open_bus(arguments.interface, name)) for name in channels))

        def show(seconds: float) -> None:
            display.step(f"{int(seconds) // 60}:{seconds % 60:04.1f} of the log sent")

        try:
            for _ in count() if arguments.loop else range(1):
                replay(frames.batches(), send, arguments.speed, summary, show)
                time.sleep(_LOOP_GAP_S)
        except KeyboardInterrupt:
            status = INTERRUPTED
    for text in dict.fromkeys(map(str, damages)):
        print(text, file=sys.stderr)
    print(f"replayed {arguments.log}: {summary}")
    return status


def _sendable(arguments: argparse.Namespace, channels: int, summary: Sent, damages: list[LogDamage]) -> FrameColumns:
    """Read the frames of the log that can be sent on so many channels; the others are counted in `summary`.

    Raises InputError for a missing log, and if there are none.
    """
    log: Path = arguments.log
    frames = read_log(log, on_damage=damages.append)
    frames = frames.between(*log_section(log, frames, arguments.start, arguments.end))
    if log_suffix(log) == ".mcap" and not arguments.all:
        frames = frames[frames.channel & TRANSMITTED == 0]
    sendable = frames.identifier & ERR_FLAG == 0  # no host can send an error frame
    if channels > 1:
        sendable &= frames.bus < channels
    summary.skipped = int((~sendable).sum())
    if not sendable.any():
        raise InputError(f"{log}: no frames to send in the chosen part")
    return frames[sendable]


def log_section(log: Path, frames: FrameColumns, start_s: float, end_s: float | None) -> tuple[int | None, int | None]:
    """--from and --to [s from the first frame] as times [ns]; InputError if they are none, or there is no frame."""
    if end_s is not None and not end_s > start_s:
        raise InputError(f"--to {end_s:g} s: must be after --from {start_s:g} s")
    if not start_s and end_s is None:
        return None, None
    if not len(frames):
        raise InputError(f"{log}: no frames in this log")
    first_ns = int(frames.time_ns[0])
    return first_ns + round(start_s * 1e9), None if end_s is None else first_ns + round(end_s * 1e9)


def _open_bus(interface: str, name: str) -> can.BusABC:
    from gz_onboard.can.channel import NO_SOCKETS
    from gz_onboard.can.python_can import can, check_interface, open_bus

    check_interface(interface)
    options = {"fd": True} if interface == "socketcan" else {}
    try:
        return open_bus(interface, name, **options)
    except (OSError, can.CanError, ImportError, ValueError) as error:
        there = sorted(name for _, name in socket.if_nameindex()) if interface == "socketcan" else []
        why = NO_SOCKETS if getattr(error, "errno", None) == errno.EAFNOSUPPORT else error
        raise InputError(f"--channel {name}: cannot be opened by {interface}: {why}{nearest(name, there)}") from None
