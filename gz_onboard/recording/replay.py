"""``gz-onboard replay``: puts a recorded log onto a bus, in its own timing.

Each frame has its place on an absolute schedule against the monotonic clock, so delays do not add up: a frame that
is late is sent at once, and the ones after it are on time again.
"""

from __future__ import annotations

import argparse
import errno
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard.errors import INTERRUPTED, OK, InputError, nearest
from gz_onboard.events import ERR_FLAG, TRANSMITTED, Frame
from gz_onboard.options import add_shared
from gz_onboard.progress import progress_bar
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.logs import log_suffix, logs_among, read_log
from gz_onboard.recording.readers.contents import LogDamage

if TYPE_CHECKING:
    import can

SLOWEST = 1e-3  # a second in a quarter of an hour
Send = Callable[[Frame], bool]
"""Puts one frame on the bus; False if it could not."""

_CLASSIC = struct.Struct("=IB3x8s")  # struct can_frame
_FD = struct.Struct("=IBB2x64s")  # struct canfd_frame
_SOL_CAN_RAW, _CAN_RAW_FILTER, _CAN_RAW_FD_FRAMES = 101, 1, 5
_FULL_WAIT_S = 0.001
_FULL_ATTEMPTS = 1000
_EARLY_NS = 50_000
"""Nearer than this a frame is sent now: sleeping takes as long."""
_LOOP_GAP_NS = 1_000_000
_PROGRESS_NS = 500_000_000


@dataclass
class Sent:
    """Numbers of frames sent, the time it took [s], and the greatest delay of a frame [s]."""

    sent: int = 0
    failed: int = 0
    skipped: int = 0
    loops: int = 0
    duration_s: float = 0.0
    worst_lateness_s: float = 0.0

    def __str__(self) -> str:
        text = f"{self.sent} frames in {self.duration_s:.1f} s, at worst {self.worst_lateness_s * 1e3:.1f} ms late"
        if self.loops > 1:
            text += f", {self.loops} rounds"
        if self.failed:
            text += f"; {self.failed} frames could not be sent"
        if self.skipped:
            text += f"; {self.skipped} frames left out"
        return text


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
    begin_ns = time.monotonic_ns()
    before_s = summary.duration_s
    first_ns: int | None = None
    told_ns = begin_ns
    now_ns = begin_ns
    worst_ns = round(summary.worst_lateness_s * 1e9)
    try:
        for batch in batches:
            for frame in batch:
                if first_ns is None:
                    first_ns = frame[0]
                if speed:
                    due_ns = begin_ns + round((frame[0] - first_ns) / speed)
                    if due_ns - now_ns > _EARLY_NS:
                        now_ns = time.monotonic_ns()
                        while due_ns - now_ns > _EARLY_NS:
                            # In short sleeps, so that Ctrl-C is heard and progress shown in a long gap.
                            time.sleep(min(due_ns - now_ns, _PROGRESS_NS) * 1e-9)
                            now_ns = time.monotonic_ns()
                    elif now_ns - due_ns > worst_ns:
                        worst_ns = now_ns - due_ns
                if send(frame):
                    summary.sent += 1
                else:
                    summary.failed += 1
                now_ns = time.monotonic_ns()
                if progress and now_ns - told_ns > _PROGRESS_NS:
                    told_ns = now_ns
                    progress((frame[0] - first_ns) * 1e-9)
    finally:
        summary.duration_s = before_s + (time.monotonic_ns() - begin_ns) * 1e-9
        summary.worst_lateness_s = worst_ns * 1e-9
    return summary


def socket_sender(raw: socket.socket) -> Send:
    """Sends through a raw CAN socket."""
    raw.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, b"")  # nothing is received here, so nothing need be queued
    raw.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)

    def put(frame: Frame) -> None:
        _, identifier, data, _ = frame
        if len(data) <= 8:
            raw.send(_CLASSIC.pack(identifier, len(data), data))
        else:
            raw.send(_FD.pack(identifier, len(data), 0, data))

    return _patient(put)


def bus_sender(bus: can.BusABC) -> Send:
    """Sends through any of python-can's interfaces."""
    from gz_onboard.recording.readers.python_can import message_of

    return _patient(lambda frame: bus.send(message_of(frame, with_time=False)))


