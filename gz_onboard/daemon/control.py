"""The control socket, on which a navigation application or ``gz-onboard route`` gives the daemon a route or clears it.

A Unix stream socket. A request is one line of JSON, {"route": {...}}, {"route": null} or {"status": true}; so is the
answer, {"ok": true, ...} or {"error": "..."}. Each client has a thread, which checks the request and prepares the
route; the daemon's loop only switches to it. A bad request changes nothing.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from math import isfinite
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from gz_onboard.constants import WH
from gz_onboard.errors import OK, InputError, nearest, shown
from gz_onboard.estimator.route import PreparedRoute
from gz_onboard.events import Estimate
from gz_onboard.pipeline import Pipeline
from gz_onboard.routes.columns import MIN_ROWS, Columns
from gz_onboard.routes.route import ROUTE_COLUMNS, Route, read_route_columns, route_name, route_of

MAX_REQUEST_BYTES = 8_000_000  # twice a route of the most points with all columns
TIMEOUT_S = 5.0  # of each read and write
RETRY_S = 1.0  # after a client that could not be accepted
UMASK = 0o777 & ~0o660
LONGEST_NAME = 100
REQUESTS = ("route", "status")
SOCKET = Path("/run/gz-onboard/control")
ANSWER_S = 30.0  # for an answer: the daemon prepares a long route first
STATES = {"ON": "on it", "OFF": "not on it"}  # by `RouteState`

log = logging.getLogger("gz-onboard")


class Control:
    """Listens at `path` from `start` to `close`. pipeline: returns the daemon's present one."""

    def __init__(self, path: Path | None, pipeline: Callable[[], Pipeline]) -> None:
        self._path, self._pipeline = path, pipeline
        self._ready: SimpleQueue[PreparedRoute | None] = SimpleQueue()  # for the daemon's loop to take
        self._name: str | None = None
        self._socket: socket.socket | None = None
        self._closed = False

    def start(self) -> None:
        """Listen, if there is a path. InputError if that is impossible."""
        if self._path is None:
            return
        before = os.umask(UMASK)  # the socket is never accessible to others, not even for a moment
        try:
            if self._path.is_socket():  # of a daemon that has crashed: a running one holds the bus
                self._path.unlink()
            self._socket = socket.socket(socket.AF_UNIX)
            self._socket.bind(str(self._path))
            self._socket.listen()
        except OSError as error:
            raise InputError(f"{self._path}: cannot listen there: {error.strerror or error}") from error
        finally:
            os.umask(before)
        threading.Thread(target=self._accept, args=(self._socket,), name="control", daemon=True).start()

    def give(self, route: Route | None) -> None:
        """Prepare `route`, which may take seconds, for the daemon's loop to take; in any thread."""
        road = self._pipeline().estimator.route.prepare(route) if route else None
        self._name = route.name if route else None
        self._ready.put(road)

    def take(self) -> None:
        """Switch to the newest prepared route; called by the daemon's loop."""
        while not self._ready.empty():
            road = self._ready.get_nowait()
            self._pipeline().estimator.route.follow(road)
            log.info("route %s", "given" if road else "cleared")

    def close(self) -> None:
        """Stop listening."""
        self._closed = True
        if self._socket and self._path:
            self._path.unlink(missing_ok=True)
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes the thread that accepts clients
            self._socket.close()

    def _accept(self, listening: socket.socket) -> None:
        while True:
            try:
                client, _ = listening.accept()
                threading.Thread(target=self._converse, args=(client,), daemon=True).start()
            except (OSError, RuntimeError):  # closed; or too many open files or threads at the moment
                if self._closed:
                    return
                time.sleep(RETRY_S)

    def _converse(self, client: socket.socket) -> None:
        """Answer the one request of a client. A client that stalls or goes away is left."""
        with suppress(OSError), client, client.makefile("rwb") as stream:
            client.settimeout(TIMEOUT_S)
            line = stream.readline(MAX_REQUEST_BYTES + 1)
            try:
                answer = self.answer(line)
            except InputError as error:
                answer = {"error": str(error)}
            except Exception as error:  # the client learns that its request was not carried out
                log.exception("control socket")
                answer = {"error": f"failed: {error!r}"}
            stream.write(json.dumps(answer).encode() + b"\n")

    def answer(self, line: bytes) -> dict[str, object]:
        """Carry out a request and return the answer. InputError for a bad request."""
        if len(line) > MAX_REQUEST_BYTES:
            raise InputError(f"is longer than {MAX_REQUEST_BYTES} bytes")
        try:
            request = json.loads(line, parse_int=float)  # a float cannot have thousands of digits
        except (ValueError, RecursionError) as error:
            raise InputError(f"is not JSON: {error}") from error
        if not isinstance(request, dict) or len(request) != 1 or next(iter(request)) not in REQUESTS:
            found = shown(list(request) if isinstance(request, dict) else request)
            raise InputError(f"must be an object with one of {', '.join(REQUESTS)}, is {found}")
        if "status" in request:
            return {"ok": True, **self._status()}
        if request["route"] is None:
            self.give(None)
            return {"ok": True, "route": None}
        route = route_of_request(request["route"])
        self.give(route)
        return {"ok": True, "route": route.name, "length_m": round(route.length), "grade_known": route.grade_known}

    def _status(self) -> dict[str, object]:
        last = self._pipeline().last or Estimate(0.0)
        return {
            "route": self._name,
            "state": last.route_state.name,
            "along_m": last.route_along,
            "left_m": last.route_left,
            "energy_j": last.route_energy,
            "arrival_soc": last.arrival_soc,
            "arrival_soc_p10": last.arrival_soc_p10,
            "arrival_soc_p90": last.arrival_soc_p90,
            "battery_ends_after_m": last.battery_ends_after,
            "battery_ends_latitude": last.battery_ends_latitude,
            "battery_ends_longitude": last.battery_ends_longitude,
            "range_m": last.range,
        }


