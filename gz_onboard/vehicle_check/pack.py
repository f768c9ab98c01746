"""Voltages, currents and charge against each other, the motion, and the battery of the vehicle file.

The sign and unit of the current come first, by the voltage's drop: a mistake is corrected for the checks that follow.
Whatever tells the number of cells comes last, and only if no sensor of it looks wrong.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from math import ceil, floor, hypot, sqrt

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import BENCH_TEMPERATURE, HOUR
from gz_onboard.estimation.summary import GAUGE_SD, gains
from gz_onboard.estimator.plausibility.residual import CONFIG
from gz_onboard.model.battery import Battery
from gz_onboard.model.model import air_density
from gz_onboard.model.series import all_quantities, soc_at_load
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.finding import Expected, Finding, Looks, right, unknown, wrong
from gz_onboard.vehicle_check.seconds import FEWEST, SECOND, Seconds, rate, relation, unit_of

VOLTAGE, CURRENT, CHARGE = "pack_voltage", "pack_current", "bms_state_of_charge"
BY_CELLS, BY_VOLTAGE = "voltage against the cells", "state of charge against the voltage"
SAG = Expected(
    "current against the voltage's drop",
    (VOLTAGE, CURRENT),
    close=0.5,  # that of a resistance
    usual=(0.6, 1.7),  # times the file's resistance
    possible=(0.3, 3.5),
    blamed=(CURRENT,),
    hidden="too weak to tell",
    unsure="aged or cold cells, r0, or the cells' number",
)
POWER = Expected(
    "power against speed and acceleration",
    (VOLTAGE, CURRENT),
    close=0.4,
    usual=(0.75, 1.5),  # times the model's: 35 recorded rides have 0.94 to 1.31
    possible=(0.5, 2.0),  # by hills, wind and payload
    blamed=(CURRENT,),
    hidden="hills hide it",
    unsure="hills, wind and payload, or mass, drag area or losses of the file",
)
CURRENTS = Expected(
    "currents against each other",
    (CURRENT, "inverter_current"),
    close=0.4,
    usual=(1 - 2 * CONFIG.current_sd_relative, 1 + 2 * CONFIG.current_sd_relative),
    sign="the sign of one",
)


@dataclass(frozen=True)
class PackCheckConfig:
    """Tolerances."""

    above_full: float = 1.02  # of the full cell's voltage, that cells which give current do not exceed for long
    above_full_share: float = 0.1  # of the time
    emptiest: float = 0.95  # of the voltage of an empty cell, that half a log does not fall below
    rough: float = 0.2  # relative tolerance of a unit told by powers or a resistance
    brakes_m_s2: float = -0.4  # slower than by the road load alone
    right_sd: float = 2.0  # of gauge against voltage
    wrong_sd: float = 3.0
    vague: float = 0.15  # sd of a state of charge by voltage that tells nothing, as on LFP's flat middle
    window_s: int = 60  # at each end of a log, that a state of charge is taken from
    loaded_least: int = 5  # seconds of these
    cells_sd: float = 0.4  # cells in series: known so closely they are told apart
    miscounted: int = 2  # cells
    flattest: float = 1e-3  # V per state of charge
    counted: float = 0.06  # of a state of charge, that is compared


SETTINGS = PackCheckConfig()


@dataclass(frozen=True)
class PackRide:
    """What the pack gives: voltage [V] and current [A] of the ride, (n,); temperature of the cells [degC]."""

    voltage: Array
    current: Array | None
    battery: Battery
    temperature: float


def drawn(ride: Seconds, vehicle: Vehicle) -> PackRide | None:
    """Return pack or inverter; None without a voltage or a battery."""
    voltages = ride.any_of(VOLTAGE, "inverter_voltage")
    if not voltages or vehicle.battery is None:
        return None
    currents = ride.any_of(CURRENT, "inverter_current")
    degrees = [float(np.nanmean(ride[role])) for role in ride.any_of("cell_temperature", "ambient_temperature")]
    temperature = min(max(degrees[0], -30.0), 60.0) if degrees else BENCH_TEMPERATURE
    return PackRide(ride[voltages[0]], ride[currents[0]] if currents else None, vehicle.battery, temperature)


def check_pack(
    ride: Seconds, vehicle: Vehicle, speed: Array | None, payload: float | None, doubted: Collection[str] = ()
) -> tuple[list[Finding], PackRide | None]:
    """Return the findings about the pack, and what it gives with the current corrected.

    speed [m/s] (n,): None if its size is not sure. payload [kg], if known. doubted: roles that look wrong already.
    """
    of = drawn(ride, vehicle)
    if of is None:
        return [], None
    findings = [*_voltages(ride, of.battery)]
    if of.current is not None:
        found, factor = _sag(of)
        findings.append(found)
        of = replace(of, current=factor * of.current)
        assert of.current is not None
        if speed is not None:
            findings.append(_road(ride, of.voltage * of.current, vehicle, speed, payload))
            findings.append(_braking(of, of.current, speed))
        if CURRENT in ride and "inverter_current" in ride:
            findings.append(_currents(ride, of.current))
        findings += _motor(ride, of.voltage * of.current, _wrong_roles(findings) | set(doubted))
        if CHARGE in ride:
            findings += _counted(of, of.current, ride[CHARGE])
    return findings + _cells(ride, of, _wrong_roles(findings) & {VOLTAGE, CURRENT, CHARGE, "inverter_voltage"}), of


def _wrong_roles(findings: list[Finding]) -> set[str]:
    return {role for one in findings if one.looks is Looks.WRONG for role in one.roles}


def _voltages(ride: Seconds, battery: Battery) -> Iterator[Finding]:
    roles = (VOLTAGE, "inverter_voltage")
    if len(ride.any_of(*roles)) == 2:
        off = float(np.nanmedian(ride[roles[1]] - ride[roles[0]])) / battery.cells_series
        looks = right if abs(off) < CONFIG.voltage_sd_v else wrong
        yield looks("voltages against each other", roles, f"the inverter's is {off:+.3f} V a cell off the pack's")


def _sag(of: PackRide) -> tuple[Finding, float]:
    """The current's sign and size by the voltage's drop, and the factor that corrects the current."""
    assert of.current is not None
    idle = CONFIG.idle_rate * of.battery.pack_capacity(BENCH_TEMPERATURE)
    current, volts = np.diff(of.current), np.diff(of.voltage)
    found = relation(current, -volts)
    if found is None or np.nanstd(of.current) < 2 * idle or np.nanstd(current) < idle:
        moved = 1e3 * float(np.nanstd(of.voltage)) / of.battery.cells_series
        text = f"the current hardly changes ({np.nanstd(of.current):.2f} A), the voltage by {moved:.0f} mV a cell"
        return unknown(SAG.check, SAG.roles, text), 1.0
    r0 = of.battery.circuit(0.5, of.temperature)[0]
    expected = of.battery.cells_series / of.battery.cells_parallel * r0 + of.battery.series_resistance
    ratio = abs(found.factor) / expected
    unit = unit_of(CURRENT, 1 / ratio, SETTINGS.rough)
    text = f"{1e3 * abs(found.factor):.3g} mΩ of the pack, where the file has {1e3 * expected:.3g} mΩ"
    finding = SAG.judge(found.correlation, ratio, text, unit or ": scale of the current, r0, or the cells' number")
    if finding.looks is not Looks.WRONG:
        return finding, 1.0
    return finding, -1.0 if found.correlation < 0 else ratio if unit else 1.0


def _road(ride: Seconds, power: Array, vehicle: Vehicle, speed: Array, payload: float | None) -> Finding:
    """The pack's power [W] (n,) against that of the model on the level, at this speed [m/s] (n,)."""
    p = vehicle.parameters
    ambient = float(np.nanmean(ride["ambient_temperature"])) if "ambient_temperature" in ride else BENCH_TEMPERATURE
    ambient = min(max(ambient, -40.0), 60.0)
    quantities = all_quantities(
        speed=speed,
        acceleration=rate(speed),
        grade=np.zeros_like(speed),
        mass=p["vehicle_mass"] + (p["payload_mass"] if payload is None else payload),
        air_density=air_density(ambient),
        ambient_temperature=ambient,
        motor_temperature=ambient,
    )
    expected = np.asarray(sum(vehicle.model.power(quantities).values()))
    moving = np.isfinite(power) & np.isfinite(expected) & (np.abs(speed) > CONFIG.moving_m_s)
    found = relation(expected, power, moving)
    if found is None:
        return unknown(POWER.check, POWER.roles, "they are too seldom there together, or do not change")
    given, wanted = (float(x[moving & (expected > 0)].sum()) for x in (power, expected))
    ratio = given / wanted if wanted > 0 else 0.0
    text = f"{ratio:.3g} times the model's while it drives, correlation {found.correlation:.2f}"
    like = unit_of(CURRENT, ratio, SETTINGS.rough)
    return POWER.judge(found.correlation, ratio, text, like or ": a scale of current or speed, mass, or drag area")


