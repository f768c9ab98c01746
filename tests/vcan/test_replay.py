"""Replay over a real socket; what it does otherwise stands in tests/recording/test_replay.py."""

from __future__ import annotations

from pathlib import Path

import can

from gz_onboard.events import EFF_FLAG, RTR_FLAG, Frame
from gz_onboard.recording.readers.python_can import frame_of
from tests.recording.test_replay import START, frames, log, payload, run


def test_a_real_socket_carries_every_kind_of_frame(tmp_path: Path) -> None:
    sent: list[Frame] = [*frames(100), (START, 0x1FFF_FFFF | EFF_FLAG, bytes(8), 0), (START, 1 | RTR_FLAG, bytes(3), 0)]
    path = log(tmp_path, sent)
    with can.Bus(interface="socketcan", channel="vcan0") as bus:
        assert run(path, "--channel", "vcan0", "--speed", "0") == 0
        received = []
        while message := bus.recv(0.5):
            received.append(frame_of(message, {"vcan0": 0}))
    assert payload(received) == payload(sent)