def route_of_request(request: object) -> Route:
    """Read the route in a request: an object of lists of numbers, named as the columns of a CSV, and maybe a ``name``.

    InputError names list and point.
    """
    if not isinstance(request, Mapping):
        raise InputError(f"route: must be an object of lists or null, is {shown(request)}")
    name = request.get("name", "route")
    columns = {column: numbers for column, numbers in request.items() if column != "name"}
    if not isinstance(name, str) or len(name) > LONGEST_NAME:
        raise InputError(f"route: name: must be a text of at most {LONGEST_NAME} letters, is {shown(name)}")
    for column, numbers in columns.items():
        if column not in ROUTE_COLUMNS:
            known = ", ".join(ROUTE_COLUMNS)
            raise InputError(f"route: unknown list {shown(column)}{nearest(column, ROUTE_COLUMNS)}; known are {known}")
        if not isinstance(numbers, list):
            raise InputError(f"route: {column}: must be a list of numbers, is {shown(numbers)}")
        for point, number in enumerate(numbers, start=1):
            if not isinstance(number, float) or not isfinite(number):
                raise InputError(f"route, point {point}: {column}: must be a finite number, is {shown(number)}")
    lengths = {column: len(numbers) for column, numbers in columns.items()}
    if len(set(lengths.values())) > 1:
        raise InputError(f"route: its lists must be of one length, are {shown(lengths)}")
    count = min(lengths.values(), default=0)
    if count < MIN_ROWS:
        raise InputError(f"route: has {count} points, must have at least {MIN_ROWS}")
    places = tuple(f"route, point {point + 1}" for point in range(count))
    return route_of(Columns("route", places, {column: tuple(numbers) for column, numbers in columns.items()}), name)


# --- the command ---------------------------------------------------------------------------------------------------


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard route``."""
    one = parser.add_mutually_exclusive_group()
    about = "route: GPX, or CSV as for `simulate`, altitudes optional (default: show the present one)"
    one.add_argument("file", nargs="?", type=Path, metavar="FILE", help=about)
    one.add_argument("--clear", action="store_true", help="clear the route")
    text = "control socket of the daemon (default: %(default)s)"
    parser.add_argument("--socket", type=Path, default=SOCKET, metavar="PATH", help=text)


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard route``: `OK` if the daemon carried it out."""
    request: dict[str, object] = {"status": True}
    if arguments.clear:
        request = {"route": None}
    elif arguments.file:
        columns = read_route_columns(arguments.file)
        route_of(columns, "")  # errors are found here already, where the lines of the file are known
        request = {"route": {"name": route_name(arguments.file)[:LONGEST_NAME], **columns.values}}
    answer = ask(arguments.socket, request)
    if "error" in answer:
        raise InputError(f"{arguments.socket}: the daemon refused it: {answer['error']}")
    print(route_text(answer))
    return OK


def route_text(answer: Mapping[str, Any]) -> str:
    """Describe the daemon's answer, for a terminal."""
    known = {key: value for key, value in answer.items() if value is not None}

    def said(text: str, *keys: str, factor: float = 1.0) -> str:
        """`text` with the numbers in its braces; nothing unless all of them are known."""
        return text.format(*(factor * known[key] for key in keys)) if known.keys() >= {*keys} else ""

    lines = [f"route  {known.get('route', 'none')}" + said(", {:.2f} km", "length_m", factor=1e-3)]
    if "route" in known and "state" in known:
        line = f"  {STATES.get(known['state'], 'not yet looked for')}"
        line += said(", {:.1f} km ridden", "along_m", factor=1e-3)
        line += said(", {:.1f} km to its end", "left_m", factor=1e-3)
        lines.append(line + said(" for {:.0f} Wh", "energy_j", factor=1 / WH))
        ends = said("  battery empty in {:.1f} km", "battery_ends_after_m", factor=1e-3)
        where = said(", at {:.5f}°, {:.5f}°", "battery_ends_latitude", "battery_ends_longitude")
        soc = said("  {:.0f} % of charge at its end", "arrival_soc", factor=100)
        between = said(" ({:.0f} to {:.0f} %, 80 % interval)", "arrival_soc_p10", "arrival_soc_p90", factor=100)
        lines.append(ends + where if ends else soc + between)
    lines.append(said("range  {:.1f} km", "range_m", factor=1e-3))
    if known.get("grade_known") is False:
        lines.append("without altitudes hills are not counted")
    return "\n".join(filter(None, lines))


def ask(path: Path, request: dict[str, object]) -> dict[str, object]:
    """Send a request and return the daemon's answer. InputError if there is none."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(ANSWER_S)
            connection.connect(str(path))
            connection.sendall(json.dumps(request).encode() + b"\n")
            with connection.makefile("rb") as stream:
                answer = json.loads(stream.readline())
    except OSError as error:
        hint = "it must run with --control-socket, and --socket must name the same file"
        raise InputError(f"{path}: no daemon answers: {error.strerror or error}; {hint}") from error
    except ValueError as error:
        raise InputError(f"{path}: the program listening there is not gz-onboard: {error}") from error
    return dict(answer) if isinstance(answer, dict) else {"error": str(answer)}
