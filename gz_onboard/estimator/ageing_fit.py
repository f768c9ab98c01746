"""The fit of a pack's resistance to the quick changes of its voltage: least squares with forgetting."""

from __future__ import annotations

from typing import NamedTuple

from gz_onboard.estimator.uncertainty import RESISTANCE_SD

RESISTANCE = 0.5, 4.0  # factors that a pack at work has
RESISTANCE_MEMORY = 3600.0  # s of load: the mean over a ride's charge and temperature is what lasts
PRIOR_WEIGHT = 0.02  # V²·s: what the guess counts beside the load
COMPARED = 300.0  # s of load from which the resistance of a ride is compared with that of the rides before
ANOTHER_PACK = 1.4  # factor between the two: one pack spans up to 1.38 from frost to 43 degC, three of the plant's did


class Fit(NamedTuple):
    """Of the resistance: its factor, what it is from [V²·s], and the time of load [s]."""

    factor: float = 1.0
    weight: float = PRIOR_WEIGHT
    time: float = 0.0

    def after(self, dt: float, quick: float, measured: float) -> Fit:
        """After `dt` [s] more, in which a cell's voltage changed by `measured` [V], `quick` at a factor of 1."""
        weight = self.weight + quick * quick * dt - self.weight * dt / RESISTANCE_MEMORY
        factor = self.factor + quick * (measured - self.factor * quick) * dt / weight
        factor = min(max(factor, RESISTANCE[0]), RESISTANCE[1])
        return Fit(factor, weight, min(self.time + dt, RESISTANCE_MEMORY))

    def of_another_pack(self, before: Fit) -> bool:
        """Whether this, of one ride, and `before`, of the rides before it, cannot be of one pack."""
        apart = max(self.factor / before.factor, before.factor / self.factor)
        return min(self.time, before.time) >= COMPARED and apart > ANOTHER_PACK


def believed(factor: float) -> float:
    """A resistance's factor: a change that is small beside the tables' own error is mostly that (a Wiener filter)."""
    change = factor - 1
    return 1 + change**3 / (change**2 + RESISTANCE_SD**2)
