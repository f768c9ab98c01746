"""Energy that a pack still delivers until its weakest cells reach the cut-off voltage, and how warm it is meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import exp, sqrt
from typing import NamedTuple

from gz_onboard.constants import HOUR
from gz_onboard.model.battery import Battery, Overpotential, WeakGroup


@dataclass(frozen=True)
class DischargeConfig:
    """How the end of a discharge is defined and found."""

    below_empty: float = -0.05  # SOC down to which the cut-off is sought: tables of OCV may end early
    voltage_span: float = 0.01  # SOC above the end over which the slope is taken: a single piece of a table misleads
    least_slope: float = 0.1  # V over the whole charge: no cell is flatter near its end
    give_up_load: float = 0.5  # sd of the load over time above its mean at which a vehicle gives up: eight full
    give_up_load_sd: float = 0.3  # discharges; some vehicles cap bursts and creep on, others stop at the first one


DISCHARGE = DischargeConfig()
ALIKE = WeakGroup(0.0, 0.0, 0.0)  # of a pack whose groups are taken to be alike
# Gauss-Legendre nodes and weights on [0, 1], of order 4: within 0.2 % of the energy
_NODES = (0.0694318442, 0.3300094782, 0.6699905218, 0.9305681558)
_WEIGHTS = (0.1739274226, 0.3260725774, 0.3260725774, 0.1739274226)

# Gauss-Legendre nodes of order 3 over the charge that is left, for the heat of the reaction
_REACTION_NODES = 0.1127, 0.5, 0.8873
_REACTION_WEIGHTS = 0.2778, 0.4444, 0.2778
HOT_CELLS_C = 50.0  # degC: vehicles limit the power of hotter cells
DIGITS = 1  # of the result [degC]: rows of tables at it are kept for seconds; 0.1 K is 0.05 % of the energy


class Drawable(NamedTuple):
    """Energy that a pack still delivers, and its sensitivities."""

    energy: float  # J, at the pack's terminals
    slope: float  # J: increase of the energy per unit of SOC
    end: float  # SOC of the mean cell at the cut-off; the present SOC if the pack is empty already
    by_cutoff: float = 0.0  # J/V: loss of energy per volt of a higher cut-off voltage of a cell
    end_drop_sd: float = 0.0  # V of a cell: uncertainty of the voltage drop under load at the end
    end_sd: float = 0.0  # of SOC: uncertainty of where the weakest group ends


def drawable(
    battery: Battery,
    soc: float,
    temperature: float,
    power: float,
    form_factor_squared: float = 1.0,
    overpotential: Overpotential | None = None,
) -> Drawable:
    """Energy delivered from `soc` at `temperature` [degC] and a mean `power` [W] until the end of the discharge.

    At constant power P the charge Q·dSOC passes in dt = Q·dSOC/I, so the energy is P·Q·∫ dSOC/I(SOC). The lower limit
    is where the lowest cell meets the cut-off voltage under a load `give_up_load` sd above the mean, or the end of the
    charge that the vehicle uses. There the pack's voltage, and with it the current, is known; so the limit is a root
    in SOC alone. A group weaker than the mean cell (`Health.weakest`) ends the discharge; until then the pack delivers
    as much as the mean cell. The RC pair counts as settled: a discharge takes an hour, its time constant is a minute.

    power: above 0; form_factor_squared, overpotential: see `Battery.settled_current`.
    """
    least = battery.window.low if battery.window.given else DISCHARGE.below_empty
    charge = battery.pack_capacity(temperature) * HOUR
    cutoff = battery.cutoff_voltage
    weakest = battery.health.weakest or ALIKE
    load_sd = sqrt(max(form_factor_squared - 1, 0.0))  # over the mean load
    end_load = 1 + DISCHARGE.give_up_load * load_sd
    end_current = end_load * power / (cutoff * battery.cells_series)
    end_cell = end_current / battery.cells_parallel
    lowest = cutoff + battery.series_resistance * end_current / battery.cells_series

    def margin(soc: float) -> float:
        """Voltage of the weakest group above the cut-off [V] at `end_current` where the mean cell is at `soc`."""
        soc = weakest.soc(soc)
        lost = (battery.r0.at(soc, temperature)[0] + battery.r1.at(soc, temperature)[0]) * end_cell
        if overpotential:
            lost += overpotential(end_cell, soc, temperature, 1.0)
        return battery.ocv(soc, temperature)[0] - (1 + weakest.resistance) * lost - lowest

    def at_end(end: float, above: float) -> tuple[float, float]:
        """(by_cutoff, end_drop_sd) of a discharge that ends at `end` with the margin `above` [V]."""
        drop = max(battery.ocv(weakest.soc(end), temperature)[0] - cutoff, 0.0)
        rise = (margin(end + DISCHARGE.voltage_span) - above) / DISCHARGE.voltage_span
        rise /= max(1 - drop / cutoff, 0.1)  # at constant power the current falls as the voltage rises
        lost = charge * cutoff * battery.cells_series / max(rise, DISCHARGE.least_slope)
        return lost, drop / end_load * DISCHARGE.give_up_load_sd * load_sd

    def mean_current(soc: float, guess: float | None = None) -> float | None:
        """Mean current [A]; bursts beyond the pack's power are capped."""
        current = battery.settled_current(power, soc, temperature, form_factor_squared, overpotential, guess)
        return current or battery.settled_current(power, soc, temperature, 1.0, overpotential)

    now, over = mean_current(soc), margin(soc)
    slope = charge * (power / now if now else cutoff * battery.cells_series)
    if over < 0 or soc <= least or now is None:
        return Drawable(0.0, slope, soc, *at_end(soc, over), weakest.sd)
    end = _root(margin, (least, *(x for x in battery.ocv_curve.x if least < x < soc), soc), over)
    total = 0.0
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        now = mean_current(end + (soc - end) * node, now) or now
        total += weight / now
    energy = power * charge * (soc - end) * total
    if end <= least:  # the vehicle stops before the voltage does: the cut-off does not count
        return Drawable(energy, slope, end, end_sd=weakest.sd)
    return Drawable(energy, slope, end, *at_end(end, 0.0), weakest.sd)


