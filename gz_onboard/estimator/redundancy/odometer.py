"""The odometer against a speed that is all there is: their distances between two counts of the odometer.

An odometer is often made from one of the speeds, and counts in steps of up to a kilometre: it is a witness only where
there is no other. One that does not count, is reset, stalls or is of another unit says nothing.
"""

from __future__ import annotations

from gz_onboard.estimator.redundancy.checks import FAULTY_AFTER, StepInputs, counters
from gz_onboard.estimator.redundancy.speeds import SpeedCheck

LENGTH, COUNTS = 1000.0, 3  # m and 1: the two are compared over at least so much
APART = 0.15  # relative; tyres, scales and the times of the counts err by less
UNIT = 5.0  # a greater ratio is a unit's; or, by a count that takes so many times as long, the odometer stalls
ZERO = 0.02  # of the odometer's distance: a speed that shows less shows nothing
STUCK_AFTER = 20.0  # s of one and the same speed, to the last bit
LATE = 100.0  # m: how late a count can come
LARGEST = 2000.0  # m, of a count; beyond, the odometer was set
FASTEST = 70.0  # m/s, beyond it was set too
SILENT = 10.0  # s without a message: when it counted is not known


class OdometerCheck:
    """See `SensorCheck`: the counter of a speed is that of `SpeedCheck`."""

    def __init__(self, speeds: SpeedCheck) -> None:
        self.counters = counters(("odometer",))
        self.compared = 0.0  # m by the speed, over which the two last contradicted each other
        self._speeds = speeds
        self._heard = float("-inf")  # s, its last message
        self._forget(None)

    def _forget(self, value: float | None) -> None:
        self._last = value  # m
        self._counting = False  # it has counted: since when the distances are known
        self._counted = self._ridden = self._since = 0.0  # m by odometer, by speed, and by speed since the last count
        self._largest = 0.0  # m, of the counts
        self._seconds = self._moving = 0.0  # s since the last count, and since the first

    def step(self, step: StepInputs) -> None:
        """See `SensorCheck`."""
        signal, speeds = step.signals.odometer, self._speeds
        silent = step.now - signal.time > SILENT or signal.time - self._heard > SILENT
        self._heard = signal.time
        if silent or step.observed < step.dt or len(speeds.reporting) != 1 or speeds.middle is None:
            self._forget(None)
            return
        self._since += abs(speeds.middle) * step.observed
        self._seconds += step.observed
        if self._last is None:
            self._forget(signal.value)
        count = signal.value - (self._last or 0.0)
        stalled = self._largest and self._since > UNIT * self._largest + LATE
        if count < 0 or count > min(LARGEST, FASTEST * self._seconds + LATE) or stalled:
            self._forget(signal.value)
        elif count:
            self._count(count, signal.value, step)

    def _count(self, count: float, value: float, step: StepInputs) -> None:
        if self._counting:
            self._counted += count
            self._ridden += self._since
            self._largest = max(self._largest, count)
            self._moving += self._seconds
        self._counting, self._last, self._since, self._seconds = True, value, 0.0, 0.0
        if self._counted < max(LENGTH, COUNTS * self._largest):
            return
        (role,), ridden, counted = self._speeds.reporting, self._ridden, self._counted
        stuck = ridden < ZERO * counted or self._speeds.still[role] > STUCK_AFTER
        apart = abs(ridden - counted) > max(APART * max(ridden, counted), self._largest)
        if stuck or max(ridden, counted) < UNIT * min(ridden, counted):  # else of another unit
            self._judge(role, apart, stuck, step)
        self._forget(value)
        self._counting = True

    def _judge(self, role: str, apart: bool, stuck: bool, step: StepInputs) -> None:
        """Of two that differ by a factor neither is known to be right; a stuck one is wrong."""
        time = FAULTY_AFTER if apart else self._moving
        self.compared = self._ridden if apart else self.compared
        self._speeds.judge(role, time, apart, step.signals)
        if not (stuck and apart):
            self.counters["odometer"].update(time, apart)
