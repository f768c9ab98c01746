"""Whether what a log says of voltages, currents and charge fits together, and fits the battery of the vehicle file."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from math import ceil, floor

import numpy as np

from gz_onboard.arrays import Array, Mask
from gz_onboard.constants import BENCH_TEMPERATURE
from gz_onboard.estimator.plausibility.residual import CONFIG
from gz_onboard.model.battery import Battery
from gz_onboard.model.model import air_density
from gz_onboard.offline.series import all_quantities
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.finding import Finding, Looks, right, unknown, wrong
from gz_onboard.vehicle_check.seconds import FEWEST, UNRELATED, Seconds, rate, relation, too_little, unit_of

PACK = ("pack_voltage", "pack_current")
BY_CELLS, BY_VOLTAGE = "voltage against the cells", "state of charge against the voltage"
BY_POWER = "power against speed and acceleration"
CELLS = "cells"  # in what may be of a wrong number of them
NUMBER = r": \d+( to \d+)? (cells )?in series would fit.*"
SAGS = 0.5  # a correlation of the changes of voltage and current from here on is that of a resistance
RESISTANCES, USUAL_RESISTANCES = (0.3, 3.5), (0.6, 1.7)  # of the file's: possible, with cold or aged cells; usual
ENERGIES, USUAL_ENERGIES = (0.5, 2.0), (0.75, 1.5)
"""Of the model's: possible, by hills, wind and payload; usual: 35 recorded rides have 0.94 to 1.31."""
ROUGH = 0.2  # relative: so near the units' is the ratio of two powers
ABOVE_FULL = 1.02  # of the full cell's voltage: cells that give current are not above it for long
ABOVE_FOR = 0.1  # of the time
EMPTIEST = 0.95  # of the voltage of an empty cell: none is below for half a log
BRAKES = -0.4  # m/s²: slower than the road load alone


@dataclass(frozen=True)
class PackRide:
    """What the pack gives: voltage [V], current [A] of the ride, (n,), and its battery; temperature of the cells."""

    voltage: Array
    current: Array | None
    battery: Battery
    temperature: float  # degC


def drawn(ride: Seconds, vehicle: Vehicle) -> PackRide | None:
    """Pack or inverter; None without a voltage or a battery."""
    voltages = ride.any_of("pack_voltage", "inverter_voltage")
    if not voltages or vehicle.battery is None:
        return None
    currents = ride.any_of("pack_current", "inverter_current")
    degrees = [float(np.nanmean(ride[role])) for role in ride.any_of("cell_temperature", "ambient_temperature")]
    temperature = min(max(degrees[0], -30.0), 60.0) if degrees else BENCH_TEMPERATURE
    current = ride[currents[0]] if currents else None
    return PackRide(ride[voltages[0]], current, vehicle.battery, temperature)


def check_voltages(ride: Seconds, battery: Battery, current: Array | None) -> Iterator[Finding]:
    """Each within what the cells can have, and both against each other; current: of the pack [A] (n,)."""
    series = battery.cells_series
    low = EMPTIEST * min(battery.cutoff_voltage, battery.ocv_curve.y[0])
    high = CONFIG.highest_voltage_ratio * battery.ocv_curve.y[-1]
    full, empty = battery.ocv_curve.y[-1], battery.cutoff_voltage
    inside: list[str] = []
    for role in ride.any_of("pack_voltage", "inverter_voltage"):
        least, middle, most = (float(x) / series for x in np.nanpercentile(ride[role], (1, 50, 99)))
        text = f"{least:.2f} to {most:.2f} V a cell of {series} in series"
        fewest, most_cells = ceil(most * series / (ABOVE_FULL * full)), floor(middle * series / empty)
        fits = f"{fewest} to {most_cells}" if fewest < most_cells else str(most_cells)
        if low < middle < high and most < high:
            inside.append(role)
            if current is not None and _above_full(ride[role] / series, current, full):
                text += f", which have {empty:.2f} to {full:.2f} V, and no more while they give current"
                yield wrong(BY_CELLS, (role,), f"{text}: {fits} in series would fit")
            else:
                yield right(BY_CELLS, (role,), f"{text}; they have {empty:.2f} to {full:.2f} V")
            continue
        like = unit_of(role, middle / (0.5 * (empty + full)))
        hint = like or (f": {fits} in series would fit" if most_cells >= 1 else "")
        yield wrong(BY_CELLS, (role,), f"{text}, which have {empty:.2f} to {full:.2f} V{hint}")
    if len(inside) == 2:
        apart = ride["inverter_voltage"] - ride["pack_voltage"]
        known = np.isfinite(apart)
        off = float(np.median(apart[known])) / series if known.any() else 0.0
        looks = right if abs(off) < CONFIG.voltage_sd_v else wrong
        yield looks("voltages against each other", (*inside,), f"the inverter's is {off:+.3f} V a cell off the pack's")


def _above_full(cell: Array, current: Array, full: float) -> bool:
    """Whether a cell's voltage [V] (n,) is for long above that of a `full` one while it gives current (n,)."""
    giving = (current > 0) & np.isfinite(cell)
    return giving.sum() >= FEWEST and float(np.mean(cell[giving] > ABOVE_FULL * full)) > ABOVE_FOR


