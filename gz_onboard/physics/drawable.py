"""What a pack still delivers until its cells reach the cut-off voltage: the weakest group of them, if one is known."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

from gz_onboard.constants import HOUR
from gz_onboard.physics.battery import Battery, Overpotential

BELOW_EMPTY = -0.05  # SOC down to which the cut-off is sought
HALVINGS = 9  # of the SOC left, to 0.002 of it; between the two ends of that the voltage is taken as straight
BESIDE = 0.01  # SOC above the end over which the voltage's rise is taken: not of one piece of the tables alone
LEAST_RISE = 0.1  # V over the whole charge: of no cell does it rise by less near its end
LEAST_WIDTH = 1e-3  # SOC: an end found nearer to the last one allowed is that
GIVES_UP, GIVES_UP_SD = 0.5, 0.3  # of the load's sd over time: how far above its mean a vehicle gives up


@dataclass(frozen=True)
class Drawable:
    """What a pack still delivers until its cells reach the cut-off voltage."""

    energy: float  # J, at the pack's terminals
    slope: float  # J: how much more energy there would be for more SOC
    end: float  # SOC of the mean cell there; that now if the pack is empty already
    by_cutoff: float = 0.0  # J/V: how much less there would be for a higher cut-off voltage of a cell
    end_drop_sd: float = 0.0  # V of a cell: how closely it is known what the load takes from its voltage at the end
    end_sd: float = 0.0  # of SOC: how closely it is known where the weakest group ends


# Gauss-Legendre nodes and weights on [0, 1], of order 5: to 0.1 % of the energy
_NODES = (0.046910077, 0.230765345, 0.500000000, 0.769234655, 0.953089923)
_WEIGHTS = (0.118463443, 0.239314335, 0.284444444, 0.239314335, 0.118463443)


def drawable(
    battery: Battery,
    soc: float,
    temperature: float,
    power: float,
    form_factor_squared: float = 1.0,
    overpotential: Overpotential | None = None,
) -> Drawable:
    """What a pack at `soc` and `temperature` [degC] delivers at a mean `power` [W] until the cut-off, or until the end
    of the charge that the vehicle uses.

    At constant power P the charge Q·dSOC passes in dt = Q·dSOC/I, so the energy is P·Q·∫ dSOC/I(SOC), from the
    SOC at which the terminal voltage meets the cut-off. Some vehicles hold bursts back and creep on at the mean load,
    others give up at the first burst: the end is at a load that is above its mean by `GIVES_UP` of its sd over time.
    form_factor_squared, overpotential: see `Battery.settled_current`. The RC pair is taken as settled (V1 = R1·I):
    discharging takes an hour, its time constant is a minute. A group that is weaker than the mean cell
    (`Health.weakest`) ends it before; until then the pack delivers what the mean cell does.
    """
    least = battery.window.low if battery.window.given else BELOW_EMPTY
    low, high = least, soc
    charge = battery.pack_capacity(temperature) * HOUR
    cutoff = battery.cutoff_voltage * battery.cells_series
    weakest = battery.health.weakest
    end_sd = weakest.sd if weakest else 0.0
    load_sd = sqrt(max(form_factor_squared - 1, 0.0))  # of its mean
    end_load = 1 + GIVES_UP * load_sd

    def above(soc: float, current: float) -> float:
        """By how much the lowest cell's voltage is above the cut-off [V]."""
        mean = (end_load * power / current - cutoff) / battery.cells_series
        if mean < 0 or not weakest:
            return mean
        lowest = battery.settled_lowest(current, soc, temperature, overpotential)
        return min(mean, lowest - battery.cutoff_voltage)

    def drawn(soc: float, load: float) -> float | None:
        return battery.settled_current(load * power, soc, temperature, overpotential=overpotential)

    def by_cutoff(end: float, margin: float = 0.0) -> tuple[float, float]:
        """(Less energy for a higher cut-off voltage [J/V], drop's sd [V]) where it ends, `margin` [V] above that."""
        current = drawn(end + BESIDE, end_load)
        rise = (above(end + BESIDE, current) - margin) / BESIDE if current else 0.0
        drop = battery.ocv(weakest.soc(end) if weakest else end, temperature)[0] - battery.cutoff_voltage
        return charge * cutoff / max(rise, LEAST_RISE), max(drop, 0.0) / end_load * GIVES_UP_SD * load_sd

    def ridden_on(soc: float) -> float | None:
        """The mean current [A]; where bursts ask for more than the pack can give they are held back."""
        current = battery.settled_current(power, soc, temperature, form_factor_squared, overpotential)
        return current or drawn(soc, 1.0)

    now, current = ridden_on(soc), drawn(soc, end_load)
    if now is None or current is None or soc <= least:
        return Drawable(0.0, charge * cutoff, soc, end_sd=end_sd)
    slope, over, under = charge * power / now, above(soc, current), None
    if over < 0:
        return Drawable(0.0, slope, soc, *by_cutoff(soc, over), end_sd)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        current = drawn(middle, end_load)
        margin = None if current is None else above(middle, current)
        if margin is None or margin < 0:
            low, under = middle, margin
        else:
            high, over = middle, margin
    if under is not None:
        high -= (high - low) * over / (over - under)
    width = soc - high
    total = 0.0
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        current = ridden_on(high + width * node)
        total += weight / current if current else 0.0
    energy = power * charge * width * total
    if high - least <= LEAST_WIDTH:  # where the vehicle ends before the voltage does, the cut-off does not count
        return Drawable(energy, slope, high, end_sd=end_sd)
    return Drawable(energy, slope, high, *by_cutoff(high), end_sd)


def soc_left(left: Drawable, soc: float, share: float) -> float:
    """The SOC at which `share` (0 to 1) is left of what a pack at `soc` still delivers.

    The energy over the SOC is taken as a parabola: it falls a little faster near empty, where the voltage is lower.
    """
    width = soc - left.end
    if left.energy <= 0 or share <= 0:
        return left.end
    square = min(left.slope * width / left.energy, 2.0) - 1
    line = 1 - square
    return left.end + width * 2 * share / (line + sqrt(line * line + 4 * square * share))
