"""Processes joined by python-can's udp_multicast: each group, and each port of one, is a bus of its own."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from gz_onboard.can.channel import CanChannel
from gz_onboard.events import Frame

pytest.importorskip("msgpack", reason="of the extra udp")
PORT = 20_000 + os.getpid() % 20_000  # not another run's
GROUP = "239.74.163.2"


@contextmanager
def opened(name: str) -> Iterator[CanChannel]:
    channel = CanChannel("udp_multicast", name)
    channel.open()
    if not channel.up:
        pytest.skip("no multicast on this machine's network")
    yield channel
    channel.close()


def received(channel: CanChannel) -> list[bytes]:
    time.sleep(0.1)
    return [data for _, _, data, _ in channel.drain()]


@pytest.mark.parametrize(
    ("other", "same"),
    [(f"239.74.163.3:{PORT}", False), (f"{GROUP}:{PORT + 1}", False), (f"{GROUP}:{PORT}", True)],
    ids=["group", "port", "same"],
)
def test_only_its_own_group_and_port_are_heard(other, same):
    frame: Frame = (0, 0x123, b"range", 0)
    with opened(f"{GROUP}:{PORT}") as one, opened(f"{GROUP}:{PORT}") as twin, opened(other) as elsewhere:
        assert one.send(frame)
        if not (heard := received(twin)):
            pytest.skip("multicast does not come back on this machine")
        assert heard == [b"range"]
        assert received(elsewhere) == [b"range"] * same
