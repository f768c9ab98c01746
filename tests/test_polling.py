"""The daemon that asks, and the ECU that it asks, on a virtual bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path

import pytest

from gz_onboard.bus.channel import CanChannel
from gz_onboard.bus.codec import LENGTH, RANGE, UNDECODABLE, Codec, known_identifiers
from gz_onboard.bus.logs import read_frames, read_samples
from gz_onboard.bus.recorder import Recorder
from gz_onboard.bus.requests import Polling
from gz_onboard.daemon.loop import Daemon
from gz_onboard.daemon.poller import Poller
from gz_onboard.events import TRANSMITTED
from tests.polled import STEADY, Ecu, carried, kona, payload, request

BATTERY = request("Battery")
_NUMBERS = count()


@pytest.fixture
def polling(tmp_path: Path) -> Iterator[tuple[Daemon, Ecu, Recorder, threading.Thread]]:
    """A daemon that asks, and the ECU that it asks, on a virtual bus."""
    name = f"poll{next(_NUMBERS)}"
    channel = CanChannel("virtual", name, identifiers=known_identifiers(kona().mapping))
    channel.open()
    recorder = Recorder(tmp_path, "kona")
    daemon = Daemon(kona(), [channel], recorder, None)
    daemon.poller = Poller(kona().mapping.requests, Polling(timeout=30.0), daemon.ask)  # on a machine however busy
    thread = threading.Thread(target=daemon.run)
    with Ecu("virtual", name) as ecu:
        thread.start()
        yield daemon, ecu, recorder, thread
        daemon.stop()
        thread.join(60)


def until(condition: Callable[[], object], what: str, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"not within {seconds:g} s: {what}"
        time.sleep(0.05)


def test_what_is_asked_is_estimated_logged_and_left_to_another_tester(polling):
    daemon, ecu, recorder, thread = polling
    pipeline, counts = daemon.pipeline, daemon.poller.counts["Battery"]
    until(lambda: pipeline.last_known and counts["answered"] >= 8, "answers, and a range by them")
    until(lambda: (pipeline.last.pack_voltage, pipeline.last.pack_current) == pytest.approx((365.0, 20.0)), "values")
    assert not {reason for _, reason in pipeline.codec.faults} & {LENGTH, RANGE, UNDECODABLE}
    assert not pipeline.foreign

    ecu.send(b"\x02\x3e\x80", 0x7E4)  # a scan tool is plugged in
    until(lambda: daemon.poller.summary.endswith("nothing more: someone else asks"), "the tester is seen")
    asked = counts["asked"]

    def heard() -> bool:
        for part in carried(payload(BATTERY, **(STEADY | {"BatteryVoltage": 364.0}))):
            ecu.send(part)  # for the tool
        time.sleep(0.3)
        return bool(pipeline.codec.values(-1, pipeline.codec.latest[-1][1])["BatteryVoltage"] == pytest.approx(364.0))

    until(heard, "what is answered to another is heard, too")
    assert counts["asked"] == asked
    daemon.stop()
    thread.join(60)

    frames = [frame for path in recorder.paths for batch in read_frames(path) for frame in batch]
    sent = [(f[1], f[2]) for f in frames if f[3] & TRANSMITTED and f[1] == 0x7E4]
    until(lambda: sent == ecu.heard, "the log has what the ECU heard")
    assert {data[:4] for _, data in sent} == {b"\x03\x22\x01\x01", b"\x03\x22\x01\x05", b"\x30\0\0\xcc"}
    again = Codec(kona().mapping)
    events = again.decode(frames)
    assert [event[2][1] for event in events if event[1] == 0][:8] == [pytest.approx(365.0)] * 8
    assert again.latest[-1][1] == pipeline.codec.latest[-1][1]
    told = [values for path in recorder.paths for topic, _, values in read_samples(path) if topic == "/status"]
    assert told[-1]["requests"]["Battery"]["answered"] >= 8
