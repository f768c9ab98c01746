"""``gz-onboard run``: the daemon's options, its locks, and what it prints when it ends."""

from __future__ import annotations

import argparse
import errno
import fcntl
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from gz_onboard.bus.channel import CanChannel
from gz_onboard.bus.codec import known_identifiers
from gz_onboard.bus.recorder import Limits, Recorder
from gz_onboard.constants import HOUR
from gz_onboard.daemon.control import Control
from gz_onboard.daemon.keeper import state_file
from gz_onboard.daemon.loop import TICK, Daemon, foreign_text, state_text
from gz_onboard.daemon.route import SOCKET
from gz_onboard.errors import FAILED, OK, InputError, not_an_input, shown, writing
from gz_onboard.estimator.consumption import CONSUMPTION
from gz_onboard.options import CHANNEL, add_shared, number
from gz_onboard.physics.trust import ROOT
from gz_onboard.pipeline import TICK_NS, Pipeline, dbc_texts, lacking, range_publisher
from gz_onboard.routes.ahead import read_ahead
from gz_onboard.vehicle import Vehicle, read_vehicle

LOCK_S = 3.0  # to wait for one that is ending
SHORTEST_TICK = 0.005  # s
LOG_LIMITS = 1e-3, 1e9  # MB, or h

log = logging.getLogger("gz-onboard")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard run``."""
    add_shared(parser, "--vehicle", "--vehicle-id", "--interface")
    add = parser.add_argument
    channel = f"channel (default: {CHANNEL}), the vehicle's bus; twice, for a second bus"
    add_shared(parser, "--channel", action="append", default=None, help=channel)
    add_shared(parser, "--payload", help="mass of rider and luggage (default: from the vehicle file)")
    add_shared(parser, "--effects", "--filter", "--route")
    add(
        "--log-dir",
        type=Path,
        default=_directory("LOGS_DIRECTORY"),
        metavar="DIR",
        help="folder for MCAP logs (default: none)",
    )
    for option, default, unit, text in (
        ("--log-file-mb", 64, "MB", "begin a new log at this size"),
        ("--log-file-hours", 6, "h", "or at this age"),
        ("--log-total-mb", 2048, "MB", "delete the oldest beyond this"),
    ):
        limit = number(option, *LOG_LIMITS, unit)
        add(option, type=limit, default=default, metavar=unit.upper(), help=f"{text} (default: %(default)g)")
    add(
        "--state-dir",
        type=Path,
        default=_directory("STATE_DIRECTORY"),
        metavar="DIR",
        help="folder for the saved state (default: none)",
    )
    rider = "who rides: what is usual is learned of each rider (default: whoever rode last, or a signal of the bus)"
    add("--rider", type=_rider, metavar="NAME", help=rider)
    runtime = _directory("RUNTIME_DIRECTORY")
    add(
        "--control-socket",
        type=Path,
        default=runtime / SOCKET.name if runtime else None,
        metavar="PATH",
        help="where `gz-onboard route` gives a route (default: none)",
    )
    write_dbc = "write the DBC file of the vehicle's range frames, for whoever reads them, and end"
    add("--write-dbc", type=Path, metavar="FILE", help=write_dbc)
    add("--all-frames", action="store_true", help="take in, count and log identifiers that the DBC files do not know")
    tick = number("--tick", SHORTEST_TICK, TICK_NS * 1e-9, counted="s")
    add("--tick", type=tick, default=TICK, metavar="S", help="read the bus this often (default: %(default)g)")


def _rider(text: str) -> str:
    most = CONSUMPTION.most_name_letters
    if not text or len(text) > most:
        raise argparse.ArgumentTypeError(f"must be a name of 1 to {most} letters, is {shown(text)}")
    return text


def _directory(variable: str) -> Path | None:
    value = os.environ.get(variable, "").split(":")[0]  # systemd gives several, colon-separated
    return Path(value) if value else None


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard run``."""
    logging.basicConfig(
        level=logging.INFO, format="%(message)s" if "JOURNAL_STREAM" in os.environ else "%(asctime)s %(message)s"
    )
    logging.getLogger("can").setLevel(logging.WARNING)
    names = arguments.channel or [CHANNEL]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"--channel {name}: given twice; each of its frames would come twice")
    # Nobody watches a daemon: the vehicle file's own code runs only if it is root's.
    vehicle = read_vehicle(arguments.vehicle, arguments.payload, arguments.effects, {ROOT}, arguments.vehicle_id)
    if not vehicle.mapping.reads_frames:
        raise vehicle.error("dbc is missing: the daemon reads frames")
    if arguments.write_dbc:
        not_an_input([arguments.write_dbc], [vehicle.file, *vehicle.mapping.dbc_files, vehicle.range_dbc])
        content = range_publisher(vehicle).dbc()
        with writing(arguments.write_dbc):
            arguments.write_dbc.write_bytes(content)
        return OK
    with ExitStack() as locks:
        _lock(locks, arguments.interface, names, arguments.state_dir)
        return _run(arguments, vehicle, names)


