"""Hostile input by the thousand: each kind is a module with `TITLE`, `COUNT`, `FULL_COUNT` and `run(count, seed)`.

The tests run `COUNT` cases of each kind; ``make hardening`` runs `FULL_COUNT` and writes docs/results/reliability.md.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass
class Report:
    """`rows`: one table row for each measured quantity; `failures`: each case that broke a promise, with its seed."""

    rows: dict[str, str] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)


@contextmanager
def quiet() -> Iterator[None]:
    """No log messages of the daemon, which would be thousands."""
    logger = logging.getLogger("gz-onboard")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
