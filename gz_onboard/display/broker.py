"""A connection to an MQTT broker that reconnects by itself.

Nothing waits for the broker: a message that cannot be sent now is dropped, as it would be old by then.
"""

from __future__ import annotations

import stat
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from paho.mqtt.client import Client
from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from gz_onboard.errors import InputError
from gz_onboard.options import host_and_port
from gz_onboard.toml import Table

KEEP_ALIVE_S = 10  # after one and a half of it the broker publishes the last will
RETRY_S = 1, 30  # before the first attempt to reconnect, and at most
CONNECT_S = 5.0  # for the connection itself
GOODBYE_S = 2.0  # for the last message
PORT, TLS_PORT = 1883, 8883


def read_login(file: Path) -> tuple[str | None, str | None]:
    """Read user and password from `file`; neither from an empty one. InputError if others can read it, too."""
    table = Table.read(file)
    if stat.S_IMODE(file.stat().st_mode) & 0o077:
        raise InputError(f"{file}: others can read the password in it: chmod 600 {file}")
    table.only({"user", "password"})
    return (table.text("user"), table.text("password")) if table.values else (None, None)


class Broker:
    """The connection to the broker at `address`, ``HOST[:PORT]``.

    hello, will: (topic, payload) that is published with each connection, and that the broker publishes once we are
    gone; report: gets messages for people; tls: a file of certificates to trust, "" for the system's, None for no
    encryption. InputError for an address or certificates that cannot be used.
    """

    def __init__(
        self,
        address: str,
        name: str,
        hello: tuple[str, bytes],
        will: tuple[str, bytes],
        report: Callable[[str], None],
        *,
        tls: str | None = None,
        login: tuple[str | None, str | None] = (None, None),
    ) -> None:
        self.address = host_and_port(address, PORT if tls is None else TLS_PORT)
        self.connected = False
        self._hello, self._will, self._report, self._reported = hello, will, report, ""
        client = Client(CallbackAPIVersion.VERSION2, f"gz-onboard-{name}", protocol=MQTTProtocolVersion.MQTTv5)
        client.will_set(*will, qos=1, retain=True)
        client.reconnect_delay_set(*RETRY_S)
        client.connect_timeout = CONNECT_S
        if login[0] is not None:
            client.username_pw_set(*login)
        if tls is not None:
            try:
                client.tls_set(ca_certs=tls or None)
            except OSError as error:  # of the file, or by ssl
                raise InputError(f"--tls {tls}: cannot be used: {error}") from error
        client.on_connect = self._on_connect
        client.on_connect_fail = self._on_connect_fail
        client.on_disconnect = self._on_disconnect
        self._client = client

    def __str__(self) -> str:
        host, port = self.address
        return f"the broker {f'[{host}]' if ':' in host else host}:{port}"

    def start(self) -> None:
        """Start to connect, on a thread."""
        self._client.connect_async(*self.address, KEEP_ALIVE_S)
        self._client.loop_start()

    def publish(self, topic: str, payload: bytes, expires: int | None = None) -> bool:
        """Publish `payload`, to be retained for `expires` [s] if given; False if it cannot be sent now."""
        properties: Any = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
        if expires is not None:
            properties.MessageExpiryInterval = expires
        # Without confirmation: an unconfirmed message would be sent again later, when it is old.
        return (
            self.connected and self._client.publish(topic, payload, qos=0, retain=True, properties=properties).rc == 0
        )

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
            self._say(f"{self} refuses us: {reason}; trying again")
            return
        self.connected = True
        self.publish(*self._hello)  # the broker may have lost everything
        self._say(f"connected to {self}")

    def _on_connect_fail(self, _client: Client, _data: Any) -> None:
        error = sys.exc_info()[1]
        why = getattr(error, "strerror", None) or str(error or "no answer")
        self._say(f"{self} cannot be reached: {why}; trying again until it answers")

    def _on_disconnect(self, _client: Client, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if self.connected:
            self.connected = False
            self._say(f"{self} is gone: {reason}; trying again until it is back")

    def _say(self, text: str) -> None:
        """Report a message once, however often it recurs."""
        if text != self._reported:
            self._reported = text
            self._report(text)
