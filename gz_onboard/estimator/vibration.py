"""How rough the road is, from samples as a bus brings them: some late, some lost, some stuck."""

from __future__ import annotations

from gz_onboard.physics.sensors import VIBRATION_MEMORY_S, VIBRATION_PERIOD_S, Vibration

SETTLED = 3 * VIBRATION_MEMORY_S  # s of samples before there is a value: 97 % of it is there
LONGEST_INTERVAL = 0.034  # s between samples in the mean: those further apart do not show what a road does to a wheel
STUCK = 1.0  # s of one and the same value: no accelerometer, not even at rest, gives that


class VibrationMonitor:
    """`Vibration` of samples of accel_z. None while it would be a wrong number: see `value`."""

    __slots__ = ("_before", "_count", "_same", "_since", "_time", "_vibration")

    def __init__(self) -> None:
        self._restart(float("-inf"), float("nan"))

    def _restart(self, time: float, accel_z: float) -> None:
        self._vibration = Vibration()
        self._vibration.update(0.0, accel_z)
        self._since = self._time = self._same = time  # s: the first sample, the last, the first of the last's value
        self._before = accel_z
        self._count = 0  # samples after the first

    def update(self, time: float, accel_z: float) -> None:
        """A sample [m/s²] at `time` [s]. After a gap, time that goes back or a stuck sensor all begins anew."""
        dt = time - self._time
        if dt == 0:
            return
        if not 0 < dt <= VIBRATION_PERIOD_S or time - self._same > STUCK:
            same = self._same if accel_z == self._before else time
            self._restart(time, accel_z)
            self._same = same if dt > 0 else time
            return
        if accel_z != self._before:
            self._before, self._same = accel_z, time
        self._time = time
        self._count += 1
        self._vibration.update(dt, accel_z)

    def value(self, now: float) -> float | None:
        """[m/s²] at `now` [s]; None while samples are missing, too few, or only just come again."""
        elapsed = self._time - self._since
        if now - self._time > VIBRATION_PERIOD_S or elapsed < SETTLED or self._count * LONGEST_INTERVAL < elapsed:
            return None
        return self._vibration.value
