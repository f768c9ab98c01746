"""systemd's notification protocol over real Unix sockets."""

from __future__ import annotations

import os
import secrets
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard import notify


@pytest.fixture(params=["path", "abstract"])
def listener(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, dict[str, str]]]:
    """A bound socket like systemd's and the environment that names it."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@gz-onboard-{secrets.token_hex(8)}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(name.replace("@", "\0", 1))
        server.settimeout(5)
        yield server, {"NOTIFY_SOCKET": name}


def test_each_message_arrives_as_systemd_reads_it(listener):
    server, environ = listener
    sent = [
        (notify.ready("on vcan0", environ), b"READY=1\nSTATUS=on vcan0"),
        (notify.ready(environ=environ), b"READY=1"),
        (notify.alive(environ), b"WATCHDOG=1"),
        (notify.status("range 41 km\n", environ), b"STATUS=range 41 km"),
        (notify.stopping("log closed", environ), b"STOPPING=1\nSTATUS=log closed"),
    ]
    for was_sent, expected in sent:
        assert was_sent
        assert server.recv(4096) == expected


@given(st.text(st.characters(codec="utf-8"), max_size=200))
def test_a_status_never_becomes_another_field(text):
    with tempfile.TemporaryDirectory() as directory, socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(f"{directory}/notify")
        assert notify.status(text, {"NOTIFY_SOCKET": f"{directory}/notify"})
        message = server.recv(4096).decode()
    assert message.startswith("STATUS=")
    assert message.splitlines() == [message]


def test_nobody_listens(tmp_path):
    assert not notify.ready(environ={})
    assert not notify.ready(environ={"NOTIFY_SOCKET": ""})
    assert not notify.ready(environ={"NOTIFY_SOCKET": str(tmp_path / "gone")})
    assert not notify.ready(environ={"NOTIFY_SOCKET": "@gz-onboard-gone"})
    assert not notify.ready(environ={"NOTIFY_SOCKET": "vsock:2:1234"})


def test_a_full_socket_does_not_block(listener):
    _, environ = listener
    assert any(not notify.alive(environ) for _ in range(10_000))


@pytest.mark.parametrize(
    ("environ", "expected"),
    [
        ({"WATCHDOG_USEC": "10000000"}, 5.0),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": str(os.getpid())}, 1.5),
        ({"WATCHDOG_USEC": "3000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({}, None),
    ],
)
def test_watchdog_interval_is_half_the_timeout(environ, expected):
    assert notify.watchdog_interval(environ) == expected
