"""The residuals of the cells: where a ride begins, what heats, what was drawn, all by what the sensors really saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gz_onboard.discovery.grid import STEP, Ride
from gz_onboard.discovery.mixed_model import MixedModel, initial
from gz_onboard.discovery.residuals import cell_temperature, counted_soc, start_soc
from gz_onboard.model.model import standing_load
from gz_onboard.offline.samples import Samples
from gz_onboard.offline.series import all_quantities, total
from gz_onboard.vehicle import read_vehicle
from tests.support import cell_voltage

SECONDS, COLD, AMPERES, SOC = 120, 5.0, 30.0, 0.15


@pytest.fixture(scope="module")
def mixed() -> MixedModel:
    vehicle = read_vehicle("reference")
    wrong = {"pack_current_offset": 1.0, "pack_current_gain": 1.05, "pack_voltage_offset": 0.3}
    return initial(replace(vehicle, parameters=vehicle.parameters.replaced(**wrong)))


@pytest.fixture(scope="module")
def ride(mixed: MixedModel) -> Ride:
    """Steady, on a cold and nearly empty pack with its lights on before; as its sensors show it."""
    battery, p = mixed.system.pack, mixed.vehicle.parameters
    cell = cell_voltage(battery, SOC, 0.0, AMPERES / battery.cells_parallel, COLD)
    load = standing_load(AMPERES, battery.pack_voltage(cell, AMPERES), p["auxiliary_power"]) / battery.cells_parallel
    settled = [e for e in mixed.system.cells if e.effect.name == "charge_transfer"]  # what is slower is left at rest
    cell -= total(settled, all_quantities(cell_current=load, cell_temperature=COLD))
    time = np.arange(0.0, SECONDS, 0.05)
    shown = {
        "motor_speed": 30.0,
        "motor_current": 20.0,
        "ambient_temperature": COLD,
        "cell_temperature": COLD,
        "pack_voltage": battery.pack_voltage(cell, AMPERES) + p["pack_voltage_offset"],
        "pack_current": AMPERES * p["pack_current_gain"] + p["pack_current_offset"],
    }
    columns = {role: (time, np.full(len(time), value)) for role, value in shown.items()}
    return mixed.ride(Samples("made up", columns, {}))


def test_a_ride_begins_where_its_first_voltages_under_load_point_to(mixed: MixedModel, ride: Ride):
    assert start_soc(ride, mixed.system) == pytest.approx(SOC, abs=1e-3)
    taken = AMPERES * STEP * len(ride.time) / (3600 * mixed.system.pack.pack_capacity(COLD))
    assert counted_soc(ride, mixed.system)[-1] == pytest.approx(SOC - taken, abs=1e-3)


def test_what_was_drawn_is_what_the_sensors_really_saw(mixed: MixedModel, ride: Ride):
    volts = ride.signals["pack_voltage"][0] - 0.3
    assert ride.energy == pytest.approx(volts * AMPERES * STEP * len(ride.time))
    assert ride.quantities["pack_current"] == pytest.approx(AMPERES)


def test_a_rest_voltage_that_is_off_heats_nothing(mixed: MixedModel, ride: Ride):
    off = {"ocv_offset": 0.05, "ocv_tilt": 0.05, "ocv_cold": 0.05}
    healthy = cell_temperature(ride, mixed.values, mixed.system)
    assert cell_temperature(ride, mixed.values | off, mixed.system) == pytest.approx(healthy, abs=1e-9)
