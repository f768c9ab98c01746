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
from tests.vcan.support import Listener, Running, ip, wait_for

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


def test_it_says_what_anyone_on_the_bus_hears(running: Running):
    with Listener() as listener:
        latest = served(running)
        assert latest()["alerts"] == ["silent"]
        daemon = running.daemon()
        replay = running.replay(CITY)
        listener.wait_for_valid(3)
        seen: list[dict[str, Any]] = []

        def enough() -> bool:
            seen.append(latest())
            return len({one["battery"]["energy_left_wh"] for one in seen} - {None}) > 3

        wait_for(enough, 60, "an energy that moves")
        energies = {round(row["RANGE_EnergyLeft"], 3) for row in listener.decoded("RANGE_Energy")}
        ranges = {round(row["RANGE_Remaining"], 3) for row in listener.decoded("RANGE_Estimate")}
        assert {one["battery"]["energy_left_wh"] for one in seen} - {None} <= energies
        assert {one["range"]["km"] for one in seen} - {None} <= ranges
        assert seen[-1]["counts"]["bad"] == 0

        daemon.stop()
        wait_for(lambda: latest()["alerts"] == ["silent"], 30, "silence is told")
        assert latest()["range"] == {"km": None, "p10_km": None, "p90_km": None}
        running.daemon()
        wait_for(lambda: latest()["range"]["km"] is not None, 60, "the range of the daemon that was started anew")
        replay.kill()


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
