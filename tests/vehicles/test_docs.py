"""The guide to another vehicle matches the code: commands run, snippets are in the files, all keys are documented."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from gz_onboard.events import ROLES

ROOT = Path(__file__).parents[2]
GUIDE = (ROOT / "docs" / "how-to" / "another-vehicle.md").read_text(encoding="utf-8")
REFERENCE = (ROOT / "docs" / "reference" / "vehicle-file.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", GUIDE, re.M | re.S)
FILES = [
    *(ROOT / "tests" / "vehicles").glob("*/*.dbc"),
    *(ROOT / "tests" / "vehicles").glob("*/*.toml"),
    ROOT / "gz_onboard" / "vehicles" / "reference.toml",
]


def test_its_commands_give_what_it_shows(tmp_path):
    (tmp_path / "tests").symlink_to(ROOT / "tests")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "utf-8"}
    ours = f'gz-onboard() {{ {shlex.quote(sys.executable)} -m gz_onboard "$@"; }}\n'
    commands = 0
    for kind, block in BLOCKS:
        if kind != "console":
            continue
        for step in re.split(r"^\$ ", block, flags=re.M)[1:]:
            command, _, shown = step.partition("\n")
            run = subprocess.run(
                ["bash", "-c", ours + command],
                cwd=tmp_path,
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
            assert (run.stdout + run.stderr).strip() == shown.strip(), command
            commands += 1
    assert commands >= 6


@pytest.mark.parametrize(
    "block", [text for kind, text in BLOCKS if kind != "console"], ids=lambda t: t.split("\n")[0][:30]
)
def test_its_snippets_stand_in_the_files(block):
    assert any(block.strip() in file.read_text(encoding="utf-8") for file in FILES)


def test_it_names_every_role():
    section = REFERENCE[REFERENCE.index("## Roles") : REFERENCE.index("## Parameters")]
    assert not [role for role in ROLES if f"`{role}`" not in section]


@pytest.mark.parametrize(
    "module", ["can/mapping", "can/requests", "vehicle", "model/riding", "model/parameters", "model/tables"]
)
def test_it_names_every_key(module):
    source = (ROOT / "gz_onboard" / f"{module}.py").read_text(encoding="utf-8")
    keys = {key for group in re.findall(r"\.only\(\s*\[(.*?)\]", source, re.S) for key in re.findall(r'"(\w+)"', group)}
    assert keys
    assert not [key for key in keys if not re.search(rf"\b{key}\b", REFERENCE)]
