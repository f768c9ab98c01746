"""The forward model: its ledger against an independent calculation and the balance of energy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.model.model import air_density
from gz_onboard.vehicle import read_vehicle

VEHICLE = read_vehicle("reference")
MODEL = VEHICLE.model
P = VEHICLE.parameters

ridings = st.fixed_dictionaries(
    {
        "speed": st.floats(0, 30),
        "acceleration": st.floats(-4, 4),
        "grade": st.floats(-0.15, 0.15),
        "headwind": st.floats(-8, 8),
        "air_density": st.floats(1.0, 1.4),
        "motor_temperature": st.floats(-20, 150),
    }
)


def complete(q):
    return {**q, "mass": MODEL.mass, "grade_cosine": math.sqrt(1 - q["grade"] ** 2)}


@given(ridings)
def test_ledger_against_the_equations_written_out(q):
    """Not by the effects: one expression for the road load, one for each loss, from the thesis' equations."""
    v, m, r = q["speed"], MODEL.mass, P["wheel_radius"]
    flow = v + q["headwind"]
    inertia = m + (P["wheel_inertia_front"] + P["wheel_inertia_rear"]) / r**2
    force = (
        0.5 * q["air_density"] * P["drag_area"] * flow * abs(flow)
        + m
        * 9.80665
        * math.sqrt(1 - q["grade"] ** 2)
        * (P["rolling_resistance_constant"] * v / math.hypot(v, 0.1) + P["rolling_resistance_speed"] * v)
        + m * 9.80665 * q["grade"]
        + inertia * q["acceleration"]
    )
    torque = max(force * r, -P["regeneration_torque_limit"])
    speed = v / r
    iron = P["motor_iron_linear"] * speed + P["motor_iron_quadratic"] * speed**2
    current = (torque + iron * speed / (speed**2 + 0.01)) / P["torque_constant"]  # in the air gap
    copper = P["motor_copper_resistance"] * (1 + 0.00393 * (q["motor_temperature"] - 25)) * current**2
    copper *= 1 + P["motor_copper_frequency"] * speed**2
    inverter = (
        P["inverter_loss_constant"]
        + P["inverter_loss_linear"] * abs(current)
        + P["inverter_loss_quadratic"] * current**2
    )
    expected = torque * speed + copper + iron + inverter + P["auxiliary_power"]
    assert sum(MODEL.power(complete(q)).values()) == pytest.approx(expected, rel=1e-9, abs=1e-6)


@given(st.lists(ridings, min_size=1, max_size=6))
def test_arrays_equal_scalars(rows):
    rows = [complete(row) for row in rows]
    arrays = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    together = MODEL.power(arrays)
    for i, row in enumerate(rows):
        for name, value in MODEL.power(row).items():
            assert np.broadcast_to(together[name], len(rows))[i] == pytest.approx(value, rel=1e-9, abs=1e-9)


def test_out_and_back_over_a_hill_costs_but_never_gives():
    """Kinetic and potential energy are given back at best: a round trip has a positive sum."""
    total = 0.0
    for grade in (0.05, -0.05):
        q = complete(
            {
                "speed": 8.0,
                "acceleration": 0.0,
                "grade": grade,
                "headwind": 0.0,
                "air_density": 1.2,
                "motor_temperature": 40.0,
            }
        )
        total += sum(MODEL.power(q).values())
    flat = complete(
        {
            "speed": 8.0,
            "acceleration": 0.0,
            "grade": 0.0,
            "headwind": 0.0,
            "air_density": 1.2,
            "motor_temperature": 40.0,
        }
    )
    assert total > 2 * sum(MODEL.power(flat).values())


def test_air_density_of_the_standard_atmosphere():
    """ISO 2533, table 1: 15 degC at sea level 1.225; 8.5 degC at 1000 m 1.1116 kg/m³."""
    assert air_density(15.0) == pytest.approx(1.225, rel=1e-3)
    assert air_density(8.501, 1000.0) == pytest.approx(1.1116, rel=1e-3)


def test_a_motor_without_current_takes_nothing_from_the_pack_and_slows_the_scooter():
    """Iron loss is drag: at the deceleration that it makes, current and copper loss are nought."""
    v = 10.0
    speed = v / P["wheel_radius"]
    iron = P["motor_iron_linear"] * speed + P["motor_iron_quadratic"] * speed**2
    q = {"speed": v, "acceleration": 0.0, "grade": 0.0, "headwind": 0.0, "air_density": 1.2, "motor_temperature": 40.0}
    level = MODEL.power(complete(q))
    force = sum(level[name] for name in ("aerodynamic_drag", "rolling_resistance")) / v
    inertia = MODEL.mass + (P["wheel_inertia_front"] + P["wheel_inertia_rear"]) / P["wheel_radius"] ** 2
    rolling = MODEL.power(complete(q | {"acceleration": -(force + iron / v) / inertia}))
    assert rolling["motor_copper_loss"] == pytest.approx(0, abs=1e-4)
    idle = P["inverter_loss_constant"] + P["auxiliary_power"]
    assert sum(rolling.values()) == pytest.approx(idle, abs=0.05)
