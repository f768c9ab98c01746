"""The first state of charge of a vehicle that is already under way."""

from __future__ import annotations

import pytest

from gz_onboard.estimator.estimator import Estimator
from gz_onboard.estimator.load_model import Conditions
from gz_onboard.events import Group
from gz_onboard.vehicle import read_vehicle


def test_at_full_speed_the_polarisation_is_that_of_full_speed():
    """Begun on a fast road: more has relaxed than in the town that the prior riding is of."""
    vehicle = read_vehicle("reference", 75.0)
    battery, model = vehicle.pack, vehicle.model
    groups = [
        Group("Pack", ("pack_current", "pack_voltage"), 0.1),
        Group("Speed", ("vehicle_speed",), 0.1),
        Group("Cells", ("cell_temperature",), 1.0),
    ]
    e = Estimator(groups, battery, model, vehicle.riding)
    speed, soc = 18.0, 0.6
    power = e.forecaster.load.power(e.forecaster.load.quantities(speed, 0.0, Conditions(17.0, 0.0)))
    current = battery.settled_current(power, soc, 20.0, overpotential=model.overpotential(battery)) or 0.0
    for i in range(30):
        e.handle((i * 0.1, 2, (20.0,)))
        e.handle((i * 0.1 + 0.01, 1, (speed,)))
        e.handle((i * 0.1 + 0.02, 0, (current, power / current)))
    assert e.filter is not None
    assert e.filter.soc == pytest.approx(soc, abs=0.04)