def _braking(of: PackRide, current: Array, speed: Array) -> Finding:
    """Whether the current has a sign, and shows the recovered energy."""
    check, roles = "current while braking", (CURRENT,)
    braking = (np.abs(speed) > CONFIG.moving_m_s) & (rate(np.abs(speed)) < SETTINGS.brakes_m_s2) & np.isfinite(current)
    if braking.sum() < FEWEST:
        return unknown(check, roles, "too little braking")
    size = float(np.nanpercentile(np.abs(current), 90))
    if float(np.percentile(current[braking], 5)) < -0.05 * size:
        return right(check, roles, "some of the energy comes back")
    steps = np.concatenate(([False], braking[1:] & braking[:-1]))
    found = relation(np.diff(current, prepend=current[0]), np.diff(of.voltage, prepend=of.voltage[0]), steps)
    if found and found.correlation > SAG.close and float(np.median(current[braking])) > 0.05 * size:
        return wrong(check, roles, "the voltage rises with it there: the current comes without its sign")
    return unknown(check, roles, "it is never negative: nothing is recovered, or that part is cut off")


def _currents(ride: Seconds, pack: Array) -> Finding:
    auxiliary = np.nan_to_num(ride["auxiliary_current"]) if "auxiliary_current" in ride else 0.0
    found = relation(pack, ride["inverter_current"] + auxiliary)
    if found is None or abs(found.correlation) < CURRENTS.close:
        return unknown(CURRENTS.check, CURRENTS.roles, CURRENTS.hidden)
    of_pack, of_inverter = unit_of(CURRENT, 1 / abs(found.factor)), unit_of("inverter_current", abs(found.factor))
    if " taken for " in of_pack:
        of_pack += f" (pack_current), or{of_inverter[1:]} (inverter_current)"
    text = f"the inverter's is {found.factor:.3g} times the pack's"
    return CURRENTS.judge(found.correlation, found.factor, text, of_pack)


