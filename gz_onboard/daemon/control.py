"""The control socket: a navigation application on the same machine gives the daemon a route, or takes it away.

A Unix stream socket. A request is one line of JSON, {"route": {...}}, {"route": null} or {"status": true}; so is the
answer, {"ok": true, ...} or {"error": "..."}. Requests are read, checked and made ready on a thread of their own; the
daemon's loop only takes what is ready. What is wrong changes nothing.
"""

from __future__ import annotations

import json
import logging
import os
import socket
import stat
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from math import isfinite
from pathlib import Path
from queue import SimpleQueue

from gz_onboard.errors import InputError, nearest, shown
from gz_onboard.estimator.route import PreparedRoute
from gz_onboard.pipeline import Pipeline
from gz_onboard.routes.columns import MIN_ROWS, Columns
from gz_onboard.routes.route import ROUTE_COLUMNS, Route, route_of

MOST_BYTES = 8_000_000  # of a request: the most points with all columns have half of it
SECONDS = 5.0  # for a request to come, and for its answer to be taken
ACCESS = 0o660
UMASK = 0o777 & ~ACCESS
WAITING = 4  # clients
LONGEST_NAME = 100
REQUESTS = ("route", "status")

log = logging.getLogger("gz-onboard")


class Control:
    """Listens at `path` from `start` to `close`. pipeline: gives that of the daemon."""

    def __init__(self, path: Path | None, pipeline: Callable[[], Pipeline]) -> None:
        self._path, self._pipeline = path, pipeline
        self._ready: SimpleQueue[PreparedRoute | None] = SimpleQueue()  # for the loop to take
        self._name: str | None = None
        self._socket: socket.socket | None = None
        self._thread = threading.Thread(target=self._serve, name="control", daemon=True)

    def start(self) -> None:
        """Listen, if there is a path. InputError if it cannot be."""
        if self._path is None:
            return
        _free(self._path)
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        before = os.umask(UMASK)  # so that it is nobody else's for no moment
        try:
            listening.bind(str(self._path))
        except OSError as error:
            listening.close()
            raise InputError(f"{self._path}: cannot listen there: {error.strerror or error}") from error
        finally:
            os.umask(before)
        listening.listen(WAITING)
        self._socket = listening
        self._thread.start()

    def give(self, route: Route | None) -> None:
        """Make `route` ready, which may take seconds, and have the loop take it; in any thread."""
        road = self._pipeline().estimator.route.prepare(route) if route else None
        self._name = route.name if route else None
        self._ready.put(road)

    def take(self) -> None:
        """In the loop: have what is ready followed from now on."""
        while not self._ready.empty():
            road = self._ready.get_nowait()
            self._pipeline().estimator.route.follow(road)
            log.info("route %s", "given" if road else "cleared")

    def close(self) -> None:
        """Listen no more."""
        if self._socket and self._path:
            with suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)  # ends the wait for a client
            self._socket.close()
            self._path.unlink(missing_ok=True)

    def _serve(self) -> None:
        assert self._socket
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:  # closed
                return
            with client:
                try:
                    answer = self.answer(_line(client))
                except InputError as error:
                    answer = {"error": str(error)}
                except OSError:
                    continue
                except Exception as error:  # the next client is to be heard, whatever this one sent
                    log.exception("control socket")
                    answer = {"error": f"failed: {error!r}"}
                with suppress(OSError):
                    client.settimeout(SECONDS)
                    client.sendall(json.dumps(answer).encode() + b"\n")

    def answer(self, line: bytes) -> dict[str, object]:
        """The answer to a request. InputError if it is none."""
        try:
            request = json.loads(line)
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
        e = self._pipeline().last
        if e is None:
            return {"route": self._name, "state": "NONE"}
        return {
            "route": self._name,
            "state": e.route_state.name,
            "along_m": e.route_along,
            "left_m": e.route_left,
            "energy_j": e.route_energy,
            "arrival_soc": e.arrival_soc,
            "arrival_soc_p10": e.arrival_soc_p10,
            "arrival_soc_p90": e.arrival_soc_p90,
            "battery_ends_after_m": e.battery_ends_after,
            "battery_ends_latitude": e.battery_ends_latitude,
            "battery_ends_longitude": e.battery_ends_longitude,
            "range_m": e.range,
        }


def route_of_request(request: object) -> Route:
    """The route in a request: an object of lists of numbers, named as the columns of a CSV, and perhaps a ``name``.

    InputError that names list and point.
    """
    if not isinstance(request, Mapping):
        raise InputError(f"route: must be an object of lists or null, is {shown(request)}")
    name = request.get("name", "route")
    if not isinstance(name, str) or len(name) > LONGEST_NAME:
        raise InputError(f"route: name: must be a text of at most {LONGEST_NAME} letters, is {shown(name)}")
    values: dict[str, tuple[float, ...]] = {}
    for column, numbers in request.items():
        if column == "name":
            continue
        if column not in ROUTE_COLUMNS:
            known = ", ".join(ROUTE_COLUMNS)
            raise InputError(f"route: unknown list {shown(column)}{nearest(column, ROUTE_COLUMNS)}; known are {known}")
        if not isinstance(numbers, list):
            raise InputError(f"route: {column}: must be a list of numbers, is {shown(numbers)}")
        values[column] = tuple(_number(column, point, x) for point, x in enumerate(numbers, start=1))
    lengths = {column: len(numbers) for column, numbers in values.items()}
    if len(set(lengths.values())) > 1:
        raise InputError(f"route: its lists must be of one length, are {shown(lengths)}")
    count = min(lengths.values(), default=0)
    if count < MIN_ROWS:
        raise InputError(f"route: has {count} points, must have at least {MIN_ROWS}")
    places = tuple(f"route, point {i + 1}" for i in range(count))
    return route_of(Columns("route", places, values), name)


def _number(column: str, point: int, value: object) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = float("inf")
        if isfinite(number):
            return number
    raise InputError(f"route, point {point}: {column}: must be a finite number, is {shown(value)}")


def _line(client: socket.socket) -> bytes:
    """The line that comes, within limits of size and time. InputError if none does."""
    until, got = time.monotonic() + SECONDS, bytearray()
    while (left := until - time.monotonic()) > 0:
        client.settimeout(left)
        try:
            part = client.recv(65536)
        except TimeoutError:
            break
        got += part
        if (end := got.find(b"\n", max(len(got) - len(part), 0))) >= 0:
            return bytes(got[:end])
        if not part:
            return bytes(got)
        if len(got) > MOST_BYTES:
            raise InputError(f"is longer than {MOST_BYTES} bytes")
    raise InputError(f"did not end with a line break within {SECONDS:g} s")


def _free(path: Path) -> None:
    """Remove the socket of a daemon that is gone. InputError if `path` is anything else."""
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise InputError(f"{path}: is not a socket, and was left alone")
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
            other.settimeout(1.0)
            other.connect(str(path))
    except FileNotFoundError:
        return
    except ConnectionRefusedError:
        path.unlink(missing_ok=True)
        return
    except OSError as error:
        raise InputError(f"{path}: cannot listen there: {error.strerror or error}") from error
    raise InputError(f"{path}: another gz-onboard run listens there; give each its own")
