"""The bridge to a broker, the daemon, a replay and the broker as processes of their own, on a real bus."""

from __future__ import annotations

import subprocess

from tests.display.broker import broker, free_port, listening
from tests.support import LOGS
from tests.vcan.support import Listener, Running, wait_for

STATE = "gz-onboard/scooter/state"


def test_the_broker_knows_what_the_bus_says(running: Running, tmp_path):
    port = free_port()
    with broker(tmp_path, port), listening(port) as client, Listener() as listener:
        running.start("mqtt", f"127.0.0.1:{port}", "--channel", "vcan0", "--name", "scooter", stdout=subprocess.PIPE)
        daemon = running.daemon()
        running.replay(LOGS / "city_14C.blf")

        def told(key: str) -> set[float]:
            return {state[key] for topic, state in client.heard if topic == STATE and state[key] is not None}

        wait_for(lambda: len(told("energy_left")) > 3, 60, "an energy that moves")
        assert told("energy_left") <= {round(row["RANGE_EnergyLeft"], 3) for row in listener.decoded("RANGE_Energy")}
        assert told("range") <= {round(row["RANGE_Remaining"], 3) for row in listener.decoded("RANGE_Estimate")}
        daemon.stop()
        wait_for(lambda: client.last[STATE]["alert"] == "silent", 60, "silence is told")
        assert client.last[STATE]["range"] is None
        assert client.last[STATE]["status"] == "online"
