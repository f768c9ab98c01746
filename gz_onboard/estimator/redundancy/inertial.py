"""Axes of the inertial unit against gravity and against what a vehicle can do for half a minute."""

from __future__ import annotations

from gz_onboard.estimator.redundancy.checks import MOVING, STUCK_AFTER, StepInputs, counters, share_of_new

# Means over `AXIS_TIME` [s] that a vehicle can have, leaning, on a side stand or on a hill; m/s² and rad/s.
AXES = {
    "accel_y": (-5.0, 5.0),
    "accel_z": (6.5, 13.0),
    "rate_x": (-0.15, 0.15),
    "rate_y": (-0.15, 0.15),
    "rate_z": (-0.8, 0.8),
}
AXIS_TIME = 30.0
JUDGED_AFTER = AXIS_TIME / 3  # s: a mean over less may be that of one bend


class InertialCheck:
    """See `SensorCheck`."""

    def __init__(self) -> None:
        self.counters = counters(tuple(AXES))
        self._mean = dict.fromkeys(AXES, 0.0)  # low-passed
        self._last = dict.fromkeys(AXES, 0.0)
        self._still = dict.fromkeys(AXES, 0.0)  # s without a change
        self._time = 0.0  # s

    def step(self, step: StepInputs) -> None:
        """See `SensorCheck`."""
        dt, moving = step.observed, step.speed is not None and abs(step.speed) > MOVING
        self._time += dt
        share = share_of_new(dt, min(self._time, AXIS_TIME))
        for role, (low, high) in AXES.items():
            signal = step.signals[role]
            value = signal.reported(step.now)
            if value is None:
                continue
            self._mean[role] += (value - self._mean[role]) * share
            self._still[role] = self._still[role] + dt if value == self._last[role] != 0.0 else 0.0
            self._last[role] = value
            wrong = self._time > JUDGED_AFTER and not low < self._mean[role] < high
            wrong |= moving and self._still[role] > STUCK_AFTER
            counter = self.counters[role]
            counter.update(dt, True if wrong else False if moving else None)
            signal.trusted = not counter.faulty