def unless_contradicted(findings: Iterable[Finding]) -> list[Finding]:
    """All of them; voltage and state of charge tell the number of cells only if nothing else says that a sensor is off.

    They look right by it only if both do.
    """
    found = list(findings)
    if off := sorted({one.check for one in found if _off_by_itself(one)}):
        found = [_without_cells(one, " and ".join(off)) for one in found]
    number = {one.check for one in found if one.looks is Looks.WRONG} & {BY_CELLS, BY_VOLTAGE}
    doubted = [bool(number) and one.check in (BY_CELLS, BY_VOLTAGE) and one.looks is Looks.RIGHT for one in found]
    text = f"; that alone tells no number of cells: see {' and '.join(sorted(number))}"
    return [unknown(f.check, f.roles, f.text + text) if i else f for f, i in zip(found, doubted, strict=True)]


def _off_by_itself(one: Finding) -> bool:
    """Whether it says that voltage, current or gauge is wrong, whatever the cells are."""
    by_cells = one.check in (BY_CELLS, BY_VOLTAGE) or CELLS in one.text
    return one.looks is Looks.WRONG and not by_cells and bool({*PACK, "bms_state_of_charge"} & set(one.roles))


def _without_cells(one: Finding, off: str) -> Finding:
    """The same, without the number of cells that would fit a sensor that is `off`, by those checks."""
    if one.looks is not Looks.WRONG or one.check not in (BY_CELLS, BY_VOLTAGE):
        return one
    text = re.sub(NUMBER, "", one.text)
    if one.check == BY_VOLTAGE:
        return unknown(one.check, one.roles, f"{text.partition(': ')[0]}: see {off}")
    return replace(one, text=text)


def check_sag(of: PackRide) -> Iterator[Finding]:
    """The current's sign and size by what the voltage lacks under it."""
    if of.current is None:
        return
    check = "current against the voltage's drop"
    capacity = of.battery.pack_capacity(BENCH_TEMPERATURE)
    current, volts = np.diff(of.current), np.diff(of.voltage)
    if np.nanstd(of.current) < 2 * CONFIG.idle_rate * capacity or np.nanstd(current) < CONFIG.idle_rate * capacity:
        yield unknown(check, PACK, f"the current hardly changes ({np.nanstd(of.current):.2f} A)" + _tiny(of, capacity))
        return
    found = relation(current, volts)
    if found is None:
        yield unknown(check, PACK, "the voltage does not move, or they are not there together")
        return
    r0 = of.battery.circuit(0.5, of.temperature)[0]
    expected = of.battery.cells_series / of.battery.cells_parallel * r0 + of.battery.series_resistance
    shown = -found.factor
    text = f"{1e3 * abs(shown):.3g} mΩ of the pack, where the file has {1e3 * expected:.3g} mΩ"
    if found.correlation > SAGS:
        yield wrong(check, ("pack_current",), f"the voltage rises with it: its sign, scale = -1 ({text})")
    elif found.correlation > -SAGS:
        yield unknown(check, PACK, f"they hardly go together (correlation {found.correlation:.2f})")
    elif USUAL_RESISTANCES[0] < shown / expected < USUAL_RESISTANCES[1]:
        yield right(check, PACK, f"the voltage sags under load: {text}")
    elif RESISTANCES[0] < shown / expected < RESISTANCES[1]:
        yield unknown(check, PACK, f"the voltage sags under load: {text}; aged or cold cells, r0, or the cells' number")
    else:
        like = unit_of("pack_current", expected / shown) or ": scale of the current, r0, or the cells' number"
        yield wrong(check, ("pack_current",), text + like)


def _tiny(of: PackRide, capacity: float) -> str:
    """What else a current may be that moves too little for the pack."""
    moved = float(np.nanstd(of.voltage)) / of.battery.cells_series
    return f", though the voltage moves by {1e3 * moved:.0f} mV a cell" if moved > 0.02 and capacity else ""


def model_power(ride: Seconds, vehicle: Vehicle, speed: Array, payload: float | None) -> Array:
    """Power [W] of the pack by the model, (n,), on the level."""
    p = vehicle.parameters
    mass = p["vehicle_mass"] + (p["payload_mass"] if payload is None else payload)
    ambient = float(np.nanmean(ride["ambient_temperature"])) if "ambient_temperature" in ride else BENCH_TEMPERATURE
    ambient = min(max(ambient, -40.0), 60.0)
    acceleration = rate(speed)
    grade = np.zeros_like(speed)
    quantities = all_quantities(
        speed=speed,
        acceleration=acceleration,
        grade=grade,
        mass=mass,
        air_density=air_density(ambient),
        ambient_temperature=ambient,
        motor_temperature=ambient,
    )
    return np.asarray(sum(vehicle.model.power(quantities).values()))


