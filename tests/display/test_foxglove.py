"""The live estimate and position, as a client of Foxglove's protocol gets them."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain, takewhile
from typing import Any, NamedTuple

import pytest
from websockets.sync.client import connect

from gz_onboard.can.python_can import can
from gz_onboard.display import foxglove as command
from gz_onboard.display.vehicle_frames import VehicleFrames
from gz_onboard.events import Frame
from gz_onboard.log_rows import ESTIMATE_UNITS, LOCATION_SCHEMA, TEXTS, declare, estimate_row, location_row
from gz_onboard.recording.logs import read_frames
from gz_onboard.vehicle import read_vehicle
from tests.display.served import ESTIMATE, Sender, command_running, send
from tests.support import LOGS, wait_for

SECONDS = 5
PATIENCE = 60.0  # s
FIRST = 7  # subscription
DATA = struct.Struct("<BIQ")  # operation, subscription, log time
GPS_MOTION = 1073


class Message(NamedTuple):
    topic: str
    time_ns: int
    row: dict[str, Any]


@contextmanager
def client(address: str, *topics: str) -> Iterator[tuple[dict[str, dict[str, Any]], Iterator[Message]]]:
    """A client by Foxglove's documented protocol: the channels advertised, by topic, and the messages of `topics`."""
    with connect(address, subprotocols=["foxglove.sdk.v1"]) as socket:  # type: ignore[list-item]

        def messages() -> Iterator[Message]:
            while True:
                data = socket.recv(PATIENCE)
                if isinstance(data, bytes):
                    operation, subscription, time_ns = DATA.unpack_from(data)
                    assert operation == 1
                    yield Message(topics[subscription - FIRST], time_ns, json.loads(data[DATA.size :]))

        there: dict[str, dict[str, Any]] = {}
        while not there.keys() >= set(topics):
            told = json.loads(socket.recv(PATIENCE))
            if told["op"] == "advertise":
                there |= {channel["topic"]: channel for channel in told["channels"]}
        wanted = [{"id": FIRST + n, "channelId": there[topic]["id"]} for n, topic in enumerate(topics)]
        socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        yield there, messages()


@contextmanager
def serving(channel: str, monkeypatch: pytest.MonkeyPatch, *options: str) -> Iterator[str]:
    """Its address."""
    arguments = ["--channel", channel, "--listen", "127.0.0.1:0", *options]
    with command_running(monkeypatch, command, *arguments) as said:
        wait_for(lambda: said, "it serves")
        yield said[0].split()[0]


class Kept:
    """A log that keeps what is declared, and the rows of each topic."""

    def __init__(self) -> None:
        self.of: dict[str, Any] = {}
        self.rows: dict[str, list[Any]] = {}

    def channel(self, topic: str, json_schema: Any) -> None:
        self.of[topic] = json_schema

    def frames(self, batch: Any) -> None:
        """Nothing."""

    def sample(self, topic: str, time_ns: int, values: Any, seen_ns: Any = None) -> None:
        self.rows.setdefault(topic, []).append(values)


def test_the_estimate_is_that_of_the_log_and_nothing_old(monkeypatch):
    logged = Kept()
    declare(logged, ())
    with serving("f1", monkeypatch) as address, client(address, "/estimate") as (channels, heard):
        assert channels.keys() == {"/estimate"}
        channel = channels["/estimate"]
        assert (channel["topic"], channel["encoding"], channel["schemaName"]) == (
            "/estimate",
            "json",
            "gz_onboard.Estimate",
        )
        assert json.loads(channel["schema"]) == logged.of["/estimate"]
        silent = next(heard).row
        assert silent.keys() == {*ESTIMATE_UNITS, *TEXTS}
        assert not any(silent[name] is not None for name in ESTIMATE_UNITS)
        assert silent["state"] == "UNKNOWN"
        there = replace(ESTIMATE, charge_power=500.0, time_to_full=3600.0, range_full=50_000.0)
        with Sender("f1", there):
            _, time_ns, row = next(
                one for one in heard if all(one.row[name] for name in ("range", "soc", "charge_power", "energy_left"))
            )
        assert time_ns > 1e18
        expected = estimate_row(there)
        for name in ESTIMATE_UNITS:
            if row[name] is not None:
                assert row[name] == pytest.approx(expected[name], rel=1e-3), name
        said = {name for name in ESTIMATE_UNITS if row[name] is not None}
        assert {"range", "range_p10", "range_p90", "soc", "soc_sd", "energy_left", "time_to_full", "range_full"} <= said
        assert {name: row[name] for name in TEXTS} == {name: expected[name] for name in TEXTS}
        gone = next(one.row for one in heard if one.row["soc"] is None)  # the status is stale after a second
        assert gone["soc_sd"] is None
        assert gone["state"] == "UNKNOWN"


@pytest.fixture(scope="module")
def ridden() -> list[Frame]:
    """The frames of the first seconds of a recorded ride."""
    frames = chain.from_iterable(read_frames(LOGS / "city_14C.blf"))
    first = next(frames)
    return [first, *takewhile(lambda frame: frame[0] - first[0] < SECONDS * 10**9, frames)]


def positions_of(frames: VehicleFrames, ridden: list[Frame]) -> dict[int, Any]:
    """By their times, each as it came."""
    found: dict[int, Any] = {}
    for frame in ridden:
        frames.take(frame, frame[0] * 1e-9)
        if place := frames.values(frame[0] * 1e-9)["position"]:
            found.setdefault(place["time_ns"], place)
    return found


@pytest.mark.parametrize(("fix", "told"), [(0, None), (1, None), (2, False), (3, True)])
def test_what_a_fix_tells(ridden, fix, told):
    """Nothing of one that is none; no altitude of one in two dimensions."""
    changed = [
        (t, i, bytes([*data[:6], data[6] & 0b1001_1111 | fix << 5, *data[7:]]) if i == GPS_MOTION else data, channel)
        for t, i, data, channel in ridden
    ]
    found = positions_of(VehicleFrames(read_vehicle("reference"), positions=True), changed)
    rows = [location_row(frame="gps", **one) for t, one in found.items() if t - ridden[0][0] > 10**9]
    assert bool(rows) is (told is not None)
    assert {"altitude" in row for row in rows} <= {told}


def test_positions_live(monkeypatch, ridden):
    vehicle = read_vehicle("reference")
    identifiers = VehicleFrames(vehicle, positions=True).identifiers or []
    mine = [frame for frame in ridden if frame[1] in identifiers]
    rows = positions_of(VehicleFrames(vehicle, positions=True), ridden).values()
    recorded = {(round(row["latitude"], 7), round(row["longitude"], 7)) for row in rows}
    began = time.time()
    with (
        serving("f3", monkeypatch, "--vehicle", "reference") as address,
        client(address, "/location", "/estimate") as (channels, heard),
        can.Bus(interface="virtual", channel="f3") as bus,
    ):
        assert channels["/location"]["schemaName"] == "foxglove.LocationFix"
        assert json.loads(channels["/location"]["schema"]) == LOCATION_SCHEMA
        assert next(heard).topic == "/estimate"  # comes each second; so what was asked for before is subscribed to, too
        for start in range(0, 400, 100):
            send(bus, mine[start : start + 100])
            _, time_ns, row = next(one for one in heard if one.topic == "/location")
            assert (row["latitude"], row["longitude"]) in recorded
            assert began <= row["timestamp"]["sec"] + 1
            assert began <= time_ns * 1e-9 <= time.time() + 1
