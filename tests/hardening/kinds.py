"""The kinds of hostile input: the modules of this package that have a `run`."""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path
from typing import Protocol

from tests.hardening.report import Report


class Kind(Protocol):
    """One module of this package."""

    TITLE: str  # heading of its table
    COUNT: int  # cases in the tests: some tens of seconds on one core
    FULL_COUNT: int  # cases in ``make hardening``

    def run(self, count: int, seed: int) -> Report:
        """`count` cases drawn from `seed`."""


def kinds() -> dict[str, Kind]:
    """Every kind by its name."""
    found: dict[str, Kind] = {}
    for info in pkgutil.iter_modules([str(Path(__file__).parent)]):
        if info.name.startswith(("test_", "_")):
            continue
        module = importlib.import_module(f"tests.hardening.{info.name}")
        if hasattr(module, "run"):
            found[info.name] = module
    return found
