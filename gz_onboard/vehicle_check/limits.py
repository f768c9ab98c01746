"""Signals against what vehicles can show: gravity, temperatures, switches, and signals that never change."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import inf

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.can.mapping import UNITS, known_units, to_si
from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.plausibility.residual import CONFIG, LIMITS
from gz_onboard.vehicle_check.finding import Finding, right, unknown, wrong
from gz_onboard.vehicle_check.seconds import FEWEST


@dataclass(frozen=True)
class SignalLimit:
    """Bounds of a signal, or of its mean; hint: for a signal beyond them that no sign or unit explains."""

    check: str
    role: str
    low: float
    high: float
    hint: str = ""
    of_mean: bool = False
    of_mean_riding: bool = False  # of a switch, 0 or 1
    confirms: bool = True  # within them it looks right

    def judge(self, values: Array, moving: Mask) -> Finding | None:
        """Return the finding about `values` (n,); None if there is nothing to say."""
        values = values[np.isfinite(values) & moving] if self.of_mean_riding else values[np.isfinite(values)]
        if not len(values):
            return None
        least, most = float(values.min()), float(values.max())
        unit = "" if UNITS[self.role] == "1" else f" {UNITS[self.role]}"
        text = f"{least:.4g} to {most:.4g}{unit}"
        if self.of_mean or self.of_mean_riding:
            least = most = float(np.clip(values, 0, 1).mean() if self.of_mean_riding else values.mean())
            text = f"{least:.3g}{unit} in the mean"
        if self.low < least and most < self.high:
            return right(self.check, (self.role,), text) if self.confirms else None
        beyond = f"{text}, expected is {self.low:.3g} to {self.high:.3g}"
        if self.of_mean_riding and values.max() > 1:
            hint = f"it goes to {values.max():g}, and 1 is on; limits of [0|1] in the DBC file drop other values"
        else:
            hint = self.hint or self._explanation(least, most)
        return wrong(self.check, (self.role,), f"{beyond}: {hint}" if hint else beyond)

    def _explanation(self, least: float, most: float) -> str:
        """Name the sign or unit that would bring values from `least` to `most` within the bounds."""
        if self.low < -most and -least < self.high:
            return "its sign, scale = -1"
        for unit in known_units(self.role):
            scale, offset = to_si(unit, self.role) or (1.0, 0.0)
            if self.low < scale * least + offset and scale * most + offset < self.high:
                return f"its unit may be {unit}"
        return ""


RANGES = (
    SignalLimit(
        "gravity", "accel_x", -2.5, 2.5, "the vertical axis, swapped, or its mounting", of_mean=True, confirms=False
    ),
    SignalLimit(
        "gravity", "accel_y", -2.5, 2.5, "the vertical axis, swapped, or its mounting", of_mean=True, confirms=False
    ),
    SignalLimit("gravity", "accel_z", GRAVITY - 2.5, GRAVITY + 2.5, of_mean=True),
    SignalLimit("throttle", "throttle", -0.2, 1.2, confirms=False),
    SignalLimit("positions", "latitude", -90.0, 90.0, "swapped with the longitude, or a wrong scale", confirms=False),
    *(SignalLimit("temperature", role, *limits[:2]) for role, limits in LIMITS.items()),
    SignalLimit(
        "charge plug", "charge_plug", -inf, 0.5, "the other way round, scale = -1, offset = 1", of_mean_riding=True
    ),
    SignalLimit("key", "key", 0.5, inf, "the other way round, scale = -1, offset = 1", of_mean_riding=True),
    SignalLimit("contactor", "contactor", 0.5, inf, "the other way round, scale = -1, offset = 1", of_mean_riding=True),
)
NEAR, FAR = 15.0, 25.0  # K between cells and air: usual; out of a warm room
FAHRENHEIT = 8.0  # K: so near the air are cells that were read in °F
WARMED = 5.0  # K, that cells or air change by while riding, and many times the motor: exchanged
STEADY = {"brake_switch", "charge_plug", "key", "contactor", "rider", "gps_fix", "odometer", "bms_state_of_charge"}
STEADY |= {"ambient_temperature", "cell_temperature", "motor_temperature", "inverter_temperature", "heater_power"}
STEADY |= {"air_conditioner_power", "auxiliary_current"}
"""Roles that may hold one value for a whole ride."""
STANDS = {"wheel_speed_front", "gps_speed", "gps_course", "gps_altitude", "latitude", "longitude"}
STANDS |= {"accel_x", "accel_y", "accel_z", "rate_x", "rate_y", "rate_z"}
"""Roles that may do so where only the driven axle turns."""


def check_limits(ride: Mapping[str, Array], speed: Array | None, bench: bool) -> Iterator[Finding]:
    """Check each signal by itself. speed [m/s] (n,); bench: only the driven axle turns."""
    some = next(iter(ride.values()))
    moving = np.zeros(len(some), dtype=bool) if speed is None else np.abs(speed) > CONFIG.moving_m_s
    if moving.sum() < FEWEST:
        moving = np.zeros_like(moving)
    for limit in RANGES:
        finding = limit.judge(ride[limit.role], moving) if limit.role in ride else None
        if finding:
            yield finding
    if "cell_temperature" in ride and "ambient_temperature" in ride:
        yield from _cells_and_air(ride["cell_temperature"], ride["ambient_temperature"])
    yield from _exchanged_temperatures(ride, moving)
    may_stand = STEADY | (STANDS if bench else set())
    for role, values in ride.items():
        known = values[moving & np.isfinite(values)]
        if role in may_stand or role.startswith(("pack_temperature", "roller", "suspension", "brake", "bms_temp")):
            continue
        if len(known) >= FEWEST and float(np.ptp(known)) == 0.0:
            yield wrong("stuck", (role,), f"is {known[0]:.6g} all the time while riding")


def _cells_and_air(cells: Array, air: Array) -> Iterator[Finding]:
    check, roles = "cells against air", ("cell_temperature", "ambient_temperature")
    known = np.flatnonzero(np.isfinite(cells) & np.isfinite(air))
    if not len(known):
        return
    cell, ambient = float(cells[known[0]]), float(air[known[0]])
    text = f"cells {cell:.0f} °C, air {ambient:.0f} °C at the start"
    scale, offset = to_si("degF", "cell_temperature") or (1.0, 0.0)
    if abs(cell - ambient) < NEAR:
        yield right(check, roles, text)
    elif cell - ambient > FAR and abs(scale * cell + offset - ambient) < FAHRENHEIT:
        yield wrong(check, roles[:1], f"{text}: that is °F taken for °C, unless it came out of a warm room")
    elif ambient - cell > FAR and abs(scale * ambient + offset - cell) < FAHRENHEIT:
        yield wrong(check, roles[1:], f"{text}: that is °F taken for °C")
    else:
        yield unknown(check, roles, f"{text}: from a room, from charging, or wrong")


def _exchanged_temperatures(ride: Mapping[str, Array], moving: Mask) -> Iterator[Finding]:
    """Cells and air warm slowly, a motor fast: while riding, as charging and heaters warm cells alone."""
    spans = {}
    for role in ("motor_temperature", "cell_temperature", "ambient_temperature"):
        known = ride[role][moving & np.isfinite(ride[role])] if role in ride else ()
        if len(known) >= FEWEST:
            spans[role] = float(np.ptp(known))
    motor = spans.pop("motor_temperature", np.inf)
    for role, span in spans.items():
        if span > WARMED and span > 2.5 * motor:
            text = f"changes by {span:.0f} K while riding, and motor_temperature by {motor:.0f} K: swapped?"
            yield wrong("temperature", (role, "motor_temperature"), text)
