"""docs/how-to/find-losses.md is true: its commands run on the rides of the repository and give what it shows."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from gz_onboard.vehicle import read_vehicle

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "how-to" / "find-losses.md").read_text(encoding="utf-8")
NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def steps() -> list[tuple[str, str]]:
    """(command, what the page shows of its output), in their order."""
    blocks = re.findall(r"^```console\n(.*?)^```$", TEXT, re.M | re.S)
    return [step.partition("\n")[::2] for block in blocks for step in re.split(r"^\$ ", block, flags=re.M)[1:]]


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[tuple[str, str]]]:
    """The folder in which the commands ran, and (shown, printed) of each."""
    folder = tmp_path_factory.mktemp("turning")
    (folder / "replay_logs").symlink_to(ROOT / "replay_logs")
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "utf-8"}
    ours = f'gz-onboard() {{ {shlex.quote(sys.executable)} -m gz_onboard "$@"; }}\n'
    result = []
    for command, shown in steps():
        run = subprocess.run(
            ["bash", "-c", ours + command], cwd=folder, env=environment, capture_output=True, text=True, check=False
        )
        assert run.stdout, run.stderr
        result.append((shown, run.stdout))
    return folder, result


ESSENTIAL = ("rides ", "verdict ", "  cornering_drag ", "model ", "  energy ", "  measured ", "  simulated less")


def essence(text: str) -> str:
    """The lines that carry what the page says; the others tell what else was looked at."""
    return "\n".join(line for line in text.splitlines() if line.startswith(ESSENTIAL))


def test_its_commands_give_what_it_shows(ran: tuple[Path, list[tuple[str, str]]]):
    """The same words and, within 10 %, the same numbers."""
    _, results = ran
    assert len(results) >= 4
    for shown, printed in ((essence(a), essence(b)) for a, b in results):
        assert shown
        assert NUMBER.sub("#", printed).split() == NUMBER.sub("#", shown).split()
        wanted, got = ([float(x) for x in NUMBER.findall(text)] for text in (shown, printed))
        assert got == pytest.approx(wanted, rel=0.1, abs=0.02)


def test_the_cause_is_cornering_and_nothing_stands_in_for_it(ran: tuple[Path, list[tuple[str, str]]]):
    whole = ran[1][0][1]
    verdict, cause = (line for line in whole.splitlines() if line.startswith(("verdict", "  cornering_drag")))
    assert "cause" in verdict
    assert "cornering_compliance" in cause
    assert not re.search(r"ambiguous:.*cornering_drag", whole)


def test_the_model_that_runs_on_a_bus_is_the_one_written_here(ran: tuple[Path, list[tuple[str, str]]]):
    """tests/vehicles/discovered.toml, which tests/vcan has the daemon run."""
    folder, _ = ran
    kept, now = (
        read_vehicle(str(ROOT / "tests" / "vehicles" / "discovered.toml")),
        read_vehicle(str(folder / "turning.toml")),
    )
    assert [effect.name for effect in kept.model.effects] == [effect.name for effect in now.model.effects]
    assert kept.parameters["cornering_compliance"] == pytest.approx(now.parameters["cornering_compliance"], rel=0.1)
    assert kept.riding.factor == pytest.approx(now.riding.factor, rel=0.02)


def test_the_oval_that_was_in_no_fit_is_simulated_better(ran: tuple[Path, list[tuple[str, str]]]):
    found = []
    for _, printed in ran[1][-2:]:
        drawn = float(re.findall(r"energy +([0-9.]+) Wh net", printed)[0])
        measured = float(re.findall(r"measured .*?([0-9.]+) Wh,", printed)[0])
        current = float(re.findall(r"([0-9.]+) A,", printed)[0])
        found.append((abs(drawn / measured - 1), current))
    (energy_before, current_before), (energy_after, current_after) = found
    assert energy_after < 0.75 * energy_before
    assert current_after < 0.8 * current_before
