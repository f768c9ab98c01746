"""Asking an ECU on a real vcan: the daemon with the kernel's filters, and a scan tool beside it."""

from __future__ import annotations

import threading

import can

from tests.polled import CHARGE, KONA, STEADY, carried, payload, request
from tests.vcan.support import Running, raw_frames, wait_for

BATTERY, SHOWN = request("Battery"), request("BatteryShown")
ANSWERS = {BATTERY.payload: payload(BATTERY, **STEADY), SHOWN.payload: payload(SHOWN, BatteryCharge=CHARGE)}


class Ecu:
    """Answers on vcan0 as the Kona's battery management would."""

    def __init__(self) -> None:
        filters: list[can.typechecking.CanFilter] = [{"can_id": BATTERY.request, "can_mask": 0x7FF}]
        self._bus = can.Bus(interface="socketcan", channel="vcan0", can_filters=filters)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self.asked = 0

    def __enter__(self) -> Ecu:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        self._bus.shutdown()

    def _serve(self) -> None:
        left: list[bytes] = []
        while not self._end.is_set():
            message = self._bus.recv(0.2)
            if message is None:
                continue
            data = bytes(message.data)
            if data[0] >> 4 == 3:
                parts, left = left, []
            else:
                self.asked += 1
                first, *left = carried(ANSWERS[data[1:4]])
                parts = [first]
            for part in parts:
                self._bus.send(can.Message(arbitration_id=BATTERY.response, data=part, is_extended_id=False))


def test_asks_until_a_scan_tool_does(running: Running):
    with Ecu() as ecu:
        daemon = running.daemon("--vehicle", str(KONA), "--poll")
        wait_for(lambda: ecu.asked >= 6, 60, "it asks")
        with can.Bus(interface="socketcan", channel="vcan0") as tool:
            tool.send(can.Message(arbitration_id=0x7DF, data=b"\x02\x01\x00", is_extended_id=False))
        wait_for(lambda: "someone else asks on 0x7df" in daemon.journal, 60, "it stops")
        summary = daemon.stop()
    assert "asking 1 ECU for 2 of their data" in daemon.journal
    assert "dropped 0, lost 0" in summary
    assert "nothing more: someone else asks" in summary
    told = daemon.estimates()
    assert any(row["pack_voltage"] == 365.0 and row["pack_current"] == 20.0 for row in told)
    sent = [frame for frame in raw_frames(daemon.logs[-1], sent=True) if frame[1] == BATTERY.request]
    assert {frame[2][1:4] for frame in sent if frame[2][0] == 3} == set(ANSWERS)


def test_without_being_told_to_it_asks_nothing(running: Running):
    with can.Bus(interface="socketcan", channel="vcan0") as tool:
        daemon = running.daemon("--vehicle", str(KONA))
        for _ in range(10):
            for part in carried(ANSWERS[BATTERY.payload]):  # a tool of which only the answers are heard
                tool.send(can.Message(arbitration_id=BATTERY.response, data=part, is_extended_id=False))
        wait_for(lambda: daemon.estimates() if daemon.logs else [], 60, "an estimate")
        summary = daemon.stop()
    assert "lists 2 requests, which are not sent: that needs --poll" in daemon.journal
    assert "dropped 0" in summary
    assert not [frame for frame in raw_frames(daemon.logs[-1], sent=True) if frame[1] == BATTERY.request]
    assert raw_frames(daemon.logs[-1])
