"""How rough the road is, from the spread of the vertical acceleration within a window."""

from __future__ import annotations

from math import exp, inf, sqrt

from gz_onboard.estimator.signals import Signal
from gz_onboard.events import WINDOW
from gz_onboard.physics.sensors import VIBRATION_MEMORY_S, VIBRATION_PERIOD_S

SETTLED = 3 * VIBRATION_MEMORY_S  # s of samples before there is a value: 97 % of it is there
STILL = 1e-6  # (m/s²)²: less is a stuck sensor's, and rounding
FEWEST = WINDOW / 0.034  # samples in a window: a slower sensor does not show what a road does to a wheel


class VibrationMonitor:
    """The vibration, as `physics.sensors.Vibration` defines it [m/s²], from windows of samples.

    Too few samples, or a sensor that shows one and the same value, begin it anew: no accelerometer is that still.
    """

    def __init__(self) -> None:
        self._since = self._time = -inf  # s: the first window and the last
        self._square = 0.0  # (m/s²)²

    def step(self, now: float, accel_z: Signal) -> None:
        """Take the samples of the window that ends at `now` [s]."""
        n, mean = accel_z.count, accel_z.mean(now)
        if n < FEWEST or mean is None or accel_z.mean_square is None:
            return
        square = (accel_z.mean_square - mean * mean) * n / (n - 1)
        dt = now - self._time
        if square < STILL or dt > 2 * WINDOW:
            self._since, self._square = now, max(square, 0.0)
        keep = exp(-WINDOW / n / VIBRATION_PERIOD_S)  # of white shaking, `Vibration` shows this share
        self._square += (1 - exp(-min(dt, WINDOW) / VIBRATION_MEMORY_S)) * (
            square * keep * keep * 2 / (1 + keep) - self._square
        )
        self._time = now

    def value(self, now: float) -> float | None:
        """[m/s²] at `now` [s]; None while samples are missing, too few, or only just come again."""
        if now - self._time > 2 * WINDOW or self._time - self._since < SETTLED:
            return None
        return sqrt(self._square)
