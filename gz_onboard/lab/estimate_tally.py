"""Sums over the estimates of one ride."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from math import sqrt

from gz_onboard.can.publisher import KNOWN
from gz_onboard.events import Estimate, Reason, RouteState, State
from gz_onboard.log_rows import reason_names

PAUSE = 30.0  # s without frames: beyond it the recording was stopped
HELD = 1.0  # s: a current holds for no longer


@dataclass
class Gauge:
    """The vehicle's own state of charge, as of its cells, first and last, and what was drawn between."""

    first: float | None = None
    last: float | None = None
    charge: float = 0.0  # A·s, less what came back
    uncounted: float = 0.0  # s without a current that a sensor showed
    _before: float | None = None  # s

    def take(self, e: Estimate, shown: float | None) -> None:
        """Go on to an estimate, and what the vehicle shows then."""
        before, self._before = self._before, e.time
        if shown is None:
            return
        if self.first is None or before is None:
            self.first = self.last = shown
            return
        self.last = shown
        dt = e.time - before
        if e.pack_current is None or e.current_modelled or not 0 <= dt <= HELD:
            self.uncounted += dt
        else:
            self.charge += e.pack_current * dt


@dataclass
class Tally:
    """Sums over a ride's estimates; pass it to the pipeline as its observer."""

    start_ns: int  # of the first frame
    first: Estimate | None = None
    last: Estimate | None = None
    soc_start: tuple[float, float] | None = None
    soc_end: tuple[float, float] | None = None
    range_start: float | None = None  # m
    ranged: Estimate | None = None  # the last whose range is published
    on_route: Estimate | None = None  # the last
    way_on_route: float = 0.0  # m
    paused: float = 0.0  # s, between estimates further apart than a pause
    speed_max: float | None = None  # m/s
    innovation_max: float = 0.0  # V
    ticks: Counter[tuple[State, int]] = field(default_factory=Counter)
    distrusted: Counter[str] = field(default_factory=Counter)  # ticks by role
    gauge: Gauge = field(default_factory=Gauge)
    _squares: float = 0.0
    _innovations: int = 0

    def __call__(self, e: Estimate) -> None:
        """Take in the next estimate."""
        if self.first is None:
            self.first = e
        if self.last is not None and e.time - self.last.time > PAUSE:
            self.paused += e.time - self.last.time
        if e.route_state == RouteState.ON:
            self.on_route = e
            self.way_on_route += e.distance - (self.last.distance if self.last else 0.0)
        self.last = e
        self.ticks[e.state, int(e.reasons)] += 1
        self.distrusted.update(e.distrusted)
        if e.innovation is not None:
            self._squares += e.innovation * e.innovation
            self._innovations += 1
            self.innovation_max = max(self.innovation_max, abs(e.innovation))
        if e.speed is not None and (self.speed_max is None or e.speed > self.speed_max):
            self.speed_max = e.speed
        if e.soc is not None and e.soc_sd is not None:
            self.soc_end = e.soc, e.soc_sd
            if self.soc_start is None:
                self.soc_start = self.soc_end
        if e.range is not None and e.state in KNOWN:
            self.ranged = e
            self.range_start = e.range if self.range_start is None else self.range_start

    @property
    def innovation_rms(self) -> float | None:
        """[V] of a cell, or None if there was no innovation."""
        return sqrt(self._squares / self._innovations) if self._innovations else None

    def by_name(self) -> tuple[Counter[str], Counter[str]]:
        """(ticks in each state, ticks with each reason)."""
        states: Counter[str] = Counter()
        reasons: Counter[str] = Counter()
        for (state, bits), ticks in self.ticks.items():
            states[state.name] += ticks
            for name in reason_names(Reason(bits)):
                reasons[name] += ticks
        return states, reasons
