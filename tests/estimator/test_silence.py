"""Messages that come seldom, pauses, and sensors that say at first what is not so: nobody healthy is accused."""

from __future__ import annotations

from math import exp

import pytest

from gz_onboard.estimator.plausibility.residual import CONFIG, LimitCheck
from gz_onboard.events import Group, Reason, State
from tests.estimator.life import CELLS, GROUPS, INVERTER, MOTOR, PACK, Scooter, estimator, follow, set_soc, worst
from tests.events import ShownSignals

MORE = [*GROUPS, Group("Temperatures", ("motor_temperature",), 1.0), Group("GPS", ("gps_altitude",), 1.0)]


def beside(events, cells=28.0, motor=80.0, altitude=200.0):
    """The events, with temperatures and an altitude that do not change."""
    for event in events:
        if event[1] != CELLS:
            yield event
            continue
        yield event[0], CELLS, (cells, 15.0)
        yield event[0] + 0.005, len(GROUPS), (motor,)
        yield event[0] + 0.006, len(GROUPS) + 1, (altitude,)


@pytest.mark.parametrize("declared", [True, False])
@pytest.mark.parametrize("period", [0.5, 1.0, 2.0, 3.0, 5.0])
def test_sensors_that_speak_seldom_are_not_accused(period, declared):
    groups = [Group(group.message, group.roles, period if declared else None) for group in GROUPS]
    scooter, e = Scooter(soc=0.8, period=period), estimator(groups)
    follow(e, scooter.live(60), scooter)
    rows = follow(e, scooter.live(1000, 11.0), scooter)
    assert {role for _, row in rows for role in row.distrusted} == set()
    assert not rows[-1][1].reasons & (Reason.VOLTAGE_MISMATCH | Reason.CURRENT_MISMATCH)
    assert worst(rows) < 3


@pytest.mark.parametrize(
    ("seconds", "after"),
    [
        (3600, {"motor": 20.0}),
        (3600, {"cells": 16.0}),
        (28_800, {"motor": 20.0, "cells": 5.0}),
        (60, {"altitude": 220.0}),
    ],
    ids=["motor", "cells", "both", "altitude"],
)
def test_what_changes_while_the_bus_is_silent_accuses_nobody(seconds, after):
    scooter, e = Scooter(soc=0.8), estimator(MORE)
    follow(e, beside(scooter.live(20)), scooter)
    follow(e, beside(scooter.live(200, 10.0)), scooter)
    scooter.away(seconds)
    rows = follow(e, beside(scooter.live(30), **after), scooter)
    rows += follow(e, beside(scooter.live(60, 10.0), **after), scooter)
    assert {role for _, row in rows for role in row.distrusted} == set()


def test_a_first_value_that_is_none_accuses_nobody():
    scooter, e, rows = Scooter(soc=0.8), estimator(MORE), []
    rows += follow(e, beside(scooter.live(1.2), cells=0.0, altitude=0.0), scooter)
    rows += follow(e, beside(scooter.live(30), cells=30.0, altitude=300.0), scooter)
    rows += follow(e, beside(scooter.live(60, 10.0), cells=30.0, altitude=300.0), scooter)
    assert {role for _, row in rows for role in row.distrusted} == set()


def shown(*values: float) -> list[bool]:
    """Which of these temperatures of a motor are trusted, one each second."""
    signals = ShownSignals("motor_temperature")
    limits, trusted = LimitCheck(signals), []
    for second, value in enumerate(values):
        signals.show(float(second), {"motor_temperature": value})
        limits.step(float(second), 1.0, None)
        trusted.append(signals.motor_temperature.trusted)
    return trusted


def test_a_jump_of_a_settled_signal_is_refused():
    settled = [20.0] * (round(CONFIG.settled_s) + 1)
    assert all(shown(*settled, 21.0, 60.0)[:-1])
    assert not any(shown(*settled, *[210.0] * 60)[len(settled) :])


def test_a_jump_from_a_start_up_value_is_accepted():
    assert shown(0.0, *[50.0] * 40, 0.0) == [True] * 41 + [False]


@pytest.mark.parametrize("latency", [0.0, 0.2])
@pytest.mark.parametrize("period", [0.1, 1.0, 3.0])
def test_a_late_voltage_is_used_however_seldom_it_comes(period, latency):
    groups = [Group(group.message, group.roles, period) for group in GROUPS]
    scooter, e = Scooter(soc=0.8, period=period), estimator(groups)
    e.pack.synchroniser.latency = latency
    follow(e, scooter.live(60), scooter)
    set_soc(e, scooter.soc + 0.1, 0.01, 1e-6)
    rows = follow(e, scooter.live(600, 11.0), scooter)
    assert abs(rows[-1][1].soc - scooter.soc) < 0.05
    assert worst(rows) < 3


