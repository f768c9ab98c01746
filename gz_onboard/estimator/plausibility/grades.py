"""Forward accelerometer and GPS altitude against each other, the speed and the energy that a grade costs.

Grades are sines of the road's angle. Where accelerometer and altitude contradict each other, the energy from the pack
beyond that for a level road tells which of them is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import hypot, sqrt

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.plausibility.limits import SlowSensor
from gz_onboard.estimator.plausibility.residual import CONFIG, ResidualTest, ResponseGain, Sensor, explain
from gz_onboard.estimator.plausibility.speeds import SpeedCheck
from gz_onboard.estimator.signals import FIX_3D, Signals
from gz_onboard.physics.sensors import grade_shown

LevelPower = Callable[[float, float], float]
"""Power of the pack [W] by the model for a speed [m/s] and an acceleration [m/s²] on a level road."""


class GradeDifference:
    """Difference of two witnesses of the grade over `stretch_m`, beyond the usual one.

    The usual one is learned: mounting of the accelerometer, errors of the model, wind. sd: of the rest.
    """

    def __init__(self, sd: float) -> None:
        self._sd = sd
        self._difference, self._usual = ResidualTest(CONFIG.stretch_m), ResidualTest(CONFIG.usual_m)
        self._usual.seen = CONFIG.usual_prior_m
        self.usual = 0.0  # as far as a mounting angle explains it
        self.unusual = 0.0  # difference beyond the usual one
        self.residual = 0.0  # the same over its sd

    def add(self, distance: float, climb: float) -> None:
        """Add `climb` [m] of the one witness beyond that of the other over `distance` [m]."""
        self._difference.update(distance, climb / distance)
        self.usual = min(max(self._usual.difference, -CONFIG.usual_most), CONFIG.usual_most)
        self.unusual = self._difference.difference - self.usual
        # The sd is larger over a short distance and before the usual difference is known.
        learned = self._usual.seen - CONFIG.usual_prior_m
        unknown = CONFIG.usual_most * max(1 - learned / CONFIG.usual_known_m, 0.0)
        short = CONFIG.stretch_m / max(min(self._difference.seen, CONFIG.stretch_m), 1.0)
        self.residual = abs(self.unusual) / hypot(self._sd * sqrt(short), unknown)

    def learn(self, distance: float) -> None:
        """Learn the usual difference from another `distance` [m] without a doubt."""
        self._usual.update(distance, self._difference.difference)


class GradeCheck:
    """Leaves out accelerometer or altitude; mass of vehicle and payload [kg]."""

    def __init__(
        self, signals: Signals, speeds: SpeedCheck, altitude: SlowSensor, mass: float, level_power: LevelPower
    ) -> None:
        self._signals, self._speeds, self._level_power = signals, speeds, level_power
        self._weight = mass * GRAVITY
        self.accelerometer, self.altitude = Sensor("accel_x", signals.accel_x), altitude
        self._gain = ResponseGain(CONFIG.gain_mean_s, CONFIG.recovered_after_s, CONFIG.gain_least_m2_s3)
        self._inertial = GradeDifference(CONFIG.grade_sd)  # accelerometer less altitude
        self._energy_inertial, self._energy_altitude = (GradeDifference(CONFIG.energy_sd) for _ in range(2))
        self._before: float | None = None  # m, altitude at the end of the last interval
        self._begin(0.0, None)

    def _begin(self, now: float, speed: float | None) -> None:
        """Begin an interval at `now` [s] and a speed [m/s] by the sensors that are believed."""
        self._begun, self._speed, self._roles = now, speed, self._speeds.roles
        self._seconds = self._distance = 0.0
        self._impulse: float | None = 0.0  # m/s, by the accelerometer
        self._work: float | None = 0.0  # J, from the pack

    def compare(self, now: float, dt: float, gap: bool, power: float | None) -> None:
        """Compare the witnesses over `dt` [s].

        gap: messages were missing before, and changes are no rates. power: of the pack [W], None where it is unknown.
        """
        signals, speeds = self._signals, self._speeds
        speed = None if speeds.disputed else speeds.median
        if gap:
            self._before = None
        if gap or speed is None or self._speed is None or speeds.roles != self._roles:
            self._begin(now, speed)
            return
        forward = signals.accel_x.reported
        self._seconds += dt
        self._distance += abs(speed) * dt
        self._impulse = None if self._impulse is None or forward is None else self._impulse + forward * dt
        self._work = None if self._work is None or power is None else self._work + power * dt
        # A speed that is held between messages has no acceleration: wait for the next ones.
        if self._seconds >= CONFIG.brief_s and all(signals[role].time > self._begun for role in speeds.roles):
            acceleration = (speed - self._speed) / self._seconds
            if abs(acceleration) < CONFIG.hardest_m_s2:
                self._end_interval(now, acceleration)
                self.accelerometer.signal.trusted = not self.accelerometer.faulty
                self.altitude.signal.trusted = self.altitude.possible and not self.altitude.faulty
            self._begin(now, speed)

    def _end_interval(self, now: float, acceleration: float) -> None:
        distance, seconds, accelerometer = self._distance, self._seconds, self.accelerometer
        known = self.altitude.possible and not self._signals.fix_below(now, FIX_3D)
        before, self._before = self._before, self.altitude.signal.reported if known else None
        rise = None if self._before is None or before is None else self._before - before
        climb, wrong_gain = None, False
        if self._impulse is not None:
            forward = self._impulse / seconds
            climb = grade_shown(forward, acceleration) * distance
            if self._speeds.on_road:
                self._gain.update(seconds, acceleration, forward)
                gain = self._gain.ratio
                wrong_gain = gain is not None and not 1 / CONFIG.gain_high < gain < CONFIG.gain_high
            if wrong_gain:
                accelerometer.judge(seconds, True)
        if distance / seconds < CONFIG.moving_m_s:
            return
        energy = None
        if self._work is not None and self._work > 0:  # brakes take what a descent gives: energy does not show it
            level = self._level_power(distance / seconds, acceleration) * seconds
            energy = (self._work - level) / self._weight
        witnesses = (
            (self._inertial, climb, rise),
            (self._energy_inertial, energy, climb),
            (self._energy_altitude, energy, rise),
        )
        pairs = [
            (pair, first - second) for pair, first, second in witnesses if first is not None and second is not None
        ]
        if not pairs:
            return
        for pair, difference in pairs:
            pair.add(distance, difference)
        residual = pairs[0][0].residual  # accelerometer against altitude, or a single one of them against the energy
        if CONFIG.agreeing_residual < residual <= 1:
            return  # nothing is proven
        compared = [sensor for sensor, shown in ((accelerometer, climb), (self.altitude, rise)) if shown is not None]
        against: Sequence[Sensor] = ()
        if residual > 1 and wrong_gain:
            against = (accelerometer,)
        elif residual > 1:
            by_energy = (self._energy_inertial.unusual, self._energy_altitude.unusual)
            first, second = ((off / CONFIG.energy_decides_sd) ** 2 for off in by_energy)
            against = compared if len(compared) == 1 else explain(compared, (first, second))
        for sensor in compared:
            sensor.judge(seconds, sensor in against, disputed=len(against) > 1)
        if not (against or accelerometer.faulty or self.altitude.faulty):
            for pair, _ in pairs:
                pair.learn(distance)

    @property
    def offset(self) -> float:
        """Add this to the grade by the accelerometer: its mounting, learned before any sensor was doubted."""
        return 0.0 if self.accelerometer.faulty else -self._inertial.usual
