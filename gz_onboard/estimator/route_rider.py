"""What is learned of the rider on routes: the cost of the way against the model, his speed against that allowed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

SEGMENT_SD = 0.25  # relative: measured less modelled energy of a segment, of recorded full discharges and the plant's
COST_WALK = 0.003  # sd of its change over a segment (wind, traffic); 0.0015 to 0.006 err as much on full discharges
STOPS, STOPS_SD = 1.0, 0.1  # cost over consumption factor of eight commissioning and ten plant rides, and its sd
COST = 0.2, 5.0  # beyond, the route is not what is ridden
PACE_SD, PACE_WALK, SECOND_SD = 0.05, 0.0005, 0.2  # of the pace, of its change over a second, of the speed in one
PACE = 0.5, 1.5


@dataclass(slots=True)
class RouteRider:
    """`cost`: energy measured over modelled on level roads; None until it is learned. `pace`: speed over that allowed.

    Each with its variance.
    """

    cost: float | None = None
    cost_variance: float = 0.0
    pace: float = 1.0
    pace_variance: float = PACE_SD**2

    def expected_cost(self, factor: float, factor_variance: float) -> tuple[float, float]:
        """(cost, its variance); before it is learned by the consumption factor and its variance."""
        if self.cost is None:
            cost = STOPS * factor
            return cost, STOPS**2 * factor_variance + (STOPS_SD * cost) ** 2
        return self.cost, self.cost_variance

    def learn_cost(self, measured: float, modelled: float, known: tuple[float, float]) -> None:
        """Learn from a segment: a Kalman filter.

        measured, modelled: its energies over what so much of the route has in the mean; known: `expected_cost`.
        """
        cost, variance = known[0], known[1] + COST_WALK**2
        gain = variance * modelled / (modelled**2 * variance + SEGMENT_SD**2)
        self.cost = min(max(cost + gain * (measured - cost * modelled), COST[0]), COST[1])
        self.cost_variance = variance * (1 - gain * modelled)

    def learn_pace(self, ratio: float) -> None:
        """Learn from a second of steady riding at so much of the speed allowed."""
        variance = self.pace_variance + PACE_WALK**2
        gain = variance / (variance + SECOND_SD**2)
        self.pace = min(max(self.pace + gain * (ratio - self.pace), PACE[0]), PACE[1])
        self.pace_variance = variance * (1 - gain)

    def snapshot(self) -> list[float | None]:
        """What is to be kept over a restart."""
        return [self.cost, self.cost_variance, self.pace, self.pace_variance]


def restored(saved: Any) -> RouteRider:
    """What `RouteRider.snapshot` gave; anew for what is not that, as an old state has none."""
    try:
        cost, cost_variance, pace, pace_variance = (None if x is None else float(x) for x in saved)
    except (TypeError, ValueError, OverflowError):
        return RouteRider()
    if cost_variance is None or pace is None or pace_variance is None:
        return RouteRider()
    good = 0 <= cost_variance < 1 and PACE[0] <= pace <= PACE[1] and 0 < pace_variance < 1
    if not good or not (cost is None or COST[0] <= cost <= COST[1]):
        return RouteRider()
    return RouteRider(cost, cost_variance, pace, pace_variance)