@pytest.mark.parametrize(("seconds", "charge"), [(3600, 15.0), (7200, 8.0), (600, 15.0), (3600, 0.0)])
@pytest.mark.parametrize("soc", [0.15, 0.3])
def test_charged_or_parked_while_the_bus_was_silent(soc, seconds, charge):
    scooter, e = Scooter(soc=soc, seed=4), estimator()
    follow(e, scooter.live(20), scooter)
    follow(e, scooter.live(200, 10.0), scooter)
    follow(e, scooter.live(15), scooter)
    scooter.away(seconds, charge=charge)
    rows = follow(e, scooter.live(15), scooter) + follow(e, scooter.live(200, 10.0), scooter)
    assert worst(rows) < 3
    assert rows[-1][1].soc_sd < 0.1
    assert {role for _, row in rows for role in row.distrusted} == set()


@pytest.mark.parametrize("asleep", [True, False], ids=["all", "pack"])
@pytest.mark.parametrize("late", [0.3, 3.0])
def test_after_a_silence_no_range_is_guessed_before_the_pack_is_heard(late, asleep):
    """Charged meanwhile. All slept, and other messages come first; or the pack's alone were not heard."""
    scooter, e, rows = Scooter(soc=0.3), estimator(), []
    follow(e, scooter.live(200), scooter)
    if asleep:
        scooter.away(7200, charge=5.0)
    else:
        scooter.period = 1.0
        follow(e, (event for event in scooter.live(7200, charge=5.0) if event[1] in (MOTOR, CELLS)), scooter)
        scooter.period = 0.1
    heard_from = scooter.time + late
    for event in scooter.live(late + 2.0):
        if event[1] not in (PACK, INVERTER) or event[0] > heard_from:
            e.handle(event)
            rows.append((scooter.soc, e.estimate(event[0])))
    assert not asleep or all(row.range is None for _, row in rows if row.time < heard_from)
    back = [row.range for _, row in rows if row.time > heard_from and row.range is not None]
    assert back == pytest.approx([back[-1]] * len(back), rel=0.01)
    assert rows[-1][1].state is State.VALID
    assert worst(rows) < 3


@pytest.mark.parametrize(("on", "off"), [(3.0, 6.0), (2.5, 20.0), (5.0, 60.0), (30.0, 30.0)])
def test_a_loose_connector_makes_the_state_of_charge_unsure_and_not_wrong(on, off):
    scooter, e, rows = Scooter(soc=0.9), estimator(), []
    follow(e, scooter.live(60), scooter)
    for _ in range(round(1200 / (on + off))):
        rows += follow(e, scooter.live(on, 10.0), scooter)
        scooter.away(off, 10.0)
    rows += follow(e, scooter.live(30, 10.0), scooter)
    assert worst(rows) < 3
    assert {role for _, row in rows for role in row.distrusted} == set()


@pytest.mark.parametrize("begin", [0.0, 15.0, 40.0])
@pytest.mark.parametrize("time_constant", [0.5, 3.0])
def test_a_precharge_accuses_nobody(begin, time_constant):
    scooter, e, rows = Scooter(soc=0.7), estimator(), []

    def precharged(events):
        for t, group, values in events:
            if group == INVERTER:
                volts = values[0] + (begin - values[0]) * exp(-t / time_constant)
                yield t, group, (volts, 0.0 if volts < values[0] - 0.5 else values[1])
            else:
                yield t, group, values

    rows = follow(e, precharged(scooter.live(15)), scooter) + follow(e, scooter.live(100, 10.0), scooter)
    assert {role for _, row in rows for role in row.distrusted} == set()
    assert worst(rows) < 3


@pytest.mark.parametrize("volts", [-2.0, 2.0])
def test_a_start_on_a_voltage_that_lies_is_made_again(volts):
    scooter, e = Scooter(soc=0.6), estimator()
    spoilt = ((t, g, (v[0] + volts, *v[1:]) if g == PACK else v) for t, g, v in scooter.live(300, 10.0))
    rows = follow(e, spoilt, scooter)
    assert worst(rows[20:]) < 3
    assert "pack_voltage" in rows[-1][1].distrusted
