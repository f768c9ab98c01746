"""The service that speaks to a broker: what docs/how-to/home-assistant.md promises of it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.display.broker import Listener, broker, free_port, listening
from tests.service.support import ROOT, UNIT, output, systemctl, wait_for

BRIDGE = "gz-onboard-mqtt.service"
STATE = "gz-onboard/scooter/state"


@pytest.fixture
def told(installed: None, tmp_path: Path) -> Iterator[Listener]:
    """What a broker that asks for a password hears of the service."""
    port = free_port()
    passwords = tmp_path / "passwords"
    passwords.write_text("rider:secret\n")
    output("mosquitto_passwd", "-U", str(passwords))
    login = Path("/etc/gz-onboard-mqtt.toml")
    login.write_text('user = "rider"\npassword = "secret"\n')
    login.chmod(0o600)
    shutil.copy(ROOT / "systemd" / BRIDGE, "/etc/systemd/system/")
    places = Path(f"/etc/systemd/system/{BRIDGE}.d")
    places.mkdir(exist_ok=True)
    shutil.copy(f"/etc/systemd/system/{UNIT}.d/checkout.conf", places)
    with Path("/etc/default/gz-onboard").open("a") as file:
        file.write(f'MQTT="127.0.0.1:{port} --channel vcan0 --name scooter"\n')
    settings = "allow_anonymous false", f"password_file {passwords}"
    with broker(tmp_path, port, *settings), listening(port, ("rider", "secret")) as listener:
        systemctl("daemon-reload")
        systemctl("start", BRIDGE)
        yield listener
        systemctl("stop", BRIDGE)


def test_it_is_closed_and_tells_and_says_goodbye(told):
    assert output("systemd-analyze", "verify", f"/etc/systemd/system/{BRIDGE}") == ""
    wait_for(lambda: told.last.get(STATE, {}).get("status") == "online", 60, "it is there")
    assert told.last[STATE]["alert"] == "silent"
    systemctl("stop", BRIDGE)
    wait_for(lambda: told.last[STATE]["status"] == "offline", 60, "goodbye")