def _motor(ride: Seconds, power: Array, doubted: Collection[str]) -> Iterator[Finding]:
    """The signs of the motor's torque and current by the `power` of the pack [W] (n,); its work by torque and speed."""
    speed = np.abs(ride["motor_speed"]) if "motor_speed" in ride else None
    for role in ride.any_of("motor_torque", "motor_current"):
        sized = role == "motor_torque" and speed is not None and not {VOLTAGE, "motor_speed"} & set(doubted)
        usual = (0.4, 1.4) if sized else (0.0, float("inf"))
        sign = "the sign of one, positive when driving"
        expected = Expected(f"{role.replace('_', ' ')} against the pack's power", (role,), 0.4, usual, sign=sign)
        found = relation(power, ride[role] * (1.0 if speed is None else speed))
        if found is None:
            yield unknown(expected.check, expected.roles, expected.hidden)
            continue
        text = f"its work is {found.factor:.2g} times the pack's, correlation {found.correlation:.2f}"
        yield expected.judge(found.correlation, found.factor, text, unit_of(role, found.factor))


def _counted(of: PackRide, current: Array, shown: Array) -> Iterator[Finding]:
    """The gauge against the charge that flowed."""
    check, roles = "state of charge against the charge", (CHARGE, CURRENT)
    capacity = of.battery.pack_capacity(of.temperature)
    known = np.isfinite(shown) & np.isfinite(current)
    if known.sum() < FEWEST:
        return
    width = of.battery.window.high - of.battery.window.low
    counted = float(current[known].sum()) * SECOND / HOUR / capacity / width
    fell = float(shown[known][0] - shown[known][-1])
    text = f"it falls by {fell:.1%}, and {counted:.1%} of the file's {capacity:.3g} A·h were drawn"
    if max(abs(counted), abs(fell)) < SETTINGS.counted or known.mean() < 0.5:
        yield unknown(check, roles, f"{text}: too little")
    elif abs(fell) < 1e-6 or counted * fell < 0 or abs(counted) < 0.02 * abs(fell):
        yield wrong(check, roles, f"{text}: the sign or unit of one, or the gauge stands")
    else:
        ratio, (least, aged, most) = counted / fell, gains(fell)
        fits = f"{text}; {capacity * ratio:.3g} A·h would fit"
        if aged < ratio < most:
            yield right(check, roles, text)
        elif least < ratio < most:
            yield unknown(check, roles, f"{fits}: aged cells, their capacity, or cells in parallel")
        else:
            others = f"{fits}: the cell's capacity, cells in parallel, or a scale"
            yield wrong(check, roles, text + like if (like := unit_of(CURRENT, ratio)) else others)


