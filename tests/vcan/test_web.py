"""The dashboard's server, the daemon and a replay as processes of their own, on a real bus."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable
from typing import Any
from urllib.request import urlopen

import pytest

from tests.support import LOGS
from tests.vcan.support import Running, ip, wait_for

CITY = LOGS / "city_14C.blf"


def served(running: Running) -> Callable[[], dict[str, Any]]:
    """What the JSON of a dashboard says, whenever it is asked."""
    process = running.start(
        "dashboard", "--web", "--channel", "vcan0", "--listen", "127.0.0.1:0", stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    told = re.search(r"http://\S+", process.stdout.readline())
    assert told

    def latest() -> dict[str, Any]:
        found: dict[str, Any] = json.loads(urlopen(f"{told[0]}api/latest", timeout=30).read())
        return found

    return latest


@pytest.mark.administers
def test_a_bus_that_goes_down_and_up(running: Running):
    latest = served(running)
    running.daemon()
    running.replay(CITY)
    wait_for(lambda: latest()["range"]["km"] is not None, 60, "a range")
    ip("link", "set", "vcan0", "down")
    try:
        wait_for(lambda: "bus_down" in latest()["alerts"], 30, "that the bus is down")
        wait_for(lambda: "silent" in latest()["alerts"], 30, "silence")
    finally:
        ip("link", "set", "vcan0", "up")
    wait_for(lambda: latest()["bus_up"] and latest()["range"]["km"] is not None, 60, "the range again")
