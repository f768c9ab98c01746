"""What one of our logs says of a ride: its estimates and the last status, if they are as we write them."""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite
from pathlib import Path
from typing import Any

from gz_onboard.errors import InputError
from gz_onboard.events import State
from gz_onboard.log_rows import ESTIMATE_TOPIC, ESTIMATE_UNITS, STATUS_TOPIC
from gz_onboard.recording.logs import read_samples
from gz_onboard.recording.readers.contents import LogDamage

Logged = dict[str, Any]
"""The values of one sample in a log, as its JSON has them."""


def read_ride(
    log: Path, on_damage: Callable[[LogDamage], None] | None = None
) -> tuple[list[Logged], list[int], Logged]:
    """(estimates, their times [ns], the last status) of one of our logs, whole or cut off.

    on_damage: is called if something could not be read. Raises InputError if the log holds no estimates.
    """
    rows: list[Logged] = []
    times: list[int] = []
    status: Logged = {}
    for topic, time_ns, values in read_samples(log, on_damage=on_damage):
        if topic == ESTIMATE_TOPIC:
            if is_estimate(values):
                rows.append(values)
                times.append(time_ns)
        elif topic == STATUS_TOPIC and is_status(values):
            status = values
    if not rows:
        raise InputError(
            f"{log}: holds no estimates ({ESTIMATE_TOPIC}): gz-onboard estimate makes such a log of a recorded ride"
        )
    return rows, times, status


def is_estimate(values: Logged) -> bool:
    """Whether it is a row as we write them: others may write to a topic of this name, too."""
    if values.get("state") not in tuple(State.__members__) or not isinstance(values.get("reasons"), str):
        return False
    numbers = {name: values.get(name) for name in ESTIMATE_UNITS}
    if not all(is_number(value) for value in numbers.values() if value is not None):
        return False
    for together in (("soc", "soc_sd"), ("range", "range_p10", "range_p90")):
        if len({values.get(name, "") is None for name in together}) > 1 or not set(together) <= values.keys():
            return False
    return is_number(numbers["time"]) and is_number(numbers["distance"])


def is_status(values: Logged) -> bool:
    """Likewise."""
    faults, lost, unknown = (values.get(name, {}) for name in ("faults", "lost", "unknown"))
    if not all(isinstance(counts, dict) for counts in (faults, lost, unknown)):
        return False
    places = faults.values()
    return all(isinstance(counts, dict) for counts in places) and all(
        is_number(n) for counts in (lost, *places) for n in counts.values()
    )


def is_number(value: object) -> bool:
    """Whether it is a finite number of a size that quantities have."""
    return isinstance(value, int | float) and isfinite(value) and abs(value) < 1e15
