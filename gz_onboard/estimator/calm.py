"""The range that is shown: it moves as the vehicle does, and draws near to the newest forecast over some distance.

The errors of successive forecasts are nearly the same error: within `CALM` the riding to come is not known any better.
So what is ridden is taken off what was shown, and of the gap that is left to the forecast a share is closed with each
metre: the Kalman filter of a constant (ridden plus remaining) seen through an error that fades over `CALM`. It closes
faster
- at first, while the forecast itself follows each kilometre: over half as much riding as the forecast is known from;
- near empty, where the forecast's error goes as its range does: over a third of that.

Once a ride has gone on for `SETTLED` and the forecast is known from as much, another one is shown no faster than
`GAINED` and `LOST`: the range does not rise under who rides, nor falls twice as fast as he rides. Of more than
`LARGE` it closes as near empty, over a third of the range: who is to turn round must know in time.

At standstill nothing is ridden that the gap could close over: what is drawn is taken off, and what else changes the
forecast, as a rest does that shows the state of charge, waits for the riding to come; at most `STEP` of it. The rest of
it shows at once. What the rider changes, as a route, and a state of charge that is begun anew end the gap
(`show_next`). While the pack is charged the gap stays as it is, in metres: fifty metres are a third of the range near
empty, and nothing of a full one. A restart is a standstill, at which the energy that is gone was drawn, and the gap
shrank with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import exp
from typing import Any

CALM = 6000.0  # m
NEAR_EMPTY = 3.0  # the gap closes over the range over this
AT_FIRST = 2.0  # the gap closes over what the forecast is known from over this
FIRST = 250.0  # m, over which it closes at first
SETTLED = 1500.0  # m
GAINED, LOST = 0.8, 0.9  # at most, of what is ridden
FASTEST = 1.25e-5  # of the range for each m ridden, where that is more
LARGE = 0.45  # of the forecast
STILL = 0.1  # m from one forecast to the next: so much a speed sensor's noise moves
STEP = 0.05  # of the range, or over a restart of the energy that is left
RATIO = 0.5, 2.0  # shown over forecast: beyond, the gap is not kept


class Calm:
    """Follows the forecast's range."""

    def __init__(self, gap: float = 0.0, before: tuple[float, float] | None = None) -> None:
        """`gap` and `before`: see `snapshot`."""
        self.gap = gap  # m: shown less forecast
        self._settled = self._on_route = False
        self._way = 0.0  # m of this ride
        self._before = before  # the last forecast's range [m] and energy [J]
        self._restarted = before is not None
        self._ridden = 0.0  # m since
        self._waiting = 0.0  # m, the part of the gap that waits for riding

    def ride(self, distance: float) -> None:
        """`distance` [m] was ridden."""
        self._ridden += distance

    def begin_ride(self) -> None:
        """Another ride: what was held back on the last one shows in the first kilometres of this."""
        self._settled, self._way = False, 0.0

    def show_next(self, *, on_route: bool = False) -> None:
        """The next forecast shows as it is: it stands on something else, as a route, and the gap was to another."""
        self._before, self.gap, self._waiting, self._on_route = None, 0.0, 0.0, on_route

    def shown(self, raw: float) -> float:
        """The range to show [m] with the present gap, for a forecast of `raw` [m]."""
        return min(max(raw + self.gap, RATIO[0] * raw), RATIO[1] * raw)

    def follow(self, raw: float, energy: float, known: float, drawn: float | None = None) -> float:
        """The range to show [m] for a forecast of `raw` [m] with `energy` [J], from so much riding `known` [m].

        drawn: what was taken from the pack since the last one [J]; None: not known, or it is charged.
        """
        before, ridden, restarted = self._before, self._ridden, self._restarted
        self._before, self._ridden, self._restarted = (raw, energy), 0.0, False
        if before is None or min(raw, energy, *before) <= 0:
            return self.shown(raw)
        if restarted:
            self.gap *= min(energy / before[1], 1.0)  # it was of a longer way
            if abs(energy - before[1]) > STEP * before[1]:
                return self.shown(raw)
            drawn = before[1] - energy  # or charged, a little
        if ridden < STILL:
            if drawn is not None and drawn < before[1]:
                held = self.shown(before[0]) * (1 - drawn / before[1])
                self._wait(held - self.shown(raw), STEP * raw)
            return self.shown(raw)
        length = max(min(known / AT_FIRST, CALM, raw / NEAR_EMPTY), FIRST)
        fading = exp(-ridden / length)
        gap = self.shown(before[0]) - ridden - raw
        closed = gap * (1 - fading)
        self._way += ridden
        self._settled |= min(known, self._way) >= SETTLED
        if self._settled:
            gained, lost = (ridden * max(most, FASTEST * raw) for most in (GAINED, LOST))
            if gap <= LARGE * raw:
                closed = min(max(closed, -gained), lost)
        self.gap = gap - closed
        self._waiting *= fading
        return self.shown(raw)

    def _wait(self, change: float, most: float) -> None:
        """The forecast has become less by `change` [m] at standstill, and nothing drawn explains it; `most` waits."""
        before = self._waiting
        self._waiting = min(max(before + change, -most), most)
        self.gap += self._waiting - before

    def snapshot(self) -> dict[str, object]:
        """What is to be kept over a restart: the gap [m], and the last forecast's range [m] and energy [J]."""
        if self._on_route:  # which is not kept
            return {"gap": 0.0, "forecast": None}
        return {"gap": self.gap, "forecast": self._before and list(self._before)}


def restored_calm(saved: Mapping[str, Any]) -> Calm:
    """Read what `Calm.snapshot` gave."""
    return Calm(saved["gap"], tuple(saved["forecast"]) if saved["forecast"] else None)
