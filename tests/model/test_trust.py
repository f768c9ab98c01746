from __future__ import annotations

import os
from pathlib import Path

import pytest

from gz_onboard.model.effect import ROOT, changeable, trusted_users

ME = frozenset((ROOT, os.geteuid()))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A file in a folder in a folder, all of them our own."""
    (tmp_path / "a").mkdir(mode=0o755)
    file = tmp_path / "a" / "effect.py"
    file.touch(mode=0o644)
    return file


def test_what_is_our_own_is_trusted(file: Path):
    assert trusted_users() == ME
    assert changeable(file, ME) is None


@pytest.mark.parametrize("mode", [0o646, 0o666])
@pytest.mark.parametrize("depth", [0, 1, 2])
def test_what_others_can_write_is_not(file: Path, depth: int, mode: int):
    place = (file, *file.parents)[depth]
    place.chmod(mode | place.stat().st_mode & 0o111)
    assert changeable(file, ME) == f"{place} can be written by others (chmod go-w)"


def test_what_belongs_to_another_is_not(file: Path):
    assert "belongs to " in str(changeable(file, ME - {file.stat().st_uid} | {123456}))


def test_a_link_is_what_it_leads_to(file: Path, tmp_path: Path):
    link = tmp_path / "link.py"
    link.symlink_to(file)
    assert changeable(link, ME) is None
    file.chmod(0o666)
    assert changeable(link, ME) == f"{file} can be written by others (chmod go-w)"
