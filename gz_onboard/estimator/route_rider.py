"""What is learned of the rider on routes: the cost of the way against the model."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import Any

SEGMENT_SD = 0.25  # relative: measured less modelled energy of a segment, of recorded full discharges and the plant's
COST_WALK = 0.003  # sd of its change over a segment (wind, traffic); 0.0015 to 0.006 err as much on full discharges
STOPS, STOPS_SD = 1.0, 0.1  # cost over consumption factor of eight commissioning and ten plant rides, and its sd
APART = 3.0  # sd between two costs that are not of the same rider on two roads
COST = 0.2, 5.0  # beyond, the route is not what is ridden


@dataclass(slots=True)
class RouteRider:
    """`cost`: energy measured over modelled on level roads; None until it is learned. With its `variance`."""

    cost: float | None = None
    variance: float = 0.0

    def expected_cost(self, factor: float, factor_variance: float) -> tuple[float, float]:
        """(cost, its variance); before it is learned by the consumption factor and its variance."""
        if self.cost is None:
            return _usual(factor, factor_variance)
        return self.cost, self.variance

    def learn_cost(self, measured: float, modelled: float, known: tuple[float, float]) -> None:
        """Learn from a segment: a Kalman filter.

        measured, modelled: its energies over what so much of the route has in the mean; known: `expected_cost`.
        """
        cost, variance = known[0], known[1] + COST_WALK**2
        gain = variance * modelled / (modelled**2 * variance + SEGMENT_SD**2)
        self.cost = min(max(cost + gain * (measured - cost * modelled), COST[0]), COST[1])
        self.variance = variance * (1 - gain * modelled)

    def begin_route(self, factor: float, factor_variance: float) -> None:
        """Another route: it has stops and traffic of its own."""
        if self.cost is not None:
            self.variance = max(self.variance, (STOPS_SD * self.cost) ** 2)
            self.check(factor, factor_variance)

    def check(self, factor: float, factor_variance: float) -> None:
        """Forget a cost that the consumption factor does not bear out: its route was not the road ridden."""
        usual, variance = _usual(factor, factor_variance)
        if self.cost is not None and abs(self.cost - usual) > APART * sqrt(self.variance + variance):
            self.cost, self.variance = None, 0.0

    def snapshot(self) -> list[float | None]:
        """What is to be kept over a restart."""
        return [self.cost, self.variance]


def _usual(factor: float, factor_variance: float) -> tuple[float, float]:
    """(cost, its variance) of a rider of whom the consumption factor is known only."""
    cost = STOPS * factor
    return cost, STOPS**2 * factor_variance + (STOPS_SD * cost) ** 2


def restored(saved: Any) -> RouteRider:
    """What `RouteRider.snapshot` gave; anew for what is not that, as an old state has none."""
    try:
        cost, variance = (None if x is None else float(x) for x in saved)
    except (TypeError, ValueError, OverflowError, KeyError):
        return RouteRider()
    if cost is None or variance is None or not (0 < variance < 1 and COST[0] <= cost <= COST[1]):
        return RouteRider()
    return RouteRider(cost, variance)
