"""What `make setup` installs: each version once, each file by hash, from no place that is named, all that is needed."""

from __future__ import annotations

import itertools
import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
LOCK, DOCS_LOCK, BOARD_LOCK, LAB_LOCK = (
    (ROOT / ".ci" / f"requirements{name}.txt").read_text(encoding="utf-8") for name in ("", "-docs", "-board", "-lab")
)
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PINNED = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;]+)", re.M)


def versions(text: str) -> dict[str, str]:
    found = PINNED.findall(text)
    assert len({canonicalize_name(name) for name, _ in found}) == len(found)
    return {canonicalize_name(name): version for name, version in found}


@pytest.mark.parametrize("text", [LOCK, DOCS_LOCK, BOARD_LOCK, LAB_LOCK], ids=["all", "docs", "board", "lab"])
def test_every_file_has_its_hash(text):
    requirements = re.split(r"\n(?=\S)", text.rstrip())[1:]  # the first line is a comment
    assert len(requirements) == len(versions(text)) > 10
    for requirement in requirements:
        lines = requirement.replace(" \\\n", "\n").splitlines()
        assert PINNED.match(lines[0])
        assert lines[1:], requirement
        assert all(re.fullmatch(r"    --hash=sha256:[0-9a-f]{64}", line) for line in lines[1:]), requirement


def test_it_is_what_the_constraints_say():
    lock, constraints = versions(LOCK), versions((ROOT / ".ci" / "constraints.txt").read_text(encoding="utf-8"))
    assert {name: lock.get(name) for name in constraints} == constraints


def test_the_documentation_takes_no_other_version():
    lock, docs = versions(LOCK), versions(DOCS_LOCK)
    constraints = versions((ROOT / ".ci" / "constraints-docs.txt").read_text(encoding="utf-8"))
    assert {name: docs.get(name) for name in constraints} == constraints
    assert not {name for name in lock.keys() & docs.keys() if lock[name] != docs[name]}


@pytest.mark.parametrize(
    ("text", "extras", "without"), [(BOARD_LOCK, [], {"scipy", "pyarrow", "pytest"}), (LAB_LOCK, ["lab"], {"pytest"})]
)
def test_what_is_shipped_has_the_same_files_and_only_what_it_needs(text, extras, without):
    project, shipped = PROJECT["project"], versions(text)
    assert shipped.items() <= versions(LOCK).items()
    assert set(re.findall(r"sha256:\w+", text)) <= set(re.findall(r"sha256:\w+", LOCK))
    check([*project["dependencies"], *itertools.chain(*(project["optional-dependencies"][e] for e in extras))], shipped)
    assert not shipped.keys() & without


def test_it_has_all_that_the_project_needs():
    project, lock = PROJECT["project"], versions(LOCK)
    needed = [*project["dependencies"], *PROJECT["build-system"]["requires"], "editables"]
    extras = dict(project["optional-dependencies"])
    check(extras.pop("docs"), versions(DOCS_LOCK))
    check([*needed, *itertools.chain(*extras.values())], lock)


def check(needed: list[str], lock: dict[str, str]) -> None:
    for text in needed:
        requirement = Requirement(text)
        assert requirement.specifier.contains(lock[canonicalize_name(requirement.name)]), text
