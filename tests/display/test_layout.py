"""A log as the daemon writes it, as others read it: positions, signals, and the layout for Foxglove."""

from __future__ import annotations

import json
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from gz_onboard.can.recorder import LogLimits, Recorder
from gz_onboard.events import Frame
from gz_onboard.pipeline import Pipeline
from gz_onboard.recording.logs import read_frames
from gz_onboard.vehicle import read_vehicle
from tests.support import LOGS, ROOT

LAYOUT = ROOT / "gz_onboard" / "display" / "foxglove_layout.json"
SECONDS = 120


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of two minutes of a recorded ride, drained ten times a second and synced at odd times."""
    recorder = Recorder(tmp_path_factory.mktemp("log"), "reference", limits=LogLimits(sync_s=1.3))
    pipeline = Pipeline(read_vehicle("reference"), log=recorder)
    tick: list[Frame] = []
    start = 0
    for frame in chain.from_iterable(read_frames(LOGS / "city_14C.blf")):
        start = start or frame[0]
        if tick and frame[0] - tick[0][0] > 100_000_000:
            pipeline.advance(tick, tick[-1][0])
            recorder.sync(tick[-1][0])
            tick = []
        tick.append(frame)
        if frame[0] - start > SECONDS * 10**9:
            break
    recorder.close()
    assert not recorder.errors
    return recorder.paths[0]


def messages(log: Path) -> dict[str, list[dict[str, Any]]]:
    """Of each JSON topic what another reader finds on it."""
    found: dict[str, list[dict[str, Any]]] = {}
    with log.open("rb") as stream:
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            if channel.message_encoding == "json":
                found.setdefault(channel.topic, []).append(json.loads(message.data))
    return found


def placed(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else [*placed(node["first"]), *placed(node["second"])]


def paths(panel: dict[str, Any]) -> list[str]:
    """The message paths of a panel, and the topics of a map."""
    found = [path["value"] for path in panel.get("paths", [])]
    found += [panel[key] for key in ("topicPath", "followTopic") if key in panel]
    return found + list(panel.get("topicColors", {}))


def test_every_panel_of_the_layout_finds_what_it_shows(log):
    layout = json.loads(LAYOUT.read_text())
    assert sorted(placed(layout["layout"])) == sorted(layout["configById"])
    found = messages(log)
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    known = {
        channel.topic: json.loads(summary.schemas[channel.schema_id].data)["properties"]
        for channel in summary.channels.values()
        if channel.message_encoding == "json"
    }
    for name, panel in layout["configById"].items():
        assert paths(panel), name
        for path in paths(panel):
            topic, _, field = path.partition(".")
            assert topic in known, f"{name}: {path}"
            if field:
                assert field in known[topic], f"{name}: {path}"
                assert any(message[field] is not None for message in found[topic]), f"{name}: {path}"
