"""What `make run` shows: a full discharge with its range, and what three rides hide, on one screen."""

from __future__ import annotations

import re
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from urllib.parse import urlparse

from gz_onboard.cli import main
from tests.support import LOGS, ROOT

BEGIN = 6400.0  # s into the ride: its last 20 minutes
SECONDS = 10


def test_it_shows_range_and_discovery_on_one_screen(tmp_path):
    ride, folder = tmp_path / "end.blf", tmp_path / "run"
    assert main(["export", str(LOGS / "full_discharge.mcap"), str(ride), "--from", str(BEGIN)]) == 0
    words = [ride, "--bus", "virtual", "--seconds", SECONDS, "--output", folder]
    told = []
    with subprocess.Popen(
        [sys.executable, ROOT / "replay_logs" / "demo.py", *map(str, words)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        for line in process.stdout or ():
            told.append(line.rstrip("\n"))
            if address := re.search(r"Dashboard: (http://127\.0\.0\.1:\d+/)", line):
                page = opened(address[1])
        wrong = process.stderr.read() if process.stderr else ""
    assert (process.returncode, wrong) == (0, "")
    assert b"<html" in page
    assert len(told) <= 40
    assert max(map(len, told)) <= 110
    text = "\n".join(told)
    assert not re.findall(r"\b[A-Z]+_[A-Z_]+\b", text)  # the daemon's reasons
    assert "virtual bus (no CAN socket)" in text

    rows = [re.findall(r"[\d.]+", line) for line in told if re.match(r" +\d+ % +\d", line)]
    *_, before, end = ([float(number) for number in row] for row in rows)
    assert end[5] < 0.1  # km that were left
    assert end[1] > before[1]
    for _, _, median, p10, p90, left, _ in before, end:
        assert p10 <= median <= p90 <= left + 1.0
        assert p10 - 0.1 <= left
    assert f"promised another {end[6]:.1f} km" in text
    assert (folder / "range.png").read_bytes().startswith(b"\x89PNG")
    (found,) = re.findall(r"Found: .*\(cornering_drag\), (\S+) % of the energy", text)
    assert 2 < float(found) < 5
    (uri,) = re.findall(r"Report: (file://\S+)", text)
    assert "<html" in Path(urlparse(uri).path).read_text(encoding="utf-8")


def opened(address: str) -> bytes:
    """The page, as soon as somebody serves it; the bytes of no page if that is too late."""
    for _ in range(200):
        try:
            return bytes(urllib.request.urlopen(address, timeout=5).read())
        except OSError:
            time.sleep(0.05)
    return b""
