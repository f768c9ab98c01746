"""The bridge to a broker: a real one, a bus in this process, and what a daemon sends."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from typing import Any

import jinja2
import pytest

from gz_onboard.display import mqtt
from gz_onboard.display.view import View
from gz_onboard.events import Activity, State
from tests.display.broker import Listener, broker, free_port, listening
from tests.display.served import ESTIMATE, Sender, command_running
from tests.support import wait_for

STATE, ABOUT = "gz-onboard/scooter/state", "homeassistant/device/gz-onboard-scooter/config"
NUMBERS = [key for key, (_, about) in mqtt.SENSORS.items() if "unit_of_measurement" in about]


def bridge(
    port: int, channel: str, *options: str, monkeypatch: pytest.MonkeyPatch
) -> AbstractContextManager[list[str]]:
    return command_running(monkeypatch, mqtt, f"127.0.0.1:{port}", "--channel", channel, "--name", "scooter", *options)


def shown(about: dict[str, Any], state: dict[str, Any]) -> dict[str, str]:
    """What Home Assistant makes of it: the value of each sensor that is available."""
    rendered = {}
    for key, sensor in about["components"].items():
        (availability,) = sensor["availability"]
        there = jinja2.Template(availability["value_template"]).render(value_json=state)
        assert there in ("online", "offline")  # what Home Assistant expects, unless it is told others
        assert availability["topic"] == about["state_topic"]
        if there == "online":
            rendered[key] = jinja2.Template(sensor["value_template"]).render(value_json=state)
    return rendered


def seen(listener: Listener) -> dict[str, str]:
    return shown(listener.last[ABOUT], listener.last[STATE]) if {ABOUT, STATE} <= listener.last.keys() else {}


def test_home_assistant_finds_the_vehicle_and_shows_what_is_on_the_bus(tmp_path, monkeypatch):
    port = free_port()
    with broker(tmp_path, port), listening(port) as listener, bridge(port, "m1", monkeypatch=monkeypatch) as said:
        wait_for(lambda: STATE in listener.last, "a state")
        assert seen(listener) == {"alert": "silent"}
        assert listener.expires == {STATE: 30, ABOUT: None}  # a broker that loses power loses the last will
        with Sender("m1", ESTIMATE) as sender:
            wait_for(lambda: {"range", "state_of_charge", "energy_left"} <= seen(listener).keys(), "the range")
            found = seen(listener)
            assert float(found["range"]) == 34.21
            assert float(found["range_p10"]) == 26.54
            assert float(found["state_of_charge"]) == 62.4
            assert found["state"] == "degraded"
            assert found["activity"] == "riding"
            assert found["alert"] == "none"
            assert found["reasons"] == "no_imu, prior_riding"
            assert "charge_power" not in found
            sender.estimate = replace(ESTIMATE, activity=Activity.CHARGING, charge_power=500.0, time_to_full=3600.0)
            wait_for(lambda: seen(listener).get("time_to_full") == "60.0", "the charge")
            sender.estimate = replace(ESTIMATE, state=State.INVALID, range=None, range_p10=None, range_p90=None)
            wait_for(lambda: seen(listener).get("alert") == "range_invalid", "an estimate that is not valid")
            assert not {"range", "range_p10", "range_p90"} & seen(listener).keys()
        wait_for(lambda: seen(listener) == {"alert": "silent"}, "nothing of a daemon that is gone")
        # who comes later is told the same
        with listening(port) as late:
            wait_for(lambda: {STATE, ABOUT} <= late.last.keys(), "what was kept")
            assert not [key for key in NUMBERS if late.last[STATE][key] is not None]
        assert said == [f"connected to the broker 127.0.0.1:{port}"]
    assert {topic for topic, _ in listener.heard} == {STATE, ABOUT}
    assert listener.last[STATE]["status"] == "offline"
    assert said == [f"connected to the broker 127.0.0.1:{port}"]  # that the bridge is ended says nothing of the broker


def test_of_a_bridge_that_is_killed_no_number_is_left(tmp_path):
    """A process of its own. It is killed on a bus that nobody else is on, so its state is rewritten as if of a ride."""
    port = free_port()
    command = [sys.executable, "-m", "gz_onboard", "mqtt", f"127.0.0.1:{port}", "--name", "scooter"]
    with broker(tmp_path, port), listening(port) as listener, ExitStack() as stack:
        process = stack.enter_context(
            subprocess.Popen([*command, "--interface", "virtual", "--channel", "k"], stdout=subprocess.PIPE, text=True)
        )
        assert process.stdout is not None
        assert process.stdout.readline() == f"mqtt: connected to the broker 127.0.0.1:{port}\n"
        wait_for(lambda: listener.last.get(STATE, {}).get("status") == "online", "it is there")
        kept = {**listener.last[STATE], "range": 12.3}
        listener.client.publish(STATE, json.dumps(kept), retain=True)
        wait_for(lambda: (STATE, kept) in listener.heard, "a number in the state")
        os.kill(process.pid, signal.SIGKILL)
        wait_for(lambda: listener.last[STATE]["status"] == "offline", "the last will")
        assert not [key for key in NUMBERS if listener.last[STATE][key] is not None]
        with listening(port) as late:
            wait_for(lambda: STATE in late.last, "what was kept")
            assert late.last[STATE]["status"] == "offline"


def test_user_and_password(tmp_path, monkeypatch):
    port = free_port()
    passwords = tmp_path / "passwords"
    passwords.write_text("rider:secret\n")
    subprocess.run(["mosquitto_passwd", "-U", passwords], check=True)
    login = tmp_path / "login.toml"
    login.write_text('user = "rider"\npassword = "wrong"\n')
    login.chmod(0o600)
    settings = "allow_anonymous false", f"password_file {passwords}"
    with broker(tmp_path, port, *settings), listening(port, ("rider", "secret")) as listener:
        with bridge(port, "m4", "--login", str(login), monkeypatch=monkeypatch) as said:
            wait_for(lambda: bool(said), "that it is refused")
            assert re.search("refuses us: (Bad user name or password|Not authorized)", said[0])
        login.write_text('user = "rider"\npassword = "secret"\n')
        with bridge(port, "m4", "--login", str(login), monkeypatch=monkeypatch):
            wait_for(lambda: STATE in listener.last, "a state")


def test_encrypted(tmp_path, monkeypatch):
    port = free_port()
    made = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=localhost"
    files = ["-keyout", str(tmp_path / "key.pem"), "-out", str(tmp_path / "cert.pem")]
    names = ["-addext", "subjectAltName=IP:127.0.0.1,DNS:localhost"]
    subprocess.run([*made.split(), *files, *names], check=True, capture_output=True)
    settings = "allow_anonymous true", f"certfile {tmp_path}/cert.pem", f"keyfile {tmp_path}/key.pem"
    with broker(tmp_path, port, *settings):
        with bridge(port, "m5", "--tls", str(tmp_path / "cert.pem"), monkeypatch=monkeypatch) as said:
            wait_for(lambda: bool(said), "an answer")
            assert said == [f"connected to the broker 127.0.0.1:{port}"]
        with bridge(port, "m5", "--tls", monkeypatch=monkeypatch) as said:
            wait_for(lambda: bool(said), "an answer")
            assert "cannot be reached: " in said[0]
            assert "certificate" in said[0].lower()


def test_each_value_of_a_picture_has_a_sensor():
    picture = View().picture(0.0, "a", "virtual", True)
    assert mqtt.state_of(picture).keys() - {"status"} == mqtt.SENSORS.keys()
    long = mqtt.state_of(picture | {"state": "degraded", "reasons": ["no_imu"] * 100})["reasons"]
    assert len(long) <= 255
    assert set(long.split(", ")) == {"no_imu"}
