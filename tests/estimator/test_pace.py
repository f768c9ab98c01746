"""Speed and current of a step belong together, however often they come."""

from __future__ import annotations

import pytest

from gz_onboard.events import Group
from gz_onboard.vehicle import read_vehicle
from tests.events import EventEstimator

VEHICLE = read_vehicle("reference", 75.0)
OFFSET, GAIN = VEHICLE.parameters["pack_current_offset"], VEHICLE.parameters["pack_current_gain"]


@pytest.mark.parametrize("period", [0.1, 0.5, 1.0])
def test_a_step_has_the_pack_of_its_own_time(period):
    """A row of a table: all at one time, the voltage last. Speed and current of a step belong together."""
    groups = [Group(role, (role,), period) for role in ("vehicle_speed", "pack_current", "pack_voltage")]
    e = EventEstimator(groups, VEHICLE.pack, VEHICLE.model, VEHICLE.riding)
    for i in range(20):
        now = i * period
        for group, value in enumerate((5.0 + i * 0.1, OFFSET + GAIN * i, 54.0)):
            e.handle((now, group, (value,)))
        assert e.estimate(now).pack_current == pytest.approx(i)
        assert e.estimate(now).speed == pytest.approx(5.0 + i * 0.1)


def test_without_the_pack_steps_are_made_all_the_same():
    groups = [Group(role, (role,), 0.5) for role in ("vehicle_speed", "pack_current", "pack_voltage")]
    e = EventEstimator(groups, VEHICLE.pack, VEHICLE.model, VEHICLE.riding)
    for i in range(40):
        for group, value in enumerate((5.0 + i * 0.1, 10.0, 54.0)):
            if group == 0 or i < 20:
                e.handle((i * 0.5, group, (value,)))
    assert e.estimate(19.5).speed == pytest.approx(8.9)