def check_road(ride: Seconds, of: PackRide, speed: Array, expected: Array) -> Iterator[Finding]:
    """The pack's power against that of the model [W] (n,) at this speed [m/s] (n,)."""
    if of.current is None:
        return
    check, power = BY_POWER, of.voltage * of.current
    moving = np.isfinite(power) & np.isfinite(expected) & (np.abs(speed) > CONFIG.moving_m_s)
    found = relation(expected, power, moving)
    if found is None:
        yield unknown(check, PACK, too_little(speed, "power and speed"))
        return
    given, wanted = (float(x[moving & (expected > 0)].sum()) for x in (power, expected))
    ratio = given / wanted if wanted > 0 else 0.0
    times = f"{ratio:.2f}" if abs(ratio) > 0.01 else f"{ratio:.2g}"
    text = f"{times} times the model's while it drives, correlation {found.correlation:.2f}"
    if found.correlation < -UNRELATED * 2:
        yield wrong(check, ("pack_current",), f"less where more is needed ({text}): its sign, scale = -1")
    elif found.correlation < UNRELATED * 2:
        yield unknown(check, PACK, f"hills hide it: {text}")
    elif USUAL_ENERGIES[0] < ratio < USUAL_ENERGIES[1]:
        yield right(check, PACK, text)
    elif ENERGIES[0] < ratio < ENERGIES[1]:
        yield unknown(check, PACK, f"{text}: hills, wind and payload, or mass, drag area or losses of the file")
    else:
        like = unit_of("pack_current", ratio, ROUGH)
        yield wrong(check, (*PACK, "speed"), f"{text}{like or ': a scale of current or speed, mass, or drag area'}")
    yield from _braking(of, speed, moving)


def _braking(of: PackRide, speed: Array, moving: Mask) -> Iterator[Finding]:
    """Whether the current has a sign, and what is recovered is in it."""
    assert of.current is not None
    check, current = "current while braking", of.current
    braking = moving & (rate(np.abs(speed)) < BRAKES)
    if braking.sum() < FEWEST:
        yield unknown(check, ("pack_current",), "too little braking")
        return
    size = float(np.nanpercentile(np.abs(current), 90))
    if float(np.percentile(current[braking], 5)) < -0.05 * size:
        yield right(check, ("pack_current",), "some of the energy comes back")
        return
    steps = np.concatenate(([False], braking[1:] & braking[:-1]))
    found = relation(np.diff(current, prepend=current[0]), np.diff(of.voltage, prepend=of.voltage[0]), steps)
    if found and found.correlation > SAGS and float(np.median(current[braking])) > 0.05 * size:
        yield wrong(check, ("pack_current",), "the voltage rises with it there: the current comes without its sign")
    else:
        yield unknown(check, ("pack_current",), "it is never negative: nothing is recovered, or that part is cut off")


def check_currents(ride: Seconds) -> Iterator[Finding]:
    """Pack against inverter and auxiliaries."""
    if not {"pack_current", "inverter_current"} <= ride.columns.keys():
        return
    check, roles = "currents against each other", ("pack_current", "inverter_current")
    auxiliary = np.nan_to_num(ride["auxiliary_current"]) if "auxiliary_current" in ride else 0.0
    pack, inverter = ride["pack_current"], ride["inverter_current"] + auxiliary
    found = relation(pack, inverter)
    if found is None or abs(found.correlation) < 2 * UNRELATED:
        yield unknown(check, roles, "they hardly move together")
        return
    text = f"the inverter's is {found.factor:.3g} times the pack's"
    if found.correlation < 0:
        yield wrong(check, roles, f"{text}: the sign of one")
    elif abs(found.factor - 1) < 2 * CONFIG.current_sd_relative:
        yield right(check, roles, text)
    else:
        yield wrong(check, roles, text + _either(found.factor))


def _either(factor: float) -> str:
    """What the inverter's current looks like that is `factor` times the pack's, or the pack's: which, is not known."""
    inverter, pack = unit_of("inverter_current", factor), unit_of("pack_current", 1 / factor)
    return f"{pack} (pack_current), or{inverter[1:]} (inverter_current)" if " taken for " in pack else pack


def check_motor(ride: Seconds, of: PackRide | None) -> Iterator[Finding]:
    """The signs of torque and current of the motor by the power of the pack."""
    if of is None or of.current is None:
        return
    speed = ride.get("motor_speed")
    for role in ride.any_of("motor_torque", "motor_current"):
        check = f"{role.replace('_', ' ')} against the pack's power"
        work = ride[role] * (speed if speed is not None else 1.0)
        found = relation(of.voltage * of.current, work)
        if found is None or abs(found.correlation) < 2 * UNRELATED:
            yield unknown(check, (role,), "they hardly move together")
        elif found.correlation < 0:
            yield wrong(check, (role, "pack_current"), "it goes against it: the sign of one, positive when driving")
        elif role == "motor_torque" and speed is not None and not 0.4 < found.factor < 1.4:
            yield wrong(check, (role,), f"its work is {found.factor:.2g} times the pack's{unit_of(role, found.factor)}")
        else:
            yield right(check, (role,), f"correlation {found.correlation:.2f}")
