"""The plant itself: it must be sound before a tool is judged by it."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gz_onboard.events import ROLES
from gz_onboard.recording.recording import read_recording
from tests.plant.cases import EFFECTS, RIDES, UNKNOWN, _draft
from tests.plant.logs import write_logs
from tests.plant.machine import G, scooter
from tests.plant.ride import STEP, Hidden, Ridden, ride
from tests.plant.roads import GRID, JOURNEY, plan
from tests.plant.sensors import measure
from tests.support import with_cell_voltages

FOLDER = Path(__file__).parent
WAYS = (("city", 80.0), ("oval", 100.0))
PLANS = [replace(plan(7 + i, kind, "B", 15.0, 0.7), duration=time) for i, (kind, time) in enumerate(WAYS)]
PLANS[1] = replace(PLANS[1], curvature=abs(PLANS[1].curvature))  # to the left


@pytest.fixture(scope="module")
def healthy() -> list[Ridden]:
    return ride(PLANS, [scooter(3)] * 2, [Hidden()] * 2)


def test_it_knows_of_the_package_nothing_but_the_form_of_a_ride():
    names = set()
    for file in FOLDER.glob("*.py"):
        if not file.name.startswith("test_"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.ImportFrom) and node.module:
                    names.add(node.module)
                elif isinstance(node, ast.Import):
                    names |= {alias.name for alias in node.names}
    assert {name for name in names if name.startswith("gz_onboard")} == {
        "gz_onboard.arrays",  # a type
        "gz_onboard.recording.recording",
    }


def test_a_ride_does_not_depend_on_its_company(healthy):
    alone = ride(PLANS[1:], [scooter(3)], [Hidden()])[0]
    for name, column in alone.columns.items():
        np.testing.assert_array_equal(column, healthy[1].columns[name])


def test_energy_and_charge_balance(healthy):
    """What the pack gave less all that can be reckoned from outside is heat: positive, and a part of it."""
    for ridden in healthy:
        c = {name: column.astype(float) for name, column in ridden.columns.items()}
        out = STEP * np.sum(c["pack_voltage"] * c["pack_current"])
        mass = ridden.machine.mass + ridden.plan.rider.mass
        kept = 0.5 * mass * c["speed"][-1] ** 2 + mass * G * (c["altitude"][-1] - 255.0)
        drag = STEP * np.sum(0.5 * 1.18 * ridden.machine.drag_area * c["speed"] ** 3)
        rolling = ridden.rolling * mass * G * c["distance"][-1]
        brakes = mass * STEP * np.sum(c["squeeze"] * c["speed"])
        lamps = STEP * np.sum(c["auxiliary_current"] * c["pack_voltage"])
        assert 0.55 * out < kept + drag + rolling + brakes + lamps < 0.9 * out
        capacity = ridden.machine.capacity * (1 - ridden.machine.capacity_temperature * 10)
        charge = STEP * np.sum(c["pack_current"]) / 3600 / 12
        assert c["soc"][0] - c["soc"][-1] == pytest.approx(charge / capacity, rel=0.02)
        np.testing.assert_allclose(c["distance"][-1], STEP * np.sum(c["speed"]), rtol=2e-3)


def test_what_is_wrong_costs_energy(healthy):
    wrong = [
        {"cornering": 0.3},
        {"rolling_factor": 1.4},
        {"drag_factor": 1.3},
        {"luggage": 40.0},
        {"pad_force": 10.0},
        {"warm_share": 0.8},
        {"wheel_viscous": 0.05},
        {"auxiliary": 60.0},
        {"copper": 0.03},
        {"switching": 1.0},
        {"recovery_lost": 0.8},
        {"band_force": 20.0},
        {"surge_loss": 8.0},
        {"steer_drag": 500.0},
        {"left_drag": 30.0},
    ]
    rides = ride([PLANS[1]] * len(wrong), [scooter(3)] * len(wrong), [Hidden(**w) for w in wrong])
    for fields, ridden in zip(wrong, rides, strict=True):
        assert ridden.energy_per_metre > 1.004 * healthy[1].energy_per_metre, fields


def test_sensors_lie_as_told():
    told = Hidden(current_factor=1.1, current_offset=1.0, voltage_offset=0.5, speed_factor=1.03, voltage_late=0.4)
    honest, lying = (measure(x, "x") for x in ride(PLANS[:1] * 2, [scooter(3)] * 2, [Hidden(), told]))

    def difference(role: str, gain: float = 1.0) -> float:
        return float(np.mean(lying.columns[role][1]) - gain * np.mean(honest.columns[role][1]))

    assert difference("pack_current", 1.1) == pytest.approx(1.0, abs=0.02)
    assert difference("pack_voltage") == pytest.approx(0.5, abs=0.05)
    assert difference("motor_speed", 1.03) == pytest.approx(0.0, abs=0.005)
    assert difference("wheel_speed_rear") == 0.0
    assert not np.array_equal(honest.columns["pack_voltage"][1] + 0.5, lying.columns["pack_voltage"][1])


def test_a_log_of_it_reads_back_as_it_is(tmp_path, healthy):
    sent = measure(healthy[0], "ride_000", cells=True)
    (file,) = write_logs([sent], tmp_path)
    read = read_recording(file, with_cell_voltages(tmp_path))
    assert read.facts == sent.facts
    assert set(read.columns) == set(sent.columns)
    assert set(sent.columns) >= set(ROLES) - {"vehicle_speed", "heater_power", "air_conditioner_power", "key", "rider"}
    for role, (times, values) in sent.columns.items():
        np.testing.assert_allclose(read.columns[role][1], values, atol=1e-9, err_msg=role)
        np.testing.assert_allclose(np.diff(read.columns[role][0]), np.diff(times), atol=2e-6, err_msg=role)


def test_all_that_can_be_hidden_is_drawn_and_no_kind_is_left_out():
    drafts = [_draft(seed) for seed in range(1500)]
    shares = {kind: sum(draft.kind == kind for draft in drafts) / len(drafts) for kind in {d.kind for d in drafts}}
    assert shares["healthy"] == pytest.approx(0.30, abs=0.04)
    assert shares["one"] == pytest.approx(0.40, abs=0.04)
    assert shares["unknown"] == pytest.approx(0.10, abs=0.03)
    assert {name for d in drafts if d.kind == "one" for name in d.parts} == set(EFFECTS)
    assert {name for d in drafts if d.kind == "unknown" for name in d.parts} == set(UNKNOWN)
    assert all(len(d.parts) == 2 for d in drafts if d.kind == "two")
    assert RIDES >= 4


def test_a_journey_goes_through_towns_and_between_them_and_up_for_good():
    way = plan(11, JOURNEY, "B", 15.0, 1.0, duration=5000.0)
    assert len(way.curvature) == len(way.grade) == len(way.speed)
    kilometres = np.abs(way.curvature)[: len(way.curvature) // 500 * 500].reshape(-1, 500).mean(axis=1)
    assert kilometres.max() > 3 * kilometres.min()  # towns bend, roads do not
    assert np.all(np.diff(way.stops) > 0) and way.stops[-2] < GRID * len(way.speed)
    there, suburb = (np.ptp(GRID * np.cumsum(x.grade)) for x in (way, plan(11, "suburban", "B", 15.0, 1.0)))
    assert there > 3 * suburb > 0  # m
