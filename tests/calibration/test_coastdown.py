"""Coast-downs: recovery from a plant of its own, what is refused, the project's recorded run, other people's."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gz_onboard.calibration.coastdown import NAMES, coast_downs
from gz_onboard.cli import main
from gz_onboard.errors import InputError
from gz_onboard.recording.recording import Recording
from gz_onboard.vehicle import read_vehicle

VEHICLE = read_vehicle("reference")
DT = 0.1


def plant(seed, trials=1, runs=6, **fixed):
    """(runs, truth) of each trial: coast-downs of a scooter that is not the package's, drawn by seed.

    Own equations, Euler. Each run has a wind with gusts (Ornstein-Uhlenbeck) that blows across too, its own temperature
    and a speed sensor with noise and steps; mass, inertia, iron drag and the wheel's radius are drawn about what the
    vehicle file says of them, by its standard deviations, and so is the weather's pressure.
    """
    rng = np.random.default_rng(seed)
    p, shape = VEHICLE.parameters, (trials, 1)
    draw = {
        name: p[name] + p.sd(name) * rng.standard_normal(shape)
        for name in (
            "vehicle_mass",
            "wheel_inertia_front",
            "wheel_inertia_rear",
            "motor_iron_linear",
            "motor_iron_quadratic",
            "wheel_radius",
        )
    }
    low, high = (0.008, 0.0, 0.4), (0.016, 6e-4, 0.7)
    truth = {
        name: np.full(shape, fixed.get(name, rng.uniform(a, b, shape)))
        for name, a, b in zip(NAMES, low, high, strict=True)
    }
    c0, c1, area = (truth[name] for name in NAMES)
    mass = draw["vehicle_mass"] + 75 + rng.standard_normal(shape)
    radius = draw["wheel_radius"]
    inertia = mass + (draw["wheel_inertia_front"] + draw["wheel_inertia_rear"]) / radius**2
    slope = rng.uniform(-0.005, 0.005, shape)
    way = np.where(np.arange(runs) % 2, -1, 1)
    celsius = rng.uniform(8, 28, (trials, runs))
    weather = 1 + 0.012 * rng.standard_normal(shape)
    density = weather * 101325 * np.exp(-250 / 8300) / (287.05 * (celsius + 273.15))
    mean, cross = rng.standard_normal((2, trials, runs))
    strength, lasting = rng.uniform(0.3, 0.8, (trials, runs)), rng.uniform(2, 12, (trials, runs))
    v = 13.0 + rng.uniform(0, 0.5, (trials, runs))
    gust = strength * rng.standard_normal((trials, runs))
    speed: list[Any] = []
    while len(speed) < 200 / DT and v.max() > 0.3:
        speed.append(v)
        gust = gust - gust / lasting * DT + strength * np.sqrt(2 * DT / lasting) * rng.standard_normal(gust.shape)
        flow = v + mean + gust
        air = 0.5 * density * area * flow * np.hypot(flow, 0.3 * cross)
        drag = (draw["motor_iron_linear"] + draw["motor_iron_quadratic"] * v / radius) / radius
        v = np.maximum(v - DT / inertia * (air + mass * 9.80665 * (c0 + c1 * v + way * slope) + drag), 0.05)
    rolled, time = np.array(speed), DT * np.arange(len(speed))
    result = []
    for i in range(trials):
        samples = []
        for r in range(runs):
            end = int(np.argmax(rolled[:, i, r] < 0.3)) or len(time)
            wheel = rolled[:end, i, r] / radius[i, 0] + 0.06 * rng.standard_normal(end)
            columns: Any = {
                "motor_speed": (time[:end], np.round(wheel / 0.01) * 0.01),
                "ambient_temperature": (time[:2], np.full(2, celsius[i, r])),
                "gps_altitude": (time[:2], np.full(2, 250.0)),
            }
            facts: dict[str, object] = {"rider_mass_kg": 75.0, "direction": "up" if way[r] > 0 else "down"}
            samples.append(Recording(f"run_{r}", columns, facts))
        result.append((samples, {name: float(values[i, 0]) for name, values in truth.items()}))
    return result


def test_intervals_hold_the_truth():
    away = []
    for runs, truth in plant(1, trials=100):
        found = coast_downs(runs, VEHICLE, hold_out=False).parameters
        away.append([(found[name].value - truth[name]) / found[name].sd for name in NAMES])
    held = dict(zip(NAMES, np.mean(np.abs(away) < 1.96, axis=0), strict=True))
    for name in NAMES:
        assert 0.9 <= held[name] <= 0.99, held


@pytest.fixture(scope="module")
def healthy():
    return plant(7)[0]


def test_left_out_pairs_are_followed(healthy):
    found = coast_downs(healthy[0], VEHICLE)
    (fit,) = (fit for fit in found.fits if fit.held_out)
    assert fit.largest < 2.0  # m/s: the thesis' figure
    assert fit.points > 100


def test_a_speed_term_that_does_not_show_is_refused_with_its_number():
    every = [coast_downs(plant(i, rolling_resistance_speed=0.0)[0][0], VEHICLE, hold_out=False) for i in range(3, 9)]
    refused = [found for found in every if found.parameters["rolling_resistance_speed"].value == 0]
    assert len(refused) >= 5  # it is given from 2 sd on: by chance of one in forty
    assert all("indistinguishable from zero" in found.refusals[0] for found in refused)
    assert all("·10⁻⁵ s/m" in found.refusals[0] for found in refused)


def test_a_speed_term_that_shows_is_given():
    found = coast_downs(plant(3, rolling_resistance_speed=1.5e-3)[0][0], VEHICLE, hold_out=False)
    speed = found.parameters["rolling_resistance_speed"]
    assert not found.refusals
    assert abs(speed.value - 1.5e-3) < 2.5 * speed.sd


def test_one_direction_leaves_slope_and_rolling_resistance_together(healthy):
    runs, truth = healthy
    found = coast_downs(runs[::2], VEHICLE, hold_out=False)
    assert "rolling_resistance_constant" not in found.parameters
    assert any("all runs go one way (up)" in text and "± 0.01" in text for text in found.refusals)
    drag = found.parameters["drag_area"]
    assert abs(drag.value - truth["drag_area"]) < 3 * drag.sd


def changed(run, **columns):
    return replace(run, columns={role: x for role, x in (run.columns | columns).items() if x is not None})


def short(runs):
    time, speed = runs[0].columns["motor_speed"]
    return [changed(runs[0], motor_speed=(time[:80], speed[:80])), *runs[1:]]


def rising(runs):
    time, speed = runs[0].columns["motor_speed"]
    return [changed(runs[0], motor_speed=(time, speed + 12 * np.exp(-(((time - 40) / 4) ** 2)))), *runs[1:]]


def driven(runs):
    time, _ = runs[0].columns["motor_speed"]
    current = np.where((time > 20) & (time < 24), 9.0, -0.3)
    return [changed(runs[0], motor_current=(time, current)), *runs[1:]]


def said(runs, words):
    return [replace(run, facts={"direction": word} if word else {}) for run, word in zip(runs, words, strict=False)]


@pytest.mark.parametrize(
    ("spoilt", "message"),
    [
        (short, r"run_0: too short a coast-down: 7\.\d s"),
        (rising, "run_0: the speed rises from"),
        (driven, r"run_0: the motor drives while it should coast: 9\.0 A"),
        (lambda runs: runs[:1], "at least 2"),
        (lambda runs: [runs[0], runs[0]], "given twice"),
        (lambda runs: [changed(runs[0], motor_speed=None), runs[1]], "has no speed"),
        (lambda runs: [changed(runs[0], ambient_temperature=None), runs[1]], "ambient_C"),
        (lambda runs: said(runs, ["", "", ""]), "neither noted"),
        (lambda runs: said(runs, "abc"), "3 directions"),
    ],
)
def test_runs_that_are_no_coast_downs_are_refused(healthy, spoilt, message):
    with pytest.raises(InputError, match=message):
        coast_downs(spoilt(list(healthy[0])), VEHICLE)


def test_tables_of_speed_are_read_as_rides(tmp_path, healthy, capsys):
    """By the command: speeds in CSV, facts beside them."""
    runs, truth = healthy
    notes = []
    for run in runs:
        time, speed = run.columns["motor_speed"]
        celsius = float(run.columns["ambient_temperature"][1][0])
        notes.append({"name": run.name, "ambient_C": celsius, **run.facts})
        rows = zip(time, speed * VEHICLE.parameters["wheel_radius"] * 3.6, strict=True)
        lines = ["time [s],speed [km/h]", *(f"{t:.2f},{v:.4f}" for t, v in rows)]
        (tmp_path / f"{run.name}.csv").write_text("\n".join(lines) + "\n")
    (tmp_path / "rides.json").write_text(json.dumps(notes))
    assert main(["calibrate", "coastdown", *(str(tmp_path / f"{run.name}.csv") for run in runs), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["procedures"]
    for name in ("rolling_resistance_constant", "drag_area"):
        assert abs(found["parameters"][name]["value"] - truth[name]) < 3 * found["parameters"][name]["sd"]
