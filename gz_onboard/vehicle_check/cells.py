"""The pack's voltage, state of charge and charge against the cells of the vehicle file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import ceil, floor, hypot

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import HOUR
from gz_onboard.estimation.summary import GAUGE_SD, gains
from gz_onboard.estimator.plausibility.residual import CONFIG
from gz_onboard.vehicle_check.finding import Finding, Looks, accused, right, unknown, wrong
from gz_onboard.vehicle_check.predictions import CURRENT, VOLTAGE, PackRide
from gz_onboard.vehicle_check.seconds import FEWEST, SECOND, unit_of

CHARGE = "bms_state_of_charge"
VOLTAGES = (VOLTAGE, "inverter_voltage")
BY_CELLS, BY_VOLTAGE = "voltage against the cells", "state of charge against the voltage"


@dataclass(frozen=True)
class CellCheckConfig:
    """Tolerances."""

    above_full: float = 1.02  # of the full cell's voltage, that cells which give current do not exceed for long
    above_full_share: float = 0.1  # of the time
    emptiest: float = 0.95  # of the voltage of an empty cell, that half a log does not fall below
    right_sd: float = 2.0  # of gauge against voltage
    wrong_sd: float = 3.0
    vague: float = 0.15  # sd of a state of charge by voltage that tells nothing, as on LFP's flat middle
    window_s: int = 60  # at each end of a log, that a state of charge is taken from
    loaded_least: int = 5  # seconds of these
    cells_sd: float = 0.4  # cells in series: known so closely they are told apart
    miscounted: int = 2  # cells
    counted: float = 0.06  # of a state of charge, that is compared


CELL_CHECK = CellCheckConfig()


def check_cells(ride: Mapping[str, Array], pack: PackRide, suspects: set[str]) -> list[Finding]:
    """Compare voltage, gauge and charge with the cells; suspects: roles that look wrong already.

    Whatever tells the number of cells looks right only if nothing contradicts it.
    """
    findings = [*_voltages(ride, pack), *_counted(ride, pack)]
    suspects = (suspects | accused(findings)) & {*VOLTAGES, CURRENT, CHARGE}
    of_number = [_within_cells(pack, ride[role], role, suspects) for role in VOLTAGES if role in ride]
    of_number += [_gauge(pack, ride[CHARGE], suspects)] if CHARGE in ride else []
    doubts = [one.check for one in of_number if one.looks is Looks.WRONG and not suspects]
    for one in of_number:
        if doubts and one.looks is Looks.RIGHT and one.check not in doubts:
            text = f"{one.text}; no number of cells alone: see {doubts[0]}"
            findings.append(unknown(one.check, one.roles, text))
        else:
            findings.append(one)
    return findings


def _voltages(ride: Mapping[str, Array], pack: PackRide) -> Iterator[Finding]:
    if all(role in ride for role in VOLTAGES):
        off = float(np.nanmedian(ride["inverter_voltage"] - ride[VOLTAGE])) / pack.battery.cells_series
        looks = right if abs(off) < CONFIG.voltage_sd_v else wrong
        yield looks("voltages against each other", VOLTAGES, f"the inverter's is {off:+.3f} V a cell off the pack's")


def _counted(ride: Mapping[str, Array], pack: PackRide) -> Iterator[Finding]:
    """The gauge against the charge that flowed."""
    if CHARGE not in ride or pack.current is None:
        return
    check, roles, battery, shown = "state of charge against the charge", (CHARGE, CURRENT), pack.battery, ride[CHARGE]
    known = np.isfinite(shown) & np.isfinite(pack.current)
    if known.mean() < 0.5 or known.sum() < FEWEST:
        yield unknown(check, roles, "they are too seldom there together")
        return
    capacity = battery.pack_capacity(pack.temperature)
    width = battery.window.high - battery.window.low
    counted = float(pack.current[known].sum()) * SECOND / HOUR / capacity / width
    fell = float(shown[known][0] - shown[known][-1])
    text = f"it falls by {fell:.1%}, and {counted:.1%} of the file's {capacity:.3g} A·h were drawn"
    if max(abs(counted), abs(fell)) < CELL_CHECK.counted:
        yield unknown(check, roles, f"{text}: too little")
    elif abs(fell) < 1e-6 or counted / fell < 0.02:
        yield wrong(check, roles, f"{text}: the sign or unit of one, or the gauge stands")
    else:
        ratio, (least, aged, most) = counted / fell, gains(fell)
        fits, unit = f"{text}; {capacity * ratio:.3g} A·h would fit", unit_of(CURRENT, ratio)
        if aged < ratio < most:
            yield right(check, roles, text)
        elif least < ratio < most:
            yield unknown(check, roles, f"{fits}: aged cells, their capacity, or cells in parallel")
        else:
            yield wrong(
                check, roles, text + unit if unit else f"{fits}: the cell's capacity, cells in parallel, or a scale"
            )


def _within_cells(pack: PackRide, voltage: Array, role: str, suspects: set[str]) -> Finding:
    """A voltage [V] (n,) within the limits of the cells."""
    battery, series = pack.battery, pack.battery.cells_series
    full, empty = battery.ocv_curve.y[-1], battery.cutoff_voltage
    low, high = CELL_CHECK.emptiest * min(empty, battery.ocv_curve.y[0]), CONFIG.highest_voltage_ratio * full
    least, middle, most = (float(x) / series for x in np.nanpercentile(voltage, (1, 50, 99)))
    text = f"{least:.2f} to {most:.2f} V a cell of {series} in series, which have {empty:.2f} to {full:.2f} V"
    fewest, most_cells = ceil(most * series / (CELL_CHECK.above_full * full)), floor(middle * series / empty)
    fits = f": {fewest} to {most_cells} in series would fit" if not suspects and fewest <= most_cells else ""
    if not (low < middle < high and most < high):
        return wrong(BY_CELLS, (role,), text + (unit_of(role, middle / (0.5 * (empty + full))) or fits))
    if pack.current is not None:
        above = voltage[(pack.current > 0) & np.isfinite(voltage)] / series > CELL_CHECK.above_full * full
        if len(above) >= FEWEST and float(np.mean(above)) > CELL_CHECK.above_full_share:
            return wrong(BY_CELLS, (role,), f"{text}, and no more while they give current{fits}")
    return right(BY_CELLS, (role,), text)


def _gauge(pack: PackRide, shown: Array, suspects: set[str]) -> Finding:
    """The vehicle's state of charge against the voltage, in the least loaded seconds at the start."""
    battery, roles = pack.battery, (CHARGE, VOLTAGE)
    current = np.zeros_like(shown) if pack.current is None else pack.current
    known = np.flatnonzero(np.isfinite(shown) & np.isfinite(pack.voltage) & np.isfinite(current))
    if not len(known):
        return unknown(BY_VOLTAGE, roles, "they are never there together")
    start = known[: CELL_CHECK.window_s]
    seconds = start[np.argsort(np.abs(current[start]))[: CELL_CHECK.loaded_least]]
    volts, amperes, gauge = (float(x[seconds].mean()) for x in (pack.voltage, current, shown))
    rest, slope = battery.ocv(battery.window.of_cells(gauge), pack.temperature)
    r0 = battery.circuit(battery.window.of_cells(gauge), pack.temperature)[0]
    before = abs(float(current[start[start <= max(seconds)]].mean()))
    # The voltage is known as closely as the table, the drop and the remainder of the load before.
    loaded, drop = battery.cell_voltage(volts, amperes), r0 * amperes / battery.cells_parallel
    lost = max(abs(drop), r0 * before / battery.cells_parallel)
    sd, gauge_sd = hypot(battery.ocv_sd, lost), GAUGE_SD * slope
    series = battery.cells_series * loaded / (rest - drop)
    series_sd = series / rest * hypot(2 * battery.ocv_sd, gauge_sd, lost)
    text = f"{gauge:.0%} by the gauge at the start, at which a cell rests at {rest:.3f} ± {hypot(sd, gauge_sd):.3f} V"
    text = f"{text}; it has {loaded + drop:.3f} V"
    if suspects:
        return unknown(BY_VOLTAGE, roles, f"{text}: {', '.join(sorted(suspects))} looks wrong")
    is_clear = max(series_sd, abs(series - round(series))) < CELL_CHECK.cells_sd
    if is_clear and 0 < abs(round(series) - battery.cells_series) <= CELL_CHECK.miscounted:
        fits = f"{round(series)} cells in series would fit, not {battery.cells_series}"
        return wrong(BY_VOLTAGE, roles, f"{text}: {fits}")
    off = abs(loaded + drop - rest) / hypot(sd, gauge_sd)
    causes = "the table ocv, of other cells than these; battery.window; or the gauge"
    if off > CELL_CHECK.wrong_sd:
        return wrong(BY_VOLTAGE, roles, f"{text}: cells in series; {causes}")
    if sd > CELL_CHECK.vague * slope:
        return unknown(BY_VOLTAGE, roles, f"{text}: too vague to tell")
    if off > CELL_CHECK.right_sd:
        return unknown(BY_VOLTAGE, roles, f"{text}: {causes}")
    return right(BY_VOLTAGE, roles, text)
