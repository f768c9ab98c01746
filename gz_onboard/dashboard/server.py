"""The page and its data over HTTP: static files, ``/api/latest``, and ``/api/stream`` of server-sent events.

Read-only. Each connection is for one request and has a thread; it sends the newest picture and keeps none, so a slow
browser costs no memory.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import ipaddress
import math
import socket
import socketserver
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

from gz_onboard import notify
from gz_onboard.bus.channel import CanChannel
from gz_onboard.dashboard.pictures import pictures, until_signalled
from gz_onboard.dashboard.view import View
from gz_onboard.errors import OK, InputError

STATIC = Path(__file__).with_name("static")
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
MAX_CONNECTIONS = 40  # a browser may keep six
TIMEOUT_S = 10.0  # for a request to arrive, and for a browser to take data
SEND_BUFFER = 32 << 10  # bytes in the kernel for each connection, so that it does not hold minutes of pictures
OLDEST_S = 3.0  # a picture is made at least every second; an older one means that the bus loop hangs
RETRY_MS = 1000  # after which a browser reopens a broken stream
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}


class Feed:
    """The newest picture, encoded, for all connections."""

    def __init__(self) -> None:
        self.number = 0
        self._data = b""
        self._time = -math.inf  # s, monotonic
        self._closed = False
        self._changed = threading.Condition()

    def publish(self, data: bytes) -> None:
        """Pass `data` to all waiting readers."""
        with self._changed:
            self._data, self.number, self._time = data, self.number + 1, time.monotonic()
            self._changed.notify_all()

    def close(self) -> None:
        """Release all waiting readers."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def start(self) -> int:
        """Return the number to pass to `after` first: a new reader gets the newest picture only if it is fresh."""
        return self.number - 1 if time.monotonic() - self._time <= OLDEST_S else self.number

    def after(self, number: int, timeout: float | None = None) -> tuple[int, bytes] | None:
        """Return the newest picture and its number once it is newer than `number`; None if none comes."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self.number > number, timeout)
            return None if self._closed or self.number <= number else (self.number, self._data)


class Server(socketserver.ThreadingTCPServer):
    """Serves `feed` at `host` and `port`. OSError if it cannot listen there."""

    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True
    request_queue_size = 16

    def __init__(self, host: str, port: int, feed: Feed) -> None:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self.address_family = family
        self.feed = feed
        files = {path.name: path for path in sorted(STATIC.iterdir()) if path.suffix in TYPES}
        self.files = {f"/{name}": (TYPES[path.suffix], path.read_bytes()) for name, path in files.items()}
        self.files["/"] = self.files.pop("/index.html")
        self.build = build_of(self.files)
        self._free = threading.Semaphore(MAX_CONNECTIONS)
        super().__init__((str(address[0]), port), Handler)
        bound = ipaddress.ip_address(str(self.server_address[0]).partition("%")[0])
        self.is_local = bound.is_loopback
        name = socket.gethostname() if bound.is_unspecified else str(self.server_address[0])
        self.url = f"http://{f'[{name}]' if ':' in name else name}:{self.server_address[1]}/"

    def process_request(self, request: Any, client_address: Any) -> None:
        """Start a thread for the connection, or reject it if there are too many."""
        if self._free.acquire(blocking=False):
            super().process_request(request, client_address)
            return
        with contextlib.suppress(OSError):
            request.settimeout(0.1)
            request.sendall(b"HTTP/1.0 503 Too many connections\r\n\r\n")
        self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve the connection, in its thread."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore browsers that go away."""


def build_of(files: Mapping[str, tuple[str, bytes]]) -> str:
    """Return a name of this version of the page; a browser that shows another one reloads it."""
    return hashlib.sha256(b"".join(body for _, body in files.values())).hexdigest()[:16]


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: Server
    server_version = "gz-onboard"
    sys_version = ""
    timeout = TIMEOUT_S
    disable_nagle_algorithm = True

    def setup(self) -> None:
        """Limit the data that the kernel keeps for a slow browser."""
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        super().setup()

    def do_GET(self) -> None:
        """Answer."""
        path, feed = self.path.partition("?")[0], self.server.feed
        if not self._is_addressed_here():
            self._answer(HTTPStatus.MISDIRECTED_REQUEST, b"This is not the address of this dashboard.\n")
        elif path == "/api/stream":
            self._stream()
        elif path == "/api/latest":
            if found := feed.after(feed.start(), OLDEST_S):
                self._answer(HTTPStatus.OK, found[1] + b"\n", "application/json")
            else:
                self._answer(HTTPStatus.SERVICE_UNAVAILABLE, b"There is no current picture.\n")
        elif path in self.server.files:
            kind, body = self.server.files[path]
            self._answer(HTTPStatus.OK, body, kind)
        else:
            self._answer(HTTPStatus.NOT_FOUND, b"There is only /, /api/latest and /api/stream.\n")

    def _is_addressed_here(self) -> bool:
        """Whether a local server is addressed by a local name: other sites' names might be made to point here."""
        if not self.server.is_local:
            return True
        host = self.headers.get("Host", "localhost")
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdigit() else host
        if name.lower() in ("localhost", "localhost."):
            return True
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name.strip("[]"))
            return True
        return False

    def _stream(self) -> None:
        """Send `build` once, then a picture when it changes and every second, until the browser goes away."""
        self._head(HTTPStatus.OK, "text/event-stream")
        self.wfile.write(f"retry: {RETRY_MS}\nevent: build\ndata: {self.server.build}\n\n".encode())
        number = self.server.feed.start()
        while found := self.server.feed.after(number):
            number, data = found
            self.wfile.write(b"data: " + data + b"\n\n")

    def _answer(self, status: HTTPStatus, body: bytes, kind: str = "text/plain; charset=utf-8") -> None:
        self._head(status, kind)
        self.wfile.write(body)

    def _head(self, status: HTTPStatus, kind: str) -> None:
        self.send_response(status)
        for name, value in {**HEADERS, "Content-Type": kind, "Cache-Control": "no-store"}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""


def host_and_port(listen: str) -> tuple[str, int]:
    """Split ``127.0.0.1:8000`` or ``[::1]:8000``. InputError for anything else."""
    host, _, port = listen.rpartition(":")
    bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if not host or not (port.isascii() and port.isdigit() and int(port) < 1 << 16) or (":" in bare and bare == host):
        raise InputError(f"--listen {listen}: must be ADDRESS:PORT, such as 127.0.0.1:8000 or [::1]:8000")
    return bare, int(port)


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
        feed.close()
        server.shutdown()
        server.server_close()


def serve(view: View, channel: CanChannel, listen: str, duration: float | None) -> int:
    """Serve the pictures of the open `channel` for `duration` [s], or until a signal. InputError for `listen`."""
    feed = Feed()
    with served(feed, listen) as address, until_signalled(duration) as stopped:
        text = f"{address} shows {channel.name} ({channel.interface})"
        if sys.stdout is not None:
            print(f"dashboard: {text}", flush=True)
        notify.ready(text)
        for new in pictures(view, channel, stopped):
            feed.publish(new.encoded())
        notify.stopping()
    return OK
