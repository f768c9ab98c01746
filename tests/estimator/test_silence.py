"""Messages that come seldom, pauses, and sensors that say at first what is not so: nobody healthy is accused."""

from __future__ import annotations

import json
from math import exp

import pytest

from gz_onboard.estimator.battery_priors import Past, uncounted, uncounted_sd
from gz_onboard.estimator.plausibility.residual import CONFIG, LimitCheck
from gz_onboard.events import Activity, Group, Reason, State
from tests.estimator.life import (
    CELLS,
    GROUPS,
    INVERTER,
    MOTOR,
    PACK,
    Scooter,
    estimator,
    flat_pack,
    follow,
    set_soc,
    worst,
)
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


def test_a_seldom_speed_does_not_make_the_riding_cheaper():
    """Between two messages it has no acceleration that means anything: a stair of speeds would cost far more."""
    factors = []
    for period in (0.1, 3.0):
        groups = [GROUPS[PACK], Group("Motor", ("motor_speed",), None), *GROUPS[2:]]
        scooter, e = Scooter(soc=0.9), estimator(groups)
        last = -10.0
        for event in scooter.live(1200, 11.0):
            if event[1] == 1:
                if event[0] - last < period - 0.01:
                    continue
                last = event[0]
            e.handle(event)
        factors.append(e.forecaster.learner.factor)
    assert factors[1] == pytest.approx(factors[0], rel=0.04)


def test_what_is_refused_for_coming_too_seldom_is_not_known_either():
    groups = [Group(group.message, group.roles, None) for group in GROUPS]
    scooter, e = Scooter(soc=0.8), estimator(groups)
    follow(e, scooter.live(60), scooter)
    scooter.period = 8.0
    rows = follow(e, scooter.live(1200, 11.0), scooter)
    assert rows[-1][1].state is State.INVALID
    scooter.period = 0.1
    back = follow(e, scooter.live(300, 11.0), scooter)
    assert not back[-1][1].reasons & Reason.SIGNALS_SLOW
    assert worst(rows + back) < 3


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


@pytest.mark.parametrize("gap", [5.0, 20.0, 60.0, 600.0])
def test_a_pause_is_as_uncertain_as_a_restart(gap):
    assert uncounted_sd(gap) == uncounted(Past(), gap, Past(0.0), 32.8, 52.0)[1]


@pytest.mark.parametrize("speed", [16.0, 20.0, 24.0])
@pytest.mark.parametrize("gap", [10.0, 20.0, 40.0])
def test_what_flowed_in_a_pause_is_covered(gap, speed):
    scooter, e = Scooter(soc=0.7, seed=1), estimator()
    follow(e, scooter.live(60), scooter)
    set_soc(e, scooter.soc, 1e-8, 1e-8)
    scooter.away(gap, speed)
    e.handle(next(scooter.live(0.1, speed)))
    e.close()
    assert abs(e.pack.state.soc - scooter.soc) < 2 * e.pack.state.covariance[0] ** 0.5


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


def test_a_gps_without_a_fix_tells_no_speed():
    groups = [GROUPS[PACK], Group("GPS", ("gps_speed", "gps_course", "gps_fix"), 1.0), GROUPS[CELLS]]
    scooter, e = Scooter(soc=0.8), estimator(groups)

    def with_fix(events, fix):
        for event in events:
            if event[1] == PACK:
                yield event
            elif event[1] == CELLS:
                yield event[0], 2, event[2]
                yield event[0] + 0.005, 1, (scooter.speed if fix > 1 else 0.0, 0.0, fix)

    follow(e, with_fix(scooter.live(60, 10.0), 3.0), scooter)
    assert e.estimate(scooter.time).speed == pytest.approx(scooter.speed, abs=1.5)
    follow(e, with_fix(scooter.live(60, 10.0), 0.0), scooter)
    lost = e.estimate(scooter.time)
    assert lost.speed is None
    assert lost.activity is Activity.UNKNOWN
    assert lost.reasons & Reason.NO_SPEED
    assert lost.reasons & Reason.NO_GPS
    follow(e, with_fix(scooter.live(60, 10.0), 3.0), scooter)
    assert e.estimate(scooter.time).speed == pytest.approx(scooter.speed, abs=1.5)


