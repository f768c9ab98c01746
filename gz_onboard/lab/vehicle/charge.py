"""Whether a vehicle's own state of charge fits the voltage, the charge that flowed, and the battery of the file."""

from __future__ import annotations

from collections.abc import Iterator
from math import sqrt

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import HOUR
from gz_onboard.lab.estimate_summary import SHOWN_SD, gains
from gz_onboard.lab.vehicle.electric import BY_VOLTAGE, SAGS, PackRide
from gz_onboard.lab.vehicle.finding import Finding, right, unknown, wrong
from gz_onboard.lab.vehicle.seconds import FEWEST, SECOND, Seconds, relation, unit_of
from gz_onboard.vehicle import Vehicle

SOC_APART = 0.3  # by the first voltage against the vehicle's own
FIRST, LEAST_LOADED = 60, 5  # s, that a log's first state of charge is taken from, and of these
CELLS_SD, MISCOUNTED = 0.4, 2  # cells in series: known so closely they are told apart; so many off are a miscount
COUNTED = 0.06  # of a state of charge, at least
LEAST_COUNTED = 0.02  # of what the gauge moves: less may be of a current's offset, and has no sign


def check_charge(ride: Seconds, of: PackRide | None, vehicle: Vehicle) -> Iterator[Finding]:
    """The vehicle's own state of charge by the first voltage, and by the charge that flowed."""
    if "bms_state_of_charge" not in ride or of is None:
        return
    role, shown = "bms_state_of_charge", ride["bms_state_of_charge"]
    current = of.current if of.current is not None else np.zeros_like(shown)
    least, before = _least_loaded(of, current, shown)
    if not least:
        return
    volts, amperes, soc = (float(x[least].mean()) for x in (of.voltage, current, shown))
    cell = of.battery.cell_voltage(volts, amperes)
    by_voltage = of.battery.soc_at_load(cell, amperes / of.battery.cells_parallel, of.temperature)
    expected = of.battery.window.shown(min(max(by_voltage, 0.0), 1.0), 0.0)[0]
    text = f"{soc:.0%} at the start, {expected:.0%} by the voltage {cell:.3f} V a cell"
    fit = _cells_that_fit(of, (volts, amperes, soc), _resistance_seen(of, current) * max(abs(amperes), before))
    if fit != of.battery.cells_series:
        hint = f"{fit} cells in series would fit, not {of.battery.cells_series}"
        yield wrong(BY_VOLTAGE, (role, "pack_voltage"), f"{text}: {hint}")
    elif abs(soc - expected) < SOC_APART:
        yield right(BY_VOLTAGE, (role, "pack_voltage"), text)
    else:
        hint = "the cells' number, the table ocv, or battery.window"
        yield wrong(BY_VOLTAGE, (role, "pack_voltage"), f"{text}: {hint}")
    yield from _counted(of, role, shown)


def _least_loaded(of: PackRide, current: Array, shown: Array) -> tuple[list[int], float]:
    """(the seconds of least load within the first minute, the mean load [A] until the last of them); (n,) both."""
    known = np.flatnonzero(np.isfinite(shown) & np.isfinite(of.voltage) & np.isfinite(current))[:FIRST]
    least: list[int] = known[np.argsort(np.abs(current[known]))[:LEAST_LOADED]].tolist()
    before = current[known[known <= max(least)]] if least else np.zeros(1)
    return least, abs(float(before.mean()))


def _resistance_seen(of: PackRide, current: Array) -> float:
    """Of the pack [ohm], by the log; 0 where it shows none. A wrong r0 or number in parallel is not in it."""
    seen = relation(np.diff(current), np.diff(of.voltage))
    return -seen.factor if seen and seen.correlation < -SAGS else 0.0


def _cells_that_fit(of: PackRide, start: tuple[float, float, float], left: float) -> int:
    """The cells in series that have the pack's voltage where the vehicle shows its state of charge.

    The file's number unless another is clearly meant. start: voltage [V], current [A] and state of charge shown. It is
    known as closely as the rest voltage: by the table's sd, the slope where the charge is in doubt, the drop, and what
    may be `left` [V] of the load before.
    """
    battery, (volts, amperes, shown) = of.battery, start
    soc, load = battery.window.of_cells(shown), amperes / battery.cells_parallel
    rest, slope = battery.ocv(soc, of.temperature)
    drop = battery.circuit(soc, of.temperature)[0] * load
    series = (volts + battery.series_resistance * amperes) / (rest - drop)
    lost = max(abs(drop), left / battery.cells_series)
    doubt = series / rest * sqrt((2 * battery.ocv_sd) ** 2 + (SHOWN_SD * slope) ** 2 + lost**2)
    fit = round(series)
    clear = doubt < CELLS_SD and abs(series - fit) < CELLS_SD
    return fit if clear and 0 < abs(fit - battery.cells_series) <= MISCOUNTED else battery.cells_series


def _counted(of: PackRide, role: str, shown: Array) -> Iterator[Finding]:
    check, capacity = "state of charge against the charge", of.battery.pack_capacity(of.temperature)
    if of.current is None:
        return
    known = np.isfinite(shown) & np.isfinite(of.current)
    if known.sum() < FEWEST:
        return
    width = of.battery.window.high - of.battery.window.low
    counted = float(of.current[known].sum()) * SECOND / HOUR / capacity / width
    fell = float(shown[known][0] - shown[known][-1])
    moves = f"falls by {fell:.1%}" if fell >= 0 else f"rises by {-fell:.1%}"
    text = f"it {moves}, and {counted:.1%} of the file's {capacity:.3g} A·h were drawn"
    if max(abs(counted), abs(fell)) < COUNTED or known.mean() < 0.5:
        yield unknown(check, (role, "pack_current"), f"{text}: too little")
    elif abs(counted) < LEAST_COUNTED * abs(fell):
        yield wrong(check, (role, "pack_current"), f"{text}: the current's unit or scale, or the gauge")
    elif counted * fell < 0:
        yield wrong(check, (role, "pack_current"), f"{text}: the sign of one")
    elif abs(fell) < 1e-6:
        yield wrong(check, (role, "pack_current"), f"{text}: it does not move")
    else:
        ratio, (least, aged, most) = counted / fell, gains(fell)
        fits = f"{text}; {capacity * ratio:.3g} A·h would fit"
        if aged < ratio < most:
            yield right(check, (role, "pack_current"), text)
        elif least < ratio < most:
            yield unknown(check, (role, "pack_current"), f"{fits}: aged cells, their capacity, or cells in parallel")
        else:
            like = unit_of("pack_current", ratio)
            others = f"{fits}: the cell's capacity, cells in parallel, or a scale"
            yield wrong(check, (role, "pack_current"), f"{text}{like}" if like else others)
