"""The vehicle's own frames on the page: its speed, how warm its cells are, and how far it was ridden today.

The range frames have none of these. The frames are read by the vehicle's DBC files, as the daemon reads them.
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
from gz_onboard.bus.mapping import BusMapping
from gz_onboard.estimator.signals import STEP_LIMITS, SelfReported
from gz_onboard.events import STALE_PERIODS, Frame
from gz_onboard.physics.derating import Derating
from gz_onboard.physics.sensors import speed_factors
from gz_onboard.vehicle import Vehicle

CELLS = "cell_temperature"
COLDEST, HOTTEST = "coldest_cell_temperature", "hottest_cell_temperature"
ODOMETER = "odometer"
SHOWN = CELLS, COLDEST, HOTTEST, ODOMETER
LATE_PERIODS = 3
PERIOD = 1.0  # s, where nothing says it
SHORTEST = 0.1  # s: the bus is read every twentieth of a second, however often a message comes
RIDING = -20.0, 60.0  # degC: usual data sheets of lithium-ion cells, where the vehicle file says nothing
CHARGING = 0.0, 45.0  # degC: likewise
MOST_OF_A_DAY = 86_400 * STEP_LIMITS[ODOMETER][2]  # m
CLOCK_SET = 10**18  # ns since 1970: earlier says the clock of a board that begins with 1970 and was not told the time


class VehicleFrames:
    """The newest of what is shown, by the vehicle's mapping.

    No clock: times [s, monotonic] come with the frames, and the day is that of their stamps. kept: the file that says
    where the day began, which may not be there yet.
    """

    def __init__(self, vehicle: Vehicle, kept: Path | None = None) -> None:
        mapping = vehicle.mapping
        p = vehicle.parameters
        factors = speed_factors(p["wheel_radius"], p["gear_ratio"] / p["speed_sensor_scale"])
        roles = {source.role for source in mapping.sources}
        self._speed = next(((role, factor) for role, factor in factors.items() if role in roles), ("", 0.0))
        chosen, of_instruments = (
            tuple(source for source in sources if source.role in (*SHOWN, self._speed[0]))
            for sources in (mapping.sources, mapping.instruments)
        )
        # That it is this vehicle's bus is believed where its checksum is right, if it has such, and not by chance.
        of_witness = tuple(s for s in mapping.sources if s.message == _witness(mapping))[:1]
        self._witness = of_witness[0].message if of_witness else ""
        chosen += tuple(source for source in of_witness if source not in chosen)
        self._witnessed = 0
        self.identifiers = identifiers_of(mapping, {source.message for source in (*chosen, *of_instruments)})
        self._limits = cell_limits(vehicle.derating)
        self._codec = Codec(replace(mapping, sources=chosen + of_instruments))
        periods = {role: group.period or PERIOD for group in self._codec.groups for role in group.roles}
        self._period = {role: max(period, SHORTEST) for role, period in periods.items()}
        self._last: dict[str, tuple[float, float]] = {}  # by role: value, time
        self._day = Day(kept, vehicle.name)

    def take(self, frame: Frame, now: float) -> None:
        """Take in a frame that came at `now`; one that is not of these, or fails a check, is left out."""
        self._codec.decode([frame])
        for window in self._codec.windows():
            group = self._codec.groups[window.group]
            self._witnessed += group.message == self._witness
            for role, samples in zip(group.roles, window.roles, strict=True):
                if samples is None or not self._believed:
                    continue
                if role != ODOMETER or self._day.take(samples.value, frame[0], now):
                    self._last[role] = samples.value, now

    @property
    def _believed(self) -> bool:
        """Of another vehicle's frames with the same identifier one in 256 has the checksum, too."""
        wrong = self._codec.faults.get((self._witness, CRC), 0)
        return not self._witness or self._witnessed >= max(wrong, 1)

    def value(self, role: str, now: float) -> float | None:
        """The newest of a role; None if it is stale or never came."""
        if role not in self._last:
            return None
        value, came = self._last[role]
        return value if now - came <= STALE_PERIODS * self._period[role] else None

    def cells(self, now: float) -> tuple[float, float] | None:
        """The coldest and the warmest cell [degC]; None if nothing says it."""
        known = [value for role in (COLDEST, CELLS, HOTTEST) if (value := self.value(role, now)) is not None]
        return (min(known), max(known)) if known else None

    def speed(self, now: float, distrusted: Container[str]) -> float | None:
        """[km/h], whole, as speedometers show it; None if nothing says it, or only a sensor that is `distrusted`."""
        role, factor = self._speed
        value = None if role in distrusted else self.value(role, now)
        return None if value is None else round(abs(value * factor) * 3.6)

    def odometer(self, now: float) -> tuple[float | None, float | None]:
        """What it shows, and what was ridden since the day began, or since the start if nothing was kept [km]."""
        metres = self.value(ODOMETER, now)
        return (None, None) if metres is None else (metres / 1e3, self._day.ridden)

    def late(self, now: float) -> tuple[str, ...]:
        """Of which a newer value should have come, and which are not stale yet."""
        roles = {CELLS: (COLDEST, CELLS, HOTTEST), ODOMETER: (ODOMETER,)}
        return tuple(name for name, of in roles.items() if self._late(of, now))

    def _late(self, roles: tuple[str, ...], now: float) -> bool:
        there = [role for role in roles if self.value(role, now) is not None]
        return any(now - self._last[role][1] > LATE_PERIODS * self._period[role] for role in there)

    def limits(self, charging: bool) -> tuple[float, float]:
        """Between which temperatures [degC] the cells should be."""
        low, high = self._limits
        return (max(low, CHARGING[0]), min(high, CHARGING[1])) if charging else (low, high)


