"""A speed that is all there is, held against the odometer and the current."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from gz_onboard.estimator.plausibility.motion import SpeedCheck
from gz_onboard.events import ROLES, Activity
from tests.estimator.life import MOTOR, Scooter, estimator, follow
from tests.estimator.test_plausibility import town
from tests.events import ShownSignals, faulty

RADIUS, GEAR, STEP = 0.25, 0.5, 0.1  # m, 1, s
Odometer = Callable[[float, float], float | None]


def ridden(odometer: Odometer, wheel: Callable[[float, float], float], seconds: float = 2400.0) -> set[str]:
    """Who is named. odometer: what it says of (time [s], distance [m]); None: nothing. wheel: of (time, speed)."""
    signals = ShownSignals(*ROLES)
    speeds = SpeedCheck(signals, RADIUS, GEAR, 30.0)
    distance, named = 0.0, set[str]()
    for i in range(round(seconds / STEP)):
        t = i * STEP
        distance += town(t) * STEP
        signals.show(t, {"wheel_speed_rear": wheel(t, town(t)) / RADIUS})
        told = odometer(t, distance)
        if i % 10 == 0 and told is not None:
            signals.odometer.value, signals.odometer.time = told, t
        speeds.step(t, STEP if i else 0.0, gap=False)
        named |= faulty(speeds.sensors)
    return named


def counting(step: float) -> Odometer:
    return lambda t, x: 1e6 + step * (x // step)


HEALTHY: dict[str, Odometer] = {
    "absent": lambda t, x: None,
    "zero": lambda t, x: 0.0,
    "constant": lambda t, x: 12_345_000.0,
    "metres": counting(1.0),
    "100 m": counting(100.0),
    "kilometres": counting(1000.0),
    "4 % more": lambda t, x: 100 * (1.04 * x // 100),
    "wraps": lambda t, x: 100 * (x // 100) % 3200,
    "reset": lambda t, x: 100 * ((x if t < 900 else x - 6000) // 100),
    "set forward": lambda t, x: 100 * ((x if t < 900 else x + 900) // 100),
    "set far forward": lambda t, x: 100 * ((x if t < 900 else x + 5e6) // 100),
    "silent for a while": lambda t, x: None if 600 < t < 800 else 100 * (x // 100),
    "stalls": lambda t, x: 100 * (min(x, 4000.0 + max(x - 9000, 0)) // 100),
    "kilometres as metres": lambda t, x: x // 100 / 10,
    "100 m as kilometres": lambda t, x: 10 * (x // 1),
}


@pytest.mark.parametrize("name", HEALTHY)
def test_no_odometer_accuses_a_speed_that_is_right(name):
    assert ridden(HEALTHY[name], lambda t, v: v) == set()


WRONG: dict[str, tuple[Callable[[float, float], float], set[str]]] = {
    "zero": (lambda t, v: 0.0 if t > 600 else v, set()),
    "stuck": (lambda t, v: 9.0 if t > 600 else v, set()),
    "doubled": (lambda t, v: 2 * v, {"odometer"}),
    "halved": (lambda t, v: v / 2, {"odometer"}),
}


@pytest.mark.parametrize("step", [1.0, 100.0])
@pytest.mark.parametrize("name", WRONG)
def test_a_lone_speed_that_contradicts_the_odometer_is_named(name, step):
    """Where both count and differ by a factor, nothing says which is right: both are named."""
    wheel, besides = WRONG[name]
    assert ridden(counting(step), wheel) == {"wheel_speed_rear"} | besides


def test_what_was_learned_from_a_doubled_speed_is_unlearned():
    scooter, e = Scooter(soc=0.9), estimator()
    follow(e, scooter.live(60), scooter)
    before = e.forecaster.learner.factor
    doubled = ((t, g, (2 * (v[0] or 0.0),) if g == MOTOR else v) for t, g, v in scooter.live(400, 10.0))
    _, end = follow(e, doubled, scooter)[-1]
    assert "motor_speed" in end.distrusted
    assert end.speed is None
    assert e.forecaster.learner.factor == before


def test_a_speed_of_zero_with_the_current_of_a_drive_is_no_standing():
    scooter, e = Scooter(soc=0.9), estimator()
    follow(e, scooter.live(300, 10.0), scooter)
    dead = ((t, g, (0.0,) if g == MOTOR else v) for t, g, v in scooter.live(60, 10.0))
    rows = follow(e, dead, scooter)
    assert all(row.activity is Activity.UNKNOWN for _, row in rows[15:40])
    assert not e._activity.teaches