# --- what tells the cells ---------------------------------------------------------------------------------------------


def _cells(ride: Seconds, of: PackRide, suspects: set[str]) -> list[Finding]:
    """The voltage by the cells' limits, and the gauge by the voltage; they look right only if both do."""
    findings = [_within_cells(of, ride[role], role, suspects) for role in ride.any_of(VOLTAGE, "inverter_voltage")]
    if CHARGE in ride:
        findings += _gauge(of, ride[CHARGE], suspects)
    doubts = [one.check for one in findings if one.looks is Looks.WRONG and not suspects]
    return [
        unknown(one.check, one.roles, f"{one.text}; no number of cells alone: see {doubts[0]}")
        if doubts and one.looks is Looks.RIGHT and one.check not in doubts
        else one
        for one in findings
    ]


def _within_cells(of: PackRide, voltage: Array, role: str, suspects: set[str]) -> Finding:
    """A voltage [V] (n,) within the limits of the cells."""
    battery, series = of.battery, of.battery.cells_series
    full, empty = battery.ocv_curve.y[-1], battery.cutoff_voltage
    low, high = SETTINGS.emptiest * min(empty, battery.ocv_curve.y[0]), CONFIG.highest_voltage_ratio * full
    least, middle, most = (float(x) / series for x in np.nanpercentile(voltage, (1, 50, 99)))
    text = f"{least:.2f} to {most:.2f} V a cell of {series} in series, which have {empty:.2f} to {full:.2f} V"
    fewest, most_cells = ceil(most * series / (SETTINGS.above_full * full)), floor(middle * series / empty)
    fits = f": {fewest} to {most_cells} in series would fit" if not suspects and fewest <= most_cells else ""
    if not (low < middle < high and most < high):
        return wrong(BY_CELLS, (role,), text + (unit_of(role, middle / (0.5 * (empty + full))) or fits))
    current = np.zeros_like(voltage) if of.current is None else of.current
    giving = (current > 0) & np.isfinite(voltage)
    above = voltage[giving] / series > SETTINGS.above_full * full
    if giving.sum() >= FEWEST and float(np.mean(above)) > SETTINGS.above_full_share:
        return wrong(BY_CELLS, (role,), f"{text}, and no more while they give current{fits}")
    return right(BY_CELLS, (role,), text)


