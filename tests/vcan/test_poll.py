"""Asking an ECU on a real vcan: the daemon with the kernel's filters, and a scan tool beside it."""

from __future__ import annotations

import re

import can

from tests.polled import KONA, Ecu, request
from tests.vcan.support import Daemon, Running, raw_frames, wait_for

BATTERY = request("Battery")


def knows(daemon: Daemon) -> bool:
    """Whether it says a state that does not lack the voltage."""
    states = re.findall(r"(?:starting|degraded|valid): (.*)", daemon.journal)
    return any("NO_PACK_VOLTAGE" not in state for state in states)


def told(daemon: Daemon) -> set[tuple[float | None, float | None]]:
    """Voltage and current of all estimates."""
    return {(row["pack_voltage"], row["pack_current"]) for row in daemon.estimates()}


def test_asks_until_a_scan_tool_does(running: Running):
    with Ecu("socketcan", "vcan0"):
        daemon = running.daemon("--vehicle", str(KONA), "--poll")
        wait_for(lambda: knows(daemon), 60, "it asks, and takes what is answered")
        with can.Bus(interface="socketcan", channel="vcan0") as tool:
            tool.send(can.Message(arbitration_id=0x7DF, data=b"\x02\x01\x00", is_extended_id=False))
        wait_for(lambda: "someone else asks on 0x7df" in daemon.journal, 60, "it stops")
        summary = daemon.stop()
    assert "asking 1 ECU for 2 of their data" in daemon.journal
    assert "nothing more: someone else asks" in summary
    assert (365.0, 20.0) in told(daemon)
    sent = [frame for frame in raw_frames(daemon.logs[-1], sent=True) if frame[1] == BATTERY.request]
    assert {frame[2][1:4] for frame in sent if frame[2][0] == 3} == {BATTERY.payload, request("BatteryShown").payload}
