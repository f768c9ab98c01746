"""Whether temperatures, switches and what else a log says can be what the vehicle file calls them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.can.mapping import to_si
from gz_onboard.constants import KELVIN
from gz_onboard.estimator.plausibility.residual import CONFIG, LIMITS
from gz_onboard.events import words
from gz_onboard.vehicle_check.finding import Finding, right, unknown, wrong
from gz_onboard.vehicle_check.seconds import FEWEST, Seconds, rate, relation

NEAR, FAR = 15.0, 25.0  # K between cells and air: usual; more than from a warm room, or a charge, into the cold
COLDER = 45.0  # K: cells were never so much colder than the air
WARMS = ((12.0, 2.0), (5.0, 4.0))
"""K and a factor: cells or air that change by more on a ride, and by as many times what the motor does, are its."""
FAHRENHEIT = 8.0  # K: so near the air are cells that were read in °F
SWITCHES = {"brake_switch", "charge_plug", "key", "contactor", "rider", "gps_fix"}
STEADY = SWITCHES | {"odometer", "bms_state_of_charge", "ambient_temperature", "cell_temperature", "heater_power"}
STEADY |= {"motor_temperature", "inverter_temperature", "air_conditioner_power", "auxiliary_current"}
"""Roles that may hold one value for a whole ride."""
STANDS = {"wheel_speed_front", "gps_speed", "gps_course", "gps_altitude", "latitude", "longitude"}
STANDS |= {"accel_x", "accel_y", "accel_z", "rate_x", "rate_y", "rate_z"}
"""Roles that may do so where only the driven axle turns."""


def check_temperatures(ride: Seconds, speed: Array | None) -> Iterator[Finding]:
    """Each within what vehicles have; the cells' against the air's."""
    for role in ride.any_of(*LIMITS):
        low, high = LIMITS[role][:2]
        least, most = float(np.nanmin(ride[role])), float(np.nanmax(ride[role]))
        middle = 0.5 * (least + most)
        if low < least and most < high:
            if role not in ("cell_temperature", "ambient_temperature"):
                yield right("temperature", (role,), f"{least:.0f} to {most:.0f} °C")
            continue
        kelvin = ": that is K taken for °C" if low < middle - KELVIN < high else ""
        yield wrong("temperature", (role,), f"{least:.0f} to {most:.0f} °C, possible are {low:g} to {high:g}{kelvin}")
    if speed is not None:
        yield from _swapped(ride, np.abs(speed) > CONFIG.moving_m_s)
    if {"cell_temperature", "ambient_temperature"} <= ride.columns.keys():
        yield from _cells_and_air(ride["cell_temperature"], ride["ambient_temperature"])
    elif "cell_temperature" in ride or "ambient_temperature" in ride:
        role = ride.any_of("cell_temperature", "ambient_temperature")[0]
        yield unknown("cells against air", (role,), "there is no other to compare it with")


def _swapped(ride: Seconds, moving: Mask) -> Iterator[Finding]:
    """Cells and air warm slowly, a motor fast: while the vehicle moves, as charging and heaters warm cells alone."""
    if "motor_temperature" not in ride:
        return
    spans = {}
    for role in ride.any_of("motor_temperature", "cell_temperature", "ambient_temperature"):
        known = ride[role][moving & np.isfinite(ride[role])]
        if len(known) < FEWEST:
            return
        spans[role] = float(np.ptp(known))
    motor = spans.pop("motor_temperature")
    for role, span in spans.items():
        if any(span > least and span > factor * motor for least, factor in WARMS):
            text = f"changes by {span:.0f} K while riding, and motor_temperature by {motor:.0f} K: swapped?"
            yield wrong("temperature", (role, "motor_temperature"), text)


def _cells_and_air(cells: Array, air: Array) -> Iterator[Finding]:
    check, roles = "cells against air", ("cell_temperature", "ambient_temperature")
    known = np.flatnonzero(np.isfinite(cells) & np.isfinite(air))
    if not len(known):
        return
    cell, ambient = float(cells[known[0]]), float(air[known[0]])
    text = f"cells {cell:.0f} °C, air {ambient:.0f} °C at the start"
    conversion = to_si("degF", "cell_temperature")
    assert conversion is not None
    read = [value * conversion[0] + conversion[1] for value in (cell, ambient)]
    if abs(cell - ambient) < NEAR:
        yield right(check, roles, text)
    elif cell - ambient > FAR and abs(read[0] - ambient) < FAHRENHEIT:
        yield wrong(check, ("cell_temperature",), f"{text}: that is °F taken for °C, unless it came out of a warm room")
    elif ambient - cell > FAR and abs(read[1] - cell) < FAHRENHEIT:
        yield wrong(check, ("ambient_temperature",), f"{text}: that is °F taken for °C")
    elif cell < ambient - COLDER or cell > ambient + 2 * FAR:
        yield wrong(check, roles, f"{text}: no pack is so far from the air")
    else:
        yield unknown(check, roles, f"{text}: from a room, from charging, or wrong")


def check_switches(ride: Seconds, speed: Array | None) -> Iterator[Finding]:
    """Those whose state the motion shows."""
    if speed is None:
        return
    moving = np.abs(speed) > CONFIG.moving_m_s
    if moving.sum() < FEWEST:
        return
    for role, riding in (("charge_plug", 0.0), ("key", 1.0), ("contactor", 1.0)):
        if role in ride and np.isfinite(ride[role][moving]).any():
            shown = float(np.nanmean(np.clip(ride[role][moving], 0.0, 1.0)))
            state = {"charge_plug": "plugged in", "key": "off", "contactor": "open"}[role]
            if abs(shown - riding) > 0.5:
                most = float(np.nanmax(ride[role][moving]))
                hint = "the other way round, scale = -1, offset = 1"
                if most > 1:
                    hint = (
                        f"it goes to {most:g}, and 1 is on; limits of [0|1] in the DBC file drop what else it may mean"
                    )
                yield wrong(words(role), (role,), f"is {state} while riding: {hint}")
            else:
                yield right(words(role), (role,), f"is not {state} while riding")
    if "brake_switch" in ride:
        yield from _brake(ride["brake_switch"], speed, moving)


def _brake(pressed: Array, speed: Array, moving: Mask) -> Iterator[Finding]:
    change = rate(np.abs(speed))
    on, off = moving & (pressed > 0.9), moving & (pressed < 0.1)
    if on.sum() < FEWEST / 3 or off.sum() < FEWEST / 3:
        yield unknown("brake switch", ("brake_switch",), "it does not change while riding")
    elif float(np.nanmean(change[on])) < float(np.nanmean(change[off])):
        yield right("brake switch", ("brake_switch",), "the vehicle slows where it is pressed")
    else:
        yield wrong("brake switch", ("brake_switch",), "the vehicle slows where it is not pressed: the other way round")


def check_throttle(ride: Seconds, current: Array | None) -> Iterator[Finding]:
    """Its range, and whether the current follows it."""
    if "throttle" not in ride:
        return
    role, most = "throttle", float(np.nanmax(ride["throttle"]))
    if most > 1.2 or float(np.nanmin(ride["throttle"])) < -0.2:
        yield wrong(role, (role,), f"goes to {most:.3g}: must be 0 to 1; its unit may be %")
        return
    found = relation(ride["throttle"], current) if current is not None else None
    if found is None:
        yield unknown(role, (role,), "it does not move, or there is no current")
    elif found.correlation < -0.3:
        yield wrong(role, (role,), "the current falls where it opens: the other way round, or the current's sign")
    elif found.correlation > 0.3:
        yield right(role, (role,), f"0 to {most:.2f}, and the current follows it")
    else:
        yield unknown(role, (role,), "the current does not follow it")


def check_stuck(ride: Seconds, speed: Array | None, bench: bool = False) -> Iterator[Finding]:
    """One value for the whole ride, where it must move; bench: only the driven axle does."""
    if speed is None or float(np.nansum(np.abs(speed) > CONFIG.moving_m_s)) < FEWEST:
        return
    moving = np.abs(speed) > CONFIG.moving_m_s
    for role, values in ride.columns.items():
        of = values[moving & np.isfinite(values)]
        if role in STEADY or role.startswith(("pack_temperature", "roller", "suspension", "brake", "bms_temp")):
            continue
        if bench and role in STANDS:
            continue
        if len(of) >= FEWEST and float(np.ptp(of)) == 0.0:
            yield wrong("stuck", (role,), f"is {of[0]:.6g} all the time while riding")
