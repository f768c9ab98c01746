"""What moves without its motor: towed, pushed, or carried in a van."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from gz_onboard.estimator.estimator import Estimator
from gz_onboard.events import Event, Group
from gz_onboard.vehicle import read_vehicle

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
    e = Estimator(groups, VEHICLE.pack, VEHICLE.model, VEHICLE.riding)
    for event in roll(600, 0.0, 390.0, seen):
        e.handle(event)
    before = e.forecaster.riding.usual.price.now
    for event in roll(400, 600.0, 0.0, seen):
        e.handle(event)
    assert e.forecaster.riding.carried
    assert e.forecaster.riding.usual.price.now == pytest.approx(before, rel=0.02)
