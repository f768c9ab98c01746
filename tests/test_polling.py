"""The daemon that asks, and the ECU that it asks, on a virtual bus."""

from __future__ import annotations

import logging
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
from gz_onboard.daemon.command import _poll
from gz_onboard.daemon.loop import Daemon
from gz_onboard.daemon.poller import Poller
from gz_onboard.events import TRANSMITTED, Frame
from tests.polled import STEADY, Ecu, carried, kona, payload, request

BATTERY = request("Battery")
_NUMBERS = count()


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    """A daemon, and the ECU that it may ask, on a virtual bus."""
    name = f"poll{next(_NUMBERS)}"
    channel = CanChannel("virtual", name, identifiers=known_identifiers(kona().mapping))
    channel.open()
    recorder = Recorder(tmp_path, "kona")
    with Ecu("virtual", name) as ecu:
        there = Scene(Daemon(kona(), [channel], recorder, None), ecu, recorder)
        yield there
        there.stop()


class Scene:
    """A daemon in a thread."""

    def __init__(self, daemon: Daemon, ecu: Ecu, recorder: Recorder) -> None:
        self.daemon, self.ecu, self.recorder = daemon, ecu, recorder
        self._thread = threading.Thread(target=daemon.run)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self.daemon.stop()
        self._thread.join(60)

    def frames(self) -> list[Frame]:
        return [frame for path in self.recorder.paths for batch in read_frames(path) for frame in batch]


def until(condition: Callable[[], object], what: str, seconds: float = 60.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"not within {seconds:g} s: {what}"
        time.sleep(0.05)


def test_what_is_asked_is_estimated_logged_and_left_to_another_tester(scene):
    daemon, ecu = scene.daemon, scene.ecu
    daemon.poller = Poller(kona().mapping.requests, Polling(timeout=30.0), daemon.ask)  # on a machine however busy
    scene.start()
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
    scene.stop()

    frames = scene.frames()
    sent = [(f[1], f[2]) for f in frames if f[3] & TRANSMITTED and f[1] == 0x7E4]
    until(lambda: sent == ecu.heard, "the log has what the ECU heard")
    assert {data[:4] for _, data in sent} == {b"\x03\x22\x01\x01", b"\x03\x22\x01\x05", b"\x30\0\0\xcc"}
    again = Codec(kona().mapping)
    events = again.decode(frames)
    assert [event[2][1] for event in events if event[1] == 0][:8] == [pytest.approx(365.0)] * 8
    assert again.latest[-1][1] == pipeline.codec.latest[-1][1]
    told = [values for path in scene.recorder.paths for topic, _, values in read_samples(path) if topic == "/status"]
    assert told[-1]["requests"]["Battery"]["answered"] >= 8


def test_without_being_told_to_it_asks_nothing_and_reads_what_others_are_answered(scene, caplog):
    caplog.set_level(logging.INFO)
    _poll(scene.daemon, kona(), False)
    assert caplog.messages == ["kona lists 2 requests, which are not sent: that needs --poll"]
    scene.start()

    def known() -> bool:
        for part in carried(payload(BATTERY, **STEADY)):
            scene.ecu.send(part)
        last = scene.daemon.pipeline.last
        return bool(last and last.pack_voltage == pytest.approx(365.0))

    until(known, "the voltage")
    scene.stop()
    assert scene.ecu.heard == []
    sent = {frame[1] for frame in scene.frames() if frame[3] & TRANSMITTED}
    assert sent <= scene.daemon.pipeline.publisher.identifiers
