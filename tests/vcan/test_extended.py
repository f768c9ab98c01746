"""An extended model in the daemon on a real vcan: the same daemon, the vehicle's file names more effects."""

from __future__ import annotations

from gz_onboard.vehicle import read_vehicle
from tests.support import LOGS, ROOT
from tests.vcan.support import Listener, Running

CITY = LOGS / "city_14C.blf"
SECONDS = 12.0
DISCOVERED = ROOT / "tests" / "vehicles" / "discovered.toml"  # see tests/test_turning_loss.py


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
