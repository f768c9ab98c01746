"""The Debian package on a minimal Debian that is not this machine's, with what it depends on and nothing else.

Not part of `make test`, since it takes longer than that has left: `make deb-clean-root`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.service.test_debian import next_version
from tests.support import LOGS, ROOT

IMAGE = os.environ.get("GZ_ONBOARD_CLEAN_ROOT")
SCRIPT = ROOT / "tests" / "clean_root" / "life.sh"


@pytest.mark.skipif(IMAGE is None, reason="no $GZ_ONBOARD_CLEAN_ROOT: make deb-clean-root")
def test_from_installation_to_purge_on_a_clean_debian(tmp_path: Path) -> None:
    built = [sys.executable, "packaging/debian/build.py", str(tmp_path), "--installed"]
    told = subprocess.run(built, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout
    package = Path(told.splitlines()[-1])
    newer = next_version(package, tmp_path)
    guest = [str(ROOT / "tests" / "vcan-guest"), "--systemd", "--base", str(IMAGE), "--ifaces", "can0"]
    shared = ["--share", str(ROOT), "--share", str(tmp_path)]
    life = ["sh", str(SCRIPT), str(package), str(newer), str(LOGS / "city_14C.blf")]
    done = subprocess.run([*guest, *shared, "--", *life], cwd=ROOT, check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1] == "--- all as it was before"