@pytest.mark.parametrize(
    "damage",
    [
        {"consumption": 1e300},
        {"consumption": -1e300},
        {"odometer": 1e308},
        {"current": 1e200},
        {"own_soc": 1e200},
        {"gyro_bias": [0.0, 0.5]},
        {"soc": -0.04},
        {"soc": 1.04},
        {"soc_variance": -0.01},
        {"soc_variance": 0.3},
        {"error_variance": float("inf")},
        {"v1": float("nan")},
    ],
    ids=str,
)
def test_a_saved_number_that_cannot_be_is_refused(damage):
    scooter, e = Scooter(soc=0.75), estimator()
    follow(e, scooter.live(60, 10.0), scooter)
    with pytest.raises(ValueError, match="is damaged"):
        estimator().restore({**e.snapshot("key"), **damage}, "key", 10.0)


def numbers(saved, path=()):
    """The paths of the numbers in a snapshot."""
    for key, value in saved.items() if isinstance(saved, dict) else enumerate(saved):
        if isinstance(value, dict | list):
            yield from numbers(value, (*path, key))
        elif isinstance(value, int | float):
            yield (*path, key), value


@pytest.mark.parametrize("make", [Scooter, flat_pack])
@pytest.mark.parametrize("wrong", [lambda x: -10 * x, lambda x: 10 * x, lambda _: 4.0, lambda _: 1e6])
def test_whatever_was_saved_what_is_published_can_be(make, wrong):
    """A number that is wrong is refused, or what is made of it has an interval that can be."""
    scooter = make(soc=0.6)
    e = estimator(vehicle=scooter.vehicle)
    follow(e, scooter.live(30), scooter)
    follow(e, scooter.live(300, 10.0), scooter)
    saved = json.loads(json.dumps(e.snapshot("key")))
    events = [*scooter.live(4), *scooter.live(2, 8.0)]
    taken = 0
    for path, value in numbers(saved):
        changed, part = (whole := json.loads(json.dumps(saved))), path[-1]
        for key in path[:-1]:
            changed = changed[key]
        changed[part] = wrong(value)
        fresh = estimator(vehicle=scooter.vehicle)
        try:
            fresh.restore(whole, "key", 3600.0)
        except ValueError:
            continue
        taken += 1
        for _, row in follow(fresh, events, scooter):
            assert row.soc_sd is None or row.soc_sd <= 0.3, path
            assert not row.range or row.range_p10 < row.range <= row.range_p90 < 1e6, (path, row)
    assert taken > 30


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


@pytest.mark.parametrize("period", [4.0, 5.0, 8.0])
def test_a_held_voltage_proves_no_rest(period):
    """Only the pack's message is slow."""
    groups = [Group(GROUPS[PACK].message, GROUPS[PACK].roles, None), *GROUPS[1:]]
    scooter, e, rows, last = Scooter(soc=0.7), estimator(groups), [], 0.0
    for event in scooter.live(600, 11.0):
        if event[1] == PACK and event[0] > 60:
            if event[0] - last < period - 0.01:
                continue
            last = event[0]
        e.handle(event)
        rows.append((scooter.soc, e.estimate(event[0])))
    assert worst(rows) < 3


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


def test_cells_do_not_cool_like_that():
    scooter, e = Scooter(soc=0.6), estimator(MORE)
    follow(e, beside(scooter.live(60, 10.0)), scooter)
    named: dict[str, int] = {}
    for step in range(300):
        for event in beside(scooter.live(1.0, 10.0), cells=28.0 - 0.05 * step):
            e.handle(event)
        for role in e.estimate(scooter.time).distrusted:
            named.setdefault(role, step)
    assert list(named) == ["cell_temperature"]
    assert named["cell_temperature"] < 240
