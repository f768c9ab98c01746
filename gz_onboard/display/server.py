"""The page and its data over HTTP: static files, ``/api/latest``, and ``/api/stream`` of server-sent events.

Read-only. Each connection is for one request and has a thread; it sends the newest picture and keeps none, so a slow
browser costs no memory.
"""

from __future__ import annotations

import errno
import ipaddress
import math
import socket
import socketserver
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from gz_onboard import __version__
from gz_onboard.errors import InputError
from gz_onboard.options import host_and_port

STATIC = Path(__file__).with_name("static")
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
MAX_THREADS = 40  # a browser may keep six connections
TIMEOUT_S = 10.0  # for a request to arrive, and for a browser to take data
SEND_BUFFER = 32 << 10  # bytes in the kernel for each connection, so that it does not hold minutes of pictures
OLDEST_S = 3.0  # a picture is made at least every second; an older one means that the bus loop hangs
RETRY_MS = 1000  # after which a browser reopens a broken stream
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Feed:
    """The newest picture, encoded, for all connections; an empty one ends them."""

    def __init__(self) -> None:
        self._number = 0
        self._data = b""
        self._time = -math.inf  # s, monotonic
        self._changed = threading.Condition()

    def publish(self, data: bytes) -> None:
        """Pass `data` to all waiting readers."""
        with self._changed:
            self._data, self._number, self._time = data, self._number + 1, time.monotonic()
            self._changed.notify_all()

    def after(self, number: int, timeout: float | None = None) -> tuple[int, bytes]:
        """Wait for a picture newer than `number` that is not old; return its number and it, empty if none comes."""

        def is_new() -> bool:
            return self._number > number and time.monotonic() - self._time <= OLDEST_S

        with self._changed:
            return (self._number, self._data) if self._changed.wait_for(is_new, timeout) else (number, b"")


class Server(socketserver.ThreadingTCPServer):
    """Serves `feed` at `host` and `port`. OSError if it cannot listen there."""

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True
    request_queue_size = 16

    def __init__(self, host: str, port: int, feed: Feed) -> None:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self.address_family, address = found[0], str(found[4][0])
        self.feed = feed
        self.files = {f"/{path.name}": (TYPES[path.suffix], path.read_bytes()) for path in STATIC.iterdir()}
        self.files["/"] = self.files.pop("/index.html")
        super().__init__((address, port), Handler)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)  # for its connections, too
        bound = ipaddress.ip_address(address.partition("%")[0])
        self.is_local = bound.is_loopback
        name = socket.gethostname() if bound.is_unspecified else address
        self.url = f"http://{f'[{name}]' if ':' in name else name}:{self.server_address[1]}/"

    def verify_request(self, request: Any, client_address: Any) -> bool:
        """Whether there is room for another connection; otherwise it is closed."""
        return threading.active_count() < MAX_THREADS

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore browsers that go away."""


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: Server
    server_version = "gz-onboard"
    sys_version = ""
    timeout = TIMEOUT_S
    disable_nagle_algorithm = True

    def do_GET(self) -> None:
        """Answer."""
        path, server = self.path.partition("?")[0], self.server
        if server.is_local and not is_local_name(self.headers.get("Host", "localhost")):
            self._answer(HTTPStatus.MISDIRECTED_REQUEST, b"This is not the address of this dashboard.\n")
        elif path == "/api/stream":
            self._stream()
        elif path == "/api/latest":
            if picture := server.feed.after(0, OLDEST_S)[1]:
                self._answer(HTTPStatus.OK, picture + b"\n", "application/json")
            else:
                self._answer(HTTPStatus.SERVICE_UNAVAILABLE, b"There is no current picture.\n")
        elif path in server.files:
            kind, body = server.files[path]
            self._answer(HTTPStatus.OK, body, kind)
        else:
            self._answer(HTTPStatus.NOT_FOUND, b"There is only /, /api/latest and /api/stream.\n")

    def _stream(self) -> None:
        """Send `build` once, then a picture when it changes and every second, until the browser goes away."""
        build = f"retry: {RETRY_MS}\nevent: build\ndata: {__version__}\n\n"
        self._answer(HTTPStatus.OK, build.encode(), "text/event-stream")
        number, picture = self.server.feed.after(0)
        while picture:
            self.wfile.write(b"data: " + picture + b"\n\n")
            number, picture = self.server.feed.after(number)

    def _answer(self, status: HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8") -> None:
        self.send_response(status)
        for name, value in {**HEADERS, "Content-Type": kind}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""


def is_local_name(host: str) -> bool:
    """Whether a Host header names this machine; the name of another site might be made to point here."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
        return name in ("localhost", "localhost.") or bool(ipaddress.ip_address(name))
    except ValueError:
        return False


@contextmanager
def served(feed: Feed, listen: str) -> Iterator[str]:
    """Serve `feed` at `listen` on a thread; yield the address for a browser. InputError if it cannot listen there."""
    host, port = host_and_port(listen)
    try:
        server = Server(host, port, feed)
    except OSError as error:
        taken = "the port is taken; give another one" if error.errno == errno.EADDRINUSE else error.strerror
        raise InputError(f"--listen {listen}: {taken}") from error
    threading.Thread(target=server.serve_forever, name="web", daemon=True).start()
    try:
        yield server.url
    finally:
        feed.publish(b"")
        server.shutdown()
        server.server_close()
