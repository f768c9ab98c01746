"""Whether a vehicle's own state of charge fits the voltage, the charge that flowed, and the battery of the file."""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gz_onboard.arrays import Array
from gz_onboard.constants import HOUR
from gz_onboard.estimation.summary import GAUGE_SD, gains
from gz_onboard.offline.series import soc_at_load
from gz_onboard.vehicle import Vehicle
from gz_onboard.vehicle_check.electric import BY_VOLTAGE, SAGS, PackRide
from gz_onboard.vehicle_check.finding import Finding, right, unknown, wrong
from gz_onboard.vehicle_check.seconds import FEWEST, SECOND, Seconds, relation, unit_of

RIGHT_SD, WRONG_SD = 2.0, 3.0  # between gauge and voltage: 95 and 99.7 % of what is right lies within
VAGUE = 0.15  # standard deviation of a state of charge by voltage that tells nothing, as on LFP's flat middle
WINDOW, LEAST_LOADED = 60, 5  # s at each end of a log, that a state of charge is taken from, and of these
CELLS_SD, MISCOUNTED = 0.4, 2  # cells in series: known so closely they are told apart; so many off are a miscount
FLATTEST = 1e-3  # V per state of charge
ROLES = ("bms_state_of_charge", "pack_voltage")
_CAUSES = "the table ocv, of other cells than these; battery.window; cells in series; or the gauge"
COUNTED = 0.06  # of a state of charge, at least
LEAST_COUNTED = 0.02  # of what the gauge moves: less may be of a current's offset, and has no sign


class RestPoint(NamedTuple):
    """Where a pack is least loaded: voltage [V], current [A], state of charge shown, voltage left of the load [V]."""

    voltage: float
    current: float
    shown: float
    left: float


def check_charge(ride: Seconds, of: PackRide | None, vehicle: Vehicle) -> Iterator[Finding]:
    """The vehicle's own state of charge by the voltage, at both ends of the log, and by the charge that flowed."""
    if "bms_state_of_charge" not in ride or of is None:
        return
    shown = ride["bms_state_of_charge"]
    current = of.current if of.current is not None else np.zeros_like(shown)
    known = np.flatnonzero(np.isfinite(shown) & np.isfinite(of.voltage) & np.isfinite(current))
    if not len(known):
        return
    resistance = _resistance_seen(of, current)
    start = _at_rest(of, current, shown, known[:WINDOW], resistance)
    fit = _cells_that_fit(of, start)
    if fit != of.battery.cells_series:
        hint = f"{fit} cells in series would fit, not {of.battery.cells_series}"
        yield wrong(BY_VOLTAGE, ROLES, f"{_by_voltage(of, start)[0]} at the start: {hint}")
    else:
        ends = [(start, "at the start"), (_at_rest(of, current, shown, known[-WINDOW:], resistance), "at the end")]
        seen = [(*_by_voltage(of, point), when) for point, when in ends]
        worst, clearest = max(seen, key=lambda end: end[1]), min(seen, key=lambda end: end[2])
        text, off, sd, when = worst if worst[1] > RIGHT_SD else clearest
        yield _verdict(f"{text} {when}", off, sd)
    yield from _counted(of, ROLES[0], shown)


def _verdict(text: str, off: float, sd: float) -> Finding:
    """off: between gauge and voltage, in standard deviations; sd: of the state of charge by the voltage."""
    if off > WRONG_SD:
        return wrong(BY_VOLTAGE, ROLES, f"{text}: {_CAUSES}")
    if off > RIGHT_SD:
        return unknown(BY_VOLTAGE, ROLES, f"{text}: unless by chance, {_CAUSES}")
    if sd > VAGUE:
        return unknown(BY_VOLTAGE, ROLES, f"{text}: too vague to tell")
    return right(BY_VOLTAGE, ROLES, text)


def _at_rest(of: PackRide, current: Array, shown: Array, known: NDArray[np.intp], resistance: float) -> RestPoint:
    """The mean of the seconds of least load among those that are `known` (indices)."""
    least = known[np.argsort(np.abs(current[known]))[:LEAST_LOADED]]
    before = abs(float(current[known[known <= max(least)]].mean()))
    volts, amperes, soc = (float(x[least].mean()) for x in (of.voltage, current, shown))
    return RestPoint(volts, amperes, soc, resistance * max(abs(amperes), before))


def _by_voltage(of: PackRide, point: RestPoint) -> tuple[str, float, float]:
    """(what gauge and voltage say, how far apart [sd], sd of the state of charge by the voltage)."""
    battery, load = of.battery, point.current / of.battery.cells_parallel
    cell = battery.cell_voltage(point.voltage, point.current)
    soc = min(max(soc_at_load(battery, cell, load, of.temperature), 0.0), 1.0)
    drop = battery.circuit(soc, of.temperature)[0] * load
    lost = max(abs(drop), point.left / battery.cells_series)
    sd = hypot(battery.ocv_sd, lost) / max(battery.ocv(soc, of.temperature)[1], FLATTEST)
    expected = battery.window.shown(soc, 0.0)[0]
    text = f"{point.shown:.0%} by the gauge, {expected:.0%} ± {min(sd, 1.0):.0%} by the voltage of {cell:.3f} V a cell"
    return text, abs(point.shown - expected) / hypot(sd, GAUGE_SD), sd


def _resistance_seen(of: PackRide, current: Array) -> float:
    """Of the pack [ohm], by the log; 0 where it shows none. A wrong r0 or number in parallel is not in it."""
    seen = relation(np.diff(current), np.diff(of.voltage))
    return -seen.factor if seen and seen.correlation < -SAGS else 0.0


def _cells_that_fit(of: PackRide, start: RestPoint) -> int:
    """The cells in series that have the pack's voltage where the vehicle shows its state of charge.

    The file's number unless another is clearly meant. It is known as closely as the rest voltage: by the table's sd,
    the slope where the charge is in doubt, the drop, and what may be left of the load before.
    """
    battery, amperes = of.battery, start.current
    soc, load = battery.window.of_cells(start.shown), amperes / battery.cells_parallel
    rest, slope = battery.ocv(soc, of.temperature)
    drop = battery.circuit(soc, of.temperature)[0] * load
    series = (start.voltage + battery.series_resistance * amperes) / (rest - drop)
    lost = max(abs(drop), start.left / battery.cells_series)
    doubt = series / rest * sqrt((2 * battery.ocv_sd) ** 2 + (GAUGE_SD * slope) ** 2 + lost**2)
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
