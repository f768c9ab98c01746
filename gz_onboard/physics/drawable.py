"""What a pack still delivers until its cells reach the cut-off voltage: the weakest group of them, if one is known."""

from __future__ import annotations

from dataclasses import dataclass

from gz_onboard.constants import HOUR
from gz_onboard.physics.battery import Battery, Overpotential

BELOW_EMPTY = -0.05  # SOC down to which the cut-off is sought
HALVINGS = 9  # of the SOC left, to 0.002 of it; between the two ends of that the voltage is taken as straight
LEAST_WIDTH = 1e-3  # SOC: an end found nearer to the last one allowed is that


@dataclass(frozen=True)
class Drawable:
    """What a pack still delivers until its cells reach the cut-off voltage."""

    energy: float  # J, at the pack's terminals
    slope: float  # J: how much more energy there would be for more SOC
    by_cutoff: float = 0.0  # J/V: how much less there would be for a higher cut-off voltage of a cell
    end_drop: float = 0.0  # V of a cell: what the mean load takes from its rest voltage at the end
    end_sd: float = 0.0  # of SOC: how closely it is known where the weakest group ends


# Gauss-Legendre nodes and weights on [0, 1], of order 8
_NODES = (0.019855072, 0.101666761, 0.237233795, 0.408282679, 0.591717321, 0.762766205, 0.898333239, 0.980144928)
_WEIGHTS = (0.050614268, 0.111190517, 0.156853323, 0.181341892, 0.181341892, 0.156853323, 0.111190517, 0.050614268)


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
    SOC at which the terminal voltage at the mean load meets the cut-off: bursts are held back by the vehicle before.
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

    def above(soc: float, current: float) -> float:
        """By how much the lowest cell's voltage is above the cut-off [V]."""
        mean = (power / current - cutoff) / battery.cells_series
        if mean < 0 or not weakest:
            return mean
        lowest = battery.settled_lowest(current, soc, temperature, overpotential)
        return min(mean, lowest - battery.cutoff_voltage)

    current = battery.settled_current(power, soc, temperature, overpotential=overpotential)
    if current is None or soc <= least or (over := above(soc, current)) < 0:
        return Drawable(0.0, charge * cutoff, end_sd=end_sd)
    slope = charge * power / current
    under = None
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        current = battery.settled_current(power, middle, temperature, overpotential=overpotential)
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
        current = battery.settled_current(power, high + width * node, temperature, form_factor_squared, overpotential)
        total += weight / current if current else 0.0
    energy = power * charge * width * total
    if high - least <= LEAST_WIDTH:  # where the vehicle ends before the voltage does, the cut-off does not count
        return Drawable(energy, slope, end_sd=end_sd)
    rest, rise = battery.ocv(weakest.soc(high) if weakest else high, temperature)
    return Drawable(energy, slope, charge * cutoff / rise, max(rest - battery.cutoff_voltage, 0.0), end_sd)


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
