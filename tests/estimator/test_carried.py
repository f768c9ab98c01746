"""What moves without its motor: towed, pushed, or carried in a van."""

from __future__ import annotations

from collections.abc import Iterator
from math import cos, sin

import pytest

from gz_onboard.events import Activity, Group
from gz_onboard.vehicle import read_vehicle
from tests.events import Event, EventEstimator

VEHICLE = read_vehicle("reference", 75.0)
RADIUS = VEHICLE.model.parameters["wheel_radius"] * VEHICLE.model.parameters["gear_ratio"]
PACK = Group("Pack", ("pack_voltage", "pack_current", "cell_temperature"), 0.5)
ROAD = Group("Road", ("motor_speed", "gps_altitude"), 0.5)


def drive(seen: tuple[str, ...], watts: float, speed: float) -> tuple[float, ...]:
    """What the motor's signals show of `watts` at `speed` [m/s]."""
    return tuple({"inverter_current": watts / 52.0, "motor_torque": watts * RADIUS / speed}[role] for role in seen)


def roll(seconds: float, start: float, watts: float, seen: tuple[str, ...]) -> Iterator[Event]:
    """A level road at 8 m/s, the motor at `watts`, beside lights and electronics."""
    for i in range(round(2 * seconds)):
        t = start + i / 2
        if seen:
            yield t, 2, drive(seen, watts, 8.0)
        yield t + 0.01, 1, (8.0 / RADIUS, 300.0)
        yield t + 0.02, 0, (52.0, (watts + 45.0) / 52.0, 25.0)


@pytest.mark.parametrize("seen", [(), ("inverter_current",), ("motor_torque",)])
def test_a_tow_is_known_by_current_or_torque(seen):
    groups = [PACK, ROAD, *([Group("Motor", seen, 0.5)] if seen else [])]
    e = EventEstimator(groups, VEHICLE.pack, VEHICLE.model, VEHICLE.riding)
    for event in roll(600, 0.0, 390.0, seen):
        e.handle(event)
    before = e.forecaster.learner.state.habits.price.now
    for event in roll(400, 600.0, 0.0, seen):
        e.handle(event)
    assert e.forecaster.learner.towed
    assert e.forecaster.learner.state.habits.price.now == pytest.approx(before, rel=0.02)


WITNESSES = {
    "motor": Group("Motor", ("motor_speed", "inverter_current"), 0.5),
    "wheel": Group("Wheel", ("wheel_speed_front", "motor_torque"), 0.5),
}
GPS = Group("GPS", ("gps_speed", "gps_altitude", "accel_x"), 0.5)


def stand(seconds: float, start: float, van: float, own: tuple[float, ...]) -> Iterator[Event]:
    """A scooter that stands, in a van that goes at about `van` [m/s], up and down."""
    for i in range(round(2 * seconds)):
        t, ridden = start + i / 2, i / 2
        speed, gained = van * (1 - cos(ridden / 20)) / 2, van * sin(ridden / 20) / 40  # m/s, m/s²
        height, rises = 300.0 + van * (1 - cos(ridden / 60)), van * sin(ridden / 60) / 60  # m, m/s
        yield t, 1, own
        yield t + 0.01, 2, (speed, height, gained + 9.81 * rises / max(speed, 0.5))
        yield t + 0.02, 0, (52.0, 45.0 / 52.0, 25.0)


@pytest.mark.parametrize("witness", WITNESSES)
def test_a_scooter_in_a_van_is_parked(witness):
    own = WITNESSES[witness]
    e = EventEstimator([PACK, own, GPS], VEHICLE.pack, VEHICLE.model, VEHICLE.riding)
    learner = e.forecaster.learner
    for event in stand(180, 0.0, 0.0, (0.0, 0.0)):
        e.handle(event)
    before = learner.state.habits, e.motion.distance
    seen = set()
    for event in stand(1200, 180.0, 15.0, (0.0, 0.0)):
        e.handle(event)
        seen.add((e.estimate(event[0]).activity, e.estimate(event[0]).distrusted))
    estimate = e.estimate(event[0])
    assert estimate.activity is Activity.PARKED
    assert not estimate.distrusted
    assert learner.state.habits == before[0]
    assert seen == {(Activity.PARKED, ())}
    assert e.motion.distance == before[1]
