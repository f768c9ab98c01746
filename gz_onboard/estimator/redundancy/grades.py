"""The grade by accelerometer, by GPS altitude, and by the energy consumed beyond that on the level.

Grades are sines of the road's angle. The commissioning rides' greatest differences of accelerometer and altitude are
0.026 over 300 m and 0.010 over 1000 m; those of the energy 0.05, most of it wind that stays for the ride.
"""

from __future__ import annotations

from collections.abc import Callable

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.redundancy.accelerometer import AccelerometerGain
from gz_onboard.estimator.redundancy.checks import AGREES, LONGEST_EVIDENCE, MOVING, NO_SENSOR, RateLimit, StepInputs
from gz_onboard.estimator.redundancy.checks import counters as new_counters
from gz_onboard.estimator.redundancy.checks import faulty as faulty_roles
from gz_onboard.estimator.redundancy.grade_difference import NEAR, DistanceMean, GradeDifference, Limits
from gz_onboard.estimator.redundancy.speeds import SpeedCheck
from gz_onboard.estimator.signals import FIX_3D, Signals
from gz_onboard.physics.sensors import grade_shown

APART = Limits(0.05, 0.022, 0.08)
APART_FROM_ENERGY = Limits(0.09, 0.06, 0.10)  # of a single witness against the energy
DECIDES = 0.4  # of what two are apart: by so much one must be nearer to the energy than the other
DOWNHILL = -0.02
FREE = 0.4  # of the usual consumption: neither wind nor a light rider saves so much over a kilometre
STEEPEST = 0.3
JUMP, WEATHER = 6.0, 1.0  # m, m/s: how far and how fast an altitude wanders by the receiver alone
STANDSTILL = 0.1  # m/s, mean of a second
STANDING_TIME, STANDING_RATE = 20.0, 0.6  # s, m/s: a standing vehicle does not climb
INTERVAL = 1.0  # s over which the witnesses are compared
ALTITUDE, ACCELEROMETER = frozenset({"gps_altitude"}), frozenset({"accel_x"})

LevelPower = Callable[[float, float], float]
"""Power of the pack [W] by the model for a speed [m/s] and an acceleration [m/s²] on a level road."""