def _patient(put: Callable[[Frame], None]) -> Send:
    """Sends by `put`. A full queue is waited for; a bus that is down loses frames, as a bus does."""
    from gz_onboard.bus._can import can

    def send(frame: Frame) -> bool:
        for _ in range(_FULL_ATTEMPTS):
            try:
                put(frame)
                return True
            except (can.CanError, OSError) as error:
                if getattr(error, "error_code", getattr(error, "errno", None)) not in (errno.ENOBUFS, errno.EAGAIN):
                    return False
            time.sleep(_FULL_WAIT_S)
        return False

    return send


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``gz-onboard replay``."""
    logs = "log, or a folder of them, which are sent one after the other by name"
    add_shared(parser, "log", help=logs)
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
    damages: list[LogDamage] = []
    parts = _parts(arguments, damages)
    names = [name for name in arguments.channel.split(",") if name]
    buses = _open_buses(arguments.interface, names)
    summary = Sent()
    status = OK
    try:
        senders = [_sender(bus) for bus in buses]
        send = senders[0] if len(senders) == 1 else _by_channel(senders)
        with progress_bar(lambda: None, quiet=arguments.quiet) as display:

            def show(log: Path, seconds: float) -> None:
                what = "the log" if len(parts) == 1 else log.name
                display.step(f"{int(seconds) // 60}:{seconds % 60:04.1f} of {what} sent")

            while True:
                summary.loops += 1
                for log, frames in parts:
                    kept = _sendable(frames, len(senders))
                    summary.skipped += len(frames) - len(kept)
                    replay(kept.batches(), send, arguments.speed, summary, partial(show, log))
                if not summary.sent and not summary.failed:
                    raise InputError(f"{arguments.log}: no frames to send in the chosen part")
                if not arguments.loop:
                    break
                time.sleep(_LOOP_GAP_NS * 1e-9)
    except KeyboardInterrupt:
        status = INTERRUPTED
    finally:
        for bus in buses:
            bus.shutdown()
    for text in dict.fromkeys(map(str, damages)):
        print(text, file=sys.stderr)
    print(f"replayed {arguments.log}: {summary}")
    return status


def _parts(arguments: argparse.Namespace, damages: list[LogDamage]) -> list[tuple[Path, FrameColumns]]:
    """Read the frames to be sent of each log, before the bus is opened. Raises InputError for a missing log."""
    logs = logs_among([arguments.log])
    if len(logs) > 1 and (arguments.start or arguments.end is not None):
        raise InputError(f"--from and --to: apply to one log, and {arguments.log} holds {len(logs)}; give one of them")
    parts = []
    for log in logs:
        frames = read_log(log, on_damage=damages.append)
        frames = frames.between(*log_section(log, frames, arguments.start, arguments.end))
        if log_suffix(log) == ".mcap" and not arguments.all:
            frames = frames[frames.channel & TRANSMITTED == 0]
        parts.append((log, frames))
    return parts


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


def _sendable(frames: FrameColumns, channels: int) -> FrameColumns:
    """Leave out error frames, which no host can send, and frames of further channels."""
    sendable = frames.identifier & ERR_FLAG == 0
    return frames[sendable if channels == 1 else sendable & (frames.bus < channels)]


def _by_channel(senders: list[Send]) -> Send:
    def send(frame: Frame) -> bool:
        return senders[frame[3] & ~TRANSMITTED](frame)

    return send


def _sender(bus: can.BusABC) -> Send:
    raw = getattr(bus, "socket", None)
    if isinstance(raw, socket.socket) and raw.family == getattr(socket, "AF_CAN", None):
        return socket_sender(raw)
    return bus_sender(bus)


def _open_buses(interface: str, names: list[str]) -> list[can.BusABC]:
    from gz_onboard.bus._can import can, check_interface, open_bus
    from gz_onboard.bus.socketcan import NO_SOCKETS

    check_interface(interface)
    buses: list[can.BusABC] = []
    for name in names:
        try:
            buses.append(open_bus(interface, name))
        except (OSError, can.CanError, ImportError, ValueError) as error:
            for bus in buses:
                bus.shutdown()
            there = sorted(name for _, name in socket.if_nameindex()) if interface == "socketcan" else []
            why = NO_SOCKETS if getattr(error, "errno", None) == errno.EAFNOSUPPORT else error
            raise InputError(
                f"--channel {name}: cannot be opened by {interface}: {why}{nearest(name, there)}"
            ) from None
    if not buses:
        raise InputError("--channel: no channel is named")
    return buses
