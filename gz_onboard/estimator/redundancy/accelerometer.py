"""The forward accelerometer against the wheels: it trembles, and shows the speed that they gain."""

from __future__ import annotations

from gz_onboard.estimator.redundancy.checks import MOVING, STUCK_AFTER, share_of_new

GAIN = 0.6, 1.5  # of the accelerometer over the wheels' acceleration, over `GAIN_TIME` if there is enough of it
HARDEST = 10.0  # m/s²: no wheel grips more
GAIN_TIME, GAIN_MEAN, GAIN_LEAST = 60.0, 20.0, 10.0  # s, s, m²/s³
SHORTEST = 1e-3  # s: a step, to divide by


class AccelerometerGain:
    """The regression of the accelerometer on the wheels' acceleration, and whether the accelerometer is stuck."""

    def __init__(self) -> None:
        self._last = 0.0  # m/s², the last value
        self._still = 0.0  # s without a change
        self._speed: float | None = None  # m/s, at the last step
        self._means: tuple[float, float, float] | None = None  # m/s²: accelerometer, acceleration; s of both
        self._product = self._square = 0.0  # m²/s³
        self.wrong = False  # it does not show what the wheels gain

    def forget_speed(self) -> None:
        """Nothing was received for a while: what changed meanwhile is no rate."""
        self._speed = self._means = None

    def contradicts(self, dt: float, forward: float, speed: float, acceleration: float | None, on_road: bool) -> bool:
        """Whether it contradicts the wheels over `dt` [s].

        forward: the accelerometer [m/s²]; speed [m/s] and acceleration [m/s²]: of the wheels, None if that is not
        known; on_road: the wheels do not turn on a bench.
        """
        self._still = self._still + dt if forward == self._last != 0.0 else 0.0  # a plain zero: a simulation's
        self._last = forward
        keep = 1 - min(dt / GAIN_TIME, 1.0)
        # Which speed is right is not yet known, or it is held for long, or the wheels turn on a bench.
        if acceleration is None or not on_road:
            self._product = self._square = 0.0
            self.wrong = False
        if acceleration is None:
            self.forget_speed()
            return on_road and abs(speed) > MOVING and self._still > STUCK_AFTER
        gained = 0.0 if self._speed is None else speed - self._speed
        self._speed = speed
        if max(abs(acceleration), abs(gained) / max(dt, SHORTEST)) > HARDEST:  # another sensor took over
            return False
        # Less their means: a slope is in the one and not in the other.
        slow, wheels, time = self._means or (forward, acceleration, 0.0)
        time = min(time + dt, GAIN_MEAN)  # plain means at first: the past is not known
        share = share_of_new(dt, time)
        self._means = slow + (forward - slow) * share, wheels + (acceleration - wheels) * share, time
        self._product = keep * self._product + (forward - slow) * (acceleration - wheels) * dt
        self._square = keep * self._square + (acceleration - wheels) * (gained - wheels * dt)
        self.wrong = self._square > GAIN_LEAST and not GAIN[0] < self._product / self._square < GAIN[1]
        return on_road and abs(speed) > MOVING and (self._still > STUCK_AFTER or self.wrong)
