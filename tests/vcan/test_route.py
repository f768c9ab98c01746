"""A route over the control socket: the daemon, the command and the replay as processes of their own."""

from __future__ import annotations

from pathlib import Path

from gz_onboard.daemon.control import ask
from gz_onboard.events import RouteState
from tests.vcan.support import Listener, Running, wait_for


def test_a_route_given_to_the_running_daemon_is_on_the_bus(running: Running, tmp_path: Path):
    way = tmp_path / "way.route.csv"
    way.write_text("distance_m,altitude_m\n" + "".join(f"{20 * i},{300 + 0.2 * i}\n" for i in range(500)))
    path = tmp_path / "control"
    with Listener() as listener:
        daemon = running.daemon("--control-socket", str(path))
        running.replay()
        listener.wait_for_valid(3)
        assert listener.decoded("RANGE_Route")[-1]["RANGE_RouteState"] == RouteState.NONE
        assert running.start("route", str(way), "--socket", str(path)).wait(30) == 0

        def on_route() -> bool:
            return bool(listener.decoded("RANGE_Route")[-1]["RANGE_RouteState"] == RouteState.ON)

        wait_for(on_route, 10, "the route is on the bus")
        last = listener.decoded("RANGE_Route")[-1]
        assert 8 < last["RANGE_RouteLeft"] < 10  # km
        assert 0 < last["RANGE_ArrivalStateOfChargeP10"] <= last["RANGE_ArrivalStateOfCharge"] < 100
        assert ask(path, {"status": True})["route"] == "way"
        assert "must be a list" in str(ask(path, {"route": {"distance_m": 3}})["error"])
        assert on_route()
        assert running.start("route", "--clear", "--socket", str(path)).wait(30) == 0
        wait_for(lambda: not on_route(), 10, "the route is cleared")
        daemon.stop()
    assert any(row["route_state"] == "ON" and row["arrival_soc"] is not None for row in daemon.estimates())
    assert not path.exists()
