"""The dashboard's server, by a real HTTP client."""

from __future__ import annotations

import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import pytest

from gz_onboard import cli
from gz_onboard.display import server as web_server
from gz_onboard.display.server import MAX_THREADS, Feed, served
from gz_onboard.errors import InputError
from tests.display.served import Sender, dashboard
from tests.display.test_picture import HEALTHY
from tests.support import HEARS_CTRL_C, ROOT, wait_for

LONG = 60.0  # s: no wait is as long, on whatever machine


def latest(address: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(urlopen(f"{address}api/latest", timeout=LONG).read())
    return found


def asked(address: str, path: str, method: str = "GET", **headers: str) -> tuple[http.client.HTTPResponse, bytes]:
    connection = http.client.HTTPConnection(urlsplit(address).netloc, timeout=LONG)
    connection.request(method, path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


@contextmanager
def stream(address: str) -> Iterator[Iterator[dict[str, Any]]]:
    """The pictures of /api/stream as they come."""
    answer = urlopen(f"{address}api/stream", timeout=LONG)

    def pictures() -> Iterator[dict[str, Any]]:
        event = ""
        for line in answer:
            name, _, value = line.decode().strip().partition(": ")
            if name == "event":
                event = value
            elif name == "data" and not event:
                yield json.loads(value)
            elif not name:
                event = ""

    with answer:
        yield pictures()


@pytest.fixture
def feed() -> Feed:
    made = Feed()
    made.publish(b'{"channel":"x"}')
    return made


# --- what it says ---------------------------------------------------------------------------------------------------


def test_the_page_and_all_that_it_names():
    with served(Feed(), "127.0.0.1:0") as address:
        answer, page = asked(address, "/?theme=night")
        assert answer.status == 200
        names = re.findall(r'(?:href|src)="([^"]+)"', page.decode())
        for name in names:
            answer, script = asked(address, f"/{name}")
            assert answer.status == 200, name
            assert answer.getheader("Cache-Control") == "no-store"
            names += re.findall(rb'from "\./([\w.]+)"', script) and [
                n.decode() for n in re.findall(rb'from "\./([\w.]+)"', script) if n.decode() not in names
            ]
    assert {"page.js", "draw.js", "de.js", "page.css", "icon.svg"} <= set(names)
    assert not [name for name in names if "//" in name]  # nothing from elsewhere


def test_latest_is_what_the_frames_say():
    with dashboard("latest") as address:
        assert latest(address)["heard"] is False
        with Sender("latest", HEALTHY):
            found = wait_for(lambda: (p := latest(address))["range"]["km"] and p, "a range")
    assert found["range"] == {"km": 34.21, "p10_km": 26.54, "p90_km": 44.34}
    assert found["alerts"] == []


def test_the_stream_follows_the_frames():
    with dashboard("stream") as address, stream(address) as pictures, Sender("stream", HEALTHY) as sender:
        assert next(p for p in pictures if p["range"]["km"])["range"]["km"] == 34.21
        sender.estimate = replace(HEALTHY, range=33_000.0, reasons=HEALTHY.reasons)
        assert next(p for p in pictures if p["range"]["km"] != 34.21)["range"]["km"] == 33.0


def test_a_loop_that_hangs_gives_no_old_picture(monkeypatch, feed):
    with served(feed, "127.0.0.1:0") as address:
        assert latest(address) == {"channel": "x"}
        monkeypatch.setattr(web_server, "OLDEST_S", -1.0)
        answer, text = asked(address, "/api/latest")
        assert (answer.status, text) == (503, b"There is no current picture.\n")
        assert feed.after(0, 0.0)[1] == b""  # a stream that begins now waits for the next


def test_too_many_connections_are_turned_away_and_room_is_made_again(feed):
    with served(feed, "127.0.0.1:0") as address:
        held = [urlopen(f"{address}api/stream", timeout=LONG) for _ in range(MAX_THREADS - threading.active_count())]
        with pytest.raises(ConnectionError):
            asked(address, "/api/latest")
        for one in held:
            one.close()

        def room() -> bool:
            feed.publish(b'{"channel":"x"}')  # a stream that has gone is noticed when something is sent
            with suppress(ConnectionError):
                return asked(address, "/api/latest")[0].status == 200
            return False

        wait_for(room, "room for another")


def test_a_browser_that_takes_nothing_is_left(feed, monkeypatch):
    monkeypatch.setattr(web_server.Handler, "timeout", 0.2)
    with served(feed, "127.0.0.1:0") as address:
        place = urlsplit(address)
        with socket.socket() as idle:
            idle.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            idle.connect((place.hostname, place.port or 0))
            idle.sendall(b"GET /api/stream HTTP/1.1\r\nHost: localhost\r\n\r\n")

            def served_now() -> bool:
                feed.publish(b"x" * 100_000)
                return any("process_request" in thread.name for thread in threading.enumerate())

            wait_for(served_now, "the thread of the stream")
            wait_for(lambda: not served_now(), "its end")


# --- where it listens -----------------------------------------------------------------------------------------------


def test_an_address_that_is_not_ours():
    with pytest.raises(InputError, match=r"--listen 192\.0\.2\.1:8000: "), served(Feed(), "192.0.2.1:8000"):
        pass


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--once", "--web"], "--once and --web"),
        (["--listen", "127.0.0.1:0"], "only with --web"),
        (["--web", "--listen", "nowhere"], "must be ADDRESS:PORT"),
    ],
)
def test_wrong_use_is_told(arguments, told, capsys):
    assert cli.main(["dashboard", "--interface", "virtual", *arguments]) == 2
    assert told in capsys.readouterr().err


# --- the command as a process of its own ----------------------------------------------------------------------------


def started(*arguments: str) -> subprocess.Popen[str]:
    command = ["-m", "gz_onboard", "dashboard", "--web", "--listen", "127.0.0.1:0", *arguments]
    return subprocess.Popen(
        [*HEARS_CTRL_C, sys.executable, *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_says_where_it_is_and_ends_in_order(number):
    with started("--interface", "virtual", "--channel", "alone") as process:
        assert process.stdout is not None
        assert process.stderr is not None
        told = re.fullmatch(
            r"dashboard: (http://127\.0\.0\.1:\d+/) shows alone \(virtual\)\n", process.stdout.readline()
        )
        assert told
        with stream(told[1]) as pictures:
            assert next(pictures)["alerts"] == ["silent"]
            process.send_signal(number)
            assert process.wait(LONG) == 0
            assert list(pictures)[3:] == []  # the stream ends with it
        assert process.stderr.read() == ""
