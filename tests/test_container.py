"""The Containerfile, read without a container engine: what it copies is there, what it installs is pinned."""

from __future__ import annotations

import re
import subprocess

import pytest

from tests.support import ROOT

LINES = re.sub(r"\\\n", " ", (ROOT / "Containerfile").read_text(encoding="utf-8")).splitlines()
STEPS = [line.partition(" ")[::2] for line in LINES if line.strip() and not line.startswith("#")]
KNOWN = {"FROM", "RUN", "ENV", "WORKDIR", "COPY", "USER", "ENTRYPOINT", "CMD"}


def of(instruction: str) -> list[str]:
    return [rest.strip() for name, rest in STEPS if name == instruction]


def test_each_step_is_one_that_engines_know():
    assert {name for name, _ in STEPS} == KNOWN
    assert STEPS[0][0] == "FROM"
    assert all(re.fullmatch(r"[\w.-]+(/[\w.-]+)+:3\.\d+-slim( AS \w+)?", base) for base in of("FROM"))
    for command in of("RUN"):
        subprocess.run(["sh", "-n", "-c", command], check=True)


def test_what_it_copies_is_there_and_not_left_out():
    ignored = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    copies = [copy.split()[:-1] for copy in of("COPY") if not copy.startswith("--from")]
    files = [file for copy in copies for file in copy]
    assert {"gz_onboard", "dbc", "pyproject.toml", ".ci/requirements-lab.txt"} <= set(files)
    assert all((ROOT / file).exists() for file in files)
    assert not set(files) & set(ignored)


def test_everything_it_installs_is_pinned_and_it_does_not_run_as_root():
    installs = [command for command in of("RUN") if "pip install" in command]
    assert len(installs) == 2
    assert all("--require-hashes" in command or "PIP_CONSTRAINT=" in command for command in installs)
    assert all("PIP_BUILD_CONSTRAINT=" in command for command in installs if "PIP_CONSTRAINT=" in command)
    last_stage = [name for name, _ in STEPS][len(STEPS) - [name for name, _ in reversed(STEPS)].index("FROM") :]
    assert "USER" in last_stage
    assert of("USER") == ["rider"]


@pytest.mark.parametrize("path", ["CHANGELOG.md", "LICENSE", "README.md"])
def test_what_the_build_needs_of_the_tree_is_copied(path):
    """pyproject.toml names them."""
    assert path in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert any(path in copy.split() for copy in of("COPY"))
