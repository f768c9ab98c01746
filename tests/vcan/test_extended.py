"""An extended model in the daemon on a real vcan: the same daemon, the vehicle's file names more effects."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gz_onboard.vehicle import OWN, read_vehicle
from tests.support import LOGS, ROOT
from tests.vcan.support import Listener, Running

CITY = LOGS / "city_14C.blf"
SECONDS = 12.0
DISCOVERED = ROOT / "tests" / "vehicles" / "discovered.toml"  # see tests/test_turning_loss.py
MORE = '"slow_relaxation", "cornering_drag", "headwind", "ocv_hysteresis", "rough_road",\n]\neffects_folder = "effects"'
VALUES = """[parameters]
wind_north = { value = 4.0, unit = "m/s", sd = 1.0, status = "guess", source = "made up for a test" }
pack_voltage_latency = { value = 0.1, unit = "s", sd = 0.05, status = "guess", source = "made up for a test" }
"""
ROUGH = """'''Drag in proportion to the vibration, as discovery writes a curve over it; made up for a test.'''
from gz_onboard.model.effect import Parameter, Port
PORT = Port.WHEEL_FORCE
PARAMETERS = (Parameter("rough_road_drag", "N·s²/m", 6.0, 1.0, 0.0, 50.0, "made up for a test"),)
def term(vibration, *, rough_road_drag):
    return rough_road_drag * vibration
"""


def extended(folder: Path) -> Path:
    """The reference scooter with more effects, one a file of its own, and a current sensor that shows 2 A more."""
    text = (OWN / "reference.toml").read_text()
    for old, new in (
        ('"slow_relaxation",\n]', MORE),
        ("[parameters]\n", VALUES),
        ("slow_resistance = { value = 0.0151295", "slow_resistance = { value = 0.03"),
        ("pack_current_offset = { value = 0.02", "pack_current_offset = { value = 2.02"),
    ):
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    (folder / "effects").mkdir(exist_ok=True)
    (folder / "effects" / "rough_road.py").write_text(ROUGH)
    file = folder / "extended.toml"
    file.write_text(text)
    return file


@pytest.fixture
def pair(running: Running, tmp_path: Path):
    """The extended daemon on vcan0 and the base one on vcan1, the same ride on both."""
    with Listener() as listener, Listener("vcan1") as other:
        file = extended(tmp_path)
        more = running.daemon("--vehicle", str(file), "--effects", str(file.parent / "effects"), name="extended")
        base = running.daemon(channels=("vcan1",), name="base")
        replays = [running.replay(CITY, channel=channel) for channel in ("vcan0", "vcan1")]
        listener.wait_for_valid(SECONDS)
        other.wait_for_valid(SECONDS)
        for replay in replays:
            replay.terminate()
            replay.wait(10)
        summaries = [daemon.stop() for daemon in (more, base)]
    yield more, base, listener, summaries


def test_an_extended_model_runs_as_it_is_and_expects_less_range(running: Running, pair):
    more, base, listener, summaries = pair
    assert all("dropped 0" in summary for summary in summaries)
    last, other = more.estimates()[-1], base.estimates()[-1]
    assert last["consumption_expected"] > 1.02 * other["consumption_expected"]  # bends and the mean wind
    assert last["range"] < 0.98 * other["range"]
    assert last["energy_left"] < other["energy_left"]  # the slow resistance
    published = listener.decoded("RANGE_Estimate")[-1]["RANGE_Remaining"]
    assert any(1000 * published == pytest.approx(row["range"], abs=6) for row in more.estimates()[-4:])

    # A restart goes on with the own state, in the cells too; that of the other model is refused, whole.
    (file,) = (path for path in more.state_dir.glob("*.json") if not path.stem.endswith(".previous"))
    assert json.loads(file.read_text())["estimator"]["cell_effects"]["slow_relaxation"] > 0
    file = more.state_dir.parent / "extended.toml"
    journals = [daemon.journal for daemon in (more, base)]
    for name in ("extended", "base"):
        running.daemon("--vehicle", str(file), "--effects", str(file.parent / "effects"), name=name).stop()
    own, foreign = (daemon.journal.removeprefix(old) for daemon, old in zip((more, base), journals, strict=True))
    assert "continuing from the state" in own
    assert "not used" in foreign
    assert "ocv_hysteresis" in foreign  # it says which models do not agree


def test_the_file_that_discover_wrote_runs_as_it_is(running: Running):
    assert "cornering_drag" in {effect.name for effect in read_vehicle(str(DISCOVERED)).model.effects}
    with Listener() as listener:
        daemon = running.daemon("--vehicle", str(DISCOVERED), name="discovered")
        replay = running.replay(CITY, channel="vcan0")
        listener.wait_for_valid(SECONDS / 2)
        replay.terminate()
        replay.wait(10)
        assert "dropped 0" in daemon.stop()
    assert 5 < listener.decoded("RANGE_Estimate")[-1]["RANGE_Remaining"] < 120  # km
