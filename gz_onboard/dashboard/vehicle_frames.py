"""The vehicle's own frames on the page: speed, cell temperatures, odometer and the distance ridden today.

The range frames do not have these. The frames are read by the vehicle's DBC files, as the daemon reads them.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Container
from dataclasses import replace
from math import inf
from pathlib import Path

from gz_onboard.bus.codec import CRC, Codec
from gz_onboard.bus.layout import identifiers_of
from gz_onboard.dashboard import LATE_PERIODS
from gz_onboard.estimator.signals import STEP_LIMITS, SelfReported
from gz_onboard.events import STALE_PERIODS, Frame
from gz_onboard.physics.derating import Derating
from gz_onboard.physics.sensors import speed_factors
from gz_onboard.vehicle import Vehicle

CELLS, ODOMETER = "cell_temperature", "odometer"
CELL_ROLES = "coldest_cell_temperature", CELLS, "hottest_cell_temperature"
PERIOD_S = 1.0  # where the vehicle file gives none
SHORTEST_PERIOD_S = 0.1  # the bus is read every twentieth of a second, however often a message comes
RIDING_DEGC = -20.0, 60.0  # usual in data sheets of lithium-ion cells; where the vehicle file says nothing
CHARGING_DEGC = 0.0, 45.0  # likewise
LONGEST_DAY_M = 86_400 * STEP_LIMITS[ODOMETER][2]
CLOCK_SET_NS = 10**18  # since 1970; an earlier time is of a board whose clock was not set


class VehicleFrames:
    """The latest values of the vehicle's own frames that are shown.

    No clock: times [s, monotonic] come with the frames, and the day is that of their time stamps. day_file: keeps where
    the day began; it need not exist yet.
    """

    def __init__(self, vehicle: Vehicle, day_file: Path | None = None) -> None:
        mapping, p = vehicle.mapping, vehicle.parameters
        factors = speed_factors(p["wheel_radius"], p["gear_ratio"] / p["speed_sensor_scale"])
        roles = {source.role for source in mapping.sources}
        self._speed = next(((role, factor) for role, factor in factors.items() if role in roles), ("", 0.0))
        # A frame with the same identifier of another vehicle is recognised by its checksum: values are shown only while
        # the checksums of one message, the rarest that has any, are right.
        protected = [name for name, protection in mapping.protection.items() if protection.crc]
        self._witness = max(protected, key=lambda name: mapping.periods.get(name, 0.0), default="")
        self._witnessed = 0
        shown = {*CELL_ROLES, ODOMETER, self._speed[0]}
        witness = [source for source in mapping.sources if source.message == self._witness][:1]
        sources = [source for source in mapping.sources if source.role in shown or source in witness]
        sources += [source for source in mapping.instruments if source.role in shown]
        self.identifiers = identifiers_of(mapping, {source.message for source in sources})
        self._limits = cell_limits(vehicle.derating)
        self._codec = Codec(replace(mapping, sources=tuple(sources)))
        self._period = {
            role: max(group.period or PERIOD_S, SHORTEST_PERIOD_S)
            for group in self._codec.groups
            for role in group.roles
        }
        self._last: dict[str, tuple[float, float]] = {}  # by role: value, time
        self._day = Day(day_file, vehicle.name)

    def take(self, frame: Frame, now: float) -> None:
        """Take in a frame that came at `now`; others, and those that fail a check, are ignored."""
        self._codec.decode([frame])
        for window in self._codec.windows():
            group = self._codec.groups[window.group]
            self._witnessed += group.message == self._witness
            wrong = self._codec.faults.get((self._witness, CRC), 0)
            if self._witness and self._witnessed < max(wrong, 1):  # by chance one in 256 is right
                continue
            for role, samples in zip(group.roles, window.roles, strict=True):
                if samples is not None and (role != ODOMETER or self._day.take(samples.value, frame[0], now)):
                    self._last[role] = samples.value, now

    def value(self, role: str, now: float, periods: float = STALE_PERIODS) -> float | None:
        """The latest value of a role; None if it is older than `periods`, or never came."""
        value, came = self._last.get(role, (0.0, -inf))
        return value if now - came <= periods * self._period.get(role, PERIOD_S) else None

    def cells(self, now: float) -> tuple[float, float] | None:
        """Temperatures of the coldest and the hottest cell [degC]; None if unknown."""
        known = [value for role in CELL_ROLES if (value := self.value(role, now)) is not None]
        return (min(known), max(known)) if known else None

    def speed(self, now: float, distrusted: Container[str]) -> float | None:
        """Speed in whole km/h, as speedometers show it; None if unknown, or if the sensor is `distrusted`."""
        role, factor = self._speed
        value = None if role in distrusted else self.value(role, now)
        return None if value is None else round(abs(value * factor) * 3.6)

    def odometer(self, now: float) -> tuple[float | None, float | None]:
        """Odometer, and distance ridden today [km]; None where unknown."""
        metres = self.value(ODOMETER, now)
        return (None, None) if metres is None else (metres / 1e3, self._day.ridden)

    def late(self, now: float) -> tuple[str, ...]:
        """`CELLS` and `ODOMETER` if their values are overdue, but not yet stale."""
        overdue = {
            role
            for role in self._last
            if self.value(role, now) is not None and self.value(role, now, LATE_PERIODS) is None
        }
        return tuple(name for name, roles in ((CELLS, CELL_ROLES), (ODOMETER, (ODOMETER,))) if overdue & {*roles})

    def limits(self, charging: bool) -> tuple[float, float]:
        """Temperatures [degC] between which the cells should be."""
        low, high = self._limits
        return (max(low, CHARGING_DEGC[0]), min(high, CHARGING_DEGC[1])) if charging else (low, high)


def cell_limits(derating: Derating) -> tuple[float, float]:
    """Temperatures [degC] between which the controller gives its full current; the usual ones if it says nothing."""
    curve = derating.current_by_cell_temperature
    full = [at for at, share in zip(curve.x, curve.y, strict=True) if share >= 1.0] or list(RIDING_DEGC)
    low = full[0] if curve.y[0] < 1.0 else RIDING_DEGC[0]
    return low, full[-1] if curve.y[-1] < 1.0 else RIDING_DEGC[1]


class Day:
    """The distance ridden on the day of the last frame, by the odometer."""

    def __init__(self, file: Path | None, vehicle: str) -> None:
        self._file, self._vehicle = file, vehicle
        self._date, self._begin = _read_day(file, vehicle) if file else ("", 0.0)  # odometer [m] when it began
        self._last: float | None = None  # m
        self._reported = SelfReported(ODOMETER)
        if self._begin:
            self._reported.accepted = self._begin, -inf
        self._clock_set = False

    @property
    def ridden(self) -> float | None:
        """Distance [km]; None before the odometer was seen, and while the date is unknown."""
        return (self._last - self._begin) / 1e3 if self._last is not None and self._clock_set else None

    def take(self, odometer: float, stamp_ns: int, now: float) -> bool:
        """Take in the odometer [m] of a time [ns since 1970], which came at `now` [s]; False if it is implausible."""
        if not self._reported.accepts(odometer, now):
            return False
        if self._reported.restarted:
            self._date, self._last = "", None
        self._clock_set = stamp_ns >= CLOCK_SET_NS
        if not self._clock_set:
            self._last = self._last or odometer  # what is ridden until then counts for the day to be known
            return True
        date = time.strftime("%Y-%m-%d", time.localtime(stamp_ns * 1e-9))
        if date != self._date or odometer - self._begin > LONGEST_DAY_M:
            self._date, self._begin = date, self._last or odometer
            if self._file:
                self._write(self._file)
        self._last = odometer
        return True

    def _write(self, file: Path) -> None:
        new = file.with_name(f"{file.name}.new")
        day = {"vehicle": self._vehicle, "date": self._date, "odometer_km": round(self._begin / 1e3, 3)}
        try:
            new.write_text(json.dumps(day), encoding="utf-8")
            new.replace(file)
        except OSError as error:
            print(f"dashboard: the start of the day is not kept: {file}: {error.strerror}", file=sys.stderr)


def _read_day(file: Path, vehicle: str) -> tuple[str, float]:
    """Date and odometer [m]; of a file that is damaged, missing or another vehicle's, no date."""
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        date, odometer, whose = str(found["date"]), 1e3 * float(found["odometer_km"]), found["vehicle"]
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return "", 0.0
    return (date, odometer) if whose == vehicle and 0 <= odometer < inf else ("", 0.0)
