"""The page and its data over HTTP: static files, ``/api/latest``, and ``/api/stream`` of server-sent events.

Everything is read-only. A thread for each connection, and few of them; each sends the newest picture and keeps none,
so a slow browser costs no memory.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import http.client
import io
import ipaddress
import json
import socket
import threading
import time
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from gz_onboard.errors import InputError

STATIC = Path(__file__).with_name("static")
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
MOST_CONNECTIONS = 40  # a browser may keep six
PATIENCE = 10.0  # s: for a request, and for a browser that takes nothing
SEND_BUFFER = 32 << 10  # bytes in the kernel for each connection: it must not hold minutes of pictures
OLDEST = 3.0  # s: a picture is made at least every second; older ones are of a bus loop that hangs
RETRY_MS = 1000  # after which a browser asks again for a stream that broke
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}


@dataclass
class Feed:
    """The newest picture, encoded, for all connections."""

    data: bytes = b"{}"
    number: int = 0
    time: float = 0.0  # s, monotonic
    closed: bool = False
    changed: threading.Condition = field(default_factory=threading.Condition)

    def publish(self, data: bytes) -> None:
        """Give `data` to all who wait."""
        with self.changed:
            self.data, self.number, self.time = data, self.number + 1, time.monotonic()
            self.changed.notify_all()

    def close(self) -> None:
        """Let all who wait go."""
        with self.changed:
            self.closed = True
            self.changed.notify_all()

    def before(self) -> int:
        """The number after which a new reader begins: it gets the newest picture only if that is of now."""
        with self.changed:
            return self.number - 1 if self._fresh() else self.number

    def after(self, number: int) -> tuple[int, bytes] | None:
        """The newest picture, with its number, once it is newer than `number`; None if there will be none."""
        with self.changed:
            self.changed.wait_for(lambda: self.closed or self.number > number)
            return None if self.closed else (self.number, self.data)

    def latest(self) -> bytes | None:
        """The newest picture, waiting for the first one; None if it is no longer of now."""
        with self.changed:
            self.changed.wait_for(lambda: self.closed or self.number > 0, OLDEST)
            return self.data if self._fresh() else None

    def _fresh(self) -> bool:
        return self.number > 0 and not self.closed and time.monotonic() - self.time <= OLDEST


@dataclass(frozen=True)
class Static:
    """A file of the page."""

    body: bytes
    type: str
    tag: str


def static_files() -> dict[str, Static]:
    """By the path of their address."""
    files = {}
    for path in sorted(STATIC.iterdir()):
        if path.suffix in TYPES:
            body = path.read_bytes()
            name = "/" if path.name == "index.html" else f"/{path.name}"
            files[name] = Static(body, TYPES[path.suffix], f'"{hashlib.sha256(body).hexdigest()[:16]}"')
    return files


def build_of(files: dict[str, Static]) -> str:
    """What tells this page from another one."""
    return hashlib.sha256("".join(file.tag for file in files.values()).encode()).hexdigest()[:16]


class Server(ThreadingHTTPServer):
    """Serves `feed` at `host` and `port`; OSError if that cannot be had."""

    daemon_threads = True
    block_on_close = False
    allow_reuse_port = False  # two on one port would share the browsers
    request_queue_size = 16

    def __init__(self, host: str, port: int, feed: Feed) -> None:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        self.address_family = family
        self.feed = feed
        self.files = static_files()
        self.build = build_of(self.files)
        self._free = threading.Semaphore(MOST_CONNECTIONS)
        super().__init__((str(address[0]), port), Handler)
        self.local = ipaddress.ip_address(str(self.server_address[0]).partition("%")[0]).is_loopback

    def server_bind(self) -> None:
        """Bind, without asking a name server for our name as the base class does."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve it on a thread of its own, or turn it away if there are too many."""
        if not self._free.acquire(blocking=False):
            with contextlib.suppress(OSError):
                request.settimeout(0.1)
                request.sendall(b"HTTP/1.1 503 Too many connections\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except RuntimeError:  # no thread can be had
            self._free.release()
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """What the thread of a connection does."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: a browser that goes away is no error of ours."""


class _Received(io.RawIOBase):
    """What a client sends. TimeoutError once `seconds` have passed since the last `begin`, however it trickles in."""

    def __init__(self, connection: socket.socket, seconds: float) -> None:
        self._connection, self._seconds = connection, seconds
        self.begin()

    def begin(self) -> None:
        """From now on the time counts."""
        self._end = time.monotonic() + self._seconds

    def readable(self) -> bool:
        """As the base class has it."""
        return True

    def readinto(self, buffer: Any) -> int:
        """As the base class has it."""
        left = self._end - time.monotonic()
        if left <= 0:
            raise TimeoutError
        self._connection.settimeout(left)
        try:
            return self._connection.recv_into(buffer)
        finally:
            self._connection.settimeout(self._seconds)


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: Server
    protocol_version = "HTTP/1.1"
    server_version = "gz-onboard"
    sys_version = ""
    timeout = PATIENCE  # of the socket, by the base class; also for all of a request's header

    def setup(self) -> None:
        """Keep little in the kernel, and find out soon that nobody is there."""
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):
            self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(PATIENCE * 1000))
        super().setup()
        self.rfile.close()
        self._received = _Received(self.connection, self.timeout)
        self.rfile = io.BufferedReader(self._received)

    def handle_one_request(self) -> None:
        """As the base class does, within the time."""
        self._received.begin()
        super().handle_one_request()

    def do_GET(self) -> None:
        """Answer."""
        path = self.path.partition("?")[0]
        if self._has_body():
            self.close_connection = True  # or what is not read would be taken for another request
            self._say(HTTPStatus.BAD_REQUEST, "There is nothing to send here.\n")
        elif not self._addressed_to_us():
            self._say(HTTPStatus.MISDIRECTED_REQUEST, "This is not the address of this dashboard.\n")
        elif path == "/api/stream":
            self._stream()
        elif path == "/api/latest":
            self._latest()
        elif file := self.server.files.get(path):
            if self.headers.get("If-None-Match") == file.tag:
                self._answer(HTTPStatus.NOT_MODIFIED, b"", ETag=file.tag, Cache_Control="no-cache")
            else:
                headers = {"Content_Type": file.type, "ETag": file.tag, "Cache_Control": "no-cache"}
                self._answer(HTTPStatus.OK, file.body, **headers)
        else:
            self._say(HTTPStatus.NOT_FOUND, "There is only /, /api/latest and /api/stream.\n")

    do_HEAD = do_GET  # noqa: N815 - the base class's name

    def _has_body(self) -> bool:
        """Whether something follows the header."""
        lengths = self.headers.get_all("Content-Length", [])
        return "Transfer-Encoding" in self.headers or any(length.strip() != "0" for length in lengths)

    def _addressed_to_us(self) -> bool:
        """Whether a local server is asked by a local name: pages of others could have any name point here."""
        if not self.server.local:
            return True
        host = self.headers.get("Host", "localhost")
        name = host.rpartition(":")[0] if host.rpartition(":")[2].isdigit() else host
        if name.lower() in ("localhost", "localhost."):
            return True
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name.strip("[]"))
            return True
        return False

    def _latest(self) -> None:
        data = self.server.feed.latest()
        if data is None:
            self._say(HTTPStatus.SERVICE_UNAVAILABLE, "There is no current picture.\n")
        else:
            self._answer(HTTPStatus.OK, data + b"\n", Content_Type="application/json", Cache_Control="no-store")

    def _stream(self) -> None:
        """Events until the browser goes away: `build` once, then a picture when it changes and every second."""
        self.close_connection = True
        self._head(HTTPStatus.OK, Content_Type="text/event-stream", Cache_Control="no-store")
        if self.command == "HEAD":
            return
        with contextlib.suppress(OSError):
            self.wfile.write(f"retry: {RETRY_MS}\nevent: build\ndata: {self.server.build}\n\n".encode())
            number = self.server.feed.before()
            while found := self.server.feed.after(number):
                number, data = found
                self.wfile.write(b"data: " + data + b"\n\n")

    def _say(self, status: HTTPStatus, text: str) -> None:
        self._answer(status, text.encode(), Content_Type="text/plain; charset=utf-8", Cache_Control="no-store")

    def _answer(self, status: HTTPStatus, body: bytes, **headers: str) -> None:
        self._head(status, Content_Length=str(len(body)), **headers)
        if self.command != "HEAD":
            self.wfile.write(body)

    def _head(self, status: HTTPStatus, **headers: str) -> None:
        self.send_response(status)
        if self.close_connection:
            headers["Connection"] = "close"
        for name, value in {**HEADERS, **headers}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the journal is for what goes wrong."""


def host_and_port(listen: str) -> tuple[str, int]:
    """Of ``127.0.0.1:8000`` or ``[::1]:8000``; InputError for what is none."""
    host, _, port = listen.rpartition(":")
    bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if not host or not (port.isascii() and port.isdigit() and int(port) < 1 << 16) or (":" in bare and bare == host):
        raise InputError(f"--listen {listen}: must be ADDRESS:PORT, such as 127.0.0.1:8000 or [::1]:8000")
    return bare, int(port)


def opened(listen: str, feed: Feed) -> Server:
    """The server at `listen`, as ``127.0.0.1:8000`` or ``[::1]:8000``; InputError if that cannot be had."""
    host, port = host_and_port(listen)
    try:
        return Server(host, port, feed)
    except socket.gaierror as error:
        raise InputError(f"--listen {listen}: no such address: {error.strerror}") from error
    except OSError as error:
        if error.errno != errno.EADDRINUSE:
            raise InputError(f"--listen {listen}: {error.strerror}") from error
        by = _who_has(host, port)
        other = f"{listen.rpartition(':')[0]}:{port + 1 if port < 65535 else 0}"
        raise InputError(f"--listen {listen}: the port is taken{by}; give another one, such as {other}") from error


def _who_has(host: str, port: int) -> str:
    """Who has the port, if it is one of us."""
    connection = http.client.HTTPConnection(host, port, timeout=2.0)
    with contextlib.suppress(OSError, ValueError, http.client.HTTPException, KeyError, TypeError):
        connection.request("GET", "/api/latest")
        return f" by a dashboard of {json.loads(connection.getresponse().read(1 << 16))['channel']}"
    connection.close()
    return ""


def address_of(server: Server) -> str:
    """Where a browser finds it."""
    host = str(server.server_address[0])
    if ipaddress.ip_address(host.partition("%")[0]).is_unspecified:
        host = socket.gethostname()
    return f"http://{f'[{host}]' if ':' in host else host}:{server.server_port}/"
