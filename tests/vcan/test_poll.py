"""Asking an ECU on a real vcan: the daemon with the kernel's filters, and a scan tool beside it."""

from __future__ import annotations

import can

from tests.polled import KONA, STEADY, Ecu, carried, payload, request
from tests.vcan.support import Daemon, Running, raw_frames, wait_for

BATTERY = request("Battery")


def knows(daemon: Daemon) -> bool:
    """Whether an estimate has the ECU's values."""
    told = daemon.estimates() if daemon.logs else []
    return any(row["pack_voltage"] == 365.0 and row["pack_current"] == 20.0 for row in told)


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
    sent = [frame for frame in raw_frames(daemon.logs[-1], sent=True) if frame[1] == BATTERY.request]
    assert {frame[2][1:4] for frame in sent if frame[2][0] == 3} == {BATTERY.payload, request("BatteryShown").payload}


def test_without_being_told_to_it_asks_nothing(running: Running):
    with can.Bus(interface="socketcan", channel="vcan0") as tool:
        daemon = running.daemon("--vehicle", str(KONA))

        def read() -> bool:
            for part in carried(payload(BATTERY, **STEADY)):  # a tool of which only the answers are heard
                tool.send(can.Message(arbitration_id=BATTERY.response, data=part, is_extended_id=False))
            return knows(daemon)

        wait_for(read, 60, "what another is answered")
        daemon.stop()
    assert "lists 2 requests, which are not sent: that needs --poll" in daemon.journal
    assert not [frame for frame in raw_frames(daemon.logs[-1], sent=True) if frame[1] == BATTERY.request]
    assert raw_frames(daemon.logs[-1])
