"""How the vehicle moves: speed, acceleration, grade, lean, yaw rate, heading; each optional, from what there is.

Lean from the roll rate, drawn to the lean of the steady turn tan φ = -V·ψ'/g (Cossalter 2006, sec. 4.1; yaw is
positive to the left, lean to the right). Grade from the accelerometer less the wheel's acceleration, its offset
(mounting, pitch) found by an observer that follows the GPS altitude over distance; without an accelerometer the
same observer finds all of the grade, more slowly.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, atan, atan2, cos, pi, sin

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.signals import FIX_3D, Signals
from gz_onboard.physics.sensors import grade_shown, speed_factors

SPEED_TIME = 0.3  # s: the speed's low pass, whose lag gives the acceleration
LEAN_TIME = 2.0  # s: how fast the lean is drawn to that of the steady turn
GRADE_TIME = 5.0  # s: low pass of the accelerometer's grade; at 2 s its noise adds 4 % to the energy modelled
ALTITUDE_LENGTH = 150.0  # m: how fast the observer follows the altitude where it seeks an offset only
ALTITUDE_LENGTH_ALONE = 60.0  # m: the same where the altitude is all there is
STANDSTILL = 0.05  # m/s
TURNING = 2.0  # m/s: below, the lean is no steady turn's, and the course of the GPS is noise
COURSE_TIME = 1.0  # s: how fast the heading is drawn to the GPS course
LEAST_COSINE = 0.5  # of the lean: no tyre holds 60 degrees
QUIET, QUIET_TIME = 0.05, 1.0  # rad/s, s: of a vehicle at standstill, upright: the rates are constant
MOST_BIAS = 0.3  # rad/s: cheap MEMS sensors are specified to a third of it
BIAS_TIME = 5.0  # s of standing to know the offset of a rate sensor
LOST = 15.0  # m: the observer is never so far from an altitude that it follows
ALTITUDES = -500.0, 9000.0  # m: where there are roads
STEEPEST = 0.3  # sine: of roads
LARGEST_SHARE = 0.5  # of the error corrected in one step, however long


def accelerated(slow: float, speed: float, dt: float) -> tuple[float, float]:
    """(low-passed speed [m/s], acceleration [m/s²]) after `dt` [s], from the low-passed speed before."""
    if dt < SPEED_TIME:
        rate = (speed - slow) / SPEED_TIME  # of the lag before this step, which is what a steady rate settles to
        return slow + rate * dt, rate
    return speed, (speed - slow) / dt  # slow messages: the mean over the step


@dataclass(slots=True)
class RoadState:
    """State and result of the road filter."""

    speed: float | None = None  # m/s
    acceleration: float | None = None  # m/s²
    grade: float | None = None  # sine of the road's angle
    lean: float | None = None  # rad, positive to the right
    yaw_rate: float | None = None  # rad/s, positive to the left
    heading: float | None = None  # rad, clockwise from north
    altitude: float | None = None  # m, as the observer has it
    distance: float = 0.0  # m
    bias_x: float = 0.0  # rad/s, of the roll rate
    bias_z: float = 0.0  # rad/s, of the yaw rate
    slow_speed: float = 0.0  # m/s, low-passed
    slow_roll: float = 0.0  # rad/s, low-passed
    slow_yaw: float = 0.0  # rad/s, low-passed
    accelerometer_grade: float = 0.0
    grade_offset: float = 0.0
    levelled: float = 0.0  # m over which the offset was sought: before, an accelerometer shows its mounting, too

    def step(self, now: float, dt: float, signals: Signals, wheel_radius: float, gear_ratio: float) -> None:
        """Go `dt` [s] ahead to `now` [s]."""
        self._update_speed(now, dt, signals, wheel_radius, gear_ratio)
        self._update_turn(now, dt, signals)
        self._update_grade(now, dt, signals)

    def forget_grade(self, grade_offset: float, altitude_holds: bool) -> None:
        """Begin the grade anew: a sensor that it was made from is faulty; `grade_offset` is still known.

        altitude_holds: the observer goes on from the measured altitude. Where the fault led it to is no climb.
        """
        self.grade_offset, self.accelerometer_grade = grade_offset, 0.0
        if altitude_holds:
            self.altitude = None

    def _update_speed(self, now: float, dt: float, signals: Signals, radius: float, gear: float) -> None:
        for role, factor in speed_factors(radius, gear).items():
            shown = signals[role].mean(now)
            if shown is not None:
                speed = shown * factor
                break
        else:
            self.speed = self.acceleration = None
            return
        if self.speed is None:
            self.slow_speed = speed
        self.speed = speed
        self.slow_speed, self.acceleration = accelerated(self.slow_speed, speed, dt)
        self.distance += abs(speed) * dt

    def _update_turn(self, now: float, dt: float, signals: Signals) -> None:
        roll, yaw = signals.rate_x.mean(now), signals.rate_z.mean(now)
        speed = self.speed
        if roll is None or yaw is None or speed is None:
            self.lean = self.yaw_rate = None
        else:
            quiet = max(abs(roll - self.slow_roll), abs(yaw - self.slow_yaw)) < QUIET
            share = min(dt / QUIET_TIME, 1.0)
            self.slow_roll += (roll - self.slow_roll) * share
            self.slow_yaw += (yaw - self.slow_yaw) * share
            if abs(speed) < STANDSTILL and quiet and max(abs(self.slow_roll), abs(self.slow_yaw)) < MOST_BIAS:
                share = min(dt / BIAS_TIME, 1.0)
                self.bias_x += (roll - self.bias_x) * share
                self.bias_z += (yaw - self.bias_z) * share
            lean = self.lean or 0.0
            self.yaw_rate = (yaw - self.bias_z) / max(cos(lean), LEAST_COSINE)
            lean += (roll - self.bias_x) * dt
            if abs(speed) > TURNING:
                steady = -atan(speed * self.yaw_rate / GRAVITY)
            else:
                sideways = signals.accel_y.mean(now)
                steady = asin(min(max(sideways / GRAVITY, -1.0), 1.0)) if sideways is not None else 0.0
            self.lean = lean + (steady - lean) * min(dt / LEAN_TIME, 1.0)
        course, gps_speed = signals.gps_course.get(now), signals.gps_speed.get(now)
        if self.heading is not None and self.yaw_rate is not None:
            self.heading -= self.yaw_rate * dt
        if course is not None and gps_speed is not None and gps_speed > TURNING:
            if self.heading is None:
                self.heading = course
            turn = course - self.heading
            self.heading += atan2(sin(turn), cos(turn)) * min(dt / COURSE_TIME, 1.0)
        elif self.yaw_rate is None:
            self.heading = None
        if self.heading is not None:
            self.heading %= 2 * pi

    def _update_grade(self, now: float, dt: float, signals: Signals) -> None:
        forward = signals.accel_x.mean(now)
        altitude = None if signals.fix_below(now, FIX_3D) else signals.gps_altitude.get(now)
        distrusted = not (signals.accel_x.trusted and signals.gps_altitude.trusted)
        nothing = forward is None and altitude is None and (distrusted or self.altitude is None)
        mounting = altitude is None and self.levelled < ALTITUDE_LENGTH
        if self.speed is None or nothing or mounting:
            self.grade = None
            return
        if forward is not None and self.acceleration is not None:
            sine = min(max(grade_shown(forward, self.acceleration), -1.0), 1.0)
            self.accelerometer_grade += (sine - self.accelerometer_grade) * min(dt / GRADE_TIME, 1.0)
        else:
            self.accelerometer_grade = 0.0
        distance = abs(self.speed) * dt
        if self.altitude is not None:
            self.altitude += (self.accelerometer_grade + self.grade_offset) * distance
        if altitude is not None:
            if self.altitude is None:
                self.altitude = altitude
            error = altitude - self.altitude
            if abs(error) > LOST:  # it was away for long, or left out: no grade is to be learned from where it is now
                self.altitude, error = altitude, 0.0
            length = ALTITUDE_LENGTH_ALONE if forward is None else ALTITUDE_LENGTH
            share = min(distance / length, LARGEST_SHARE)  # critically damped over distance
            self.altitude += 2 * share * error
            self.grade_offset += share * error / length
            self.levelled += distance
        if self.altitude is not None:
            self.altitude = min(max(self.altitude, ALTITUDES[0]), ALTITUDES[1])
        self.grade = min(max(self.accelerometer_grade + self.grade_offset, -STEEPEST), STEEPEST)
