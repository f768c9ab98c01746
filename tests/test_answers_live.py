"""The daemon reads what a vehicle answers another tester, on a virtual bus."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import can
import pytest

from gz_onboard.can.channel import CanChannel
from gz_onboard.can.layout import identifiers_of
from gz_onboard.can.recorder import Recorder
from gz_onboard.daemon.loop import Daemon
from gz_onboard.events import TRANSMITTED
from gz_onboard.recording.logs import read_frames
from tests.polled import STEADY, carried, kona, payload, request


def test_the_daemon_reads_answers_and_sends_only_range_frames(tmp_path: Path):
    channel = CanChannel("virtual", "answers", identifiers=identifiers_of(kona().mapping))
    channel.open()
    recorder = Recorder(tmp_path, "kona")
    daemon = Daemon(kona(), [channel], recorder, None)
    thread = threading.Thread(target=daemon.run)
    with can.Bus(interface="virtual", channel="answers") as ecu:
        thread.start()
        try:
            end = time.monotonic() + 60.0
            while not (last := daemon.pipeline.last) or last.pack_voltage != pytest.approx(365.0):
                assert time.monotonic() < end, "no voltage"
                for part in carried(payload(request("Battery"), **STEADY)):
                    ecu.send(can.Message(arbitration_id=0x7EC, data=part, is_extended_id=False))
                time.sleep(0.05)
        finally:
            daemon.stop()
            thread.join(60)
    frames = [frame for path in recorder.paths for batch in read_frames(path) for frame in batch]
    sent = {frame[1] for frame in frames if frame[3] & TRANSMITTED}
    assert sent and sent <= daemon.pipeline.publisher.identifiers
