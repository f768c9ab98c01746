"""Temperatures, switches, throttle and stuck signals of a log."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.can.mapping import to_si
from gz_onboard.constants import KELVIN
from gz_onboard.estimator.plausibility.residual import CONFIG, LIMITS
from gz_onboard.events import words
from gz_onboard.vehicle_check.finding import Expected, Finding, right, unknown, wrong
from gz_onboard.vehicle_check.seconds import FEWEST, Seconds, rate, relation

NEAR, FAR, FARTHEST = 15.0, 25.0, 50.0  # K between cells and air: usual; out of a warm room; impossible
FAHRENHEIT = 8.0  # K: so near the air are cells that were read in °F
STEADY = {"brake_switch", "charge_plug", "key", "contactor", "rider", "gps_fix", "odometer", "bms_state_of_charge"}
STEADY |= {"ambient_temperature", "cell_temperature", "motor_temperature", "inverter_temperature", "heater_power"}
STEADY |= {"air_conditioner_power", "auxiliary_current"}
"""Roles that may hold one value for a whole ride."""
STANDS = {"wheel_speed_front", "gps_speed", "gps_course", "gps_altitude", "latitude", "longitude"}
STANDS |= {"accel_x", "accel_y", "accel_z", "rate_x", "rate_y", "rate_z"}
"""Roles that may do so where only the driven axle turns."""
THROTTLE = Expected(
    "throttle",
    ("throttle",),
    close=0.3,
    sign="the current falls where it opens: the other way round, or the current's sign",
    hidden="the current does not follow it",
)


def check_others(ride: Seconds, speed: Array | None, current: Array | None, bench: bool) -> Iterator[Finding]:
    """Check temperatures, switches, the throttle and stuck signals. speed [m/s], current [A], (n,).

    bench: only the driven axle turns.
    """
    moving = None if speed is None else np.abs(speed) > CONFIG.moving_m_s
    yield from _temperatures(ride)
    if moving is not None and speed is not None and moving.sum() >= FEWEST:
        yield from _swapped(ride, moving)
        yield from _switches(ride, moving)
        if "brake_switch" in ride:
            yield _brake(ride["brake_switch"], speed, moving)
        yield from _stuck(ride, moving, STEADY | (STANDS if bench else set()))
    if "throttle" in ride:
        most = float(np.nanmax(ride["throttle"]))
        found = relation(ride["throttle"], current) if current is not None else None
        if most > 1.2 or float(np.nanmin(ride["throttle"])) < -0.2:
            yield wrong("throttle", ("throttle",), f"goes to {most:.3g}: must be 0 to 1; its unit may be %")
        elif found is None:
            yield unknown("throttle", ("throttle",), "it does not move, or there is no current")
        else:
            yield THROTTLE.judge(found.correlation, 1.0, f"0 to {most:.2f}, correlation {found.correlation:.2f}")


def _temperatures(ride: Seconds) -> Iterator[Finding]:
    """Each within what vehicles have; the cells' against the air's."""
    believed = []
    for role in ride.any_of(*LIMITS):
        (low, high), shown = LIMITS[role][:2], ride[role][np.isfinite(ride[role])]
        least, most = float(shown.min()), float(shown.max())
        if low < least and most < high:
            believed.append(role)
            if role not in ("cell_temperature", "ambient_temperature"):
                yield right("temperature", (role,), f"{least:.0f} to {most:.0f} °C")
            continue
        kelvin = ": that is K taken for °C" if low < 0.5 * (least + most) - KELVIN < high else ""
        yield wrong("temperature", (role,), f"{least:.0f} to {most:.0f} °C, possible are {low:g} to {high:g}{kelvin}")
    if {"cell_temperature", "ambient_temperature"} <= set(believed):
        yield from _cells_and_air(ride["cell_temperature"], ride["ambient_temperature"])


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
    elif abs(cell - ambient) > FARTHEST:
        yield wrong(check, roles, f"{text}: no pack is so far from the air")
    else:
        yield unknown(check, roles, f"{text}: from a room, from charging, or wrong")


def _swapped(ride: Seconds, moving: Mask) -> Iterator[Finding]:
    """Cells and air warm slowly, a motor fast: while riding, as charging and heaters warm cells alone."""
    spans = {}
    for role in ride.any_of("motor_temperature", "cell_temperature", "ambient_temperature"):
        known = ride[role][moving & np.isfinite(ride[role])]
        if len(known) >= FEWEST:
            spans[role] = float(np.ptp(known))
    motor = spans.pop("motor_temperature", None)
    for role, span in spans.items() if motor is not None else ():
        if motor is not None and ((span > 12.0 and span > 2 * motor) or (span > 5.0 and span > 4 * motor)):
            text = f"changes by {span:.0f} K while riding, and motor_temperature by {motor:.0f} K: swapped?"
            yield wrong("temperature", (role, "motor_temperature"), text)


def _switches(ride: Seconds, moving: Mask) -> Iterator[Finding]:
    """Switches with a known state while moving."""
    for role, riding, state in (("charge_plug", 0, "plugged in"), ("key", 1, "off"), ("contactor", 1, "open")):
        if role not in ride or not np.isfinite(ride[role][moving]).any():
            continue
        shown, most = float(np.nanmean(np.clip(ride[role][moving], 0, 1))), float(np.nanmax(ride[role][moving]))
        if abs(shown - riding) < 0.5:
            yield right(words(role), (role,), f"is not {state} while riding")
            continue
        hint = "the other way round, scale = -1, offset = 1"
        if most > 1:
            hint = f"it goes to {most:g}, and 1 is on; limits of [0|1] in the DBC file drop what else it may mean"
        yield wrong(words(role), (role,), f"is {state} while riding: {hint}")


def _brake(pressed: Array, speed: Array, moving: Mask) -> Finding:
    check, roles, change = "brake switch", ("brake_switch",), rate(np.abs(speed))
    on, off = moving & (pressed > 0.9), moving & (pressed < 0.1)
    if on.sum() < FEWEST / 3 or off.sum() < FEWEST / 3:
        return unknown(check, roles, "it does not change while riding")
    if float(np.nanmean(change[on])) < float(np.nanmean(change[off])):
        return right(check, roles, "the vehicle slows where it is pressed")
    return wrong(check, roles, "the vehicle slows where it is not pressed: the other way round")


def _stuck(ride: Seconds, moving: Mask, may_stand: set[str]) -> Iterator[Finding]:
    """One value for the whole ride."""
    for role, values in ride.columns.items():
        known = values[moving & np.isfinite(values)]
        if role in may_stand or role.startswith(("pack_temperature", "roller", "suspension", "brake", "bms_temp")):
            continue
        if len(known) >= FEWEST and float(np.ptp(known)) == 0.0:
            yield wrong("stuck", (role,), f"is {known[0]:.6g} all the time while riding")
