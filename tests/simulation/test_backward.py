"""The energy-only form against the model written out, and the forward simulation."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.backward import RideConditions, backward
from gz_onboard.model.effect import QUANTITIES, load_effect
from gz_onboard.model.model import air_density
from gz_onboard.simulation.cycles import cycle
from gz_onboard.simulation.run import at_steps, drive, follow
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.vehicle import read_vehicle
from tests.support import joined

VEHICLE = read_vehicle("reference", 75.0)


def test_is_the_model_summed_up_step_by_step():
    t = np.array([0.0, 1.0, 2.5, 3.0, 5.0])
    v = np.array([0.0, 3.0, 9.0, 8.0, 2.0])
    grade = np.array([0.0, 0.02, 0.02, -0.01, 0.0])
    conditions = RideConditions(grade=grade, headwind=1.5, ambient=12.0, motor_temperature=40.0)
    energy = backward(VEHICLE, t, v, conditions, smoothing=0.0)
    total = 0.0
    for i in range(4):
        dt, sine = t[i + 1] - t[i], (grade[i] + grade[i + 1]) / 2
        q = dict.fromkeys(QUANTITIES, 0.0) | {
            "speed": (v[i] + v[i + 1]) / 2,
            "acceleration": (v[i + 1] - v[i]) / dt,
            "grade": sine,
            "grade_cosine": (1 - sine**2) ** 0.5,
            "mass": VEHICLE.model.mass,
            "headwind": 1.5,
            "air_density": air_density(12.0),
            "motor_temperature": 40.0,
        }
        total += sum(VEHICLE.model.power(q).values()) * dt
    assert energy.total == pytest.approx(total, rel=1e-12)
    assert sum(energy.ledger.values()) == pytest.approx(energy.total, rel=1e-9)
    assert energy.distance == pytest.approx(((v[1:] + v[:-1]) / 2 * np.diff(t)).sum())


def test_agrees_with_the_forward_simulation_on_a_cycle():
    """Beyond it the forward one has tyre slip, the rider, and no regeneration below walking pace: 5 % here."""
    c = cycle("wmtc_part1_reduced")
    speeds = at_steps(c.time, c.speed, 0.01)
    run = drive(Scooter(VEHICLE, soc=0.8), follow(speeds, 0.01), c.duration)
    energy = backward(VEHICLE, np.arange(len(speeds)) * 0.01, speeds, RideConditions(motor_temperature=25.0))
    assert energy.total == pytest.approx(run.energy, rel=0.05)
    for name in ("aerodynamic_drag", "rolling_resistance", "auxiliary_load", "motor_iron_loss"):
        assert energy.ledger[name] == pytest.approx(run.ledger[name], rel=0.03), name


@pytest.mark.parametrize("effects", [(), ("tyre_warm_up", "drivetrain_drag", "headwind")])
def test_blocks_are_one_ride(effects, monkeypatch):
    more = [load_effect(name) for name in effects]
    vehicle = VEHICLE.changed(joined(VEHICLE.parameters, more), (*VEHICLE.model.effects, *more))
    t = np.arange(0, 60, 0.01)
    v, grade = 8 + 4 * np.sin(t / 7), 0.02 * np.sin(t / 5)
    conditions = RideConditions(grade=grade, curvature=0.01 * np.cos(t / 3), headwind=2.0)
    whole = backward(vehicle, t, v, conditions)
    monkeypatch.setattr("benchmarks.backward.BLOCK", 700)
    parts = backward(vehicle, t, v, conditions)
    assert parts.power == pytest.approx(whole.power, rel=1e-12)
    assert parts.ledger == pytest.approx(whole.ledger, rel=1e-12)


def test_kinetic_energy_comes_back():
    t = np.arange(0, 100, 0.01)
    v = 8 + 3 * np.sin(t * 2 * np.pi / 20)
    energy = backward(VEHICLE, t, v, smoothing=0.0)
    assert abs(energy.ledger["inertia"]) < 1e-3 * energy.total


def test_a_noisy_speed_does_not_cost_more():
    rng = np.random.default_rng(1)
    t = np.arange(0, 300, 0.01)
    v = 10 + np.sin(t / 10)
    radius = VEHICLE.parameters["wheel_radius"]
    quantum = 0.1 * 2 * np.pi / 60 * radius  # 0.1 r/min
    noisy = np.round((v + rng.normal(0, 0.004, len(t))) / quantum) * quantum
    assert backward(VEHICLE, t, noisy).total == pytest.approx(backward(VEHICLE, t, v).total, rel=0.005)
    assert backward(VEHICLE, t, noisy, smoothing=0.0).total > 1.05 * backward(VEHICLE, t, v).total


def test_turning_is_seen_by_effects_that_look_for_it():
    from dataclasses import replace

    from gz_onboard.model.effect import load_effect
    from gz_onboard.model.model import Model

    effects = {e.name: e for e in VEHICLE.model.effects} | {"cornering_drag": load_effect("cornering_drag")}
    vehicle = replace(VEHICLE, model=Model(tuple(effects.values()), VEHICLE.parameters))
    t = np.arange(0, 60, 0.1)
    v = np.full_like(t, 8.0)
    bent = backward(vehicle, t, v, RideConditions(curvature=1 / 20))
    straight = backward(vehicle, t, v)
    assert bent.ledger["cornering_drag"] > 0
    assert straight.ledger["cornering_drag"] == 0


@pytest.mark.parametrize(
    ("t", "v"), [([0.0], [1.0]), ([0.0, 1.0], [1.0]), ([0.0, 1.0, 1.0], [1.0, 1.0, 1.0]), ([[0.0, 1.0]], [[1.0, 1.0]])]
)
def test_shapes_that_do_not_fit(t, v):
    with pytest.raises(ValueError, match="time"):
        backward(VEHICLE, t, v)
