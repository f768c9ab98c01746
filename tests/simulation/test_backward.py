"""The energy-only form against the model written out, and the forward simulation."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.backward import RideConditions, backward
from gz_onboard.model.effect import QUANTITIES
from gz_onboard.model.model import air_density
from gz_onboard.simulation.cycles import cycle
from gz_onboard.simulation.run import at_steps, drive, follow
from gz_onboard.simulation.scooter import Scooter
from gz_onboard.vehicle import read_vehicle

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
