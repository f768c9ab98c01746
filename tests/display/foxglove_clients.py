"""Two clients of a server of Foxglove's: one after its documented protocol, and Foxglove's own library."""

from __future__ import annotations

import json
import shutil
import struct
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from queue import Queue
from typing import Any, NamedTuple

import pytest
from websockets.sync.client import connect

from tests.display.broker import PATIENCE

SUBPROTOCOL = "foxglove.sdk.v1"
FIRST = 7  # subscription
NODE = shutil.which("node")
FOLDER = Path(__file__).parent / "foxglove_npm"
_DATA = struct.Struct("<BIQ")  # operation, subscription, log time


class Message(NamedTuple):
    topic: str
    time_ns: int
    row: dict[str, Any]


Heard = tuple[dict[str, dict[str, Any]], Iterator[Message]]  # the channels advertised, by topic; the messages
Client = Callable[..., AbstractContextManager[Heard]]  # of an address and topics, subscribed to in this order


@contextmanager
def documented(address: str, *topics: str) -> Iterator[Heard]:
    """Written by hand; it counts its subscriptions from `FIRST`."""
    with connect(address, subprotocols=[SUBPROTOCOL]) as client:  # type: ignore[list-item]

        def messages() -> Iterator[Message]:
            while True:
                data = client.recv(PATIENCE)
                if isinstance(data, bytes):
                    operation, subscription, time_ns = _DATA.unpack_from(data)
                    assert operation == 1
                    yield Message(topics[subscription - FIRST], time_ns, json.loads(data[_DATA.size :]))

        there: dict[str, dict[str, Any]] = {}
        while not there.keys() >= set(topics):
            told = json.loads(client.recv(PATIENCE))
            if told["op"] == "advertise":
                there |= {channel["topic"]: channel for channel in told["channels"]}
        wanted = [{"id": FIRST + n, "channelId": there[topic]["id"]} for n, topic in enumerate(topics)]
        client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        yield there, messages()


@contextmanager
def official(address: str, *topics: str) -> Iterator[Heard]:
    """`FoxgloveClient` of Foxglove's npm package, in Node; it must end without complaint."""
    if NODE is None or not (FOLDER / "node_modules/.package-lock.json").exists():
        pytest.skip("there is no client of Foxglove's own (.ci/setup foxglove)")
    lines: Queue[Any] = Queue()

    def read(stream: Any) -> None:
        for line in stream:
            lines.put(json.loads(line))
        lines.put(None)

    command = [NODE, str(FOLDER / "client.mjs"), address, *topics]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        reader = threading.Thread(target=read, args=(process.stdout,))
        reader.start()
        try:
            heard = iter(lambda: lines.get(timeout=PATIENCE), None)
            channels = next(heard, None)
            assert channels, "it ended at once; stderr says why"
            yield channels, (Message(topic, int(time_ns), row) for topic, time_ns, row in heard)
            assert process.stdin
            process.stdin.close()
            assert process.wait(PATIENCE) == 0
        finally:
            process.kill()
            reader.join()


CLIENTS: list[Client] = [documented, official]
