"""The summaries of many rides as one table, a row for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import get_type_hints

from gz_onboard.errors import InputError, nearest, writing
from gz_onboard.events import State
from gz_onboard.imports import require
from gz_onboard.lab.estimate_summary import RideSummary
from gz_onboard.offline.write_tables import write_table
from gz_onboard.reports.results import Failure

FORMATS = (".csv", ".parquet", ".jsonl")
_HINTS = get_type_hints(RideSummary)
CELLS: dict[str, type] = {
    f.name: kind for f in fields(RideSummary) for kind in (str, int, float) if _HINTS[f.name] in (kind, kind | None)
}
"""What of a summary is a number or a text, by name."""


def summary_table(rides: Sequence[RideSummary], failed: Sequence[Failure] = ()) -> dict[str, list[object]]:
    """The column of each of `CELLS`, the seconds in each state, the reasons that there were; and why a log is no ride.

    None stands for what is not known.
    """
    missing = [None] * len(failed)
    table: dict[str, list[object]] = {name: [*(getattr(ride, name) for ride in rides), *missing] for name in CELLS}
    table["file"] = [*(ride.file for ride in rides), *(failure.file for failure in failed)]
    for state in State:
        table[f"{state.name.lower()}_s"] = [*(ride.states.get(state.name, 0.0) for ride in rides), *missing]
    table["reasons"] = [*(" ".join(ride.reasons) for ride in rides), *missing]
    table["error"] = [*(None for _ in rides), *(failure.error for failure in failed)]
    return table


def check_table(out: Path) -> None:
    """InputError if no table can be written into `out`, ModuleNotFoundError if what writes it is not installed."""
    require("pyarrow", out.suffix.lower() == ".parquet")
    if not out.name.lower().endswith((*FORMATS, ".csv.gz", ".jsonl.gz")):
        raise InputError(f"--table {out}: a table is written as {', '.join(FORMATS)}{nearest(out.suffix, FORMATS)}")


def write_summaries(out: Path, rides: Sequence[RideSummary], failed: Sequence[Failure]) -> None:
    """Write the table in the format of the name of `out`. Raises InputError."""
    with writing(out):
        write_table(out, summary_table(rides, failed), kinds={**CELLS, "reasons": str, "error": str})
