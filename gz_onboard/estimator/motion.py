"""Motion of the vehicle, its activity, and the roughness of the road.

Lean follows from the roll rate, drawn to the lean of the steady turn tan φ = -V·ψ'/g (Cossalter 2006, sec. 4.1; yaw is
positive to the left, lean to the right). Grade follows from the accelerometer less the wheel's acceleration; its offset
(mounting, pitch) is found by an observer that follows the GPS altitude over distance. Without an accelerometer the same
observer finds all of the grade, more slowly.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, atan, atan2, cos, exp, inf, pi, sin, sqrt

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.signals import FIX_3D, Signal, Signals
from gz_onboard.events import WINDOW, Activity
from gz_onboard.model.effect import MOVING
from gz_onboard.model.sensors import VIBRATION_MEMORY_S, VIBRATION_PERIOD_S, grade_shown, speed_factors


@dataclass(frozen=True)
class MotionConfig:
    """Constants of motion and activity; times in s."""

    speed_time: float = 0.3  # low pass of the speed, whose lag gives the acceleration
    standstill: float = 0.05  # m/s
    turning_speed: float = 2.0  # m/s: below, the lean is no steady turn's, and the course of the GPS is noise
    lean_time: float = 2.0  # how fast the lean is drawn to that of the steady turn
    min_lean_cosine: float = 0.5  # no tyre holds 60 degrees
    course_time: float = 1.0  # how fast the heading is drawn to the GPS course
    max_gyro_bias: float = 0.3  # rad/s: cheap MEMS sensors are specified to a third of it
    gyro_bias_time: float = 5.0  # of standing, to know the offset of a rate sensor
    grade_time: float = 5.0  # low pass of the accelerometer's grade: at 2 s its noise adds 4 % to the modelled energy
    altitude_length: float = 150.0  # m: how fast the observer follows the altitude where it seeks an offset only
    altitude_length_alone: float = 60.0  # m: the same where the altitude is all there is
    max_altitude_error: float = 15.0  # m: beyond it the observer begins anew
    max_observer_gain: float = 0.5  # share of the error corrected in one step, however long
    min_altitude: float = -500.0  # m: where there are roads
    max_altitude: float = 9000.0  # m
    max_grade: float = 0.3  # sine; no road is steeper
    stop_time: float = 120.0  # a stop of up to this belongs to the ride, as at a traffic light; beyond, it is parked
    standing_after: float = 2.0  # without motion
    moving_after: float = 1.0  # of motion: a single sample of a noisy sensor is none
    charging_rate: float = 0.02  # 1/h, current over capacity: offsets of current sensors are smaller
    charging_after: float = 3.0  # of that at standstill: the last of a regenerative brake is over
    silent_charging_after: float = 30.0  # of it with no speed known and a silent inverter
    uncharged_after: float = 60.0  # without that current: a charger that is dead, or done, though it is plugged in
    drawing_rate: float = 0.2  # 1/h: a drive draws more at standstill only if the speed is wrong
    drawing_after: float = 10.0  # of that, less the time without: the speed is wrong
    max_drawing: float = 30.0  # that counts
    max_sample_interval: float = 0.034  # of the vertical acceleration: slower ones do not show a road's roughness
    vibration_after: float = 3 * VIBRATION_MEMORY_S  # of samples: 97 % of the value is there
    min_vibration_square: float = 1e-6  # (m/s²)²: less is a stuck sensor's, and rounding


MOTION = MotionConfig()


class Motion:
    """State and result of the motion filter. None: not known, for want of sensors.

    wheel_radius: of the driven wheel [m]; gear_ratio: wheel speed over the reading of the motor's sensor.
    """

    def __init__(self, signals: Signals, wheel_radius: float, gear_ratio: float) -> None:
        self._signals = signals
        self._speeds = [(signals[role], factor) for role, factor in speed_factors(wheel_radius, gear_ratio).items()]
        self.speed: float | None = None  # m/s
        self.acceleration: float | None = None  # m/s²
        self.grade: float | None = None  # sine of the road's angle
        self.lean: float | None = None  # rad, positive to the right
        self.yaw_rate: float | None = None  # rad/s, positive to the left
        self.heading: float | None = None  # rad, clockwise from north
        self.altitude: float | None = None  # m, as the observer has it
        self.distance = 0.0  # m
        self.gyro_bias = 0.0, 0.0  # rad/s, of roll and yaw rate
        self._slow_speed = 0.0  # m/s, low-passed
        self._accelerometer_grade = self._grade_offset = 0.0
        self._levelled = 0.0  # m over which the offset was sought: before, an accelerometer shows its mounting, too

    def step(self, now: float, dt: float) -> None:
        """Go `dt` [s] ahead to `now` [s]."""
        before, self.speed, self.acceleration = self.speed, None, None
        for signal, factor in self._speeds:
            if signal.reported is not None and signal.trusted:
                self._follow_speed(dt, before, signal.reported * factor)
                break
        self._update_turning(now, dt)
        self._update_grade(now, dt)

    def _follow_speed(self, dt: float, before: float | None, speed: float) -> None:
        slow = speed if before is None else self._slow_speed
        if dt < MOTION.speed_time:  # the lag before this step, to which a steady rate settles
            self.acceleration = (speed - slow) / MOTION.speed_time
            self._slow_speed = slow + self.acceleration * dt
        else:  # the mean over the step
            self.acceleration, self._slow_speed = (speed - slow) / dt, speed
        self.speed = speed
        self.distance += abs(speed) * dt

    def forget_grade(self, grade_offset: float, altitude_holds: bool) -> None:
        """Start the grade again: a sensor that it was made from is faulty; `grade_offset` is still known.

        altitude_holds: the observer starts from the measured altitude. Where the fault led it is no climb.
        """
        self._grade_offset, self._accelerometer_grade = grade_offset, 0.0
        if altitude_holds:
            self.altitude = None

    def _update_turning(self, now: float, dt: float) -> None:
        signals, speed, heading = self._signals, self.speed, self.heading
        roll, yaw = signals.rate_x.mean, signals.rate_z.mean
        if roll is None or yaw is None or speed is None:
            self.lean = self.yaw_rate = None
        else:
            self._update_lean(dt, speed, roll, yaw)
        moves = (signals.gps_speed.get(now) or 0.0) > MOTION.turning_speed
        course = signals.gps_course.get(now) if moves else None
        if heading is None or (self.yaw_rate is None and course is None):
            heading = course
        else:
            heading -= (self.yaw_rate or 0.0) * dt
        if heading is not None and course is not None:
            heading += atan2(sin(course - heading), cos(course - heading)) * min(dt / MOTION.course_time, 1.0)
        self.heading = None if heading is None else heading % (2 * pi)

    def _update_lean(self, dt: float, speed: float, roll: float, yaw: float) -> None:
        (bias_x, bias_z), share = self.gyro_bias, min(dt / MOTION.gyro_bias_time, 1.0)
        if abs(speed) < MOTION.standstill and max(abs(roll), abs(yaw)) < MOTION.max_gyro_bias:
            bias_x, bias_z = bias_x + (roll - bias_x) * share, bias_z + (yaw - bias_z) * share
            self.gyro_bias = bias_x, bias_z
        lean = self.lean or 0.0
        self.yaw_rate = (yaw - bias_z) / max(cos(lean), MOTION.min_lean_cosine)
        if abs(speed) > MOTION.turning_speed:
            steady = -atan(speed * self.yaw_rate / GRAVITY)
        else:
            steady = asin(min(max((self._signals.accel_y.mean or 0.0) / GRAVITY, -1.0), 1.0))
        lean += (roll - bias_x) * dt
        self.lean = lean + (steady - lean) * min(dt / MOTION.lean_time, 1.0)

    def _update_grade(self, now: float, dt: float) -> None:
        signals = self._signals
        forward = signals.accel_x.mean
        measured = None if signals.fix_below(now, FIX_3D) else signals.gps_altitude.get(now)
        distrusted = not (signals.accel_x.trusted and signals.gps_altitude.trusted)
        nothing = forward is None and measured is None and (distrusted or self.altitude is None)
        mounting = measured is None and self._levelled < MOTION.altitude_length
        if self.speed is None or nothing or mounting:
            self.grade = None
            return
        if forward is not None and self.acceleration is not None:
            sine = min(max(grade_shown(forward, self.acceleration), -1.0), 1.0)
            self._accelerometer_grade += (sine - self._accelerometer_grade) * min(dt / MOTION.grade_time, 1.0)
        else:
            self._accelerometer_grade = 0.0
        distance, altitude = abs(self.speed) * dt, self.altitude
        if altitude is not None:
            altitude += (self._accelerometer_grade + self._grade_offset) * distance
        if measured is not None:
            if altitude is None or abs(measured - altitude) > MOTION.max_altitude_error:
                altitude = measured  # it was away for long, or left out: where it is now teaches no grade
            length = MOTION.altitude_length_alone if forward is None else MOTION.altitude_length
            share = min(distance / length, MOTION.max_observer_gain)  # critically damped over distance
            self._grade_offset += share * (measured - altitude) / length
            altitude += 2 * share * (measured - altitude)
            self._levelled += distance
        self.altitude = None if altitude is None else min(max(altitude, MOTION.min_altitude), MOTION.max_altitude)
        self.grade = min(max(self._accelerometer_grade + self._grade_offset, -MOTION.max_grade), MOTION.max_grade)


class ActivityTracker:
    """Follows whether the vehicle is ridden, stands, is parked or charged. Only riding teaches the consumption.

    A stop is short until it has lasted `stop_time`, or the key is turned off or the contactor opens: then it is parked.
    So it is with a charge plug in, and charging from the first charging current until none has flowed for
    `uncharged_after`, or as long as no current is known. Without a plug signal, or with one that is out, a charging
    current that lasts means charging too, where it cannot be a brake's: at standstill, or with a silent inverter.
    """

    def __init__(self) -> None:
        self.now = Activity.UNKNOWN
        self._still = inf  # s since the last motion; none yet
        self._followed = 0.0  # s since the first step
        self._moving = 0.0  # s of motion
        self._charging = 0.0  # s of a charging current without motion
        self._uncharged = inf  # s since the last such current that lasted
        self._drawing = 0.0  # s of a drive's current without motion, less those without it
        self.takes_charge = False  # the pack is charged, or could be: nothing drives
        self.teaches = False  # what flows now is part of a ride: motion, or a short stop

    def step(
        self,
        dt: float,
        speed: float | None,
        c_rate: float | None,
        plug: float | None,
        inverter_silent: bool,
        off: bool = False,
        drive: float | None = None,
    ) -> None:
        """Go `dt` [s] on.

        speed: [m/s]. c_rate: current over capacity [1/h], positive discharging. plug: 1 while the charge plug is in.
        Each None where it is not known. inverter_silent: the vehicle has signals of its inverter and none comes. off:
        the key is off, or the contactor is open. drive: c_rate of the inverter alone, if that is known: a heater draws
        from the pack as much as a drive that creeps.
        """
        moving = speed is not None and abs(speed) > MOVING
        self._moving = self._moving + dt if moving else 0.0
        self._still = 0.0 if self._moving >= MOTION.moving_after else self._still + dt
        self._followed += dt
        drawn = c_rate if drive is None else drive
        more = dt if drawn is not None and drawn > MOTION.drawing_rate else -dt
        self._drawing = 0.0 if moving else min(max(self._drawing + more, 0.0), MOTION.max_drawing)
        speed_is_wrong = self._drawing >= MOTION.drawing_after  # it must be moving
        speed = None if speed_is_wrong else speed
        charged = c_rate is not None and c_rate < -MOTION.charging_rate and not moving
        self._charging = self._charging + dt if charged else 0.0
        self._uncharged = 0.0 if self._charging >= MOTION.charging_after else self._uncharged + dt
        plugged = bool(plug) and not moving
        flows = c_rate is None or self._uncharged < MOTION.uncharged_after
        without_speed = MOTION.silent_charging_after if inverter_silent else inf
        if (plugged and flows) or self._charging >= (without_speed if speed is None else MOTION.charging_after):
            self.now = Activity.CHARGING
        elif plugged and not speed_is_wrong:
            self.now = Activity.PARKED
        elif speed is None:
            self.now = Activity.UNKNOWN
        elif moving or self._still < MOTION.standing_after:
            self.now = Activity.RIDING
        else:
            parked = off or min(self._still, self._followed) > MOTION.stop_time
            self.now = Activity.PARKED if parked else Activity.STANDING
        charging = self.now is Activity.CHARGING
        self.takes_charge = charging and self._drawing == 0
        known = not (charging or speed_is_wrong or self._charging)
        self.teaches = known and self._still <= MOTION.stop_time

    def shown(self, silent: bool, joined: bool) -> Activity:
        """The activity; silent: nothing comes from the bus; joined: no rest has shown the state of charge yet."""
        if silent:
            return Activity.UNKNOWN if self.now in (Activity.UNKNOWN, Activity.RIDING) else Activity.ASLEEP
        return Activity.JOINED if joined and self.now is Activity.RIDING else self.now


class VibrationMonitor:
    """The vibration, as `model.sensors` defines it [m/s²], from windows of samples.

    It starts again after a gap, or with a sensor that shows one and the same value: no accelerometer is that still.
    """

    def __init__(self) -> None:
        self._since = self._time = -inf  # s: the first window and the last
        self._square = 0.0  # (m/s²)²

    def step(self, now: float, accel_z: Signal) -> None:
        """Take the samples of the window that ends at `now` [s]."""
        n, mean = accel_z.count, accel_z.mean
        if n * MOTION.max_sample_interval < WINDOW or mean is None or accel_z.mean_square is None:
            return
        square = (accel_z.mean_square - mean * mean) * n / (n - 1)
        dt = now - self._time
        if square < MOTION.min_vibration_square or dt > 2 * WINDOW:
            self._since, self._square = now, max(square, 0.0)
        keep = exp(-WINDOW / n / VIBRATION_PERIOD_S)  # of white shaking, the filters show this share
        fade = exp(-min(dt, WINDOW) / VIBRATION_MEMORY_S)
        self._square = fade * self._square + (1 - fade) * square * keep * keep * 2 / (1 + keep)
        self._time = now

    def value(self, now: float) -> float | None:
        """RMS [m/s²] at `now` [s]; None while samples are missing, too few, or have only just come again."""
        if now - self._time > 2 * WINDOW or self._time - self._since < MOTION.vibration_after:
            return None
        return sqrt(self._square)
