"""Slow signals against their own past, inertial axes against what a vehicle can have.

Temperatures and altitude cannot change faster than heat flows or a road climbs.
"""

from __future__ import annotations

from math import inf

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.motion import MOTION
from gz_onboard.estimator.plausibility.residual import CONFIG, ResidualTest, Sensor
from gz_onboard.estimator.signals import FIX_3D, Signal, Signals

# Lowest and highest temperature [degC] that vehicles have, fastest rise and fall [K/s]. Cells heat themselves, but cool
# through their pack.
LIMITS = {
    "cell_temperature": (-40.0, 85.0, 0.05, 0.01),
    "ambient_temperature": (-50.0, 65.0, 0.5, 0.5),
    "motor_temperature": (-50.0, 220.0, 3.0, 3.0),
    "inverter_temperature": (-50.0, 180.0, 3.0, 3.0),
}
# Mean over `settled_s` that a vehicle can have (leaning, on a side stand, on a hill) and its limit; m/s², rad/s.
AXES = {
    "accel_y": (0.0, 5.0),
    "accel_z": (GRAVITY, 3.25),
    "rate_x": (0.0, 0.15),
    "rate_y": (0.0, 0.15),
    "rate_z": (0.0, 0.8),
}


class SlowSensor(Sensor):
    """A sensor that its own past predicts.

    Until it has held for `settled_s`, a jump is taken for the end of a start-up value.
    """

    possible = True  # the last value

    def __init__(
        self, role: str, signal: Signal, low: float = -inf, high: float = inf, agreement: bool | None = False
    ) -> None:
        """agreement: False if a possible value agrees with all that is known; None if other checks tell."""
        super().__init__(role, signal)
        self._low, self._high, self._agreement = low, high, agreement
        self._possible: float | None = None  # the last value that was possible, as near as it can have been
        self._since = self._seen = -inf  # s: of that value, and of the last one
        self._held = 0.0  # s of values that follow from each other

    def check(self, rise: float, fall: float) -> None:
        """Check a new value, if there is one; rise, fall: the fastest since the last [1/s]."""
        signal, value = self.signal, self.signal.reported
        if not signal.count or value is None:
            return
        # One value after a silence is no more evidence than a second, or the period of its message.
        dt, self._seen = min(signal.time - self._seen, max(CONFIG.brief_s, signal.period)), signal.time
        before, age = value if self._possible is None else self._possible, signal.time - self._since
        near = before if value == before else min(max(value, before - fall * age), before + rise * age)
        follows, in_range = abs(value - near) <= CONFIG.jump, self._low < value < self._high
        self.possible = in_range and (follows or self._held < CONFIG.settled_s)
        if self.possible:
            self._held = self._held + dt if follows else 0.0
            self._possible, self._since = near if follows else value, signal.time
        self.judge(dt, self._agreement if self.possible else True)


class LimitCheck:
    """Leaves out slow signals and inertial axes that no vehicle can have."""

    def __init__(self, signals: Signals) -> None:
        self._signals = signals
        self._temperatures = {
            role: SlowSensor(role, signals[role], *LIMITS[role][:2]) for role in signals.mapped(LIMITS)
        }
        self.altitude = SlowSensor("gps_altitude", signals.gps_altitude, agreement=None)
        self._axes = {role: Sensor(role, signals[role]) for role in signals.mapped(AXES)}
        self._means = {role: ResidualTest(CONFIG.settled_s) for role in self._axes}
        self._unchecked = 0.0  # s since the axes were checked
        self.sensors: dict[str, Sensor] = {**self._temperatures, "gps_altitude": self.altitude, **self._axes}

    def step(self, now: float, dt: float, speed: float | None) -> None:
        """Check the values of this step of `dt` [s] in which messages came; speed: of the last step [m/s]."""
        for role, slow in self._temperatures.items():
            slow.check(*LIMITS[role][2:])
        if not self._signals.fix_below(now, FIX_3D):
            climb = MOTION.max_grade * abs(speed or 0.0) + CONFIG.altitude_wander_m_s
            self.altitude.check(climb, climb)
        for axis in self._axes.values():
            if axis.signal.reported is not None:
                axis.time_unchanged(dt, axis.signal.reported)
        self._unchecked += dt
        if self._unchecked < CONFIG.brief_s:
            return
        dt, self._unchecked = self._unchecked, 0.0
        moving = speed is not None and abs(speed) > CONFIG.moving_m_s
        for role, axis in self._axes.items():
            value, mean = axis.signal.reported, self._means[role]
            if value is None:
                continue
            usual, limit = AXES[role]
            mean.update(dt, value - usual, limit)
            # Means of coarse samples can agree for a moment. An axis of exactly 0 is one of a simulated unit.
            stuck = moving and axis.unchanged > CONFIG.brief_s + CONFIG.faulty_after_s and value != 0.0
            # A mean over less than a third of the time may be that of one bend.
            wrong = stuck or (mean.contradicts and mean.seen > CONFIG.settled_s / 3)
            axis.judge(dt, True if wrong else False if moving else None)
