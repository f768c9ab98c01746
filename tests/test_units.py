"""The systemd units, read without a system that runs them."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from tests.support import ROOT

MOST = {"gz-onboard-kiosk.service": 2.5}  # it has a screen
"""Of the exposure that `systemd-analyze security` gives, from 0 to 10; 1.5 for all other units."""


@pytest.mark.parametrize("unit", sorted((ROOT / "systemd").glob("*.service")), ids=lambda unit: unit.name)
def test_little_is_open(unit):
    if not shutil.which("systemd-analyze"):
        pytest.skip("no systemd-analyze")
    limit = f"--threshold={10 * MOST.get(unit.name, 1.5):.0f}"
    command = ["systemd-analyze", "security", "--offline=yes", "--no-pager", limit, str(unit)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-200:] + done.stderr
