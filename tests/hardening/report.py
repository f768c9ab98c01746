"""What a run of hostile cases found."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Report:
    """`rows`: what was measured, one table row each; `failures`: each case that broke a promise, with its seed."""

    rows: dict[str, str] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
