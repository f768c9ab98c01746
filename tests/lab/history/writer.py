"""A process that writes a history; it imports little, so that it begins soon."""

from __future__ import annotations

from dataclasses import replace
from multiprocessing.synchronize import Barrier
from pathlib import Path

from gz_onboard.lab.history.ride import KeptRide
from gz_onboard.lab.history.store import Store

DAY = 24 * 3600 * 10**9  # ns


def on_other_days(one: KeptRide, days: range) -> list[KeptRide]:
    return [replace(one, start_ns=one.start_ns + DAY * day) for day in days]


def add_many(file: Path, one: KeptRide, name: str, logs: int, together: Barrier | None = None) -> None:
    """As a process: add logs of three rides each, once others are there to do it at the same time."""
    if together:
        together.wait(200)
    with Store(file, begin=True) as store:
        for i in range(logs):
            rides = [replace(each, vehicle=name) for each in on_other_days(one, range(3 * i, 3 * i + 3))]
            store.add(f"{name} {i}", "", rides)
