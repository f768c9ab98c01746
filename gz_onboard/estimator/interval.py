"""P10 and P90 of how far some energy goes, where the energy and the price of a metre err."""

from __future__ import annotations

from math import exp, hypot, log, sqrt

DECILE = 1.2815515655446004  # sd of a normal distribution: 10 % are beyond


def deciles(energy: float, down: float, up: float, variance: float) -> tuple[float, float]:
    """The energies [J] that would go as far as P10 and P90, at the consumption that is expected.

    energy: the median [J]; its sd downwards and upwards [J]; variance: of the logarithm of the consumption. The energy
    is normal, the consumption log-normal; deciles that each would give alone are added as sds are. So it is right for
    each alone, at any size, and nothing jumps where the energy becomes less than its own error.
    """
    if energy <= 0:
        return 0.0, DECILE * up
    spread, least = DECILE * sqrt(variance), 1 - DECILE * down / energy
    p10 = energy * exp(-hypot(spread, log(least))) if least > 0 else 0.0
    return p10, energy * exp(hypot(spread, log(1 + DECILE * up / energy)))
