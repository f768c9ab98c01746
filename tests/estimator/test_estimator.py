"""The estimator, fed with events from a plant of another kind: two RC branches, other numbers, other code."""

from __future__ import annotations

import json
from dataclasses import dataclass
from math import exp

import numpy as np
import pytest

from gz_onboard.estimator.battery_filter import with_soc
from gz_onboard.events import Group, Reason, State
from gz_onboard.vehicle import read_vehicle
from tests.events import EventEstimator

VEHICLE = read_vehicle("reference", 75.0)
BATTERY = VEHICLE.pack
GROUPS = [
    Group("Pack", ("pack_voltage", "pack_current"), 0.1),
    Group("Motor", ("motor_speed",), 0.05),
    Group("Inverter", ("inverter_voltage", "inverter_current"), 0.1),
    Group("Cells", ("cell_temperature", "ambient_temperature"), 1.0),
    Group("Imu", ("accel_x", "accel_y", "rate_x", "rate_z"), 0.1),
    Group("Gps", ("gps_speed", "gps_course", "gps_altitude", "gps_fix"), 0.2),
]
PACK, MOTOR, INVERTER, CELLS, IMU, GPS = range(6)


@dataclass
class Plant:
    """A pack with a fast and a slow RC branch and a current sensor with an offset; a rider who stops and goes."""

    soc: float = 0.8
    temperature: float = 20.0
    offset: float = 0.1  # A
    capacity: float = 33.1  # A·h
    seed: int = 0

    def ride(self, seconds, lost=lambda role_group, t: False, begin=0.0, dt=0.1):
        """Yields (event, true soc) in the order of time."""
        rng = np.random.default_rng(self.seed)
        fast = slow = 0.0
        speed = way = 0.0
        target = 8.0
        for step in range(round(seconds / dt)):
            t = begin + step * dt
            if step % 400 == 0:
                target = rng.uniform(5, 12)
            if step % 400 > 330 or step < 30:
                target = 0.0
            a = float(np.clip(0.6 * (target - speed), -1.5, 1.0))
            speed = max(speed + a * dt, 0.0)
            way += speed * dt
            power = 60 + speed * (190 * a * 1.05 + 26 + 0.36 * speed**2) * (1.15 if a > -0.3 else 0.3)
            ocv = BATTERY.ocv_curve.at(self.soc)
            source = 14 * (ocv - fast - slow)
            resistance = 0.066
            current = (source - np.sqrt(max(source**2 - 4 * resistance * power, 0))) / (2 * resistance)
            voltage = source - resistance * current
            cell = current / 12
            fast = exp(-dt / 25) * fast + 0.018 * (1 - exp(-dt / 25)) * cell
            slow = exp(-dt / 1200) * slow + 0.008 * (1 - exp(-dt / 1200)) * cell
            self.soc -= current * dt / 3600 / self.capacity
            measured = current + self.offset + 0.06 * rng.standard_normal()
            events = [
                (t, PACK, (round(voltage + 0.01 * rng.standard_normal(), 2), round(measured, 2))),
                (t + 0.01, MOTOR, (speed / 0.2438,)),
                (t + 0.02, INVERTER, (voltage - 0.009 * current, current - 0.85)),
                (t + 0.03, IMU, (a + 0.1 * rng.standard_normal(), 0.0, 0.0, 0.0)),
            ]
            if step % 2 == 0:
                events.append((t + 0.04, GPS, (speed, 1.0, 200 + rng.standard_normal(), 3.0)))
            if step % 10 == 0:
                events.append((t + 0.05, CELLS, (self.temperature, self.temperature - 2)))
            for event in events:
                if not lost(event[1], t):
                    yield event, self.soc


def run(plant, seconds, estimator=None, lost=lambda group, t: False, begin=0.0, every=1.0):
    estimator = estimator or EventEstimator(GROUPS, BATTERY, VEHICLE.model, VEHICLE.riding)
    rows, due = [], begin + every
    for event, true in plant.ride(seconds, lost, begin):
        estimator.handle(event)
        if event[0] >= due:
            rows.append((true, estimator.estimate(event[0])))
            due += every
    return estimator, rows