def _gauge(of: PackRide, shown: Array, suspects: set[str]) -> list[Finding]:
    """The vehicle's state of charge against the voltage, in the least loaded seconds at both ends of the log."""
    current = np.zeros_like(shown) if of.current is None else of.current
    known = np.flatnonzero(np.isfinite(shown) & np.isfinite(of.voltage) & np.isfinite(current))
    if not len(known):
        return []
    roles = (CHARGE, VOLTAGE)
    seen = relation(np.diff(current), np.diff(of.voltage))
    resistance = -seen.factor if seen and seen.correlation < -SAG.close else 0.0  # of the pack [ohm], by the log
    ends = []
    for when, seconds in (("start", known[: SETTINGS.window_s]), ("end", known[-SETTINGS.window_s :])):
        least = seconds[np.argsort(np.abs(current[seconds]))[: SETTINGS.loaded_least]]
        volts, amperes, gauge = (float(x[least].mean()) for x in (of.voltage, current, shown))
        left = resistance * max(abs(amperes), abs(float(current[seconds[seconds <= max(least)]].mean())))
        if when == "start" and not suspects and (fit := _series_that_fit(of, volts, amperes, gauge, left)):
            text = f"{gauge:.0%} by the gauge at the start, {volts:.1f} V: {fit} cells in series would fit"
            return [wrong(BY_VOLTAGE, roles, f"{text}, not {of.battery.cells_series}")]
        ends.append((*_by_voltage(of, volts, amperes, gauge, left), when))
    worst, clearest = max(ends, key=lambda end: end[1]), min(ends, key=lambda end: end[2])
    text, off, sd, when = worst if worst[1] > SETTINGS.right_sd else clearest
    text, causes = f"{text} at the {when}", "the table ocv, of other cells than these; battery.window; or the gauge"
    if suspects:
        return [unknown(BY_VOLTAGE, roles, f"{text}: {', '.join(sorted(suspects))} looks wrong")]
    if off > SETTINGS.wrong_sd:
        return [wrong(BY_VOLTAGE, roles, f"{text}: cells in series; {causes}")]
    if off > SETTINGS.right_sd or sd > SETTINGS.vague:
        return [unknown(BY_VOLTAGE, roles, f"{text}: {'too vague to tell' if sd > SETTINGS.vague else causes}")]
    return [right(BY_VOLTAGE, roles, text)]


def _by_voltage(of: PackRide, volts: float, amperes: float, gauge: float, left: float) -> tuple[str, float, float]:
    """(what gauge and voltage say, their difference [sd], sd of the state of charge by the voltage).

    left [V]: voltage that is left of the load before.
    """
    battery, load = of.battery, amperes / of.battery.cells_parallel
    cell = battery.cell_voltage(volts, amperes)
    soc = min(max(soc_at_load(battery, cell, load, of.temperature), 0.0), 1.0)
    lost = max(abs(battery.circuit(soc, of.temperature)[0] * load), left / battery.cells_series)
    sd = hypot(battery.ocv_sd, lost) / max(battery.ocv(soc, of.temperature)[1], SETTINGS.flattest)
    expected = battery.window.shown(soc, 0.0)[0]
    text = f"{gauge:.0%} by the gauge, {expected:.0%} ± {min(sd, 1.0):.0%} by the voltage of {cell:.3f} V a cell"
    return text, abs(gauge - expected) / hypot(sd, GAUGE_SD), sd


def _series_that_fit(of: PackRide, volts: float, amperes: float, gauge: float, left: float) -> int | None:
    """Another number of cells in series that clearly fits the voltage at the gauge's state of charge.

    It is known as closely as the rest voltage: by the table's sd, the slope where the charge is in doubt, the drop, and
    and the remainder of the load before.
    """
    battery = of.battery
    soc, load = battery.window.of_cells(gauge), amperes / battery.cells_parallel
    rest, slope = battery.ocv(soc, of.temperature)
    drop = battery.circuit(soc, of.temperature)[0] * load
    series = (volts + battery.series_resistance * amperes) / (rest - drop)
    lost = max(abs(drop), left / battery.cells_series)
    doubt = series / rest * sqrt((2 * battery.ocv_sd) ** 2 + (GAUGE_SD * slope) ** 2 + lost**2)
    fit = round(series)
    clear = max(doubt, abs(series - fit)) < SETTINGS.cells_sd
    return fit if clear and 0 < abs(fit - battery.cells_series) <= SETTINGS.miscounted else None
