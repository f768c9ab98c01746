"""Values from the vehicle's own frames, which the range frames do not have.

Speed, cell temperatures, odometer, distance ridden today and position. The frames are decoded by the vehicle's DBC
files, as the daemon decodes them.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Container
from contextlib import suppress
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

from gz_onboard.can.codec import CRC, Codec
from gz_onboard.can.layout import identifiers_of
from gz_onboard.estimator.signals import FIX_2D, FIX_3D, STEP_LIMITS, SelfReported
from gz_onboard.events import STALE_PERIODS, Frame
from gz_onboard.model.sensors import speed_factors
from gz_onboard.model.tables import Derating
from gz_onboard.vehicle import Vehicle

CELLS, ODOMETER = "cell_temperature", "odometer"
CELL_ROLES = "coldest_cell_temperature", CELLS, "hottest_cell_temperature"
POSITION_ROLES = "latitude", "longitude", "gps_altitude", "gps_fix"
PERIOD_S = 1.0  # where the vehicle file gives none
SHORTEST_PERIOD_S = 0.1  # the bus is read every twentieth of a second, however often a message comes
RIDING_DEGC = -20.0, 60.0  # usual in data sheets of lithium-ion cells; where the vehicle file says nothing
CHARGING_DEGC = 0.0, 45.0  # likewise
LONGEST_DAY_M = 86_400 * STEP_LIMITS[ODOMETER][2]
CLOCK_SET_NS = 10**18  # since 1970; an earlier time is of a board whose clock was not set


class VehicleFrames:
    """The latest values of the vehicle's own frames.

    No clock: times [s, monotonic] come with the frames, and the day is that of their time stamps. day_file: keeps where
    the day began; it need not exist yet. positions: also read where the vehicle is.
    """

    def __init__(self, vehicle: Vehicle, day_file: Path | None = None, *, positions: bool = False) -> None:
        mapping, p = vehicle.mapping, vehicle.parameters
        factors = speed_factors(p["wheel_radius"], p["gear_ratio"] / p["speed_sensor_scale"])
        mapped = {source.role for source in mapping.sources}
        self._speed = next(((role, factor) for role, factor in factors.items() if role in mapped), ("", 0.0))
        # A frame with the same identifier of another vehicle is recognised by its checksum: values are shown only while
        # the checksums of one message, the rarest that has any, are right.
        protected = [name for name, protection in mapping.protection.items() if protection.crc]
        self._witness = max(protected, key=lambda name: mapping.periods.get(name, 0.0), default="")
        self._witnessed = 0
        roles = {*CELL_ROLES, ODOMETER, self._speed[0], *(POSITION_ROLES if positions else ())}
        witness = [source for source in mapping.sources if source.message == self._witness][:1]
        sources = [source for source in mapping.sources if source.role in roles or source in witness]
        sources += [source for source in mapping.instruments if source.role in roles]
        self.identifiers = identifiers_of(mapping, {source.message for source in sources})
        self._codec = Codec(replace(mapping, sources=tuple(sources)))
        self._period = {
            role: max(group.period or PERIOD_S, SHORTEST_PERIOD_S)
            for group in self._codec.groups
            for role in group.roles
        }
        self._latest: dict[str, tuple[float, float, int]] = {}  # by role: value, when it came [s], its stamp [ns]
        self._day = Day(day_file, vehicle.name)
        self.has_positions = {"latitude", "longitude"} <= self._period.keys()
        self.riding_limits = low, high = cell_limits(vehicle.derating)  # degC
        self.charging_limits = max(low, CHARGING_DEGC[0]), min(high, CHARGING_DEGC[1])

    def take(self, frame: Frame, now: float) -> None:
        """Take a frame that came at `now`; others, and those that fail a check, are ignored."""
        self._codec.decode([frame])
        for window in self._codec.windows():
            group = self._codec.groups[window.group]
            self._witnessed += group.message == self._witness
            wrong = self._codec.faults.get((self._witness, CRC), 0)
            if self._witness and self._witnessed < max(wrong, 1):  # by chance one in 256 is right
                continue
            for role, samples in zip(group.roles, window.roles, strict=True):
                if samples is not None and (role != ODOMETER or self._day.take(samples.value, frame[0], now)):
                    self._latest[role] = samples.value, now, frame[0]

    def values(self, now: float, distrusted: Container[str] = ()) -> dict[str, Any]:
        """The values by their names in the picture; None if unknown, stale, or of a sensor that is `distrusted`."""
        fresh = {
            role: value
            for role, (value, came, _) in self._latest.items()
            if now - came <= STALE_PERIODS * self._period[role]
        }
        cells = [fresh[role] for role in CELL_ROLES if role in fresh and CELLS not in distrusted]
        metres = None if ODOMETER in distrusted else fresh.get(ODOMETER)
        role, factor = self._speed
        speed = None if role in distrusted else fresh.get(role)
        shown = {
            "cells": {"coldest_degc": round(min(cells), 1), "hottest_degc": round(max(cells), 1)} if cells else None,
            "speed_km_h": None if speed is None else round(abs(speed * factor) * 3.6),  # whole, as speedometers show it
            "odometer_km": None if metres is None else round(metres / 1e3, 1),
            "ridden_today_km": None if metres is None else self._day.ridden_km,
        }
        return shown | {"position": self._position(fresh)} if self.has_positions else shown

    def _position(self, fresh: dict[str, float]) -> dict[str, Any] | None:
        """Where the vehicle is, and the time stamp [ns] of the longitude; None without a fix."""
        fix = fresh.get("gps_fix", FIX_3D)
        if fix < FIX_2D or not {"latitude", "longitude"} <= fresh.keys():
            return None
        altitude = fresh.get("gps_altitude") if fix >= FIX_3D else None
        where = {"latitude": fresh["latitude"], "longitude": fresh["longitude"], "altitude": altitude}
        return {"time_ns": self._latest["longitude"][2], **where}


def cell_limits(derating: Derating) -> tuple[float, float]:
    """Temperatures [degC] between which the controller gives its full current; the usual ones if it says nothing."""
    curve = derating.current_by_cell_temperature
    full = [at for at, share in zip(curve.x, curve.y, strict=True) if share >= 1.0] or list(RIDING_DEGC)
    low = full[0] if curve.y[0] < 1.0 else RIDING_DEGC[0]
    return low, full[-1] if curve.y[-1] < 1.0 else RIDING_DEGC[1]


class Day:
    """The distance ridden on the day of the last frame, by the odometer.

    `ridden_km` is None before the odometer was seen, and while the date is unknown.
    """

    def __init__(self, file: Path | None, vehicle: str) -> None:
        self.ridden_km: float | None = None
        self._file, self._vehicle = file, vehicle
        self._date, self._begin = "", 0.0  # odometer [m] when it began
        self._last: float | None = None  # m
        self._reported = SelfReported(ODOMETER)
        # A file that is damaged, missing or another vehicle's keeps no day.
        with suppress(OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            kept = json.loads(file.read_text(encoding="utf-8")) if file else {}
            begin = 1e3 * float(kept["odometer_km"])
            if kept["vehicle"] == vehicle and 0 < begin < inf:
                self._date, self._begin, self._reported.accepted = str(kept["date"]), begin, (begin, -inf)

    def take(self, odometer: float, stamp_ns: int, now: float) -> bool:
        """Take the odometer [m] of a time [ns since 1970], which came at `now` [s]; False if it is implausible."""
        if not self._reported.accepts(odometer, now):
            return False
        if self._reported.restarted:
            self._date, self._last = "", None
        if stamp_ns < CLOCK_SET_NS:
            self.ridden_km = None
            self._last = self._last or odometer  # the distance until then counts for the day to be known
            return True
        date = time.strftime("%Y-%m-%d", time.localtime(stamp_ns * 1e-9))
        if date != self._date or odometer - self._begin > LONGEST_DAY_M:
            self._date, self._begin = date, self._last or odometer
            if self._file:
                self._write(self._file)
        self._last, self.ridden_km = odometer, round((odometer - self._begin) / 1e3, 1)
        return True

    def _write(self, file: Path) -> None:
        new = file.with_name(f"{file.name}.new")
        day = {"vehicle": self._vehicle, "date": self._date, "odometer_km": round(self._begin / 1e3, 3)}
        try:
            new.write_text(json.dumps(day), encoding="utf-8")
            new.replace(file)
        except OSError as error:
            print(f"dashboard: the start of the day is not kept: {file}: {error.strerror}", file=sys.stderr)
