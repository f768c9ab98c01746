"""What `make run` shows: the page's address, and a picture of it beside the log."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.browser.support import CHROMIUM, LONG
from tests.support import LOGS, ROOT


def demo(folder: Path, *options: object, path: str = "/usr/local/bin:/usr/bin:/bin") -> str:
    command = [sys.executable, "replay_logs/demo.py", LOGS / "city_14C.blf", "--interface", "virtual", *options]
    words = [*map(str, command), "--output", str(folder)]
    environment = {"PATH": path, "PYTHONPATH": str(ROOT), "HOME": str(folder.parent)}
    done = subprocess.run(
        words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=10 * LONG
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_it_leaves_a_picture_of_the_page(tmp_path):
    pytest.importorskip("playwright", reason="no Playwright: .ci/setup venv")
    if not CHROMIUM:
        pytest.skip("no chromium: .ci/setup browser")
    from PIL import Image

    for seconds in 10, 60, 240:  # a busy machine may need long to start a browser
        told = demo(tmp_path / str(seconds), "--seconds", seconds)
        folder = tmp_path / str(seconds)
        if (folder / "page.png").exists():
            break
    assert re.search(r"^=== The dashboard's page: http://127\.0\.0\.1:\d+/$", told, re.M)
    assert f"page          {folder}/page.png" in told
    picture = Image.open(folder / "page.png").convert("RGB")
    assert picture.width == 800
    assert len(picture.getcolors(1 << 24) or ()) > 20  # black, white and blue, and the edges of letters
    assert {path.suffix for path in folder.iterdir()} >= {".mcap", ".png", ".log"}


def test_without_a_browser_it_says_where_the_page_was(tmp_path):
    told = demo(tmp_path / "run", "--seconds", 5, path="")
    assert re.search(r"^page +was at http://127\.0\.0\.1:\d+/; no picture of it", told, re.M)
