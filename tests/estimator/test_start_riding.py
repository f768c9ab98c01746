"""The first state of charge of a vehicle that is already under way."""

from __future__ import annotations

from dataclasses import replace
from math import exp

import pytest

from gz_onboard.estimator.battery_pack import PACK
from gz_onboard.estimator.load_model import Conditions
from gz_onboard.events import Group
from gz_onboard.model.effect import Port
from gz_onboard.model.model import Model
from gz_onboard.vehicle import read_vehicle
from tests.events import EventEstimator


def test_at_full_speed_the_polarisation_is_that_of_full_speed():
    """Begun on a fast road: more has relaxed than in the town that the prior riding is of. The ride is a while old."""
    vehicle = read_vehicle("reference", 75.0)
    battery, model = vehicle.pack, vehicle.model
    groups = [
        Group("Pack", ("pack_current", "pack_voltage"), 0.1),
        Group("Speed", ("vehicle_speed",), 0.1),
        Group("Cells", ("cell_temperature",), 1.0),
    ]
    e = EventEstimator(groups, battery, model, vehicle.riding)
    speed, soc = 18.0, 0.6
    power = e.forecaster.load.power(e.forecaster.load.quantities(speed, 0.0, Conditions(17.0, 0.0)))
    reaction = Model(tuple(x for x in model.effects if x.name != "slow_relaxation"), model.parameters)
    settled, p = reaction.overpotential(battery), model.parameters
    slow = p["slow_resistance"] * (1 - exp(-PACK.joined_s / p["slow_time"]))

    def lost(current: float, soc: float, temperature: float, form_factor_squared: float) -> float:
        return slow * current + (settled(current, soc, temperature, form_factor_squared) if settled else 0.0)

    current = battery.settled_current(power, soc, 20.0, overpotential=lost) or 0.0
    for i in range(30):
        e.handle((i * 0.1, 2, (20.0,)))
        e.handle((i * 0.1 + 0.01, 1, (speed,)))
        e.handle((i * 0.1 + 0.02, 0, (current, power / current)))
    assert e.pack.is_started
    assert e.pack.state.soc == pytest.approx(soc, abs=0.04)


@pytest.mark.parametrize("guess", [0.0, 0.6])
def test_a_series_resistance_that_r0_holds_already_does_not_hide_what_the_current_explains(guess):
    """A vehicle of which only the voltage's drop is known: all of it is in r0, and a guess lies beside."""
    vehicle = read_vehicle("reference", 75.0)
    cells = vehicle.pack
    r0 = cells.r0.at(0.6, 20.0)[0]
    guessed = guess * r0 * cells.cells_series / cells.cells_parallel
    groups = [Group("Pack", ("pack_current", "pack_voltage"), 0.1), Group("Cells", ("cell_temperature",), 1.0)]
    effects = tuple(x for x in vehicle.model.effects if x.port is not Port.CELL_VOLTAGE)
    model = Model(effects, vehicle.model.parameters)
    e = EventEstimator(groups, replace(cells, series_resistance=guessed), model, vehicle.riding)
    for i in range(300):
        current = 40.0 if i // 20 % 2 else 5.0
        e.handle((i * 0.1, 1, (20.0,)))
        e.handle((i * 0.1 + 0.02, 0, (current, cells.cells_series * (3.75 - r0 * current / cells.cells_parallel))))
    assert e.electrical.sag.explained
