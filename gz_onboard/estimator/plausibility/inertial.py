"""Inertial unit and GPS altitude against gravity, the speed and the energy that a grade costs.

Grades are sines of the road's angle. Where accelerometer and altitude contradict each other, the energy from the pack
beyond that for a level road tells which of them is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from math import hypot, sqrt

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.plausibility.residual import (
    CONFIG,
    NO_SENSOR,
    FaultCounter,
    RateLimit,
    ResidualTest,
    StepInputs,
    UnchangedTimer,
    faulty,
    isolate,
    share_of_new,
)
from gz_onboard.estimator.plausibility.speeds import SpeedCheck
from gz_onboard.estimator.signals import FIX_3D, Signals
from gz_onboard.physics.sensors import grade_shown

# Mean over `axis_time_s` that a vehicle can have (leaning, on a side stand, on a hill) and its limit; m/s² and rad/s.
AXES = {
    "accel_y": (0.0, 5.0),
    "accel_z": (GRAVITY, 3.25),
    "rate_x": (0.0, 0.15),
    "rate_y": (0.0, 0.15),
    "rate_z": (0.0, 0.8),
}
ACCELEROMETER, ALTITUDE = frozenset({"accel_x"}), frozenset({"gps_altitude"})

LevelPower = Callable[[float, float], float]
"""Power of the pack [W] by the model for a speed [m/s] and an acceleration [m/s²] on a level road."""


class InertialCheck:
    """Leaves out axes of the inertial unit that are stuck or whose mean no vehicle can have."""

    def __init__(self) -> None:
        self.counters = {role: FaultCounter() for role in AXES}
        self._mean = {role: ResidualTest(CONFIG.axis_time_s) for role in AXES}
        self._unchanged = {role: UnchangedTimer() for role in AXES}

    def step(self, step: StepInputs) -> None:
        """Check the axes of this step."""
        dt, moving = step.observed, step.speed is not None and abs(step.speed) > CONFIG.moving_m_s
        for role, (usual, limit) in AXES.items():
            signal, mean = step.signals[role], self._mean[role]
            value = signal.reported
            if value is None:
                continue
            mean.update(dt, value - usual, limit)
            stuck = self._unchanged[role].update(dt, value) > CONFIG.stuck_s and value != 0.0  # as if simulated
            # A mean over less than a third of the time may be that of one bend.
            wrong = (mean.contradicts and mean.seen > CONFIG.axis_time_s / 3) or (moving and stuck)
            self.counters[role].update(dt, True if wrong else False if moving else None)
            signal.trusted = not self.counters[role].faulty


class GradeDifference:
    """Difference of two witnesses of the grade over `grade_m`, beyond the usual one.

    The usual one is learned: mounting of the accelerometer, errors of the model, wind. sd: of the rest.
    """

    def __init__(self, sd: float) -> None:
        self._sd = sd
        self._difference, self._usual = ResidualTest(CONFIG.grade_m), ResidualTest(CONFIG.usual_m)
        self._usual.seen = CONFIG.usual_prior_m

    @property
    def usual(self) -> float:
        """Usual difference, as far as a mounting angle explains it."""
        return min(max(self._usual.difference, -CONFIG.usual_most), CONFIG.usual_most)

    @property
    def unusual(self) -> float:
        """Difference beyond the usual one."""
        return self._difference.difference - self.usual

    @property
    def residual(self) -> float:
        """The same over its sd, which is larger over a short distance and before the usual one is known."""
        unknown = CONFIG.usual_most * max(1 - (self._usual.seen - CONFIG.usual_prior_m) / CONFIG.usual_known_m, 0.0)
        short = CONFIG.grade_m / max(min(self._difference.seen, CONFIG.grade_m), 1.0)
        return abs(self.unusual) / hypot(self._sd * sqrt(short), unknown)

    def add(self, distance: float, climb: float) -> None:
        """Add `climb` [m] of the one witness beyond that of the other over `distance` [m]."""
        self._difference.update(distance, climb / distance)

    def learn(self, distance: float) -> None:
        """Learn the usual difference from another `distance` [m] without a doubt."""
        self._usual.update(distance, self._difference.difference)


class AccelerometerGain:
    """Regression of the forward accelerometer on the acceleration of the wheels, both without their means."""

    def __init__(self) -> None:
        self._forward, self._wheels = ResidualTest(CONFIG.gain_mean_time_s), ResidualTest(CONFIG.gain_mean_time_s)
        self._product = self._square = 0.0  # m²/s³

    def update(self, dt: float, forward: float, wheels: float) -> bool:
        """Whether the two contradict each other; mean accelerations [m/s²] over `dt` [s]."""
        self._forward.update(dt, forward)
        self._wheels.update(dt, wheels)
        keep, wheels = 1 - share_of_new(dt, CONFIG.gain_time_s), wheels - self._wheels.difference
        self._product = keep * self._product + (forward - self._forward.difference) * wheels * dt
        self._square = keep * self._square + wheels * wheels * dt
        gain = self._product / self._square if self._square > CONFIG.gain_least_m2_s3 else 1.0
        return not 1 / CONFIG.gain_factor < gain < CONFIG.gain_factor


class GradeCheck:
    """Leaves out accelerometer or altitude. `step` tests the altitude before it is used, `compare` both after.

    mass of vehicle and payload [kg].
    """

    def __init__(self, mass: float) -> None:
        self._weight = mass * GRAVITY
        self.counters = {role: FaultCounter() for role in ("accel_x", "gps_altitude")}
        self._gain = AccelerometerGain()
        self._inertial = GradeDifference(CONFIG.grade_sd)  # accelerometer less altitude
        self._energy_inertial, self._energy_altitude = (GradeDifference(CONFIG.energy_sd) for _ in range(2))
        self._past = RateLimit()
        self._altitude: float | None = None  # m, of this step
        self._before: float | None = None  # m, at the end of the last interval
        self._begin(0.0, None)

    def _begin(self, now: float, speed: float | None, roles: tuple[str, ...] = ()) -> None:
        """Begin an interval at `now` [s] and a speed [m/s] by the sensors of these roles."""
        self._begun, self._speed, self._roles = now, speed, roles
        self._seconds = self._distance = 0.0
        self._impulse: float | None = 0.0  # m/s, by the accelerometer
        self._work: float | None = 0.0  # J, from the pack

    def step(self, step: StepInputs) -> None:
        """Check whether road and receiver can have come to this altitude since the last one."""
        if step.observed < step.dt:  # a change over a gap is no rate
            self._begin(step.now, None)
            self._before = None
        signals, counter = step.signals, self.counters["gps_altitude"]
        altitude = None if signals.fix_below(step.now, FIX_3D) else signals.gps_altitude.reported
        evidence = min(step.dt, CONFIG.evidence_s)
        change = (CONFIG.steepest * abs(step.speed or 0.0) + CONFIG.altitude_wander_m_s) * step.dt
        possible = self._past.allows(evidence, altitude, change, change, CONFIG.altitude_jump_m)
        if not possible:
            counter.update(evidence, True)
        self._altitude = altitude if possible else None
        signals.gps_altitude.trusted = possible and not counter.faulty

    def compare(
        self, now: float, dt: float, signals: Signals, speeds: SpeedCheck, power: float | None, level_power: LevelPower
    ) -> None:
        """Compare the witnesses over `dt` [s]; power of the pack [W], None where it is unknown."""
        speed = None if speeds.disputed else speeds.median
        if speed is None or self._speed is None or speeds.roles != self._roles:
            self._begin(now, speed, speeds.roles)
            return
        forward = signals.accel_x.reported
        self._seconds += dt
        self._distance += abs(speed) * dt
        self._impulse = None if self._impulse is None or forward is None else self._impulse + forward * dt
        self._work = None if self._work is None or power is None else self._work + power * dt
        # A speed that is held between messages has no acceleration: wait for the next ones.
        if self._seconds >= CONFIG.interval_s and min(signals[role].time for role in speeds.roles) > self._begun:
            acceleration = (speed - self._speed) / self._seconds
            if abs(acceleration) < CONFIG.hardest_m_s2:
                self._end_interval(acceleration, speeds.on_road, level_power)
            self._begin(now, speed, speeds.roles)
        signals.accel_x.trusted = not self.counters["accel_x"].faulty

    def _end_interval(self, acceleration: float, on_road: bool, level_power: LevelPower) -> None:
        distance, seconds, altitude = self._distance, self._seconds, self._altitude
        rise = None if altitude is None or self._before is None else altitude - self._before
        self._before = altitude
        climb, wrong_gain = None, False
        if self._impulse is not None:
            forward = self._impulse / seconds
            climb = grade_shown(forward, acceleration) * distance
            if not on_road:
                self._gain = AccelerometerGain()
            elif wrong_gain := self._gain.update(seconds, forward, acceleration):
                self.counters["accel_x"].update(seconds, True)
        if distance / seconds < CONFIG.moving_m_s:
            return
        energy = None
        if self._work is not None and self._work > 0:  # brakes take what a descent gives: energy does not show it
            energy = (self._work - level_power(distance / seconds, acceleration) * seconds) / self._weight
        pairs = (
            (self._inertial, climb, rise),
            (self._energy_inertial, energy, climb),
            (self._energy_altitude, energy, rise),
        )
        known = [(pair, first - second) for pair, first, second in pairs if first is not None and second is not None]
        if not known:
            return
        for pair, difference in known:
            pair.add(distance, difference)
        residual = known[0][0].residual  # accelerometer against altitude, or a single one of them against the energy
        if CONFIG.agreeing_residual < residual <= 1:
            return  # nothing is proven
        against = NO_SENSOR if residual <= 1 else self._isolate(climb, rise, wrong_gain)
        for role, counter in self.counters.items():
            counter.update(seconds, role in against, disputed=len(against) > 1)
        if not against and not self.faulty:
            for pair, _ in known:
                pair.learn(distance)

    def _isolate(self, climb: float | None, rise: float | None, wrong_gain: bool) -> frozenset[str]:
        """Sensors that explain a contradiction, of those that tell a climb [m]."""
        if rise is None or wrong_gain:
            return ACCELEROMETER
        if climb is None:
            return ALTITUDE
        by_energy = (self._energy_inertial.unusual, self._energy_altitude.unusual)
        wrong = isolate(*((off / CONFIG.energy_decides_sd) ** 2 for off in by_energy))
        return (ACCELEROMETER | ALTITUDE, ACCELEROMETER, ALTITUDE)[wrong]

    @property
    def faulty(self) -> frozenset[str]:
        """Roles that are left out."""
        return faulty(self.counters)

    @property
    def offset(self) -> float:
        """Add this to the grade by the accelerometer: its mounting, learned before any sensor was doubted."""
        return 0.0 if self.counters["accel_x"].faulty else -self._inertial.usual
