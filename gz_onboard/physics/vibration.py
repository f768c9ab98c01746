"""How rough the road is, as the vertical accelerometer shows it: one definition, on board and in the lab."""

from __future__ import annotations

from math import exp

FAST = 0.1  # s: what is slower is the vehicle's motion
SLOW = 2.0  # s: over which the mean of the square goes


class Vibration:
    """The RMS [m/s²] of the vertical acceleration's part that is faster than `FAST`, over about `SLOW`.

    Of samples at 30 Hz or more; two first-order filters, each exact for any time between samples.
    """

    __slots__ = ("_mean", "_square", "_step", "_weights")

    def __init__(self) -> None:
        self._mean: float | None = None
        self._square = 0.0
        self._step = 0.0
        self._weights = (0.0, 0.0)

    def update(self, dt: float, accel_z: float) -> None:
        """A sample [m/s²], `dt` [s] after the last."""
        if self._mean is None:
            self._mean = accel_z
            return
        if abs(dt - self._step) > 1e-4:  # samples come evenly: the weights hold for most of them
            self._step, self._weights = dt, (1 - exp(-dt / FAST), 1 - exp(-dt / SLOW))
        fast, slow = self._weights
        self._mean += fast * (accel_z - self._mean)
        self._square += slow * ((accel_z - self._mean) ** 2 - self._square)

    @property
    def value(self) -> float:
        """[m/s²]"""
        return float(self._square**0.5)
