"""The weakest group of cells, on packs of the tests' plant: learned, used, refused, kept, forgotten."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from gz_onboard.estimator import forecast
from gz_onboard.estimator.weakest import CONFIG, NAMES
from gz_onboard.events import Group
from gz_onboard.model.battery import Battery, Health, WeakGroup
from gz_onboard.model.drawable import drawable
from gz_onboard.vehicle import read_vehicle
from tests.events import Event, EventEstimator
from tests.plant.machine import SERIES
from tests.plant.packs import STEP, Discharge, discharge
from tests.plant.ride import Hidden
from tests.plant.sensors import GROUP_NOISE, GROUPS

Lie = Callable[[float, float], float | None]
"""Another value of time [s] and lowest voltage [V]."""
VEHICLE = read_vehicle("reference")
BUS = [
    Group("Pack", ("pack_voltage", "pack_current"), STEP),
    Group("Motor", ("motor_speed",), STEP),
    Group("Inverter", ("inverter_voltage", "inverter_current"), STEP),
    Group("Cells", ("cell_temperature", "ambient_temperature", "lowest_cell_voltage"), 1.0),
]
PACK, MOTOR, INVERTER, CELLS = range(4)
SELDOM = 15.0  # s between forecasts, which take most of the time
WEAK = Hidden(weak_capacity=0.92, weak_resistance=1.15)
LOW = Hidden(weak_charge=0.04)
SEED, START = 11, 0.65  # SOC: half a discharge shows enough, and takes half of the time


@cache
def packs() -> dict[Hidden, Discharge]:
    kinds = (Hidden(), WEAK, LOW)
    return dict(zip(kinds, discharge(kinds, SEED, soc=START), strict=True))


@cache
def noisy(kind: Hidden) -> tuple[list[float], ...]:
    """Lowest voltage, voltage and current of the pack, speed, inverter: with noise, steps and channels that differ."""
    pack, rng = packs()[kind], np.random.default_rng([SEED, 3])
    n = len(pack.time)
    channels = GROUPS[3] * rng.normal(size=(SERIES, 1)) + GROUP_NOISE * rng.normal(size=(SERIES, n))
    columns = (
        np.round((pack.groups + channels).min(axis=0), 3),
        np.round(pack.voltage + 0.01 * rng.normal(size=n), 2),
        np.round(1.011 * pack.current + 0.026 + 0.06 * rng.normal(size=n), 2),
        pack.speed / 0.2438,
        np.round(pack.voltage - 0.0087 * pack.current, 2),
        np.round(pack.current - 45 / pack.voltage, 2),
    )
    return tuple(column.tolist() for column in columns)


def heard(kind: Hidden, lie: Lie | None = None) -> Iterator[Event]:
    """What the bus says."""
    pack = packs()[kind]
    rows = zip(pack.time.tolist(), *noisy(kind), strict=True)
    for time, lowest, voltage, current, speed, behind, through in rows:
        yield time - 0.03, CELLS, (pack.temperature, pack.temperature - 2, lie(time, lowest) if lie else lowest)
        yield time - 0.02, MOTOR, (speed,)
        yield time - 0.01, INVERTER, (behind, through)
        yield time, PACK, (voltage, current)


def ridden(kind: Hidden, until: float, lie: Lie | None = None, saved: dict[str, Any] | None = None) -> Any:
    """The estimator when the mean cell is at `until`."""
    estimator = EventEstimator(BUS, VEHICLE.pack, VEHICLE.model, VEHICLE.riding)
    if saved:
        estimator.restore(json.loads(json.dumps(saved)), "key", None)
    pack = packs()[kind]
    end = pack.time[int(np.argmax(pack.soc <= until))]
    with patch.object(forecast, "FORECAST", forecast.ForecastConfig(period_s=SELDOM)):
        for event in heard(kind, lie):
            if event[0] > end:
                break
            estimator.handle(event)
    return estimator


@cache
def at(kind: Hidden, until: float) -> Any:
    return ridden(kind, until)


def left(estimator: Any, weakest: WeakGroup | None) -> float:
    """The energy [J] that it expects to be left, were this known of the weakest group."""
    known = estimator.pack.battery
    estimator.pack.battery = known.aged(replace(known.health, weakest=weakest))
    soc, sd = estimator.pack.soc
    found = estimator.forecaster.forecast(soc, sd, 18.0, 1.0, 16.0, 0.0).energy
    estimator.pack.battery = known
    return float(found)


def drawn(kind: Hidden, since: float) -> float:
    """The energy [J] that the pack really gave from this state of charge of the mean cell on."""
    pack = packs()[kind]
    first = int(np.argmax(pack.soc <= since))
    return float(np.sum(pack.voltage[first:] * pack.current[first:]) * STEP)


# --- the signal -----------------------------------------------------------------------------------------------------


# --- learned and used -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "charge", "capacity", "resistance"), [(WEAK, 1.0, 0.92, 1.15), (LOW, 0.96, 1.0, 1.0)])
def test_a_weak_group_is_found_and_ends_the_range(kind: Hidden, charge: float, capacity: float, resistance: float):
    found = at(kind, 0.2)
    learned = found.pack.weakest.learned()
    for name, truth in zip(NAMES, (charge, capacity, resistance), strict=True):
        assert abs(learned[name].value - truth) < 2.5 * learned[name].sd
    assert learned["weak_capacity"].sd < 0.025
    whole = drawn(Hidden(), START) / START
    with_it, without = (left(found, x) - drawn(kind, 0.2) for x in (found.pack.battery.health.weakest, None))
    assert abs(with_it) < 0.015 * whole
    assert without > 0.03 * whole


def test_a_healthy_pack_has_none():
    for until in (0.55, 0.2):
        found = at(Hidden(), until)
        assert found.pack.weakest.known.blocks > CONFIG.proven
        for x in found.pack.weakest.learned().values():
            assert abs(x.value - 1) < 2 * x.sd
        assert left(found, found.pack.battery.health.weakest) == pytest.approx(left(found, None), rel=0.01)


# --- signals that lie -----------------------------------------------------------------------------------------------


def jumping() -> Lie:
    rng = np.random.default_rng(5)
    return lambda t, v: round(v - (0.25 if rng.random() < 0.3 else 0.0), 3)


LIES: dict[str, Callable[[], Lie]] = {
    "stuck": lambda: lambda t, v: 3.7,
    "high": lambda: lambda t, v: v + 0.3,
    "low": lambda: lambda t, v: v - 0.3,
    "jumping": jumping,
    "silent": lambda: lambda t, v: None,
}


@pytest.mark.parametrize("name", LIES)
def test_a_lie_from_the_start_teaches_nothing(name: str):
    found = ridden(Hidden(), 0.57, LIES[name]())
    assert found.pack.weakest.refused is (name != "silent")
    assert all(abs(x.value - 1) < x.sd for x in found.pack.weakest.learned().values())
    assert left(found, found.pack.battery.health.weakest) == pytest.approx(left(found, None), rel=0.005)


# --- kept -----------------------------------------------------------------------------------------------------------


def test_what_was_learned_survives_a_restart():
    before = at(WEAK, 0.2)
    saved = json.loads(json.dumps(before.snapshot("key")))
    again: Any = EventEstimator(BUS, VEHICLE.pack, VEHICLE.model, VEHICLE.riding)
    again.restore(saved, "key", 10.0)
    assert again.pack.weakest.learned() == before.pack.weakest.learned()
    assert again.pack.battery.health.weakest == before.pack.battery.health.weakest
    assert again.pack.weakest.known == before.pack.weakest.known


@pytest.mark.parametrize(
    "wrong",
    [
        {"means": [9.0, 0, 0, 0]},
        {"means": [0, 0, 0]},
        {"means": [0, 0, 0, float("nan")]},
        {"rows": [1]},
        {"rows": [[0.0] * 4] * 4},
        {"rows": [[9e9 * (i == j) for j in range(4)] for i in range(4)]},
        {"rows": [[1e-4, 1e-2, 0, 0], [1e-2, 1e-4, 0, 0], [0, 0, 1e-2, 0], [0, 0, 0, 1e-6]]},
        {"blocks": -1},
        {"blocks": "x"},
    ],
)
def test_what_cannot_be_is_refused_whole(wrong: dict[str, Any]):
    saved = json.loads(json.dumps(at(WEAK, 0.2).snapshot("key")))
    saved["learned"]["weakest"] |= wrong
    again: Any = EventEstimator(BUS, VEHICLE.pack, VEHICLE.model, VEHICLE.riding)
    with pytest.raises(ValueError):
        again.restore(saved, "key", 10.0)
    assert again.pack.weakest.known.blocks == 0


# --- the energy of a pack with a weak group ---------------------------------------------------------------------------


def pack_with(weakest: WeakGroup | None) -> Battery:
    return VEHICLE.pack.aged(Health(weakest=weakest))


def test_a_pack_delivers_until_its_weakest_group_ends():
    whole = drawable(pack_with(None), 0.5, 18.0, 700.0)
    lower = drawable(pack_with(WeakGroup(0.04, 0.0, 0.0, 0.01)), 0.5, 18.0, 700.0)
    assert whole.energy - lower.energy == pytest.approx(0.035 * lower.slope, rel=0.2)
    assert (whole.end_sd, lower.end_sd) == (0.0, 0.01)
    smaller = drawable(pack_with(WeakGroup(0.0, 0.08, 0.0)), 0.5, 18.0, 700.0)
    assert whole.energy - smaller.energy == pytest.approx(0.065 * smaller.slope, rel=0.2)
    harder = drawable(pack_with(WeakGroup(0.0, 0.0, 0.5)), 0.5, 18.0, 700.0)
    assert 0 < whole.energy - harder.energy < 0.02 * whole.slope
    alike = drawable(pack_with(WeakGroup(0.0, 0.0, 0.0)), 0.5, 18.0, 700.0)
    assert alike.energy == pytest.approx(whole.energy, rel=2e-3)


def test_a_group_that_would_long_be_empty_is_none():
    """A signal 0.15 V too low from the start looks like a weak group, until the pack goes on without it."""
    deceived, later = (ridden(Hidden(), until, lambda t, v: v - 0.15) for until in (0.3, 0.12))
    assert not deceived.pack.weakest.refused
    assert left(deceived, deceived.pack.weakest.group) < 0.5 * left(deceived, None)
    assert later.pack.weakest.refused
    assert later.pack.weakest.group is None
    assert left(later, later.pack.battery.health.weakest) == pytest.approx(left(later, None))