def _root(margin: Callable[[float], float], knots: Sequence[float], over: float) -> float:
    """SOC at which `margin` [V], rising and nearly straight between the `knots`, is 0; the first knot if none is.

    over: the margin at the last knot, not negative.
    """
    low, high = 0, len(knots) - 1
    under = margin(knots[0])
    if under >= 0:
        return knots[0]
    while high - low > 1:
        middle = (low + high) // 2
        if (found := margin(knots[middle])) < 0:
            low, under = middle, found
        else:
            high, over = middle, found
    return knots[high] - (knots[high] - knots[low]) * over / (over - under)


def soc_left(left: Drawable, soc: float, share: float) -> float:
    """SOC at which the `share` (0 to 1) of the energy that a pack at `soc` still delivers is left.

    The energy over SOC is taken as a parabola: it falls a little faster near empty, where the voltage is lower.
    """
    width = soc - left.end
    if left.energy <= 0 or share <= 0:
        return left.end
    square = min(left.slope * width / left.energy, 2.0) - 1
    line = 1 - square
    return left.end + width * 2 * share / (line + sqrt(line * line + 4 * square * share))


def pack_constants(p: Mapping[str, float]) -> tuple[float, float]:
    """(conductance [W/K], time constant [s]) of a pack in the ambient air (eq. 2.30)."""
    conductance = p["pack_conductance"] * p["cooling_factor"]
    return conductance, p["pack_heat_capacity"] / conductance


def cells_ahead(
    battery: Battery,
    cooling: tuple[float, float],
    cells: tuple[float, float],
    ambient: float,
    load: tuple[float, float],
    overpotential: Overpotential | None = None,
) -> float:
    """Mean temperature [degC] of the cells until they are empty, from (SOC, temperature [degC]) now.

    Their loss at the mean power and the reversible heat of their reaction warm one mass that the air cools (eq. 2.30),
    in closed form. Warm cells lose less: the mean is where the line through the solutions for two assumed temperatures
    gives the temperature that it assumes.

    cooling: see `pack_constants`; load: mean power [W] and the square of its form factor; ambient in degC;
    overpotential: see `Battery.settled_current`.
    """
    (soc, temperature), (power, form_factor_squared), (conductance, time_constant) = cells, load, cooling
    if power <= 0 or soc <= 0:
        return temperature
    nodes = zip(_REACTION_NODES, _REACTION_WEIGHTS, strict=True)
    reaction: float = sum(weight * battery.reversible_heat(1.0, at * soc, temperature) for at, weight in nodes)  # W/A

    def mean_if(assumed: float) -> float:
        source = battery.cells_series * battery.ocv(soc / 2, assumed)[0]
        current = battery.settled_current(power, soc / 2, assumed, form_factor_squared, overpotential)
        if current is None:  # bursts are capped at the most that the pack gives, of which half stays in it as heat
            current = 2 * power / source
        settled = ambient + ((source + reaction) * current - power) / conductance
        lasting = max(soc * battery.pack_capacity(assumed) * HOUR / current / time_constant, 1e-6)
        return settled + (temperature - settled) * (1 - exp(-lasting)) / lasting

    # Whole degrees, so that rows of tables at them are kept.
    first = round(temperature)
    found = mean_if(first)
    second = round(found) if abs(found - first) > 1 else first + 1
    slope = (mean_if(second) - found) / (second - first)
    mean = found + slope * (found - first) / max(1 - slope, 0.5)
    return round(min(mean, max(temperature, HOT_CELLS_C)), DIGITS)