class GradeCheck:
    """``step`` checks the altitude before it is used (`SensorCheck`); ``compare`` the witnesses, after.

    mass [kg]; level: the force [N] that the pack gives in the mean of the usual riding.
    """

    ROLES = ("accel_x", "gps_altitude")

    def __init__(self, mass: float, level: float) -> None:
        self._weight = mass * GRAVITY
        self._free = -FREE * level / self._weight
        self.counters = new_counters(self.ROLES)
        self.gain = AccelerometerGain()
        self._inertial = GradeDifference()  # accelerometer less altitude,
        self._energy = GradeDifference()  # energy less accelerometer,
        self._energy_altitude = GradeDifference()  # and energy less altitude
        self._by_energy = DistanceMean(NEAR)
        self._begin_interval(None)
        self._altitude: float | None = None  # m, of this step
        self._limit = RateLimit()
        self._before: float | None = None  # m, at the end of the last interval
        self._standing_rate = 0.0  # m/s, low-passed

    def _begin_interval(self, speed: float | None) -> None:
        self._seconds = self._distance = 0.0
        self._climb: float | None = 0.0  # m, by accelerometer
        self._work: float | None = 0.0  # J, out of the pack
        self._speed = speed  # m/s, at its begin

    def step(self, step: StepInputs) -> None:
        """Before the altitude is used: whether a road and a receiver could have come to it since the last one."""
        if step.observed < step.dt:  # what changed in a gap is no rate
            self._begin_interval(None)
            self._before = None
            self.gain.forget_speed()
        signals, counter = step.signals, self.counters["gps_altitude"]
        altitude = None if signals.fix_below(step.now, FIX_3D) else signals.gps_altitude.reported(step.now)
        evidence = min(step.dt, LONGEST_EVIDENCE)
        rise = (STEEPEST * abs(step.speed or 0.0) + WEATHER) * step.dt
        possible = self._limit.update(evidence, altitude, rise, JUMP)
        if not possible:
            counter.update(evidence, True)
        self._altitude = altitude if possible else None
        signals.gps_altitude.trusted = possible and not counter.faulty

    def compare(
        self, now: float, dt: float, signals: Signals, speeds: SpeedCheck, power: float | None, level_power: LevelPower
    ) -> None:
        """Compare the witnesses over `dt` [s].

        speeds: where they are not unsettled, their median is the speed; one of them may be late or noisy. power: of
        the pack [W], None if that is not known.
        """
        forward, speed = signals.accel_x.reported(now), speeds.middle
        if speed is None or speeds.unsettled:
            self._begin_interval(None)
            return
        distance = abs(speed) * dt
        if self._speed is None:
            self._speed = speed
        self._seconds += dt
        self._distance += distance
        if forward is None:
            self._climb = None
        elif self._climb is not None:
            self._climb += grade_shown(forward, speeds.acceleration) * distance
            acceleration = None if speeds.in_steps else speeds.acceleration
            if self.gain.contradicts(dt, forward, speed, acceleration, speeds.on_road):
                self.counters["accel_x"].update(dt, True)
        self._work = None if self._work is None or power is None else self._work + power * dt
        if self._seconds >= INTERVAL:
            self._end_interval(speed, self._altitude, level_power)
            self._begin_interval(speed)
        signals.accel_x.trusted = not self.counters["accel_x"].faulty

    def _end_interval(self, speed: float, altitude: float | None, level_power: LevelPower) -> None:
        distance, seconds = self._distance, self._seconds
        rise = None if altitude is None or self._before is None else altitude - self._before
        self._before = altitude
        if distance / seconds < MOVING:
            if rise is not None and distance / seconds < STANDSTILL:
                self._standing_rate += (rise / seconds - self._standing_rate) * min(seconds / STANDING_TIME, 1.0)
                if abs(self._standing_rate) > STANDING_RATE:
                    self.counters["gps_altitude"].update(seconds, True)
            return
        energy = None
        if self._work is not None and self._speed is not None:
            gained = (speed - self._speed) / seconds
            energy = (self._work - level_power(distance / seconds, gained) * seconds) / self._weight
            self._by_energy.add(distance, energy)
        climb = self._climb
        pairs = [
            (difference, first - second)
            for difference, first, second in (
                (self._inertial, climb, rise),
                (self._energy, energy, climb),
                (self._energy_altitude, energy, rise),
            )
            if first is not None and second is not None
        ]
        for difference, apart in pairs:
            difference.add(distance, apart)
        against = self._contradicting(climb is not None, rise is not None, energy is not None)
        if against is None:
            return
        for role in self.ROLES:
            self.counters[role].update(seconds, role in against)
        if against:
            for difference, _ in pairs:
                difference.doubt()
        elif not self.faulty:
            for difference, apart in pairs:
                difference.learn(distance, apart)

    def _contradicting(self, inertial: bool, altitude: bool, energy: bool) -> frozenset[str] | None:
        """Which sensors are contradicted, of the witnesses that report; None if that cannot be decided now."""
        if inertial and altitude:
            return self._of_two(energy)
        if not energy or not (inertial or altitude):
            return None
        role, difference = (ACCELEROMETER, self._energy) if inertial else (ALTITUDE, self._energy_altitude)
        apart = difference.beyond(APART_FROM_ENERGY)
        if apart > 0 and self._by_energy.value < DOWNHILL:  # brakes take what a descent gives: energy does not see it
            return None
        return role if apart else NO_SENSOR

    def _of_two(self, energy: bool) -> frozenset[str] | None:
        apart = self._inertial.beyond(APART)
        if not apart and self._energy_altitude.far.value < self._free:  # less consumption than possible
            return ALTITUDE
        if not apart:
            return None if self._inertial.beyond(APART, AGREES) else NO_SENSOR
        if not energy:
            return ACCELEROMETER | ALTITUDE
        if self.gain.wrong:
            return ACCELEROMETER
        by_inertial = abs(self._energy.near.value - self._energy.usual)
        by_altitude = abs(self._energy_altitude.near.value - self._energy_altitude.usual)
        if abs(by_inertial - by_altitude) < DECIDES * abs(apart):
            return ACCELEROMETER | ALTITUDE
        return ACCELEROMETER if by_inertial > by_altitude else ALTITUDE

    @property
    def faulty(self) -> frozenset[str]:
        """The roles that are left out."""
        return faulty_roles(self.counters)

    @property
    def offset(self) -> float:
        """What to add to the accelerometer's grade, as it was before anything was distrusted."""
        return 0.0 if self.counters["accel_x"].faulty else -self._inertial.usual