def test_soc_within_its_sigma_on_a_richer_plant():
    for seed in range(4):
        _, rows = run(Plant(seed=seed, soc=0.35 + 0.15 * seed), 900)
        assert all(abs(e.soc - true) < 3 * e.soc_sd for true, e in rows if e.soc is not None)
        assert rows[-1][1].soc_sd < 0.03
        assert rows[-1][1].state is State.VALID


def test_starts_from_the_rest_voltage():
    _, rows = run(Plant(soc=0.55, offset=0.0), 5)
    true, first = rows[0]
    assert first.soc == pytest.approx(true, abs=0.02)
    assert 0.002 < first.soc_sd < 0.03


def test_finds_back_from_a_wrong_start():
    """20 % wrong and unaware of it by half: half an hour of riding brings it back."""
    plant = Plant(soc=0.7, offset=0.0)
    estimator, _ = run(plant, 2)
    assert estimator.pack.is_started
    estimator.pack.state = with_soc(estimator.pack.state, estimator.pack.state.soc - 0.2, 0.1**2)
    _, rows = run(plant, 1800, estimator, begin=2.0)
    assert abs(rows[-1][1].soc - rows[-1][0]) < 0.05


def test_the_same_events_give_the_same_bits():
    _, a = run(Plant(), 120)
    _, b = run(Plant(), 120)
    assert [e for _, e in a] == [e for _, e in b]


def test_a_sensor_that_comes_back_is_forgiven():
    _, rows = run(Plant(), 400, lost=lambda g, t: g == IMU and 200 < t < 250)
    assert rows[240][1].reasons & Reason.NO_IMU
    assert not rows[-1][1].reasons & Reason.NO_IMU
    assert rows[-1][1].state is State.VALID


def test_a_voltage_glitch_is_gated_and_counted_as_mismatch():
    plant = Plant()
    estimator, rows = run(plant, 60)
    before = rows[-1][1]
    estimator.handle((60.05, PACK, (35.0, 1.0)))
    after = estimator.estimate(60.1)
    assert after.soc == pytest.approx(before.soc, abs=1e-3)
    assert after.reasons & Reason.VOLTAGE_MISMATCH


def test_snapshot_over_a_restart():
    plant = Plant(seed=3)
    estimator, rows = run(plant, 600)
    saved = json.loads(json.dumps(estimator.snapshot("key")))
    fresh = EventEstimator(GROUPS, BATTERY, VEHICLE.model, VEHICLE.riding)
    fresh.restore(saved, "key", 5.0)
    _, again = run(plant, 20, fresh, begin=605.0)
    assert again[0][1].soc == pytest.approx(rows[-1][1].soc, abs=0.005)
    assert again[-1][1].range == pytest.approx(rows[-1][1].range, rel=0.05)


def test_charged_meanwhile_the_voltage_is_believed():
    estimator, _ = run(Plant(soc=0.3), 60)
    saved = estimator.snapshot("key")
    fresh = EventEstimator(GROUPS, BATTERY, VEHICLE.model, VEHICLE.riding)
    fresh.restore(saved, "key", 30_000.0)
    _, rows = run(Plant(soc=0.95), 10, fresh)
    assert rows[0][1].soc == pytest.approx(0.95, abs=0.03)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({"version": 99}, "version"),
        ({"key": "other"}, "other"),
        ({"soc": 7.0}, "not from 0 to 1"),
        ({"soc_variance": 2e-9}, "impossible"),
        ({"soc_variance": None}, "damaged"),
        ({"riding": {}}, "damaged"),
        ({"soc": float("nan")}, "state.soc is nan"),
    ],
)
def test_a_snapshot_that_does_not_fit_is_refused(damage, message):
    estimator, _ = run(Plant(), 60)
    saved = estimator.snapshot("key")
    assert saved
    fresh = EventEstimator(GROUPS, BATTERY, VEHICLE.model, VEHICLE.riding)
    with pytest.raises(ValueError, match=message):
        fresh.restore({**saved, **damage}, "key", 5.0)
