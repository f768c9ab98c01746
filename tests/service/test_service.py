"""The daemon as a service on vcan0: what systemd/README.md promises."""

from __future__ import annotations

import os
import shutil
import signal
import time
from pathlib import Path

import pytest

from tests.service.support import (
    ROOT,
    SOC,
    UNIT,
    Listener,
    journal,
    link,
    main_pid,
    output,
    show,
    systemctl,
    wait_for,
    wait_for_another,
)

README = ROOT / "systemd" / "README.md"
SIGMA = "RANGE_StateOfChargeSigma"


def first_soc(listener: Listener) -> dict[str, float]:
    """The first status frame whose state of charge is available."""
    for _ in range(100):
        status = listener.next(SOC)
        if status[SOC] <= 100 and status[SIGMA] <= 25.4:
            return status
    pytest.fail(f"no state of charge within 100 status frames; the last: {status}\n{journal()}")


def test_networkd_takes_the_network_files():
    for file in (ROOT / "systemd").glob("80-*"):
        shutil.copy(file, "/etc/systemd/network")
    # One that is wrong, so that we know that a complaint would be seen.
    Path("/etc/systemd/network/90-broken.network").write_text("[Match]\nName=none\n[CAN]\nBitRat=500K\n")
    output("ip", "link", "delete", "vcan0")
    try:
        systemctl("start", "systemd-networkd")
        wait_for(lambda: "LOWER_UP" in link("vcan0"), 10, "vcan0 made and brought up by systemd-networkd")
        complaints = [line for line in journal("systemd-networkd").splitlines() if "ignoring" in line]
        assert any("90-broken.network" in line for line in complaints)
        assert not any("/80-" in line for line in complaints)
    finally:
        systemctl("stop", "systemd-networkd.socket", "systemd-networkd")
        if not link("vcan0"):
            output("ip", "link", "add", "dev", "vcan0", "type", "vcan")
        output("ip", "link", "set", "vcan0", "up")


def test_starts_when_the_interface_appears(installed):
    output("ip", "link", "delete", "vcan0")
    try:
        systemctl("enable", UNIT)
        time.sleep(1)
        assert show("ActiveState") == "inactive"
        output("ip", "link", "add", "dev", "vcan0", "type", "vcan")
        output("ip", "link", "set", "vcan0", "up")
        wait_for(lambda: show("ActiveState") == "active", 20, "active after vcan0 appeared")
    finally:
        systemctl("disable", UNIT)
        systemctl("stop", UNIT)


def test_ready_without_rights_and_stopped_in_order(service, listener, ride):
    assert show("ActiveState") == "active"
    lines = Path(f"/proc/{main_pid()}/status").read_text().splitlines()
    fields = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    assert fields["Uid"].split()[0] != "0"
    assert int(fields["CapEff"], 16) == 0
    assert fields["NoNewPrivs"] == "1"
    assert fields["Seccomp"] == "2"  # the kernel filters its system calls
    assert Path(f"/proc/{main_pid()}/uid_map").read_text().split()[:3] != ["0", "0", "4294967295"]  # users of its own
    first_soc(listener)
    wait_for(lambda: "%" in show("StatusText"), 10, "range and state of charge in systemctl status")
    started = time.monotonic()
    systemctl("stop", UNIT)
    assert time.monotonic() - started < 10
    assert show("Result") == "success"
    files = [*Path("/var/log/gz-onboard").iterdir(), *Path("/var/lib/gz-onboard").iterdir()]
    assert {file.suffix for file in files} >= {".mcap", ".json"}
    assert {file.stat().st_mode & 0o077 for file in files} == {0}
    for line in README.read_text(encoding="utf-8").splitlines():  # how to have a copy
        if line.strip().startswith("sudo sh -c"):
            output("sh", "-c", f"cd /run/tmp && SUDO_USER=nobody {line.strip().removeprefix('sudo ')}")
    (copy,) = Path("/run/tmp").glob("*.mcap")
    assert (copy.owner(), copy.stat().st_mode & 0o777) == ("nobody", 0o644)


def test_hung_it_is_started_again(service, listener, ride):
    pid = main_pid()
    os.kill(pid, signal.SIGSTOP)
    time.sleep(4)
    assert main_pid() == pid  # not before its time
    wait_for_another(pid, 40)
    assert "Watchdog timeout" in journal()
    listener.next(SOC)
