"""A pack's age: learning on voltages of a cell with a known capacity and resistance, and the belief by brute force."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from gz_onboard.estimator.battery_filter import SCALAR, FilterState, Noise, condition, predict, with_soc
from gz_onboard.estimator.battery_priors import bounded
from gz_onboard.estimator.pack_age import AGE, Belief, PackAge, believe, mixture_variance
from gz_onboard.estimator.plausibility.electrical import CurrentSource, PackReading
from gz_onboard.model.battery import Battery, Health
from gz_onboard.model.series import advanced
from gz_onboard.vehicle import read_vehicle
from tests.events import ShownSignals
from tests.support import cell_voltage

PACK = read_vehicle("reference").pack
DT, WARM = 1.0, 25.0  # s, degC
ERROR_VARIANCE, ERROR_TIME = 0.008**2, 573.0  # V², s
SOUND = PackReading(50.0, 10.0, CurrentSource.PACK)


def known_signals() -> ShownSignals:
    signals = ShownSignals("cell_temperature", "pack_voltage")
    signals.cell_temperature.time = signals.pack_voltage.time = 0.0
    return signals


@dataclass
class Aged:
    """A pack's age and the filter's state."""

    age: PackAge
    state: FilterState

    @property
    def battery(self) -> Battery:
        return PACK.aged(self.age.health)

    @classmethod
    def new(cls) -> Aged:
        age = PackAge(PACK, SCALAR)
        return cls(age, age.unknown)

    def restarted(self) -> Aged:
        """Restored from what is saved, with a state of charge of which nothing is known."""
        again = Aged.new()
        state = with_soc(self.state, self.state.soc, 0.25)
        saved = {"soc": state.soc, "soc_variance": 0.25, "error_variance": 1e-4, "v1": 0.0}
        again.state = again.age.restored(saved | {"learned": self.age.snapshot(state)})
        return again


def discharge(
    capacity: float,
    resistance: float,
    until: float,
    aged: Aged | None = None,
    reading: PackReading = SOUND,
    now: float = 0.0,
) -> tuple[Aged, float]:
    """(age, true SOC) after a cell that aged so is discharged from full `until` a state of charge."""
    truth, aged, signals = PACK.aged(Health(capacity, resistance)), aged or Aged.new(), known_signals()
    age = aged.age
    state = with_soc(aged.state, 1.0, 0.005**2)._replace(v1=0.0, error=0.0)
    soc, v1, step = 1.0, 0.0, 0
    while soc > until:
        battery, current = aged.battery, 0.9 + 0.7 * math.sin(step / 7) + 0.3 * math.sin(step / 61)
        soc, v1 = advanced(truth, DT, soc, v1, current, WARM)
        voltage = cell_voltage(truth, soc, v1, current, WARM)
        charge = current * DT / 3600 / (PACK.capacity * PACK.capacity_share.at(WARM))
        noise = Noise(1e-10, ERROR_VARIANCE, math.exp(-DT / ERROR_TIME), AGE.capacity_walk * charge, 0.0)
        state = predict(state, charge, advanced(battery, DT, state.soc, state.v1, current, WARM)[1], noise)
        state = age.allow_learning(now, reading, signals, state)
        state = age.replaced_pack(state) or state
        predicted = cell_voltage(battery, state.soc, state.v1, current, WARM)
        h = battery.ocv(state.soc)[1] - current * battery.r0.at(state.soc, WARM)[1]
        error, drop = voltage - predicted, battery.r0.at(state.soc, WARM)[0] * current + state.v1
        least = age.min_capacity_variance(state, state.soc, battery.ocv(state.soc)[1])
        state = condition(state, (h, -1.0, 0.0), error + state.error, 0.005**2 * 2 * ERROR_TIME, least)
        state = age.load(bounded(state), DT, drop, error)
        age.follow(state, DT)
        step += 1
    aged.state = state
    return aged, soc


@pytest.mark.parametrize(("capacity", "resistance"), [(0.8, 1.5), (0.7, 1.0), (1.0, 1.0), (0.9, 2.5)])
def test_half_a_discharge_shows_capacity_and_resistance(capacity: float, resistance: float):
    aged, soc = discharge(capacity, resistance, 0.5)
    found = aged.age.learned(aged.state)
    assert found["capacity"].value == pytest.approx(capacity, abs=0.04)
    assert abs(found["capacity"].value - capacity) < 2.5 * found["capacity"].sd
    assert found["resistance"].value == pytest.approx(resistance, rel=0.06)
    assert aged.age.published(aged.state)[0] == pytest.approx(soc, abs=0.015)
    assert 0.5 < found["capacity"].share < 1


@pytest.mark.parametrize(
    "reading",
    [
        SOUND._replace(source=CurrentSource.INVERTER),
        SOUND._replace(source=CurrentSource.DISPUTED),
        SOUND._replace(voltage_doubted=True),
        SOUND._replace(current_difference=2.0),
    ],
)
def test_a_doubted_sensor_is_not_explained_as_age(reading: PackReading):
    aged, _ = discharge(0.8, 1.5, 0.7, reading=reading)
    assert (aged.state.inverse_capacity, aged.age.learned(aged.state)["resistance"].value) == (1.0, 1.0)


def test_the_age_survives_a_restart_and_improves():
    aged, _ = discharge(0.8, 1.5, 0.3)
    again = aged.restarted()
    capacity = again.age.learned(again.state)["capacity"].value
    assert capacity == pytest.approx(aged.age.learned(aged.state)["capacity"].value, abs=1e-4)
    assert again.battery.cell_capacity(WARM) == pytest.approx(capacity * PACK.cell_capacity(WARM))
    found, soc = discharge(0.8, 1.5, 0.9, again)
    assert found.age.published(found.state)[0] == pytest.approx(soc, abs=0.008)


@pytest.mark.parametrize(("before", "now"), [((0.78, 1.5), (1.0, 1.0)), ((1.0, 1.0), (0.78, 1.6))])
def test_a_replaced_pack_shows_by_its_resistance(before: tuple[float, float], now: tuple[float, float]):
    """Of its capacity nothing is known, rather than that of the one before."""
    found, soc = discharge(*now, 0.5, discharge(*before, 0.2)[0].restarted())
    assert found.age.published(found.state)[0] == pytest.approx(soc, abs=0.02)
    assert found.age.learned(found.state)["capacity"].value == pytest.approx(now[0], abs=0.05)
    assert found.age.learned(found.state)["resistance"].value == pytest.approx(now[1], rel=0.06)


def test_an_aged_pack_that_shows_more_resistance_is_not_taken_for_half_a_new_one():
    """As on a colder day: it may be another pack, but no newer one."""
    aged, _ = discharge(0.75, 1.2, 0.2)
    sd = aged.age.learned(aged.state)["capacity"].sd
    found, soc = discharge(0.75, 1.76, 0.85, aged.restarted())
    learned = found.age.learned(found.state)
    assert learned["resistance"].value == pytest.approx(1.76, rel=0.06)  # it was begun with
    assert learned["capacity"].value == pytest.approx(0.75, abs=0.04)  # 0.82 if of its capacity nothing were known
    assert learned["capacity"].sd > sd
    assert found.age.published(found.state)[0] == pytest.approx(soc, abs=0.02)


def test_a_state_of_another_capacity_is_as_new():
    aged, _ = discharge(0.8, 1.5, 0.6)
    other = PackAge(replace(PACK, capacity=2.0), SCALAR)
    saved = {"soc": 0.5, "soc_variance": 0.25, "error_variance": 1e-4, "v1": 0.0}
    state = other.restored(saved | {"learned": aged.age.snapshot(aged.state)})
    assert state.inverse_capacity == 1.0
    assert other.learned(state)["resistance"].value == aged.age.learned(aged.state)["resistance"].value


# --- the belief, against the same by brute force on a grid ------------------------------------------------------------

AS_NEW, NEW_SD = 0.5, 0.01
PRIOR_VARIANCE = mixture_variance(AS_NEW, NEW_SD)
NO_SIGHT = 1e9  # variance of a resistance that was not seen
PSI, MORE = np.arange(-0.8, 1.2, 0.0005), np.arange(-1.5, 2.5, 0.01)


def belief(inverse: float, variance: float, with_soc: float, factor: float = 1.0, sd: float = NO_SIGHT**0.5) -> Belief:
    state = Aged.new().state
    covariance = (*state.covariance[:2], with_soc, *state.covariance[3:7], variance, *state.covariance[8:])
    return believe(AS_NEW, NEW_SD, state._replace(inverse_capacity=inverse, covariance=covariance), factor, sd * sd)


def normal(x, variance):
    return np.exp(-(x**2) / variance / 2) / np.sqrt(variance)


def by_force(seen, seen_sd, factor, factor_sd):
    """(mean, variance, P10, P90 of ψ - 1) given a direct sight of it and of the resistance."""
    likely = normal(PSI - seen, seen_sd**2)
    new = normal(PSI, NEW_SD**2) * normal(factor - 1, factor_sd**2) * likely
    sds, c = (AGE.aged_capacity_sd, AGE.aged_resistance_sd), AGE.aged_correlation
    x, y = PSI[:, None] / sds[0], MORE[None, :] / sds[1]
    joint = np.exp(-(x * x - 2 * c * x * y + y * y) / 2 / (1 - c**2)) / (
        2 * np.pi * sds[0] * sds[1] * np.sqrt(1 - c**2)
    )
    old = (joint * normal(factor - 1 - MORE, factor_sd**2)).sum(axis=1) * 0.01 * likely * np.sqrt(2 * np.pi)
    both = new + old
    mean = (both * PSI).sum() / both.sum()
    below = np.cumsum(both) / both.sum()
    deciles = (PSI[np.searchsorted(below, share)] for share in (0.1, 0.9))
    return mean, (both * (PSI - mean) ** 2).sum() / both.sum(), *deciles


@pytest.mark.parametrize("seen", [(0.0, 0.03), (0.02, 0.05), (0.2, 0.05), (0.3, 0.4), (-0.05, 0.02)])
@pytest.mark.parametrize("resistance", [(1.0, 0.12), (1.3, 0.15), (1.5, 0.12), (1.1, 0.3)])
def test_the_belief_follows_from_bayes_theorem(seen, resistance):
    """The filter's ψ is a sight of it together with the prior of both kinds as one normal distribution."""
    variance = 1 / (1 / PRIOR_VARIANCE + 1 / seen[1] ** 2)
    found = belief(1 + variance * seen[0] / seen[1] ** 2, variance, 0.0, *resistance)
    mean, expected, low, high = by_force(*seen, *resistance)
    assert found.inverse - 1 == pytest.approx(mean, abs=0.001)
    assert found.variance == pytest.approx(expected, rel=0.01, abs=1e-6)
    assert (found.low - 1, found.high - 1) == pytest.approx((low, high), abs=0.0015)
