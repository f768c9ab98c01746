"""A connection to an MQTT broker that reconnects by itself.

Nothing waits for the broker: a message that cannot be sent now is dropped, as it would be old by then.
"""

from __future__ import annotations

import os
import re
import stat
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from gz_onboard.errors import InputError
from gz_onboard.toml import Table

KEEP_ALIVE_S = 10  # after one and a half of it the broker publishes the last will
RETRY_S = 1, 30  # before the first attempt to reconnect, and at most
CONNECT_S = 5.0  # for the connection itself
GOODBYE_S = 2.0  # for the last message
PORT, TLS_PORT = 1883, 8883
USER, PASSWORD = "GZ_ONBOARD_MQTT_USER", "GZ_ONBOARD_MQTT_PASSWORD"


@dataclass(frozen=True)
class Address:
    """Broker and login. tls: a file of certificates to trust, "" for the system's, None for no encryption."""

    host: str
    port: int
    user: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: str | None = None

    @classmethod
    def of(
        cls, text: str, tls: str | None = None, login: Path | None = None, environ: Mapping[str, str] = os.environ
    ) -> Address:
        """Parse ``HOST[:PORT]``; user and password come from the file `login` or `environ`. InputError."""
        found = re.fullmatch(r"(\[[0-9A-Fa-f:.%\w]+\]|[^:\s/@]+)(?::(\d{1,5}))?", text)
        port = int(found[2] or (PORT if tls is None else TLS_PORT)) if found else 0
        if not found or not 0 < port < 1 << 16:
            raise InputError(f"{text}: must be HOST or HOST:PORT, such as broker.local or 192.168.1.20:1883")
        user, password = _login(login) if login else (environ.get(USER), environ.get(PASSWORD))
        if password is not None and user is None:
            raise InputError(f"{PASSWORD} is set, and {USER} is not")
        return cls(found[1].strip("[]"), port, user, password, tls)

    def __str__(self) -> str:
        return f"{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"


def _login(file: Path) -> tuple[str | None, str | None]:
    """Read user and password, none from an empty file. InputError if others than the owner may read them."""
    table = Table.read(file)
    if stat.S_IMODE(file.stat().st_mode) & 0o077:
        raise InputError(f"{file}: others can read the password in it: chmod 600 {file}")
    table.only({"user", "password"})
    return (table.text("user"), table.text("password")) if table.values else (None, None)


class Broker:
    """The connection. will: (topic, payload) that the broker publishes once we are gone; report: gets messages."""

    def __init__(self, address: Address, name: str, will: tuple[str, bytes], report: Callable[[str], None]) -> None:
        self.connections = 0  # so far
        self.connected = False
        self._address, self._will, self._report = address, will, report
        self._reported = ""
        client = Client(CallbackAPIVersion.VERSION2, f"gz-onboard-{name}", protocol=MQTTProtocolVersion.MQTTv5)
        client.will_set(*will, qos=1, retain=True)
        client.reconnect_delay_set(*RETRY_S)
        client.connect_timeout = CONNECT_S
        if address.user is not None:
            client.username_pw_set(address.user, address.password)
        if address.tls is not None:
            try:
                client.tls_set(ca_certs=address.tls or None)
            except OSError as error:  # of the file, or by ssl
                raise InputError(f"--tls {address.tls}: cannot be used: {error}") from error
        client.on_connect = self._on_connect
        client.on_connect_fail = self._on_connect_fail
        client.on_disconnect = self._on_disconnect
        self._client = client

    def start(self) -> None:
        """Start to connect, on a thread."""
        self._client.connect_async(self._address.host, self._address.port, KEEP_ALIVE_S)
        self._client.loop_start()

    def publish(self, topic: str, payload: bytes, expires: int | None = None) -> bool:
        """Publish `payload`, to be retained for `expires` [s] if given; False if it cannot be sent now."""
        if not self.connected:
            return False
        properties: Any = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
        if expires is not None:
            properties.MessageExpiryInterval = expires
        # Without confirmation: an unconfirmed message would be sent again later, when it is old.
        return self._client.publish(topic, payload, qos=0, retain=True, properties=properties).rc == 0

    def close(self) -> None:
        """Publish the last will, as the broker does not after an orderly end, and disconnect."""
        connected, self.connected = self.connected, False
        if connected:
            self._client.publish(*self._will, qos=1, retain=True).wait_for_publish(GOODBYE_S)
        self._client.disconnect()
        if connected:
            self._client.loop_stop()  # otherwise its thread may be waiting for an address; it ends by itself

    # --- on the thread of the connection ----------------------------------------------------------------------

    def _on_connect(self, _client: Client, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._say(f"the broker {self._address} refuses us: {reason}; trying again")
            return
        self.connected = True
        self.connections += 1
        self._say(f"connected to the broker {self._address}")

    def _on_connect_fail(self, _client: Client, _data: Any) -> None:
        error = sys.exc_info()[1]
        why = getattr(error, "strerror", None) or str(error or "no answer")
        self._say(f"the broker {self._address} cannot be reached: {why}; trying again until it answers")

    def _on_disconnect(self, _client: Client, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if self.connected:
            self.connected = False
            self._say(f"the broker {self._address} is gone: {reason}; trying again until it is back")

    def _say(self, text: str) -> None:
        """Report a message once, however often it recurs."""
        if text != self._reported:
            self._reported = text
            self._report(text)
