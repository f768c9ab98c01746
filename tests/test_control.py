"""The control socket: routes given, cleared and refused, and clients that do not keep to the rules."""

from __future__ import annotations

import socket
import stat

import pytest

from gz_onboard.cli import main
from gz_onboard.daemon import control
from gz_onboard.daemon.control import Control, ask
from gz_onboard.errors import InputError
from gz_onboard.events import RouteState
from gz_onboard.pipeline import Pipeline
from tests.support import reference

WAY = {"name": "home", "distance_m": [20.0 * i for i in range(50)], "altitude_m": [400.0] * 50}


@pytest.fixture
def pipeline():
    return Pipeline(reference())


@pytest.fixture
def listening(tmp_path, pipeline):
    it = Control(tmp_path / "control", lambda: pipeline)
    it.start()
    yield it, tmp_path / "control"
    it.close()


def test_a_route_is_given_asked_for_and_cleared(listening, pipeline):
    it, path = listening
    assert stat.S_IMODE(path.stat().st_mode) == 0o660
    assert ask(path, {"route": WAY}) == {"ok": True, "route": "home", "length_m": 980, "grade_known": True}
    assert pipeline.estimator.route.outlook.route_state == RouteState.NONE  # the loop has not been there
    it.take()
    assert pipeline.estimator.route.outlook.route_state == RouteState.OFF  # given, not yet known to be on it
    assert ask(path, {"status": True})["route"] == "home"
    assert ask(path, {"route": None}) == {"ok": True, "route": None}
    it.take()
    assert pipeline.estimator.route.outlook.route_state == RouteState.NONE


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"", "is not JSON"),
        (b"{", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        (b"3", "must be an object with one of route, status, is 3.0"),
        (b'{"rout": null}', r"must be an object with one of route, status, is \['rout'\]"),
        (b'{"route": 5}', "route: must be an object of lists or null, is 5.0"),
        (b'{"route": {}}', "route: has 0 points"),
        (b'{"route": {"distance_m": [0]}}', "route: has 1 points"),
        (b'{"route": {"distance": [0, 1]}}', r"unknown list 'distance' \(did you mean 'distance_m'\?\)"),
        (b'{"route": {"distance_m": 3}}', "route: distance_m: must be a list of numbers, is 3.0"),
        (b'{"route": {"distance_m": [0, "a"]}}', "route, point 2: distance_m: must be a finite number, is 'a'"),
        (b'{"route": {"distance_m": [0, NaN]}}', "route, point 2: distance_m: must be a finite number, is nan"),
        (b'{"route": {"distance_m": [0, 1%s]}}' % (b"0" * 400), "route, point 2: distance_m: must be a finite number"),
        (b'{"route": {"distance_m": [0, 20], "altitude_m": [0]}}', "its lists must be of one length"),
        (b'{"route": {"distance_m": [0, 20, 10]}}', "route, point 3: distance_m: 10 m does not increase"),
        (b'{"route": {"altitude_m": [0, 20]}}', "needs column distance_m, or latitude_deg"),
        (b'{"route": {"distance_m": [0, 20], "name": 3}}', "name: must be a text"),
    ],
)
def test_what_is_wrong_is_named_and_changes_nothing(line, message, pipeline):
    it = Control(None, lambda: pipeline)
    with pytest.raises(InputError, match=message):
        it.answer(line)
    it.take()
    assert pipeline.estimator.route.outlook.route_state == RouteState.NONE


def test_clients_that_stall_or_flood_are_left(listening, monkeypatch):
    monkeypatch.setattr(control, "MAX_REQUEST_BYTES", 100_000)
    monkeypatch.setattr(control, "TIMEOUT_S", 0.2)
    _, path = listening
    for sent, answer in ((b'{"status"', b""), (b"x" * 150_000, b"longer than 100000 bytes")):
        with socket.socket(socket.AF_UNIX) as client:
            client.settimeout(5)
            client.connect(str(path))
            client.sendall(sent)
            assert answer in client.recv(65536)
    with socket.socket(socket.AF_UNIX) as client:  # one that goes away at once
        client.connect(str(path))
    assert ask(path, {"status": True})["ok"]


def test_the_command(listening, tmp_path, capsys):
    _, path = listening
    file = tmp_path / "way.route.csv"
    file.write_text("distance_m\n0\n20\n40\n")
    assert main(["route", str(file), "--socket", str(path)]) == 0
    assert capsys.readouterr().out == "route  way, 0.04 km\nwithout altitudes hills are not counted\n"
    assert main(["route", "--socket", str(path)]) == 0
    assert capsys.readouterr().out == "route  way\n  not yet looked for\n"
    assert main(["route", "--clear", "--socket", str(path)]) == 0
    assert main(["route", "--socket", str(path)]) == 0
    assert capsys.readouterr().out == "route  none\nroute  none\n"
    assert main(["route", "--socket", str(tmp_path / "none")]) == 2
    assert "no daemon answers" in capsys.readouterr().err
    file.write_text("distance_m\n0\n0\n")
    assert main(["route", str(file), "--socket", str(path)]) == 2
    assert "way.route.csv:3: distance_m: 0 m does not increase" in capsys.readouterr().err
