"""The live estimate, as a client that speaks Foxglove's documented protocol gets it."""

from __future__ import annotations

import json
import re
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from gz_onboard import cli
from gz_onboard.bridges import foxglove as command
from gz_onboard.log_rows import ESTIMATE_UNITS, TEXTS, declare, estimate_row
from tests.bridges.broker import PATIENCE, wait_for
from tests.dashboard.served import Sender
from tests.dashboard.test_terminal import ESTIMATE

SUBSCRIPTION = 7
_DATA = struct.Struct("<BIQ")  # operation, subscription, log time


@contextmanager
def serving(channel: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Its address."""
    said: list[str] = []
    stop = threading.Event()

    @contextmanager
    def stopped() -> Iterator[Any]:
        yield stop.is_set

    monkeypatch.setattr(command, "until_signalled", stopped)
    monkeypatch.setattr(command, "_say", said.append)
    arguments = ["foxglove", "--interface", "virtual", "--channel", channel, "--listen", "127.0.0.1:0"]
    thread = threading.Thread(target=cli.main, args=(arguments,))
    thread.start()
    try:
        wait_for(lambda: bool(said), "it serves")
        yield said[0].split()[0]
    finally:
        stop.set()
        thread.join()


def advertised(client: ClientConnection) -> list[dict[str, Any]]:
    while True:
        told = json.loads(client.recv(PATIENCE))
        if told["op"] == "advertise":
            channels: list[dict[str, Any]] = told["channels"]
            return channels


def messages(client: ClientConnection) -> Iterator[tuple[int, dict[str, Any]]]:
    while True:
        data = client.recv(PATIENCE)
        if isinstance(data, bytes):
            operation, subscription, time_ns = _DATA.unpack_from(data)
            assert (operation, subscription) == (1, SUBSCRIPTION)
            yield time_ns, json.loads(data[_DATA.size :])


class Schemas:
    """A log that keeps what is declared."""

    def __init__(self) -> None:
        self.of: dict[str, Any] = {}

    def channel(self, topic: str, json_schema: Any, metadata: Any = None) -> None:
        self.of[topic] = json_schema

    def frames(self, batch: Any) -> None:
        """Nothing."""

    def sample(self, topic: str, time_ns: int, values: Any, seen_ns: Any = None) -> None:
        """Nothing."""


def test_the_estimate_is_that_of_the_log_and_nothing_old(monkeypatch):
    logged = Schemas()
    declare(logged, ())
    with serving("f1", monkeypatch) as address, connect(address, subprotocols=["foxglove.sdk.v1"]) as client:  # type: ignore[list-item]
        (channel,) = advertised(client)
        assert (channel["topic"], channel["encoding"], channel["schemaName"]) == (
            "/estimate",
            "json",
            "gz_onboard.Estimate",
        )
        assert json.loads(channel["schema"]) == logged.of["/estimate"]
        wanted = [{"id": SUBSCRIPTION, "channelId": channel["id"]}]
        client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        heard = messages(client)
        _, silent = next(heard)
        assert silent.keys() == {*ESTIMATE_UNITS, *TEXTS}
        assert not any(silent[name] is not None for name in ESTIMATE_UNITS)
        assert silent["state"] == "UNKNOWN"
        there = replace(ESTIMATE, charge_power=500.0, time_to_full=3600.0, range_full=50_000.0)
        with Sender("f1", there):
            time_ns, row = next(
                (t, v) for t, v in heard if v["range"] and v["soc"] and v["charge_power"] and v["energy_left"]
            )
        assert time_ns > 1e18
        expected = estimate_row(there)
        for name in ESTIMATE_UNITS:
            if row[name] is not None:
                assert row[name] == pytest.approx(expected[name], rel=1e-3), name
        said = {name for name in ESTIMATE_UNITS if row[name] is not None}
        assert {"range", "range_p10", "range_p90", "soc", "soc_sd", "energy_left", "time_to_full", "range_full"} <= said
        assert {name: row[name] for name in TEXTS} == {name: expected[name] for name in TEXTS}
        gone = next(v for _, v in heard if v["soc"] is None)  # the status is stale after a second
        assert gone["soc_sd"] is None
        assert gone["state"] == "UNKNOWN"


def test_a_port_that_is_taken(monkeypatch, capsys):
    with serving("f2", monkeypatch) as address:
        place = address.removeprefix("ws://")
        assert cli.main(["foxglove", "--interface", "virtual", "--channel", "f2", "--listen", place]) == 2
    assert re.search(rf"--listen {place}: .*in use", capsys.readouterr().err)
    assert cli.main(["foxglove", "--interface", "virtual", "--channel", "f2", "--listen", "nowhere"]) == 2
