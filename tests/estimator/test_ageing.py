"""What is learned of a pack's age, on voltages of a cell with a known capacity and resistance."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from gz_onboard.constants import HOUR
from gz_onboard.estimator.ageing import CAPACITY, Ageing
from gz_onboard.estimator.ekf import Noise, ScalarFilter
from gz_onboard.estimator.sources import CurrentSource, PackReading
from gz_onboard.estimator.start import update_soc
from gz_onboard.physics.battery import Battery
from gz_onboard.vehicle import read_vehicle
from tests.events import ShownSignals

DT, WARM = 1.0, 25.0  # s, degC
ERROR = Noise(1e-10, 0.008**2, 573.0)
SOUND = PackReading(50.0, 10.0, CurrentSource.PACK)


@pytest.fixture(scope="module")
def fresh() -> Battery:
    return read_vehicle("reference").pack


def known_signals() -> ShownSignals:
    signals = ShownSignals("cell_temperature", "pack_voltage")
    signals.cell_temperature.time = signals.pack_voltage.time = 0.0
    return signals


def discharge(
    fresh: Battery, capacity: float, resistance: float, until: float, reading: PackReading = SOUND, **kept: Any
) -> tuple[Ageing, ScalarFilter, float]:
    """(ageing, filter, true SOC) after a cell that aged so is discharged from full `until` a state of charge."""
    truth, battery = fresh.own(), kept.get("battery") or fresh.own()
    truth.age(capacity, resistance)
    ageing = kept.get("ageing") or Ageing(battery)
    filter_ = ScalarFilter(battery, 1.0, 0.0, (0.005**2, 0.0, ERROR.error))
    signals, soc, v1, now = known_signals(), 1.0, 0.0, 0
    while soc > until:
        current = 0.9 + 0.7 * math.sin(now / 7) + 0.3 * math.sin(now / 61)
        soc, v1, _ = truth.advanced(DT, soc, v1, current, WARM)
        voltage = truth.terminal_voltage(soc, v1, current, WARM)[0]
        before = filter_.covariance
        capacity_used = battery.cell_capacity(WARM)
        filter_.predict(DT, current, WARM, ERROR)
        ageing.count(filter_, before, current * DT / (HOUR * capacity_used))
        ageing.permit(0.0, reading, signals, filter_)
        then = filter_.soc, filter_.error, filter_.covariance
        error = filter_.innovation(voltage, current, WARM)[0]
        filter_.update(voltage, current, WARM, 0.005**2 * 2 * ERROR.time)
        ageing.corrected(filter_, then)
        ageing.load(DT, battery.r0.at(filter_.soc, WARM)[0] * current + filter_.v1, error)
        ageing.apply(DT)
        now += 1
    return ageing, filter_, soc


@pytest.mark.parametrize(("capacity", "resistance"), [(0.8, 1.5), (0.7, 1.0), (1.0, 1.0), (0.9, 2.5)])
def test_half_a_discharge_shows_capacity_and_resistance(fresh: Battery, capacity: float, resistance: float):
    ageing, filter_, soc = discharge(fresh, capacity, resistance, 0.5)
    found = ageing.learned()
    assert found["capacity"].value == pytest.approx(capacity, abs=0.04)
    assert abs(found["capacity"].value - capacity) < 2.5 * found["capacity"].sd
    assert found["resistance"].value == pytest.approx(resistance, rel=0.06)
    assert ageing.state_of_charge(filter_)[0] == pytest.approx(soc, abs=0.015)
    assert 0.5 < found["capacity"].share < 1


def test_a_little_charge_shows_no_capacity(fresh: Battery):
    ageing, _, _ = discharge(fresh, 0.8, 1.0, 0.99)
    assert ageing.capacity.share < 0.4  # what half of the packs being as new makes of it
    assert ageing.variance > 0.95 * Ageing(fresh.own()).variance


def test_a_healthy_pack_is_held_for_one(fresh: Battery):
    ageing, filter_, soc = discharge(fresh, 1.0, 1.0, 0.7)
    assert ageing.capacity.value == pytest.approx(1.0, abs=0.01)
    assert ageing.state_of_charge(filter_)[0] == pytest.approx(soc, abs=0.005)


@pytest.mark.parametrize(
    "reading",
    [
        SOUND._replace(source=CurrentSource.INVERTER),
        SOUND._replace(source=CurrentSource.DISPUTED),
        SOUND._replace(voltage_doubted=True),
        SOUND._replace(current_apart=2.0),
    ],
)
def test_a_doubted_sensor_is_not_explained_as_age(fresh: Battery, reading: PackReading):
    ageing, _, _ = discharge(fresh, 0.8, 1.5, 0.7, reading)
    assert (ageing.inverse, ageing.resistance.value) == (1.0, 1.0)


def test_an_unknown_temperature_teaches_nothing(fresh: Battery):
    signals = known_signals()
    ageing, filter_ = Ageing(fresh.own()), ScalarFilter(fresh, 0.8, 0.0, (0.005**2, 0.0, ERROR.error))
    ageing.permit(100.0, SOUND, signals, filter_)
    ageing.load(1.0, 0.1, 0.05)
    assert ageing.resistance.value == 1.0


def test_two_rests_and_the_charge_between_show_the_capacity(fresh: Battery):
    battery = fresh.own()
    ageing, filter_ = Ageing(battery), ScalarFilter(battery, 0.9, 0.0, (0.005**2, 0.0, ERROR.error))
    ageing.permit(0.0, SOUND, known_signals(), filter_)
    for _ in range(400):  # 40 % of what the file says, half of it of a pack that holds 0.8
        before = filter_.covariance
        filter_.covariance = before[0] + 1e-9, before[1], before[2]
        filter_.soc -= 0.001
        ageing.count(filter_, before, 0.001)
    saved = ageing.snapshot()
    counted = filter_.soc, filter_.covariance[0]
    again = Ageing(fresh.own())
    again.restore(saved)
    after = ScalarFilter(battery, 0.9 - 0.4 / 0.8, 0.0, (0.006**2, 0.0, ERROR.error))
    update_soc(after, *counted)
    again.resume(after, counted)
    assert 1 / again.inverse == pytest.approx(0.8, abs=0.02)


def restarted(fresh: Battery, ageing: Ageing) -> tuple[Ageing, Battery]:
    """What goes on from what `ageing` has saved, and its battery."""
    battery = fresh.own()
    again = Ageing(battery)
    again.restore(ageing.snapshot())
    return again, battery


def test_what_was_learned_survives_and_goes_on(fresh: Battery):
    ageing, _, _ = discharge(fresh, 0.8, 1.5, 0.3)
    again, battery = restarted(fresh, ageing)
    assert again.capacity.value == pytest.approx(ageing.capacity.value, abs=1e-4)
    assert battery.cell_capacity(WARM) == pytest.approx(again.capacity.value * fresh.cell_capacity(WARM))
    found, filter_, soc = discharge(fresh, 0.8, 1.5, 0.9, ageing=again, battery=battery)
    assert found.state_of_charge(filter_)[0] == pytest.approx(soc, abs=0.008)


@pytest.mark.parametrize(("before", "now"), [((0.78, 1.5), (1.0, 1.0)), ((1.0, 1.0), (0.78, 1.6))])
def test_another_pack_is_told_by_its_resistance(fresh: Battery, before: tuple[float, float], now: tuple[float, float]):
    """A pack that was replaced: of its capacity nothing is known, rather than what that of the one before was."""
    ageing, _, _ = discharge(fresh, *before, 0.2)
    again, battery = restarted(fresh, ageing)
    found, filter_, soc = discharge(fresh, *now, 0.5, ageing=again, battery=battery)
    assert found.state_of_charge(filter_)[0] == pytest.approx(soc, abs=0.02)
    assert found.capacity.value == pytest.approx(now[0], abs=0.05)
    assert found.resistance.value == pytest.approx(now[1], rel=0.06)


def test_an_aged_pack_that_shows_more_resistance_is_not_taken_for_half_a_new_one(fresh: Battery):
    """As on a colder day: it may be another pack, but no newer one."""
    ageing, _, _ = discharge(fresh, 0.75, 1.2, 0.2)
    again, battery = restarted(fresh, ageing)
    found, filter_, soc = discharge(fresh, 0.75, 1.76, 0.85, ageing=again, battery=battery)
    assert found.resistance.value == pytest.approx(1.76, rel=0.06)  # it was begun with
    assert found.capacity.value == pytest.approx(0.75, abs=0.04)  # 0.82 if of its capacity nothing were known
    assert found.capacity.sd > ageing.capacity.sd
    assert found.state_of_charge(filter_)[0] == pytest.approx(soc, abs=0.02)


def test_the_same_pack_is_no_other_one_for_a_little_more_resistance(fresh: Battery):
    ageing, _, _ = discharge(fresh, 0.8, 1.3, 0.2)
    again, battery = restarted(fresh, ageing)
    found, _, _ = discharge(fresh, 0.8, 1.5, 0.8, ageing=again, battery=battery)
    assert found.capacity.share > 0.9 * ageing.capacity.share


def test_a_state_without_it_or_of_another_pack_is_as_new(fresh: Battery):
    ageing, _, _ = discharge(fresh, 0.8, 1.5, 0.6)
    saved = ageing.snapshot()
    other = Ageing(replace(fresh, capacity=2.0).own())
    other.restore(saved)
    assert other.inverse == 1.0
    assert other.resistance.value == ageing.resistance.value
    other.restore({})


@pytest.mark.parametrize(
    "wrong", [{"inverse": 9.0}, {"inverse": math.nan}, {"variance": -1.0}, {"with_soc": 5.0}, {"variance": "x"}]
)
def test_what_cannot_be_is_refused_whole(fresh: Battery, wrong: dict[str, Any]):
    ageing = Ageing(fresh.own())
    saved = ageing.snapshot()
    saved["resistance"]["factor"] = 2.0
    with pytest.raises((ValueError, TypeError)):
        ageing.restore({**saved, "capacity": {**saved["capacity"], **wrong}})
    assert ageing.resistance.value == 1.0


def test_it_stays_within_bounds_whatever_comes(fresh: Battery):
    for capacity, resistance in ((0.3, 6.0), (1.6, 0.2)):
        ageing, _, _ = discharge(fresh, capacity, resistance, 0.4)
        assert CAPACITY[0] <= 1 / ageing.inverse <= CAPACITY[1] + 1e-9
        assert 0.5 <= ageing.resistance.value <= 4.0


def test_one_vehicle_s_age_is_not_another_s(fresh: Battery):
    before = fresh.cell_capacity(WARM), fresh.r0.at(0.5, WARM)
    fresh.own().age(0.7, 2.0)
    assert (fresh.cell_capacity(WARM), fresh.r0.at(0.5, WARM)) == before


def test_ageing_scales_capacity_and_resistance_at_a_kept_time_constant(fresh: Battery):
    aged = fresh.own()
    aged.age(0.8, 1.5)
    r0, r1, c1 = fresh.circuit(0.5, WARM)
    assert aged.circuit(0.5, WARM) == pytest.approx((1.5 * r0, 1.5 * r1, c1 / 1.5))
    assert aged.pack_capacity(WARM) == pytest.approx(0.8 * fresh.pack_capacity(WARM))


def test_the_energy_is_less_certain_downwards(fresh: Battery):
    down, up = Ageing(fresh.own()).energy_sd(4e6, 4e6, 0.01)
    assert down > 2 * up > 0


def test_a_state_of_charge_made_known_from_elsewhere_keeps_its_own_sd(fresh: Battery):
    ageing, filter_, _ = discharge(fresh, 0.9, 1.0, 0.8)
    filter_.covariance = (0.01**2, 0.0, filter_.covariance[2])
    ageing._with_soc = -1.0  # more than the two variances allow
    ageing.permit(0.0, SOUND, known_signals(), filter_)
    assert ageing.state_of_charge(filter_)[1] == pytest.approx(0.01)
