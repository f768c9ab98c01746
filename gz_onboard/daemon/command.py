"""``gz-onboard run``: options, locks and closing summary of the daemon."""

from __future__ import annotations

import argparse
import fcntl
import logging
import os
import signal
import socket
import sys
from contextlib import ExitStack
from pathlib import Path

from gz_onboard.can.channel import CanChannel
from gz_onboard.can.layout import identifiers_of
from gz_onboard.can.recorder import LogLimits, Recorder
from gz_onboard.daemon.control import SOCKET
from gz_onboard.daemon.loop import Daemon, foreign_text, status_text
from gz_onboard.errors import FAILED, OK, InputError, not_an_input, shown, writing
from gz_onboard.estimator.consumption import CONSUMPTION
from gz_onboard.model.effect import ROOT
from gz_onboard.options import CHANNEL, add_shared, number
from gz_onboard.pipeline import Pipeline, dbc_texts, lacking, range_publisher
from gz_onboard.routes.route import read_route
from gz_onboard.state import state_file
from gz_onboard.vehicle import Vehicle, read_vehicle

LOG_TOTAL_MB = 1e-3, 1e9  # bounds of the option
LOG_FILE_BYTES, LOG_FILE_S = 64_000_000, 6 * 3600.0  # at which a new log begins

log = logging.getLogger("gz-onboard")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard run``."""
    add_shared(parser, "--vehicle", "--vehicle-id", "--interface")
    channels = f"channel of the vehicle's bus (default: {CHANNEL}); repeat for a second bus"
    add_shared(parser, "--channel", action="append", default=None, help=channels)
    add_shared(parser, "--payload", help="mass of rider and luggage (default: from the vehicle file)")
    add_shared(parser, "--effects", "--filter", "--route")
    logs, states, runtime = map(_directory, ("LOGS_DIRECTORY", "STATE_DIRECTORY", "RUNTIME_DIRECTORY"))
    add = parser.add_argument
    add("--log-dir", type=Path, default=logs, metavar="DIR", help="folder for MCAP logs (default: none)")
    add(
        "--log-total-mb",
        type=number("--log-total-mb", *LOG_TOTAL_MB, "MB"),
        default=2048,
        metavar="MB",
        help="delete the oldest logs beyond this size (default: %(default)g)",
    )
    add("--state-dir", type=Path, default=states, metavar="DIR", help="folder for the saved state (default: none)")
    add(
        "--rider",
        type=_rider,
        metavar="NAME",
        help="name of the rider; habits are learned per rider (default: the last one, or a signal of the bus)",
    )
    add(
        "--control-socket",
        type=Path,
        default=runtime and runtime / SOCKET.name,
        metavar="PATH",
        help="socket on which `gz-onboard route` gives a route (default: none)",
    )
    add("--write-dbc", type=Path, metavar="FILE", help="write the DBC file of the vehicle's range frames, and end")
    add("--all-frames", action="store_true", help="also receive, count and log identifiers not in the DBC files")


def _rider(text: str) -> str:
    if not 1 <= len(text) <= (most := CONSUMPTION.max_name_letters):
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
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"--channel {twice[0]}: given twice; each of its frames would come twice")
    # A daemon runs unattended: the vehicle file's own code runs only if it is root's.
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
    route = read_route(arguments.route) if arguments.route else None
    missing = lacking(vehicle)
    recorder = None
    if arguments.log_dir:
        metadata = {"vehicle_key": vehicle.key, "lacking": " ".join(missing)}
        if arguments.payload is not None:
            metadata["payload_kg"] = f"{arguments.payload:g}"
        total = round(arguments.log_total_mb * 1e6)
        limits = LogLimits(max_file_bytes=LOG_FILE_BYTES, max_age_s=LOG_FILE_S, max_total_bytes=total)
        recorder = Recorder(arguments.log_dir, vehicle.name, metadata, dbc_texts(vehicle), limits)
    identifiers = None if arguments.all_frames else identifiers_of(vehicle.mapping)
    if identifiers is not None:  # our own too: another sender of them is reported
        identifiers += sorted(vehicle.publisher().identifiers)
    channels = [CanChannel(arguments.interface, name, index, identifiers) for index, name in enumerate(names)]
    for channel in channels:
        channel.open()
    if missing:
        log.info("%s has wider intervals, because it has no sensors for: %s", vehicle.name, ", ".join(missing))
    daemon = Daemon(
        vehicle,
        channels,
        recorder,
        state_file(arguments.state_dir, vehicle.name) if arguments.state_dir else None,
        filter_name=arguments.filter,
        control_socket=arguments.control_socket,
        rider=arguments.rider or "",
    )
    daemon.control.start()
    if route:
        daemon.control.give(route)
    signal.signal(signal.SIGTERM, daemon.stop)
    signal.signal(signal.SIGINT, daemon.stop)
    daemon.run()
    print("\n".join(summary(daemon.pipeline)))
    for path in recorder.paths if recorder else ():
        if path.exists():
            print(f"log {path}")
    if not daemon.finished:  # a thread may still wait for its disk: the interpreter would abort over its files
        sys.stdout.flush()
        logging.shutdown()
        os._exit(FAILED)
    return OK


def _lock(locks: ExitStack, interface: str, names: list[str], state_dir: Path | None) -> None:
    """Hold the channels and the state folder until `locks` is left, or the process ends.

    InputError if another daemon has one of them.
    """
    # Abstract socket names belong to the network namespace, as the interfaces do; a virtual bus is the process' own.
    for name in names if interface != "virtual" else ():
        holder = locks.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
        try:
            holder.bind(f"\0gz-onboard:{interface}:{name}"[:107])
        except OSError as error:
            why = "another gz-onboard run has it; two would send the same identifiers"
            raise InputError(f"--channel {name}: {why}") from error
    if state_dir is None:
        return
    try:
        state_dir.mkdir(parents=True, exist_ok=True)
        folder = os.open(state_dir, os.O_RDONLY | os.O_DIRECTORY)
        locks.callback(os.close, folder)
        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise InputError(f"--state-dir {state_dir}: another gz-onboard run uses it; give each its own") from error
    except OSError as error:  # no state can be saved there either, and the daemon reports that
        log.warning("--state-dir %s: cannot be locked: %s", state_dir, error.strerror)


def summary(pipeline: Pipeline) -> list[str]:
    """Describe the received frames, the last estimate that had a range, and the last of all."""
    last, known, counts = pipeline.last, pipeline.last_known, pipeline.counts()
    lines = [
        f"received {pipeline.codec.received} frames; dropped {counts.dropped}, lost {counts.lost}, "
        f"implausible {counts.implausible}, unknown identifiers {counts.unknown}"
    ]
    if pipeline.foreign:
        lines.append(foreign_text(pipeline))
    if last and known and known is not last:
        lines.append(f"{last.time - known.time:.1f} s before the end {status_text(pipeline, known)}")
    if last:
        lines.append(f"at the end {status_text(pipeline, last)}")
    return lines
