"""The motion, on motions whose truth is known."""

from __future__ import annotations

from math import atan, pi, radians, sin

import numpy as np
import pytest

from gz_onboard.constants import GRAVITY
from gz_onboard.estimator.motion import Motion
from gz_onboard.events import ROLES
from tests.events import ShownSignals

RADIUS = 0.2438


def drive(seconds, truth, *, without=(), altitude_until=1e9, seed=0, dt=0.1):
    """Run the filter over `truth`(t) -> true speed, grade, lean, yaw rate (left), altitude; with noisy sensors."""
    rng = np.random.default_rng(seed)
    signals = ShownSignals(*(role for role in ROLES if role not in without))
    motion = Motion(signals, RADIUS, 1.0)
    heading, rows, before = 0.0, [], truth(0.0)
    for step in range(1, round(seconds / dt) + 1):
        t = step * dt
        speed, grade, lean, yaw, altitude = truth(t)
        heading = (heading - yaw * dt) % (2 * pi)
        values = {
            "motor_speed": speed / RADIUS,
            "accel_x": (speed - before[0]) / dt + GRAVITY * grade + 0.05 + 0.1 * rng.standard_normal(),
            "accel_y": GRAVITY * sin(lean) + 0.05 * rng.standard_normal(),
            "rate_x": (lean - before[2]) / dt + radians(0.2) + 0.005 * rng.standard_normal(),
            "rate_z": yaw * np.cos(lean) - radians(0.15) + 0.005 * rng.standard_normal(),
            "gps_speed": speed,
            "gps_course": heading,
            "gps_fix": 3.0,
            "gps_altitude": altitude + 1.5 * rng.standard_normal(),
        }
        if t >= altitude_until:
            del values["gps_altitude"]
        signals.show(t, {role: value for role, value in values.items() if role not in without})
        motion.step(t, dt)
        before = (speed, grade, lean, yaw, altitude)
        found = t, motion.speed, motion.grade, motion.lean, motion.yaw_rate, motion.heading
        rows.append((*found, grade, lean, yaw, heading))
    return motion, rows


def test_an_accelerometer_alone_shows_no_grade_before_an_altitude_has_levelled_it():
    def level(t):
        return min(9.0, t), 0.0, 0.0, 0.0, 100.0

    motion, rows = drive(120, level, without=("gps_altitude",))
    assert motion.speed is not None
    assert all(row[2] is None for row in rows), "its mounting would be a hill"
    motion, rows = drive(120, level)
    assert motion.grade == pytest.approx(0.0, abs=0.02)


def turning(t):
    """Half a minute at rest, then curves left and right at 9 m/s."""
    if t < 30:
        return 0.0, 0.0, 0.0, 0.0, 100.0
    speed = min(9.0, 1.5 * (t - 30))
    yaw = 0.35 * sin((t - 40) / 4) if t > 40 else 0.0
    return speed, 0.0, -atan(speed * yaw / GRAVITY), yaw, 100.0


def test_a_gyro_with_a_large_offset_is_learned_at_rest():
    signals = ShownSignals(*ROLES)
    motion = Motion(signals, RADIUS, 1.0)
    for step in range(1, 300):
        signals.show(step * 0.1, {"motor_speed": 0.0, "rate_x": 0.1, "rate_z": -0.12, "accel_y": 0.0})
        motion.step(step * 0.1, 0.1)
    assert motion.gyro_bias[0] == pytest.approx(0.1, abs=0.005)
    assert motion.gyro_bias[1] == pytest.approx(-0.12, abs=0.005)


def test_lean_and_yaw_in_curves():
    _, rows = drive(180, turning)
    late = [r for r in rows if r[0] > 50]
    assert np.std([r[3] - r[7] for r in late]) < radians(2)
    assert abs(np.mean([r[3] - r[7] for r in late])) < radians(1)
    assert np.std([r[4] - r[8] for r in late]) < radians(1)
    left = max(late, key=lambda r: r[8])
    assert left[3] < -radians(10)  # turning left leans left, and right is positive


def test_heading_goes_clockwise():
    _, rows = drive(180, turning)
    late = [r for r in rows if r[0] > 60]
    errors = [(r[5] - r[9] + pi) % (2 * pi) - pi for r in late]
    assert np.std(errors) < radians(4)


def hill(t):
    speed = 8.0
    grade = 0.05 * sin(speed * t / 150)
    return speed, grade, 0.0, 0.0, 100 + 0.05 * 150 * (1 - np.cos(speed * t / 150))


@pytest.mark.parametrize(
    ("without", "altitude_until", "worst"), [((), 600, 0.012), (("accel_x",), 600, 0.025), ((), 120, 0.012)]
)
def test_grade_of_hills(without, altitude_until, worst):
    _, rows = drive(600, hill, without=without, altitude_until=altitude_until)
    errors = [r[2] - r[6] for r in rows if r[0] > 200]
    assert np.std(errors) < worst


def test_without_any_source_a_quantity_is_none():
    motion, _ = drive(30, turning, without=("rate_x", "rate_z", "accel_x", "gps_altitude", "gps_course", "gps_speed"))
    assert motion.lean is None
    assert motion.yaw_rate is None
    assert motion.grade is None
    assert motion.heading is None
    assert motion.speed == pytest.approx(0.0)


@pytest.mark.parametrize("dt", [0.02, 0.1, 0.25, 1.0])
def test_a_steady_acceleration_is_shown_as_it_is_whatever_the_step(dt):
    signals = ShownSignals("motor_speed")
    motion = Motion(signals, RADIUS, 1.0)
    for step in range(round(5 / dt)):
        signals.show(dt * step, {"motor_speed": 1.2 * dt * step / RADIUS})
        motion.step(dt * step, dt)
    assert motion.acceleration == pytest.approx(1.2, rel=1e-6)
