"""A log that is kept in memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


class KeptRows:
    """A log in memory, of rows by topic. samples: all rows in their order, as (topic, time [ns], values)."""

    def __init__(self) -> None:
        self.rows: dict[str, list[tuple[int, Mapping[str, object]]]] = {}
        self.samples: list[tuple[str, int, dict[str, Any]]] = []

    def channel(self, topic: str, json_schema: Mapping[str, Any], metadata: Mapping[str, str] | None = None) -> None:
        """As of `log_rows.Log`."""
        self.rows[topic] = []

    def frames(self, batch: Sequence[Any]) -> None:
        """As of `log_rows.Log`."""

    def sample(self, topic: str, time_ns: int, values: Mapping[str, object], seen_ns: int | None = None) -> None:
        """As of `log_rows.Log`."""
        self.rows[topic].append((time_ns, values))
        self.samples.append((topic, time_ns, dict(values)))

    def of(self, topic: str) -> list[Mapping[str, object]]:
        """The rows of a topic."""
        return [values for _, values in self.rows[topic]]
