"""Which rides of a history are wanted, and reading them."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from gz_onboard.errors import InputError, nearest, shown
from gz_onboard.lab.history.store import Store
from gz_onboard.lab.history.totals import NumberedRide, whole_rides

FILE = Path("gz-onboard/history.sqlite")
_PERIOD = re.compile(r"(\d{4})(?:-(\d{1,2})(?:-(\d{1,2}))?)?")


@dataclass(frozen=True)
class Period:
    """From one time to before another [ns since the epoch]."""

    begin: int
    end: int


@dataclass(frozen=True)
class Choice:
    """Of the rides; None: all."""

    vehicle: str | None = None
    rider: str | None = None
    since: Period | None = None
    until: Period | None = None  # included

    @property
    def by_date(self) -> bool:
        """Whether a ride without a date is none of it."""
        return self.since is not None or self.until is not None

    def __post_init__(self) -> None:
        if self.since and self.until and self.until.end <= self.since.begin:
            raise InputError("until: must not be before since")

    def has(self, one: NumberedRide) -> bool:
        """Whether a ride is among them."""
        ride = one.ride
        if self.by_date and not ride.dated:
            return False
        return (
            self.vehicle in (None, ride.vehicle)
            and self.rider in (None, ride.rider)
            and (self.since is None or ride.start_ns >= self.since.begin)
            and (self.until is None or ride.start_ns < self.until.end)
        )


def period(text: str, option: str) -> Period:
    """A year, month, day or time in the machine's zone, such as ``2025-06``; InputError for another text."""
    try:
        if found := _PERIOD.fullmatch(text):
            year, month, day = (None if part is None else int(part) for part in found.groups())
            begin = datetime(year or 0, month or 1, day or 1)
            if day:
                end = begin + timedelta(days=1)
            elif month:
                end = begin.replace(year=begin.year + month // 12, month=month % 12 + 1)
            else:
                end = begin.replace(year=begin.year + 1)
        else:
            begin = end = datetime.fromisoformat(text)
        return Period(_ns(begin), _ns(end))
    except (ValueError, OverflowError, OSError) as error:
        raise InputError(f"{option} {shown(text)}: must be a date such as 2025, 2025-06, 2025-06-15") from error


def _ns(time: datetime) -> int:
    return round(time.astimezone().timestamp()) * 1_000_000_000


def read_rides(file: Path, choice: Choice) -> tuple[list[NumberedRide], int]:
    """(the chosen rides in a history, by vehicle and start; how many were left out as they have no date).

    A ride of which the daemon began a new log is one. Raises InputError, also for a vehicle or rider that is not there.
    """
    with Store(file) as store:
        rides = whole_rides(NumberedRide(*row) for row in store.rides())
    for what, wanted in (("vehicle", choice.vehicle), ("rider", choice.rider)):
        names = sorted({name for one in rides if (name := getattr(one.ride, what)) is not None})
        if wanted is not None and wanted not in names:
            others = f"there are {', '.join(names)}" if names else f"no ride in it has a {what}"
            raise InputError(f"{what} {wanted}: is not in {file}{nearest(wanted, names)}; {others}")
    chosen = [one for one in rides if choice.has(one)]
    left_out = sum(not one.ride.dated for one in rides) if choice.by_date else 0
    return chosen, left_out


def default_file() -> Path:
    """The state directory of a service, else the user's data as the XDG base directories say. InputError if neither."""
    if state := os.environ.get("STATE_DIRECTORY", "").split(":")[0]:
        return Path(state) / FILE.name
    data = Path(os.environ.get("XDG_DATA_HOME", ""))
    if data.is_absolute():  # others are to be ignored
        return data / FILE
    try:
        return Path.home() / ".local/share" / FILE
    except RuntimeError as error:
        raise InputError("--file: is missing, and there is no home directory to keep the history in") from error
