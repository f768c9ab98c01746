"""The estimator with an extended model: effects in the cells, of bends and wind, warming tyres, sensors that err."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from gz_onboard.model.effect import load_effect
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.estimator.life import CELLS, GROUPS, MOTOR, PACK, Scooter
from tests.events import EventEstimator
from tests.support import joined, without_cell_effects

BASE = without_cell_effects(read_vehicle("reference", 75.0))


def extended(*names: str, **values: float) -> Vehicle:
    effects = [load_effect(name) for name in names]
    return BASE.changed(joined(BASE.parameters, effects).replaced(**values), (*BASE.model.effects, *effects))


def estimator(vehicle: Vehicle) -> EventEstimator:
    return EventEstimator(GROUPS, vehicle.pack, vehicle.model, vehicle.riding)


def run(vehicle, seconds, change=lambda events: events):
    """(estimator, the innovations [V] after the first minute)."""
    e = estimator(vehicle)
    innovations, due = [], 60.0
    for event in change(Scooter(offset=0.0, period=0.1).live(seconds, 9.0)):
        e.handle(event)
        if event[0] >= due:
            due += 0.5
            found = e.estimate(event[0]).innovation
            if found is not None:
                innovations.append(found)
    return e, np.array(innovations)


# --- effects in the cells -----------------------------------------------------------------------------------------


def slow_plant(resistance, seconds=700.0):
    """Events of a pack as the base model has it, and a slow RC pair of 5 min: bursts of 35 A for 20 s in 30."""
    battery, soc, fast, slow = BASE.pack, 0.7, 0.0, 0.0
    p = BASE.parameters
    for step in range(round(seconds / 0.1)):
        t = 0.1 * step
        current = 0.0 if t < 3 else 35.0 if t % 30 < 20 else 2.0
        cell = current / battery.cells_parallel
        volts = battery.ocv(soc)[0] - battery.r0.at(soc, 25.0)[0] * cell - fast - slow
        pack = battery.cells_series * volts - battery.series_resistance * current
        yield t, PACK, (pack, p["pack_current_gain"] * current + p["pack_current_offset"], None)
        yield t + 0.01, MOTOR, (0.0 if t < 3 else 20.0,)
        if step % 10 == 0:
            yield t + 0.02, CELLS, (25.0, 20.0)
        fade = math.exp(-0.1 / (battery.r1.at(soc, 25.0)[0] * battery.c1.at(soc, 25.0)[0]))
        fast = fade * fast + battery.r1.at(soc, 25.0)[0] * (1 - fade) * cell
        slow = math.exp(-0.1 / 300) * slow + resistance * (1 - math.exp(-0.1 / 300)) * cell
        soc -= current * 0.1 / 3600 / battery.pack_capacity(25.0)
    yield t, PACK, (slow, soc)  # the truth, for the test; not handled


def test_a_second_rc_pair_is_taken_out_of_the_innovation_and_of_the_soc():
    results = {}
    for name, vehicle in (("base", BASE), ("slow", extended("slow_relaxation", slow_resistance=0.03, slow_time=300.0))):
        *events, (_, _, (slow, soc)) = slow_plant(0.03)
        e = estimator(vehicle)
        for event in events:
            e.handle(event)
        found = e.estimate(events[-1][0])
        assert found.innovation is not None
        assert found.soc is not None
        results[name] = abs(found.innovation), abs(found.soc - soc)
        if name == "slow":
            assert e.pack.effects.overpotential == pytest.approx(slow, rel=0.02)
    assert results["slow"][0] < 0.003
    assert results["base"][0] > 10 * results["slow"][0]
    assert results["slow"][1] < 0.002


def test_the_states_outlive_a_restart_and_relax_meanwhile():
    vehicle = extended("slow_relaxation", "ocv_hysteresis", slow_time=600.0, hysteresis_rate=300.0)
    first, _ = run(vehicle, 300)
    saved = json.loads(json.dumps(first.snapshot(vehicle.key)))
    before = dict(first.pack.effects.states)
    assert before["slow_relaxation"] > 1e-3
    assert before["ocv_hysteresis"] > 1e-3
    for age, share in ((0.0, 1.0), (600.0, math.exp(-1)), (None, 0.0)):
        second = estimator(vehicle)
        second.restore(saved, vehicle.key, age)
        assert second.pack.effects.states["slow_relaxation"] == pytest.approx(
            share * before["slow_relaxation"], abs=1e-9
        )
        assert second.pack.effects.states["ocv_hysteresis"] == pytest.approx(before["ocv_hysteresis"])
        assert second.pack.effects.overpotential == pytest.approx(sum(second.pack.effects.states.values()))


# --- sensors ------------------------------------------------------------------------------------------------------


def shifted(voltage_late):
    """Pack messages whose voltage is that of `voltage_late` messages before (or after) their current."""

    def change(events):
        events = list(events)
        packs = [event for event in events if event[1] == PACK]
        index = {event[0]: i for i, event in enumerate(packs)}
        for time, group, values in events:
            if group == PACK:
                other = packs[min(max(index[time] - voltage_late, 0), len(packs) - 1)]
                yield time, group, (other[2][0], *values[1:])
            else:
                yield time, group, values

    return change


@pytest.mark.parametrize("late", [1, 3])
def test_voltage_and_current_out_of_step_are_paired(late):
    _, true = run(BASE, 400)
    _, off = run(BASE, 400, shifted(late))
    _, mended = run(extended(pack_voltage_latency=0.1 * late), 400, shifted(late))
    jumps = [float(np.std(np.diff(values))) for values in (true, mended, off)]  # what is slow has other causes
    assert jumps[1] < 1.5 * jumps[0]
    assert jumps[2] > 2 * jumps[0]
