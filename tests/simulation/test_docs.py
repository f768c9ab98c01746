"""What docs/explanation/simulation.md says: its example runs, its files and tests are there."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "explanation" / "simulation.md").read_text(encoding="utf-8")
ROWS = [line.split("|")[1:-1] for line in TEXT.splitlines() if re.match(r"\| (\d|ch\. 4|brakes|  *\|)", line)]
EQUATIONS = [row for row in ROWS if len(row) == 4 and ".py`" in row[2]]


def test_the_example_runs():
    (example,) = re.findall(r"```python\n(.*?)```", TEXT, re.S)
    run = subprocess.run([sys.executable, "-c", example], cwd=ROOT, check=True, capture_output=True, text=True)
    assert "Wh/km" in run.stdout
    assert "motor_map_loss" in run.stdout
    assert "motor_copper_loss" not in run.stdout


@pytest.mark.parametrize("row", EQUATIONS, ids=lambda row: row[0].strip() or row[1].strip())
def test_each_equation_has_its_file_and_its_test(row):
    for file in re.findall(r"`([^`]+\.py)`", row[2]):
        assert (ROOT / "gz_onboard" / ("" if file.startswith(("model", "offline")) else "simulation") / file).is_file()
    places = re.findall(r"`(\S+\.py)`", row[3]) or ["test_equations.py"]
    code = (ROOT / "tests" / "simulation" / places[0]).read_text(encoding="utf-8")
    tests = re.findall(r"`(test_\w+)`", row[3])
    assert tests
    for name in tests:
        assert f"def {name}(" in code


def test_every_equation_is_there():
    told = set()
    for row in EQUATIONS:
        for chapter, first, last in re.findall(r"(\d)\.(\d+)(?:–\d\.(\d+))?", row[0]):
            told |= {(int(chapter), n) for n in range(int(first), int(last or first) + 1)}
    assert told == {(2, n) for n in range(1, 32) if n not in (7, 15)} | {(3, n) for n in range(1, 17)}


def test_pictures_are_there():
    for picture in re.findall(r"\]\(\.\./(images/\S+)\)", TEXT):
        assert (ROOT / "docs" / picture).is_file()
