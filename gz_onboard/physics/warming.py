"""How warm the cells will be on the way that is left."""

from __future__ import annotations

from math import exp

from gz_onboard.constants import HOUR
from gz_onboard.physics.battery import Battery, Overpotential
from gz_onboard.physics.cooling import LumpedCooling

HOT_CELLS = 50.0  # degC; warmer they are not expected to become


def cells_ahead(
    battery: Battery,
    cooling: LumpedCooling,
    cells: tuple[float, float],
    ambient: float,
    load: tuple[float, float],
    overpotential: Overpotential | None = None,
) -> float:
    """The mean temperature [degC] of the cells until they are empty, from (SOC, temperature [degC]) now.

    load: mean power [W] and the square of its form factor; ambient in degC; overpotential: see
    `Battery.settled_current`. Their loss at the mean power warms one mass that the air cools (eq. 2.30), in closed
    form.
    """
    (soc, temperature), (power, form_factor_squared) = cells, load
    if power <= 0 or soc <= 0:
        return temperature
    time_constant = cooling.capacity / cooling.conductance

    def warmed(mean: float) -> float:
        source = battery.cells_series * battery.ocv(soc / 2, mean)[0]
        current = battery.settled_current(power, soc / 2, mean, form_factor_squared, overpotential)
        if current is None:  # bursts are held back at the most that the pack gives, of which half stays in it as heat
            current = 2 * power / source
        loss = source * current - power
        settled = ambient + loss / cooling.conductance
        lasting = max(soc * battery.pack_capacity(mean) * HOUR / current / time_constant, 1e-6)
        return settled + (temperature - settled) * (1 - exp(-lasting)) / lasting

    # Warm cells lose less: two rounds about that, and what they draw near to (Aitken 1926).
    first = warmed(temperature)
    change, bend = first - temperature, warmed(first) - 2 * first + temperature
    mean = temperature - change * change / bend if abs(bend) > abs(change) / 2 else first
    return min(mean, max(temperature, HOT_CELLS))
