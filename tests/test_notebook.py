"""docs/tutorial/notebook.ipynb runs from first cell to last, as in Jupyter, and shows what its text says."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import pytest

from tests.support import ROOT

NOTEBOOK = ROOT / "docs" / "tutorial" / "notebook.ipynb"
CELLS: list[dict[str, Any]] = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
CODE = ["".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code"]
TEXT = "\n".join("".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "markdown")
RUN = """
import json, sys
names = {"__name__": "__main__"}
for number, code in enumerate(json.load(sys.stdin)):
    exec(compile(code, f"<cell {number}>", "exec"), names)
plt, np = names["plt"], names["np"]
print(json.dumps({
    "pictures": len(plt.get_fignums()),
    "drawn": all(axis.has_data() for number in plt.get_fignums() for axis in plt.figure(number).axes),
    "capacity": names["vehicle"].parameters["cell_capacity"],
    "km": float(names["table"]["range[m]"][-1]) / 1000,
    "widths": [float(x) for x in (names["table"]["range_p90[m]"] - names["table"]["range_p10[m]"])[[60, -1]]],
    "cycles": [cycle.summary.consumption_wh_km for cycle in names["cycles"].values()],
    "hill": [names[name].summary.consumption_wh_km for name in ("hill", "level")],
    "found": [names["found"].report.verdict, list(names["found"].to_table()["name"])],
}))
"""


@pytest.fixture(scope="module")
def ran() -> dict[str, Any]:
    """Run all cells without a screen and return the figures that the tests check."""
    environment = os.environ | {"MPLBACKEND": "agg", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "ignore:FigureCanvasAgg", "-c", RUN]
    done = subprocess.run(
        command,
        cwd=NOTEBOOK.parent,
        env=environment,
        input=json.dumps(CODE),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found | {"told": done.stdout}


def test_it_runs_and_draws(ran):
    assert ran["pictures"] == 4
    assert ran["drawn"]


def test_it_shows_what_its_text_says(ran):
    assert f"cells of {ran['capacity']:.2f} Ah" in ran["told"]
    assert 2 < ran["capacity"] < 4
    assert 20 < ran["km"] < 35
    assert ran["widths"][1] < ran["widths"][0]
    cold, warm = ran["cycles"]
    assert cold > warm
    hill, level = ran["hill"]
    assert hill > level
    assert ran["found"] == ["cause", ["cornering_drag"]]