def _run(arguments: argparse.Namespace, vehicle: Vehicle, names: list[str]) -> int:
    route = read_ahead(arguments.route)[1] if arguments.route else None
    recorder = None
    if arguments.log_dir:
        payload = {} if arguments.payload is None else {"payload_kg": f"{arguments.payload:g}"}
        recorder = Recorder(
            arguments.log_dir,
            vehicle.name,
            metadata={"vehicle_key": vehicle.key, "lacking": " ".join(lacking(vehicle)), **payload},
            attachments=dbc_texts(vehicle),
            limits=Limits(
                max_file_bytes=round(arguments.log_file_mb * 1e6),
                max_age_s=arguments.log_file_hours * HOUR,
                max_total_bytes=round(arguments.log_total_mb * 1e6),
            ),
        )
    saved = state_file(arguments.state_dir, vehicle.name) if arguments.state_dir else None
    wanted = None if arguments.all_frames else known_identifiers(vehicle.mapping)
    if wanted is not None:  # who else sends on our own identifiers is to be told
        wanted += sorted(vehicle.publisher().identifiers)
    channels = [CanChannel(arguments.interface, name, index, wanted) for index, name in enumerate(names)]
    for channel in channels:
        channel.open()
    if never := lacking(vehicle):
        log.info("%s lacks sensors, which makes its intervals wider: %s", vehicle.name, ", ".join(never))
    daemon = Daemon(vehicle, channels, recorder, saved, arguments.filter, arguments.tick)
    daemon.rider = arguments.rider or ""
    daemon.control = Control(arguments.control_socket, lambda: daemon.pipeline)
    daemon.control.start()
    if route:
        daemon.control.give(route)
    signal.signal(signal.SIGTERM, daemon.stop)
    signal.signal(signal.SIGINT, daemon.stop)
    daemon.run()
    _summary(daemon)
    if not daemon.finished:  # a thread may still wait for its disk: the interpreter would abort over its files
        sys.stdout.flush()
        logging.shutdown()
        os._exit(FAILED)
    return OK


def _lock(locks: ExitStack, interface: str, names: list[str], state_dir: Path | None) -> None:
    """Hold the channels and the state directory until `locks` is left, or the process ends, however it does.

    InputError if another daemon has one of them and does not give it back soon, as one that is being restarted does.
    """
    until = time.monotonic() + LOCK_S
    # The names of abstract sockets are those of the network namespace, as the interfaces are; a virtual bus is the
    # process' own.
    for name in names if interface != "virtual" else ():
        holder = locks.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        address = f"\0gz-onboard:{interface}:{name}"[:107]
        if not _retried(lambda holder=holder, address=address: holder.bind(address), until):  # type: ignore[misc]
            raise InputError(f"--channel {name}: another gz-onboard run has it; two would send the same identifiers")
    if state_dir is None:
        return
    try:
        state_dir.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(state_dir, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:  # then nothing can be saved there either, and the daemon says so
        return
    locks.callback(os.close, descriptor)
    if not _retried(lambda: fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB), until):
        raise InputError(f"--state-dir {state_dir}: another gz-onboard run uses it; give each its own")


def _retried(take: Callable[[], None], until: float) -> bool:
    """Take a lock, again and again `until` a monotonic time [s]; False if another holds it. True without locks."""
    while True:
        try:
            take()
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EWOULDBLOCK):
                log.warning("without a lock: %s", error)
                return True
        else:
            return True
        if time.monotonic() > until:
            return False
        time.sleep(0.1)


def _summary(daemon: Daemon) -> None:
    """What a person wants to read when the daemon ends."""
    print("\n".join(summary(daemon.pipeline)))
    for path in [path for path in daemon.recorder.paths if path.exists()] if daemon.recorder else []:
        print(f"log {path}")


def summary(pipeline: Pipeline) -> list[str]:
    """What came, the last numbers and the last state, as they were sent: numbers may be older than the state."""
    last, known, counts = pipeline.last, pipeline.last_known, pipeline.counts()
    lines = [
        f"received {pipeline.codec.received} frames; dropped {counts.dropped}, lost {counts.lost}, "
        f"implausible {counts.implausible}, unknown identifiers {counts.unknown}"
    ]
    if pipeline.foreign:
        lines.append(foreign_text(pipeline))
    if last is None:
        return lines
    ago = ""
    if known and known.soc is not None and known.soc_sd is not None:
        _, *numbers = pipeline.publisher.reported(known)
        remaining, p10, p90 = ("–" if value is None else f"{value:.1f}" for value in numbers)
        lines += [
            f"state of charge {100 * known.soc:.1f} % ± {100 * known.soc_sd:.1f} %, "
            f"ridden {last.distance / 1000:.2f} km",
            f"range {remaining} km ({p10} to {p90})",
        ]
        ago = f"; the figures above are from {last.time - known.time:.1f} s earlier" if known is not last else ""
    state = pipeline.publisher.reported(last)[0]
    return [*lines, f"state at the end {state_text(state, last.reasons)}{ago}"]
