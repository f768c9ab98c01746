"""Mean temperature of the cells on the way that is left."""

from __future__ import annotations

from math import exp

from gz_onboard.constants import HOUR
from gz_onboard.physics.battery import Battery, Overpotential

# Gauss-Legendre nodes of order 3 over the charge that is left, for the heat of the reaction
_NODES = 0.1127, 0.5, 0.8873
_WEIGHTS = 0.2778, 0.4444, 0.2778
HOT_CELLS_C = 50.0  # degC: vehicles limit the power of hotter cells
DIGITS = 1  # of the result [degC]: rows of tables at it are kept for seconds; 0.1 K is 0.05 % of the energy


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

    cooling: see `cooling.pack_constants`; load: mean power [W] and the square of its form factor; ambient in degC;
    overpotential: see `Battery.settled_current`.
    """
    (soc, temperature), (power, form_factor_squared), (conductance, time_constant) = cells, load, cooling
    if power <= 0 or soc <= 0:
        return temperature
    nodes = zip(_NODES, _WEIGHTS, strict=True)
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
