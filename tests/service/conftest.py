"""The service as it is installed, under the real systemd of a guest whose files nobody misses."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.service.support import ROOT, UNIT, Listener, systemctl


@pytest.fixture(scope="session", autouse=True)
def guest() -> None:
    if not Path("/run/vcan-guest").is_dir() or Path("/proc/1/comm").read_text().strip() != "systemd":
        pytest.skip("installs a service: only by tests/vcan-guest --systemd -- .venv/bin/pytest tests/service")


@pytest.fixture(scope="session")
def installed(guest: None) -> None:
    """Install as systemd/README.md says, on vcan0, except that /opt/gz-onboard is this environment."""
    opt = Path("/opt/gz-onboard")
    if not opt.exists():
        opt.symlink_to(sys.prefix)
    shutil.copy(ROOT / "systemd" / UNIT, "/etc/systemd/system/")
    shutil.copy(ROOT / "systemd" / "gz-onboard.default", "/etc/default/gz-onboard")
    with Path("/etc/default/gz-onboard").open("a") as settings:
        settings.write('OPTIONS="--channel vcan0"\n')

    # A checkout may be where the service's own user cannot look: below a closed home, or in /tmp, which is private.
    places = {ROOT, Path(sys.prefix), Path(sys.base_prefix), Path(sys.executable).resolve().parents[1]}
    for place in places:
        for directory in [place, *place.parents]:
            directory.chmod(directory.stat().st_mode | 0o055)
    dropin = Path(f"/etc/systemd/system/{UNIT}.d/checkout.conf")
    dropin.parent.mkdir()
    temporary = [str(p) for p in places if Path("/tmp") in p.parents or Path("/var/tmp") in p.parents]
    dropin.write_text(f"[Service]\nBindReadOnlyPaths={' '.join(temporary)}\n")
    systemctl("daemon-reload")


@pytest.fixture
def service(installed: None) -> Iterator[None]:
    """The service, active, without a past; stopped afterwards."""
    for directory in "/var/lib/private/gz-onboard", "/var/log/private/gz-onboard":
        shutil.rmtree(directory, ignore_errors=True)
    systemctl("start", UNIT)
    yield
    systemctl("stop", UNIT)


@pytest.fixture
def listener() -> Iterator[Listener]:
    listening = Listener()
    yield listening
    listening.bus.shutdown()


@pytest.fixture
def ride() -> Iterator[subprocess.Popen[bytes]]:
    """A recorded ride on vcan0, over and over."""
    log = sorted((ROOT / "replay_logs").glob("*.blf"))[0]
    command = [f"{sys.prefix}/bin/gz-onboard", "replay", str(log), "--channel", "vcan0", "--loop"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        yield process
        process.terminate()
