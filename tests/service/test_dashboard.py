"""The page's service beside the daemon: what systemd/README.md promises of it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from tests.service.support import ROOT, UNIT, output, systemctl, wait_for

PAGE = "gz-onboard-dashboard.service"
ADDRESS = "http://127.0.0.1:8000"


def latest() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(urlopen(f"{ADDRESS}/api/latest", timeout=30).read())
    return found


def pid() -> int:
    return int(systemctl("show", PAGE, "--value", "-p", "MainPID"))


def active() -> bool:
    return systemctl("show", PAGE, "--value", "-p", "ActiveState") == "active"


@pytest.fixture
def page(installed: None) -> Iterator[None]:
    shutil.copy(ROOT / "systemd" / PAGE, "/etc/systemd/system/")
    places = Path(f"/etc/systemd/system/{PAGE}.d")
    places.mkdir(exist_ok=True)
    shutil.copy(f"/etc/systemd/system/{UNIT}.d/checkout.conf", places)
    settings = Path("/etc/default/gz-onboard")
    if "vcan0 --listen" not in settings.read_text():
        with settings.open("a") as file:
            file.write('DASHBOARD="--channel vcan0 --listen 127.0.0.1:8000"\n')
    systemctl("daemon-reload")
    systemctl("start", PAGE)
    yield
    systemctl("stop", PAGE)


def test_it_shows_the_daemon_and_outlives_it(page, service, ride):
    assert output("systemd-analyze", "verify", f"/etc/systemd/system/{PAGE}") == ""
    assert urlopen(f"{ADDRESS}/", timeout=30).read().startswith(b"<!doctype html>")
    wait_for(lambda: latest()["range"]["km"] is not None, 30, "a range")
    wait_for(lambda: latest()["cells"] and latest()["odometer_km"], 30, "the vehicle's own frames")
    day = json.loads(Path("/var/lib/gz-onboard-dashboard/day.json").read_text())
    assert day["odometer_km"] == pytest.approx(latest()["odometer_km"], abs=5.0)
    before = pid()
    systemctl("stop", UNIT)
    wait_for(lambda: latest()["alerts"] == ["silent"], 30, "silence is told")
    systemctl("start", UNIT)
    wait_for(lambda: latest()["range"]["km"] is not None, 60, "the range again")
    assert pid() == before
