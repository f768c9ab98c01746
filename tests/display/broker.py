"""A real MQTT broker for a test, and what any client of it hears."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion

from tests.support import wait_for

MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@contextmanager
def broker(folder: Path, port: int, *settings: str) -> Iterator[subprocess.Popen[bytes]]:
    """A broker at `port` that keeps nothing; settings: lines of its configuration in place of open doors."""
    if MOSQUITTO is None:
        pytest.skip("there is no mosquitto (.ci/setup broker)")
    file = folder / "mosquitto.conf"
    file.write_text("\n".join([f"listener {port} 127.0.0.1", *(settings or ["allow_anonymous true"]), "user root", ""]))
    with subprocess.Popen([MOSQUITTO, "-c", str(file)], stderr=subprocess.DEVNULL) as process:
        try:
            wait_for(lambda: answers(port), "the broker listens")
            yield process
        finally:
            process.terminate()


def answers(port: int) -> bool:
    with socket.socket() as tried:
        return tried.connect_ex(("127.0.0.1", port)) == 0


class Listener:
    """A client of the broker that remembers the last message of each topic, and all of them in order."""

    def __init__(self, port: int, login: tuple[str, str] | None = None) -> None:
        self.last: dict[str, Any] = {}
        self.heard: list[tuple[str, Any]] = []
        self.expires: dict[str, int | None] = {}  # s, by topic
        self.client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTProtocolVersion.MQTTv5)
        if login:
            self.client.username_pw_set(*login)
        self.client.on_connect = lambda client, *_: client.subscribe("#", qos=1)
        self.client.on_message = self._take
        self.client.connect("127.0.0.1", port)
        self.client.loop_start()

    def _take(self, _client: Any, _data: Any, message: Any) -> None:
        values = json.loads(message.payload)
        self.last[message.topic] = values
        self.heard.append((message.topic, values))
        self.expires[message.topic] = getattr(message.properties, "MessageExpiryInterval", None)

    def close(self) -> None:
        self.client.disconnect()
        self.client.loop_stop()


@contextmanager
def listening(port: int, login: tuple[str, str] | None = None) -> Iterator[Listener]:
    listener = Listener(port, login)
    try:
        yield listener
    finally:
        listener.close()
