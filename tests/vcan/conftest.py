"""What needs a vcan, and what needs the right to take it down."""

from __future__ import annotations

import os
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.vcan.support import Listener, Running, ip, is_up

HOW = "tests/vcan-guest -- .venv/bin/pytest tests/vcan"


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "administers: sets interfaces up and down, or the clock: as root only")


@pytest.fixture(autouse=True)
def vcan(request: pytest.FixtureRequest) -> Iterator[None]:
    """Both interfaces are there before each test, and again after it."""
    for name in ("vcan0", "vcan1"):
        if name not in {interface for _, interface in socket.if_nameindex()}:
            pytest.skip(f"no {name} here: {HOW}")
    if request.node.get_closest_marker("administers") and os.geteuid() != 0:
        pytest.skip(f"as root only: {HOW.replace('--', '--root --', 1)}")
    yield
    if request.node.get_closest_marker("administers") and not is_up("vcan0"):
        subprocess.run(["ip", "link", "add", "dev", "vcan0", "type", "vcan"], check=False, capture_output=True)
        ip("link", "set", "vcan0", "up")


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    """Starts daemons and replays; whatever still runs is killed afterwards."""
    processes = Running(tmp_path)
    yield processes
    processes.kill()


@pytest.fixture
def listener() -> Iterator[Listener]:
    with Listener() as listening:
        yield listening