def _witness(mapping: BusMapping) -> str:
    """The message with a checksum that comes least often; empty if none has one."""
    protected = [name for name, protection in mapping.protection.items() if protection.crc]
    return max(protected, key=lambda name: mapping.periods.get(name, 0.0), default="")


def cell_limits(derating: Derating) -> tuple[float, float]:
    """Between which temperatures [degC] the controller gives its full current; the usual ones if it says nothing."""
    curve = derating.current_by_cell_temperature
    full = [at for at, share in zip(curve.at, curve.share, strict=True) if share >= 1.0] or list(RIDING)
    low = full[0] if curve.share[0] < 1.0 else RIDING[0]
    return low, full[-1] if curve.share[-1] < 1.0 else RIDING[1]


class Day:
    """How far was ridden on the day of the last frame, by the odometer."""

    def __init__(self, kept: Path | None, vehicle: str) -> None:
        self._kept, self._vehicle = kept, vehicle
        self._date, self._begin = _read(kept, vehicle) if kept else ("", 0.0)  # of the day; the odometer [m] then
        self._last: float | None = None  # m
        self._reported = SelfReported(ODOMETER)
        if self._begin:
            self._reported.accepted = self._begin, -inf
        self._clock_set = False

    @property
    def ridden(self) -> float | None:
        """[km]; None before the odometer was seen, and while nobody knows which day it is."""
        return (self._last - self._begin) / 1e3 if self._last is not None and self._clock_set else None

    def take(self, odometer: float, stamp_ns: int, now: float) -> bool:
        """The odometer [m] at a time [ns since 1970], which came at `now` [s]; False if it is not believed."""
        if not self._reported.accepts(odometer, now):
            return False
        if self._reported.restarted:
            self._date, self._last = "", None
        self._clock_set = stamp_ns >= CLOCK_SET
        if not self._clock_set:
            self._last = self._last or odometer  # what is ridden until then counts for the day that it will be
            return True
        date = time.strftime("%Y-%m-%d", time.localtime(stamp_ns * 1e-9))
        if date != self._date or odometer - self._begin > MOST_OF_A_DAY:
            self._date, self._begin = date, self._last or odometer
            if self._kept:
                self._keep(self._kept)
        self._last = odometer
        return True

    def _keep(self, file: Path) -> None:
        new = file.with_name(f"{file.name}.new")
        day = {"vehicle": self._vehicle, "date": self._date, "odometer_km": round(self._begin / 1e3, 3)}
        try:
            new.write_text(json.dumps(day), encoding="utf-8")
            new.replace(file)
        except OSError as error:
            print(f"dashboard: where the day began is not kept: {file}: {error.strerror}", file=sys.stderr)


def _read(file: Path, vehicle: str) -> tuple[str, float]:
    """Date and odometer [m] in the file; of one that is damaged, not there or another's a day that never was."""
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        date, odometer, of = str(found["date"]), 1e3 * float(found["odometer_km"]), found["vehicle"]
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return "", 0.0
    return (date, odometer) if of == vehicle and 0 <= odometer < inf else ("", 0.0)
