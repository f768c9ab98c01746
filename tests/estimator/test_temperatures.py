"""Cells whose sensor is silent warm by their own heat and cool as their pack does."""

from __future__ import annotations

import pytest

from gz_onboard.events import Group
from gz_onboard.model.cooling import LumpedCooling
from gz_onboard.model.series import advanced
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.events import EventEstimator
from tests.support import cell_voltage

VEHICLE = read_vehicle("reference", 75.0)
AMBIENT, CELLS, AMPERES, DT = 5.0, 12.0, 30.0, 0.1  # degC, degC, A, s
PACK, MOTOR, THERMAL, AIR = range(4)
GROUPS = [
    Group("Pack", ("pack_voltage", "pack_current"), DT),
    Group("Motor", ("motor_speed",), DT),
    Group("Cells", ("cell_temperature",), 1.0),
    Group("Air", ("ambient_temperature",), 1.0),
]


def ridden(vehicle: Vehicle, seconds: float, cells: float = 60.0, air: float = 1e9) -> EventEstimator:
    """At a steady current at the voltage of the model; cells, air [s]: when their sensors fall silent."""
    battery, p = vehicle.pack, vehicle.parameters
    e, soc, v1 = EventEstimator(GROUPS, battery, vehicle.model, vehicle.riding), 0.9, 0.0
    for step in range(round(seconds / DT)):
        t, current = step * DT, 0.5 if step < 30 else AMPERES
        cell = current / battery.cells_parallel
        soc, v1 = advanced(battery, DT, soc, v1, cell, CELLS)
        lost = e.pack.effects.overpotential
        volts = battery.pack_voltage(cell_voltage(battery, soc, v1, cell, CELLS) - lost, current)
        if step % 10 == 0 and t < cells:
            e.handle((t, THERMAL, (CELLS,)))
        if step % 10 == 0 and t < air:
            e.handle((t, AIR, (AMBIENT,)))
        e.handle((t, MOTOR, (0.0 if step < 30 else 30.0,)))
        e.handle((t, PACK, (volts, current * p["pack_current_gain"] + p["pack_current_offset"])))
    return e


def by_network(vehicle: Vehicle, seconds: float) -> float:
    """The cells' temperature [degC] by the pack's cooling network, written out."""
    battery, p = vehicle.pack, vehicle.parameters
    network, cell = LumpedCooling(p, "pack", CELLS), AMPERES / battery.cells_parallel
    r0, r1, _ = battery.circuit(0.85, CELLS)
    lost = r0 * cell + r1 * cell + ridden(vehicle, 60.0).pack.effects.overpotential
    watts = battery.cells_series * lost * AMPERES + p["pack_series_resistance"] * AMPERES**2
    watts += battery.reversible_heat(AMPERES, 0.85, CELLS)
    for _ in range(round(seconds)):
        network.step(1.0, watts, AMBIENT, factor=p["cooling_factor"])
    return network.temperature


@pytest.mark.parametrize("light", [1.0, 0.5])
def test_they_warm_by_what_they_lose_over_what_the_pack_holds(light: float) -> None:
    p = VEHICLE.parameters
    vehicle = VEHICLE.changed(p.replaced(pack_heat_capacity=light * p["pack_heat_capacity"]))
    found = ridden(vehicle, 300.0).estimate(300.0).cell_temperature
    assert found is not None
    assert found - CELLS == pytest.approx(by_network(vehicle, 235.0) - CELLS, rel=0.15)
    assert found - CELLS > 1.0


def test_they_cool_to_the_air_over_a_gap_and_no_further() -> None:
    e = ridden(VEHICLE, 120.0)
    e.handle((30 * 86400.0, AIR, (AMBIENT,)))
    e.handle((30 * 86400.0 + 0.1, PACK, (54.0, 0.5)))
    assert e.estimate(30 * 86400.0 + 0.2).cell_temperature == pytest.approx(AMBIENT, abs=0.1)


def test_air_that_is_not_measured_is_as_much_colder_than_the_cells_as_their_heat_makes_it() -> None:
    e = ridden(VEHICLE, 300.0, cells=1e9, air=60.0)
    assert e._temperatures.ambient(299.9) == pytest.approx(AMBIENT, abs=2.5)
    never = ridden(VEHICLE, 10.0, cells=1e9, air=0.0)
    assert never._temperatures.ambient(9.9) == pytest.approx(CELLS, abs=0.1)
