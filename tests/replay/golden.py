"""Golden results: what the pipeline made of each recorded ride, kept as CSV, and the differences told field by field.

A row holds every field of the estimate, ten seconds after the row before it; the last row is the last estimate of
the ride. A change of the estimator shows here in every number that it moves. If the change is wanted:

    python -m tests.replay.regenerate

prints what moved and by how much, and writes the new results.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from gz_onboard.events import WINDOW, Estimate
from gz_onboard.log_rows import estimate_row
from gz_onboard.pipeline import Pipeline
from gz_onboard.recording.decode import feed
from gz_onboard.recording.frames import FrameColumns
from gz_onboard.recording.logs import read_log
from gz_onboard.vehicle import read_vehicle

LOGS = Path(__file__).resolve().parents[2] / "replay_logs"
GOLDEN = Path(__file__).resolve().parent / "golden"
EVERY = round(10.0 / WINDOW)  # estimates, thus 10 s

Row = Mapping[str, str]

# How far a field may be from its golden value: absolute, in the field's unit. Another processor or mathematical
# library rounds otherwise in the last digits; a change in the estimator moves more than this.
TOLERANCE = {
    "time": 1e-6,
    "soc": 1e-6,
    "soc_sd": 1e-6,
    "v1": 1e-6,
    "innovation": 1e-6,
    "innovation_rms": 1e-6,
    "pack_voltage": 1e-4,
    "pack_current": 1e-4,
    "cell_temperature": 1e-4,
    "speed": 1e-5,
    "acceleration": 1e-5,
    "grade": 1e-6,
    "lean": 1e-6,
    "yaw_rate": 1e-6,
    "heading": 1e-5,
    "distance": 0.01,
    "range": 0.5,
    "range_p10": 0.5,
    "range_p90": 0.5,
    "energy_left": 20.0,
    "energy_left_sd": 20.0,
    "consumption_recent": 1e-3,
    "consumption_expected": 1e-3,
    "consumption_expected_sd": 1e-3,
    "consumption_factor": 1e-5,
    "consumption_factor_sd": 1e-5,
    "why": 0.0,
    "current_modelled": 0.0,
    "charge_power": 1.0,
    "time_to_full": 10.0,
    "range_full": 1.0,
    "route_along": 0.01,
    "route_left": 0.01,
    "route_energy": 20.0,
    "route_energy_sd": 20.0,
    "arrival_soc": 1e-6,
    "arrival_soc_p10": 1e-6,
    "arrival_soc_p90": 1e-6,
    "battery_ends_after": 0.5,
    "battery_ends_latitude": 1e-6,
    "battery_ends_longitude": 1e-6,
    "state": 0.0,
    "reasons": 0.0,
    "activity": 0.0,
    "route_state": 0.0,
    "distrusted": 0.0,
}


@dataclass(frozen=True)
class Difference:
    """One value that is not what it was."""

    time: str
    field: str
    golden: str
    now: str

    @property
    def size(self) -> float:
        """Of the difference; infinite where a number came or went, or a text changed."""
        try:
            return abs(float(self.now) - float(self.golden))
        except ValueError:
            return float("inf")


def logs() -> list[Path]:
    """The recorded rides of the project."""
    return sorted(LOGS.glob("*.blf"))


def golden_file(log: Path) -> Path:
    """Where the golden results of `log` are."""
    return GOLDEN / f"{log.stem}.csv"


def estimates(frames: FrameColumns, filter_name: str = "scalar") -> list[Estimate]:
    """Every estimate that the pipeline of the reference scooter makes of the frames."""
    made: list[Estimate] = []
    feed(Pipeline(read_vehicle("reference"), filter_name=filter_name, observer=made.append), frames)
    return made


def sampled(made: Sequence[Estimate]) -> list[Row]:
    """The rows of a golden file."""
    chosen = [*made[:-1:EVERY], made[-1]]
    return [{name: _text(value) for name, value in estimate_row(estimate).items()} for estimate in chosen]


def run(log: Path) -> list[Row]:
    """The rows that the pipeline makes of `log` now."""
    return sampled(estimates(read_log(log)))


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.9g}"
    return "" if value is None else str(value)


def write(file: Path, rows: Sequence[Row]) -> None:
    """Write a golden file."""
    file.parent.mkdir(exist_ok=True)
    with file.open("w", encoding="ascii", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def read(file: Path) -> list[Row]:
    """The rows of a golden file; none if there is no such file."""
    if not file.exists():
        return []
    with file.open(encoding="ascii", newline="") as stream:
        return list(csv.DictReader(stream))


def differences(golden: Sequence[Row], now: Sequence[Row], tolerance: Mapping[str, float]) -> list[Difference]:
    """Every value that is further from its golden one than its field's tolerance, in the order of rows."""
    found: list[Difference] = []
    if len(golden) != len(now):
        found.append(Difference("", "number of rows", str(len(golden)), str(len(now))))
    for old, new in zip(golden, now, strict=False):
        for name in dict.fromkeys([*old, *new]):
            difference = Difference(
                new.get("time", ""), name, old.get(name, "(no such field)"), new.get(name, "(no such field)")
            )
            if difference.golden != difference.now and not difference.size <= tolerance.get(name, 0.0):
                found.append(difference)
    return found


def told(found: Sequence[Difference], rows: int) -> str:
    """The differences for a person: for each field how many rows differ, and the largest difference."""
    lines: list[str] = []
    for name in dict.fromkeys(difference.field for difference in found):
        of_field = [difference for difference in found if difference.field == name]
        worst = max(of_field, key=lambda difference: difference.size)
        limit = TOLERANCE.get(name, 0.0)
        count = f"{name}: {len(of_field)} of {rows} rows differ by more than {limit:g}"
        lines.append(f"{count}, most at {worst.time} s: {worst.golden or '-'} before, {worst.now or '-'} now")
    return "\n".join(lines)
