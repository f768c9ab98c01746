"""The assembled scooter: balance of energy, step halving, standstill, replaceable parts."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.simulation.parts import Rider, straight
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.vehicle import read_vehicle
from tests.support import without_cell_effects

VEHICLE = without_cell_effects(read_vehicle("reference", 75.0))
BATTERY = VEHICLE.pack


def follow(scooter, profile, seconds):
    rider = Rider()
    for i in range(round(seconds / scooter.dt)):
        scooter.step(*rider.step(profile(i * scooter.dt), scooter.speed, scooter.dt))
    return scooter


def closure(scooter, kinetic):
    """(energy out of the cells, energy accounted for) [J]; the first from the state of charge alone."""
    accounted = sum(scooter.ledger.values()) + scooter.kinetic_energy() - kinetic + scooter.potential_energy()
    return scooter.pack.chemical_energy_drawn(), accounted


def town(t):
    return max(0.0, 8 + 4 * math.sin(t / 13)) if 5 < t % 90 < 70 else 0.0


@settings(max_examples=25, deadline=None)
@given(
    soc=st.floats(0.15, 0.98),
    ambient=st.floats(-5, 38),
    grade=st.floats(-0.08, 0.08),
    wind=st.floats(-6, 6),
    ride=st.lists(st.tuples(st.floats(0, 1), st.floats(0, 1), st.integers(20, 300)), min_size=1, max_size=8),
)
def test_the_ledger_closes_over_any_ride(soc, ambient, grade, wind, ride):
    scooter = Scooter(VEHICLE, straight(grade, wind), soc=soc, ambient=ambient)
    for throttle, brake, steps in ride:
        for _ in range(steps):
            scooter.step(throttle if brake < 0.5 else 0.0, brake if brake >= 0.5 else 0.0)
    drawn, accounted = closure(scooter, 0.0)
    turnover = sum(abs(x) for x in scooter.ledger.values()) + scooter.kinetic_energy()
    assert math.isfinite(scooter.speed)
    assert abs(drawn - accounted) < 1e-4 * turnover


def test_halving_the_step_changes_energy_by_less_than_a_thousandth():
    coarse, fine = (follow(Scooter(VEHICLE, soc=0.8, dt=dt), town, 300) for dt in (0.01, 0.005))
    assert coarse.pack.chemical_energy_drawn() == pytest.approx(fine.pack.chemical_energy_drawn(), rel=1e-3)
    assert coarse.distance == pytest.approx(fine.distance, rel=1e-3)


@pytest.mark.parametrize(
    ("grade", "brake"), [(-0.12, 0.8), (-0.05, 0.8), (0.05, 0.8), (0.12, 0.8), (0.15, 0.3), (-0.15, 0.3), (0.25, 0.6)]
)
def test_braked_on_a_hill_it_comes_to_rest_and_stays(grade, brake):
    """As long as both brakes together can hold it, which at 0.3 of the lever is 18 %."""
    scooter = Scooter(VEHICLE, straight(grade), soc=0.8, speed=6.0)
    for _ in range(1500):
        scooter.step(0.0, brake)
    stood = scooter.distance
    for _ in range(3000):
        scooter.step(0.0, brake)
        assert abs(scooter.speed) < 1e-6
    assert abs(scooter.distance - stood) < 1e-4
    p = VEHICLE.parameters
    most = brake * p["brake_torque_limit"] / p["wheel_radius"]
    on_front = VEHICLE.model.mass * 9.80665 * grade - scooter.force  # how they share it is as they came to rest
    assert abs(on_front) < 1.001 * p["front_brake_share"] * most
    assert abs(scooter.force) < 1.001 * (1 - p["front_brake_share"]) * most


def test_a_hill_beyond_the_brakes_is_rolled_down():
    scooter = Scooter(VEHICLE, straight(0.15), soc=0.8)
    for _ in range(500):
        scooter.step(0.0, 0.1)
    p = VEHICLE.parameters
    expected = VEHICLE.model.mass * 9.80665 * 0.15 - 0.1 * p["brake_torque_limit"] / p["wheel_radius"]
    assert scooter.speed < -1.0
    assert scooter.speed == pytest.approx(-expected / VEHICLE.model.mass * 5, rel=0.25)


def test_coasting_down_against_a_fine_integration_written_out():
    """Eqs. 3.1-3.3 and 3.9 with the motor's iron drag and no current: another integrator, other code."""
    p = VEHICLE.parameters
    scooter = Scooter(VEHICLE, soc=0.8, speed=12.0)
    for _ in range(3000):
        scooter.step(0.0, 0.0)
    density = 101325 / (287.05 * 293.15)
    mass = VEHICLE.model.mass
    inertia = mass + (p["wheel_inertia_front"] + p["wheel_inertia_rear"]) / p["wheel_radius"] ** 2
    v, dt = 12.0, 1e-3
    for _ in range(30_000):
        drag = 0.5 * density * p["drag_area"] * v * v
        rolling = mass * 9.80665 * (p["rolling_resistance_constant"] + p["rolling_resistance_speed"] * v)
        iron = p["motor_iron_linear"] / p["wheel_radius"] + p["motor_iron_quadratic"] * v / p["wheel_radius"] ** 2
        v -= dt * (drag + rolling + iron) / inertia
    assert scooter.speed == pytest.approx(v, abs=0.02)
    assert scooter.motor_current == 0


def test_cold_hot_and_empty_are_derated():
    def pulled(**start):
        scooter = Scooter(VEHICLE, **{"soc": 0.8, **start})
        for _ in range(300):
            scooter.step(1.0, 0.0)
        return scooter.speed

    assert pulled() > pulled(soc=0.02)
    assert pulled() > pulled(cell_temperature=-15.0)


@pytest.mark.parametrize(("soc", "ambient"), [(0.12, -5.0), (0.1, 20.0), (0.3, -10.0)])
def test_held_back_by_its_voltage_it_does_not_chatter(soc, ambient):
    """Current sags the voltage, which limits the current: a loop that must not swing from step to step."""
    scooter = Scooter(VEHICLE, straight(0.03), soc=soc, ambient=ambient)
    voltage = []
    for _ in range(1000):
        scooter.step(1.0, 0.0)
        voltage.append(scooter.voltage)
    assert max(abs(b - a) for a, b in pairwise(voltage[200:])) < 0.2
    assert scooter.motor_current < 0.95 * VEHICLE.parameters["motor_current_limit"]
