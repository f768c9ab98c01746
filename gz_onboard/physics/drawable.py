"""What a pack still delivers until its cells reach the cut-off voltage: the weakest group of them, if one is known."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

from gz_onboard.constants import HOUR
from gz_onboard.physics.battery import Battery, Overpotential

BELOW_EMPTY = -0.05  # SOC down to which the cut-off is sought
HALVINGS = 9  # of the SOC left, to 0.002 of it; between the two ends of that the voltage is taken as straight
BESIDE = 0.01  # SOC to both sides of the end over which the rest voltage rises
LEAST_WIDTH = 1e-3  # SOC: an end found nearer to the last one allowed is that
GIVES_UP, GIVES_UP_SD = 0.5, 0.3  # of the load's sd over time: how far above its mean a vehicle gives up


@dataclass(frozen=True)
class Drawable:
    """What a pack still delivers until its cells reach the cut-off voltage."""

    energy: float  # J, at the pack's terminals
    slope: float  # J: how much more energy there would be for more SOC
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

    now, current = drawn(soc, 1.0), drawn(soc, end_load)
    if now is None or current is None or soc <= least or (over := above(soc, current)) < 0:
        return Drawable(0.0, charge * cutoff, end_sd=end_sd)
    slope = charge * power / now
    under = None
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
        at = high + width * node
        # Where bursts ask for more than the pack can give they are held back.
        current = battery.settled_current(power, at, temperature, form_factor_squared, overpotential) or drawn(at, 1.0)
        total += weight / current if current else 0.0
    energy = power * charge * width * total
    if high - least <= LEAST_WIDTH:  # where the vehicle ends before the voltage does, the cut-off does not count
        return Drawable(energy, slope, end_sd=end_sd)
    end = weakest.soc(high) if weakest else high
    below, rest, beyond = (battery.ocv(end + off, temperature)[0] for off in (-BESIDE, 0.0, BESIDE))
    rise = (beyond - below) / (2 * BESIDE)  # not that of one piece of the table, which ends at a knot
    drop_sd = max(rest - battery.cutoff_voltage, 0.0) / end_load * GIVES_UP_SD * load_sd
    return Drawable(energy, slope, charge * cutoff / rise, drop_sd, end_sd)


NEWTON_STEPS = 3  # to 1e-4 of SOC: the energy is nearly linear in it


def soc_left(battery: Battery, soc: float, temperature: float, share: float, power: float = 1.0) -> float:
    """The SOC at which `share` (0 to 1) is left of the energy that a pack at `soc` still delivers.

    temperature in degC, power in W.
    """
    left = share * drawable(battery, soc, temperature, power).energy
    for _ in range(NEWTON_STEPS):
        now = drawable(battery, soc, temperature, power)
        soc -= (now.energy - left) / now.slope
    return soc
