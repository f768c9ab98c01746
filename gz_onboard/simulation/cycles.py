"""Drive cycles: speed over time, those of the regulations built in, others from a CSV file.

Where the built-in speeds come from, and how they compare with other tables, is in docs/reference/cycles.md.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path

from gz_onboard.errors import InputError, nearest
from gz_onboard.routes.columns import METRES_PER_SECOND, read_columns

NAMES = (
    "ece15",
    "r40",
    "udds",
    "wmtc_part1",
    "wmtc_part1_reduced",
    "wmtc_part2",
    "wmtc_part3",
    "wmtc_class1",
    "wmtc_class1_3",
    "wmtc_class2_2",
    "wmtc_class3_2",
)
"""Built-in cycles."""
_PARTS = {
    "r40": ("ece15",) * 6,
    "wmtc_class1": ("wmtc_part1_reduced",) * 2,
    "wmtc_class1_3": ("wmtc_part1",) * 2,
    "wmtc_class2_2": ("wmtc_part1", "wmtc_part2"),
    "wmtc_class3_2": ("wmtc_part1", "wmtc_part2", "wmtc_part3"),
}
# (time [s], speed [km/h]) at the corners; straight lines between them.
_ECE15 = (
    *((0, 0), (11, 0), (15, 15), (23, 15), (28, 0), (49, 0), (61, 32), (85, 32), (96, 0)),
    *((117, 0), (143, 50), (155, 50), (163, 35), (176, 35), (188, 0), (195, 0)),
)
_MAX_SPEED = 100.0  # [m/s]: faster than any road vehicle of the regulations; more is a wrong unit
_JOINT = 0.1  # [m/s]: two cycles are joined without a sample between them if their speeds differ by less


@dataclass(frozen=True)
class Cycle:
    """Speed over time: `time` [s] from 0, evenly spaced, and `speed` [m/s], of one length (two at least)."""

    name: str
    time: tuple[float, ...]
    speed: tuple[float, ...]

    @property
    def duration(self) -> float:
        """Time from the first sample to the last [s]."""
        return self.time[-1] - self.time[0]

    def check_closed(self) -> None:
        """InputError if it ends at another speed than it begins with, and so cannot be repeated."""
        _joined((self, self))


@cache
def cycle(name: str) -> Cycle:
    """The built-in cycle `name`, one sample a second.

    Raises InputError, with the nearest name, if there is none.
    """
    if name not in NAMES:
        raise InputError(f"unknown cycle {name!r}{nearest(name, NAMES)}; known are {', '.join(NAMES)}")
    if name in _PARTS:
        time, speed = _joined(tuple(cycle(part) for part in _PARTS[name]))
    else:
        speed = _ece15() if name == "ece15" else _table()[name]
        time = tuple(float(second) for second in range(len(speed)))
    return Cycle(name, time, speed)


def read_cycle(file: Path | str) -> Cycle:
    """The cycle in a CSV `file`: columns time_s and one of speed_mps, speed_kmh, speed_mph; any even time step.

    Time is counted from the first sample. Raises InputError, naming file and line, for what read_columns refuses,
    a time that does not increase, a gap or an uneven step in it, a negative speed, and one above 100 m/s.
    """
    file = Path(file)
    speeds = {f"speed_{unit}": factor for unit, factor in METRES_PER_SECOND.items()}
    columns = read_columns(file, ("time_s", *speeds))
    given = [name for name in speeds if name in columns.values]
    if "time_s" not in columns.values:
        raise InputError(f"{file}: column time_s is missing")
    if len(given) != 1:
        raise InputError(
            f"{file}: must have one of the columns {', '.join(speeds)}, has {' and '.join(given) or 'none'}"
        )
    column = given[0]
    columns.check_increasing("time_s", "s")
    time, values = columns.values["time_s"], columns.values[column]
    step = min(after - before for before, after in pairwise(time))
    for row, (before, after) in enumerate(pairwise(time), start=1):
        if after - before > 1.1 * step:  # rounded times are even enough
            gap = f"gap from {before:g} s to {after:g} s, other steps are {step:g} s; resample the cycle to even steps"
            raise columns.error(row, f"time_s: {gap}")
    columns.check(column, 0.0, _MAX_SPEED / speeds[column], column.removeprefix("speed_"))
    return Cycle(file.stem, tuple(t - time[0] for t in time), tuple(value * speeds[column] for value in values))


def find_cycle(name_or_file: str) -> Cycle:
    """The built-in cycle of that name, or else the one in the CSV file of that name.

    Raises InputError, with the nearest built-in name, if there is neither.
    """
    if name_or_file in NAMES:
        return cycle(name_or_file)
    file = Path(name_or_file)
    if file.exists() or file.suffix:
        return read_cycle(file)
    raise InputError(
        f"{name_or_file!r} is neither a file nor a built-in cycle{nearest(name_or_file, NAMES)}; "
        f"built in are {', '.join(NAMES)}"
    )


def _joined(parts: tuple[Cycle, ...]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    time, speed = list(parts[0].time), list(parts[0].speed)
    for part in parts[1:]:
        if abs(part.speed[0] - speed[-1]) > _JOINT:
            raise InputError(
                f"cycle {part.name}: begins at {part.speed[0]:.2f} m/s, the one before ends at {speed[-1]:.2f} m/s"
            )
        start = time[-1]
        time += (start + t for t in part.time[1:])
        speed += part.speed[1:]
    return tuple(time), tuple(speed)


def _ece15() -> tuple[float, ...]:
    speeds = [0.0]
    for (t0, v0), (t1, v1) in pairwise(_ECE15):
        speeds += ((v0 + (v1 - v0) * (t - t0) / (t1 - t0)) * METRES_PER_SECOND["kmh"] for t in range(t0 + 1, t1 + 1))
    return tuple(speeds)


@cache
def _table() -> dict[str, tuple[float, ...]]:
    """The columns of cycles.csv [m/s] by cycle; shorter ones end with empty fields."""
    text = Path(__file__).with_name("cycles.csv").read_text(encoding="utf-8")
    header, *rows = csv.reader(text.splitlines())
    table = {}
    for column, title in enumerate(header[1:], start=1):
        name, unit = title.rsplit("_", 1)
        table[name] = tuple(float(row[column]) * METRES_PER_SECOND[unit] for row in rows if row[column])
    return table
