"""``gz-onboard mqtt``: publish the range on an MQTT broker, in a form that Home Assistant discovers."""

from __future__ import annotations

import argparse
import math
import re
import socket
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from gz_onboard import notify
from gz_onboard.bridges import home_assistant
from gz_onboard.dashboard.command import add_source, channel_of, view_of
from gz_onboard.dashboard.picture import Picture, picture
from gz_onboard.dashboard.pictures import clock, pictures, until_signalled
from gz_onboard.dashboard.view import View
from gz_onboard.errors import OK, InputError
from gz_onboard.imports import require

if TYPE_CHECKING:
    from gz_onboard.bridges.broker import Broker

EVERY_S = 1.0  # at most so often, when something has changed
AT_LEAST_S = 10.0  # though nothing has


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``gz-onboard mqtt``."""
    add = parser.add_argument
    add("broker", metavar="HOST[:PORT]", help="the broker (port: 1883, with --tls 8883)")
    add_source(parser)
    add("--name", help="name of the vehicle in topics and in Home Assistant (default: this machine's)")
    tls = "encrypt; FILE: the certificates to trust (default: the system's)"
    add("--tls", nargs="?", const="", metavar="FILE", help=tls)
    login = "TOML file with user and password (default: $GZ_ONBOARD_MQTT_USER and $GZ_ONBOARD_MQTT_PASSWORD)"
    add("--login", type=Path, metavar="FILE", help=login)


def run(arguments: argparse.Namespace) -> int:
    """``gz-onboard mqtt``: 0 when it is ended. InputError for bad options; the broker may be away."""
    require("paho")
    from gz_onboard.bridges.broker import Address, Broker

    name = arguments.name or re.sub(r"[^\w-]+", "-", socket.gethostname(), flags=re.ASCII) or "scooter"
    if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name):
        raise InputError(f"--name {name}: must be of letters, digits, - and _, at most 64")
    address = Address.of(arguments.broker, arguments.tls, arguments.login)
    view = view_of(arguments, own_frames=True)
    with channel_of(arguments, view) as channel, until_signalled(arguments.duration) as stopped:
        unknown = picture(View(view.source), clock(), (channel.name, channel.interface), False)
        offline = home_assistant.encoded(home_assistant.state_of(unknown, home_assistant.OFFLINE))
        broker = Broker(address, name, (home_assistant.topic_of(name), offline), _say)
        bridge = Bridge(broker, name)
        broker.start()
        notify.ready(f"{channel.name} ({channel.interface}) to {address} as {name}")
        try:
            for new in pictures(view, channel, stopped):
                bridge.show(new, time.monotonic())
        finally:
            notify.stopping()
            broker.close()
    return OK


def _say(text: str) -> None:
    if sys.stdout is not None:
        print(f"mqtt: {text}", flush=True)
    notify.status(text)


class Bridge:
    """Publishes pictures: each change within a second, an unchanged one every `AT_LEAST_S`."""

    def __init__(self, broker: Broker, name: str) -> None:
        self._broker = broker
        self._name = name
        self._announced = 0  # to which of the broker's connections the device was announced
        self._sent: dict[str, object] | None = None
        self._time = -math.inf

    def show(self, new: Picture, now: float) -> None:
        """Publish `new` if it is due at `now` [s]."""
        broker, number = self._broker, self._broker.connections
        if not broker.connected:
            return
        if number != self._announced:
            about = home_assistant.encoded(home_assistant.discovery(self._name))
            if not broker.publish(home_assistant.discovery_topic(self._name), about):
                return
            self._announced, self._sent, self._time = number, None, -math.inf
        state = home_assistant.state_of(new, home_assistant.ONLINE)
        if now - self._time < (AT_LEAST_S if state == self._sent else EVERY_S):
            return
        payload = home_assistant.encoded(state)
        if broker.publish(home_assistant.topic_of(self._name), payload, home_assistant.EXPIRES_S):
            self._sent, self._time = state, now
