"""How warm the cells will be on the way that is left."""

from __future__ import annotations

from math import exp

from gz_onboard.constants import HOUR
from gz_onboard.physics.battery import Battery, Overpotential

ON_THE_WAY = 0.1127, 0.5, 0.8873  # of the charge that is left: Gauss-Legendre nodes of order 3
WEIGHTS = 0.2778, 0.4444, 0.2778
HOT_CELLS = 50.0  # degC; warmer they are not expected to become


def cells_ahead(
    battery: Battery,
    cooling: tuple[float, float],
    cells: tuple[float, float],
    ambient: float,
    load: tuple[float, float],
    overpotential: Overpotential | None = None,
) -> float:
    """The mean temperature [degC] of the cells until they are empty, from (SOC, temperature [degC]) now.

    cooling: see `cooling.pack_constants`; load: mean power [W] and the square of its form factor; ambient in degC;
    overpotential: see `Battery.settled_current`. Their loss at the mean power, and what their reaction gives without
    loss, warm one mass that the air cools (eq. 2.30), in closed form.
    """
    (soc, temperature), (power, form_factor_squared), (conductance, time_constant) = cells, load, cooling
    if power <= 0 or soc <= 0:
        return temperature

    def warmed(mean: float) -> float:
        source = battery.cells_series * battery.ocv(soc / 2, mean)[0]
        current = battery.settled_current(power, soc / 2, mean, form_factor_squared, overpotential)
        if current is None:  # bursts are held back at the most that the pack gives, of which half stays in it as heat
            current = 2 * power / source
        heat = source * current - power
        for at, weight in zip(ON_THE_WAY, WEIGHTS, strict=True):
            heat += weight * battery.reversible_heat(current, at * soc, mean)
        settled = ambient + heat / conductance
        lasting = max(soc * battery.pack_capacity(mean) * HOUR / current / time_constant, 1e-6)
        return settled + (temperature - settled) * (1 - exp(-lasting)) / lasting

    # Warm cells lose less: two rounds about that, and what they draw near to (Aitken 1926).
    first = warmed(temperature)
    change, bend = first - temperature, warmed(first) - 2 * first + temperature
    mean = temperature - change * change / bend if abs(bend) > abs(change) / 2 else first
    return min(mean, max(temperature, HOT_CELLS))
