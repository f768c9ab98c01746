"""Ordinary life: standing, charging, joining a ride, restarts, power cuts, slow messages."""

from __future__ import annotations

import json
from math import exp
from typing import Any

import pytest

from gz_onboard.estimator.battery_priors import soc_from_voltage
from gz_onboard.estimator.motion import MOTION
from gz_onboard.events import Activity, Cause, Group, Reason, State
from tests.estimator.life import (
    BATTERY,
    GROUPS,
    INVERTER,
    MOTOR,
    OTHERS,
    PACK,
    PERIOD,
    VEHICLE,
    Scooter,
    estimator,
    flat_pack,
    follow,
    knows,
    set_soc,
    worst,
)


def restarted(e, age, vehicle=VEHICLE):
    """A new daemon with what the old one saved `age` [s] ago."""
    fresh = estimator(vehicle=vehicle)
    fresh.restore(json.loads(json.dumps(e.snapshot("key"))), "key", age)
    return fresh


def heard(events, *, odometer=True, own_soc=True):
    """The events, on a vehicle that does not tell everything."""
    for t, group, values in events:
        if group == PACK and not own_soc:
            yield t, group, (*values[:2], None)
        elif group != OTHERS or odometer:
            yield t, group, values


# --- standing and charging ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("new", [False, True], ids=["known", "new"])
def test_an_hour_of_standing_costs_its_energy_and_no_more(new):
    """Of a new vehicle the rest teaches state of charge and capacity: that waits for the riding to come."""
    scooter, e = Scooter(), estimator()
    follow(e, scooter.live(20), scooter)
    follow(e, scooter.live(540, 11.0), scooter)
    if not new:
        follow(e, scooter.live(60), scooter)
        knows(e, scooter)
    _, before = follow(e, scooter.live(2), scooter)[-1]
    energy, scooter.period = scooter.energy, 0.5
    rows = follow(e, scooter.live(3600), scooter)
    _, after = rows[-1]
    standing = (scooter.energy - energy) / before.consumption_expected  # m
    assert rows[60][1].activity is Activity.STANDING
    assert before.range - after.range == pytest.approx(standing, rel=0.25)  # of 1.6 km
    assert after.consumption_expected == pytest.approx(before.consumption_expected, rel=0.03)
    _, later = follow(e, scooter.live(540, 11.0), scooter)[-1]
    assert later.consumption_expected == pytest.approx(before.consumption_expected, rel=0.05)


def with_auxiliary_current(scooter, seconds, speed=0.0):
    for t, group, values in scooter.live(seconds, speed):
        yield t, group, values
        if group == INVERTER:
            yield t, OTHERS + 1, (scooter.auxiliary / values[0],)


SENSED = [*GROUPS, Group("Auxiliary", ("auxiliary_current",), 0.1)]


def test_a_heater_is_watts_and_no_price_of_a_metre():
    scooter, e = Scooter(soc=0.95), estimator(SENSED)

    def ride(seconds, speed=0.0):
        return follow(e, with_auxiliary_current(scooter, seconds, speed), scooter)

    def price():
        energy, distance = scooter.energy, scooter.distance
        ride(900, 7.0)
        return (scooter.energy - energy) / (scooter.distance - distance)

    ride(20)
    ride(900, 7.0)
    for power in (400.0, 45.0):  # more than a fifth of the capacity in an hour: as much as a drive
        scooter.auxiliary = power
        rows = ride(100)
        assert all(row.activity is Activity.STANDING for _, row in rows[15:])
        _, soon = ride(500, 7.0)[-1]
        assert soon.consumption_expected == pytest.approx(price(), rel=0.1)
    scooter.auxiliary = 400.0
    ride(600, 7.0)
    why = e.explainer.latest.causes
    assert why[Cause.AUXILIARIES] < -5000.0
    assert abs(why[Cause.UNEXPLAINED]) < -0.3 * why[Cause.AUXILIARIES]
    saved = json.loads(json.dumps(e.snapshot("a")))
    fresh = estimator(SENSED)
    fresh.restore(saved, "a", 60.0)
    assert (
        fresh.forecaster.learner.auxiliaries.mean
        == e.forecaster.learner.auxiliaries.mean
        == pytest.approx(355.0, abs=20)
    )
    assert fresh.forecaster.learner.consumption_factor == pytest.approx(
        e.forecaster.learner.consumption_factor, rel=0.05
    )


def test_of_a_thermostat_its_mean_is_to_come():
    scooter, e = Scooter(soc=0.95), estimator(SENSED)
    follow(e, with_auxiliary_current(scooter, 20), scooter)
    rows: list[tuple[float, Any]] = []
    energy = distance = 0.0
    for minute in range(24):
        if minute == 18:
            energy, distance, shown = scooter.energy, scooter.distance, rows
        for seconds, scooter.auxiliary in ((20, 400.0), (40, 45.0)):
            rows = follow(e, with_auxiliary_current(scooter, seconds, 7.0), scooter)
    price = (scooter.energy - energy) / (scooter.distance - distance)
    assert all(row.consumption_expected == pytest.approx(price, rel=0.12) for _, row in shown)


@pytest.mark.parametrize("plug", [0.0, None], ids=["plug signal", "none"])
def test_charging_is_no_riding(plug):
    scooter, e = Scooter(soc=0.56, plug=plug), estimator()
    follow(e, scooter.live(20), scooter)
    _, ridden = follow(e, scooter.live(600, 10.0), scooter)[-1]
    hours, scooter.period = 0.2 * scooter.capacity / 10.0, 0.5
    rows = follow(e, scooter.live(3600 * hours, charge=10.9), scooter)
    scooter.period = PERIOD
    assert all(row.activity is Activity.CHARGING for _, row in rows[10:])
    _, charged = rows[-1]
    assert charged.consumption_factor == pytest.approx(ridden.consumption_factor, abs=0.01)
    rows = follow(e, scooter.live(200, 10.0), scooter)
    _, end = rows[-1]
    assert end.activity is Activity.RIDING
    assert end.range / end.soc == pytest.approx(ridden.range / ridden.soc, rel=0.12)
    assert worst(rows) < 3


def test_a_plug_that_says_yes_for_ever_does_not_stop_the_learning():
    scooter, e = Scooter(), estimator()
    stuck = ((t, g, (v[0], 1.0) if g == 4 else v) for t, g, v in scooter.live(900, 10.0))
    rows = follow(e, stuck, scooter)
    assert rows[-1][1].activity is Activity.RIDING
    assert not rows[-1][1].reasons & Reason.PRIOR_RIDING


def test_a_stop_at_a_traffic_light_belongs_to_the_ride():
    scooter, e = Scooter(), estimator()
    follow(e, scooter.live(400, 10.0), scooter)
    learner = e.forecaster.learner

    def ridden():
        return learner.state.sums.duration + learner._segment.duration

    before = ridden()
    follow(e, scooter.live(60), scooter)
    assert ridden() - before == pytest.approx(60, abs=5)
    follow(e, scooter.live(600), scooter)
    assert ridden() - before == pytest.approx(MOTION.stop_time, abs=15)  # it comes to a stop first


@pytest.mark.parametrize(("learned", "true"), [(1.0, 0.8), (0.8, 1.0)])
def test_a_voltage_overrules_a_capacity_that_was_learned_and_is_wrong(learned, true):
    """As of a pack replaced by one that differs in nothing else: what is believed does not outlast the curve."""
    scooter, e = Scooter(soc=0.95, capacity=true * BATTERY.pack_capacity(25.0), period=0.5, offset=0.0), estimator()
    known = e.pack.age.unknown
    covariance = (*known.covariance[:7], 0.01**2, *known.covariance[8:])
    e.pack.state = known._replace(inverse_capacity=1 / learned, covariance=covariance)
    follow(e, scooter.live(30), scooter)
    while scooter.soc > 0.35:
        rows = follow(e, scooter.live(60, 9.0), scooter)
    found = e.pack.learned()["capacity"]
    assert abs(found.value - true) < 3 * found.sd < 0.25  # else it is 1 ± 0.01 to the end of the ride
    assert worst(rows) < 3


# --- the first state of charge --------------------------------------------------------------------------------------


@pytest.mark.parametrize("soc", [0.9, 0.6, 0.35, 0.2])
@pytest.mark.parametrize("temperature", [5.0, 25.0])
def test_joined_mid_ride_the_sd_covers_the_polarisation(soc, temperature):
    scooter = Scooter(soc=soc, temperature=temperature, seed=7)
    scooter.away(20)
    scooter.away(700, 11.0)
    for _ in range(3):
        e = estimator()
        rows = follow(e, scooter.live(130, 11.0), scooter)
        assert worst(rows) < 3
        first = next(row for _, row in rows if row.soc is not None)
        assert 0.018 < first.soc_sd < (0.24 if temperature < 10 and soc < 0.3 else 0.16)  # as docs/limits.md says
        scooter.away(17, 11.0)


def test_a_rest_is_believed_the_more_the_longer_it_is():
    scooter, e = Scooter(soc=0.6), estimator()
    rows = follow(e, scooter.live(600), scooter)
    at_once, proven, long = rows[2][1], rows[15][1], rows[-1][1]
    assert at_once.soc_sd > proven.soc_sd > long.soc_sd
    assert proven.soc_sd < 0.03
    assert long.soc_sd < 0.015
    assert worst(rows) < 2


def test_after_a_load_a_short_stop_proves_nothing():
    scooter = Scooter(soc=0.6)
    scooter.away(900, 11.0)
    scooter.speed = 0.0
    e = estimator()
    follow(e, scooter.live(20, 11.0), scooter)
    before = e.pack.state.covariance[0]
    rows = follow(e, scooter.live(40), scooter)
    assert e.pack.state.covariance[0] > 0.5 * before
    assert worst(rows) < 3


def test_a_voltage_that_never_changes_proves_no_rest():
    stuck, moving = estimator(), estimator()
    for i in range(1000):
        stuck.handle((0.1 * i, PACK, (52.0, 0.9, 0.5)))
        moving.handle((0.1 * i, PACK, (52.0 + 0.01 * (i % 2), 0.9, 0.5)))
    assert stuck.estimate(100.0).soc_sd > 1.3 * moving.estimate(100.0).soc_sd


@pytest.mark.parametrize("time_constant", [0.3, 2.0, 5.0])
def test_an_inverter_that_is_being_charged_is_no_empty_pack(time_constant):
    """The pack's own voltage is missing, the inverter's stands in: it comes up from 4 V."""
    scooter, e = Scooter(soc=0.6), estimator()
    for t, group, values in scooter.live(60 + 6 * time_constant):
        if group == PACK:
            continue
        if group == 2:
            volts = values[0] or 0.0
            values = (volts - (volts - 4.0) * exp(-t / time_constant), values[1])  # noqa: PLW2901
        e.handle((t, group, values))
        now = e.estimate(t)
        assert now.soc is None or abs(now.soc - scooter.soc) < 3 * now.soc_sd
    assert now.soc is not None


def test_a_filter_that_is_contradicted_for_a_minute_begins_anew_and_says_so():
    scooter, e = Scooter(soc=0.8), estimator()
    follow(e, scooter.live(30), scooter)
    set_soc(e, 0.1, 0.005**2, 1e-6)
    rows = follow(e, scooter.live(300, 8.0), scooter)
    true, end = rows[-1]
    assert end.reasons & Reason.SOC_RESTARTED
    assert end.state is State.DEGRADED
    assert abs(end.soc - true) < 3 * end.soc_sd
    assert abs(end.soc - true) < 0.1
    rows = follow(e, scooter.live(700, 8.0), scooter)
    assert not rows[-1][1].reasons & Reason.SOC_RESTARTED


@pytest.mark.parametrize(("resistance", "speed"), [(2.0, 19.0), (2.5, 15.0), (4.0, 15.0)])
def test_cells_of_another_resistance_do_not_make_it_leave_a_right_estimate(resistance, speed):
    """As in the cold: under load the voltage contradicts the model for minutes, and the state of charge is right."""
    scooter, e = Scooter(soc=0.7), estimator()
    follow(e, scooter.live(120), scooter)
    scooter.resistance = resistance
    rows = [row for _ in range(6) for row in follow(e, scooter.live(42, speed), scooter)]
    assert any(row.reasons & Reason.VOLTAGE_MISMATCH for _, row in rows)
    assert worst(rows) < 3
    assert max(abs(row.soc - true) for true, row in rows) < 0.1


# --- the pack's messages are lost -----------------------------------------------------------------------------------


def without_pack(events):
    """What comes while the battery's own controller and the inverter are silent and the others go on."""
    return (event for event in events if event[1] not in (PACK, INVERTER))


@pytest.mark.parametrize("own_soc", [True, False])
def test_charged_while_only_the_pack_was_silent(own_soc):
    scooter, e = Scooter(soc=0.3), estimator()
    follow(e, heard(scooter.live(300, 9.0), own_soc=own_soc), scooter)
    follow(e, scooter.live(30), scooter)
    scooter.period = 0.5
    follow(e, without_pack(scooter.live(1.25 * 3600, charge=12.0)), scooter)
    scooter.period = PERIOD
    rows = follow(e, heard(scooter.live(60), own_soc=own_soc), scooter)
    true, end = rows[-1]
    assert true > 0.6
    assert abs(end.soc - true) < min(3 * end.soc_sd, 0.05)
    assert all(abs(row.soc - true) < 3 * row.soc_sd for true, row in rows if row.soc is not None)


def test_ridden_while_the_pack_was_silent_the_road_load_counts():
    scooter, e = Scooter(soc=0.8), estimator()
    follow(e, scooter.live(300, 9.0), scooter)
    before = scooter.soc
    lost = follow(e, without_pack(scooter.live(1200, 9.0)), scooter)
    true, end = lost[-1]
    assert end.reasons & Reason.NO_PACK_CURRENT
    assert abs(end.soc - true) < 0.3 * (before - true)
    assert worst(lost) < 3
    assert worst(follow(e, scooter.live(600, 9.0), scooter)) < 3


# --- restarts -------------------------------------------------------------------------------------------------------

AWAY = [
    pytest.param(590, 10.0, 0.0, id="ridden 590 s"),
    pytest.param(1200, 10.0, 0.0, id="ridden 1200 s"),
    pytest.param(600, 0.0, 10.0, id="charged by 5 %"),
    pytest.param(7200, 0.0, 3.5, id="charged for two hours"),
    pytest.param(7200, 0.0, 0.0, id="parked"),
    pytest.param(20, 11.0, 0.0, id="ridden 20 s"),
    pytest.param(3, 11.0, 0.0, id="crashed"),
]


PACKS = pytest.mark.parametrize("make", [Scooter, flat_pack])
"""Of a flat pack no rest repairs within seconds what a restart has taken up wrongly."""


@PACKS
@pytest.mark.parametrize(("seconds", "speed", "charge"), AWAY)
@pytest.mark.parametrize(("told", "clock"), [("all", True), ("all", False), ("neither", True), ("no own", True)])
def test_a_restart_knows_what_it_does_not_know(make, seconds, speed, charge, told, clock):
    tells = {"all": {}, "no own": {"own_soc": False}, "neither": {"own_soc": False, "odometer": False}}[told]
    scooter = make(soc=0.75)
    e = estimator(vehicle=scooter.vehicle)
    follow(e, heard(scooter.live(30), **tells), scooter)
    follow(e, heard(scooter.live(400, 10.0), **tells), scooter)
    scooter.away(seconds, speed, charge)
    e, fresh = restarted(e, seconds if clock else None, scooter.vehicle), estimator(vehicle=scooter.vehicle)

    def both(events):
        for event in events:
            fresh.handle(event)
            yield event

    rows = follow(e, both(heard(scooter.live(60, 10.0), **tells)), scooter)
    assert worst(rows) < 3
    _, end = rows[-1]
    without = fresh.estimate(scooter.time)
    assert end.soc_sd < ((0.6 if make is Scooter else 0.7) if clock and seconds <= 60 else 1.2) * without.soc_sd
    assert without.reasons & Reason.PRIOR_RIDING
    assert not end.reasons & Reason.PRIOR_RIDING  # what a kilometre costs is known at once, whatever has flowed
    assert end.consumption_expected_sd < without.consumption_expected_sd


def told_wrongly(events, seconds, own_soc=None, odometer=None):
    """The events, of a vehicle that says so of itself for the first `seconds`."""
    end = None
    for t, group, values in events:
        end = t + seconds if end is None else end
        if t < end and group == PACK and own_soc is not None:
            yield t, group, (*values[:2], own_soc)
        elif t < end and group == OTHERS and odometer is not None:
            yield t, group, (odometer, values[1])
        else:
            yield t, group, values


@PACKS
@pytest.mark.parametrize(
    ("at", "wrong"),
    [
        ("asleep", {"own_soc": 0.0}),
        ("asleep", {"own_soc": 1.0}),
        ("asleep", {"odometer": 0.0}),
        ("asleep", {"odometer": 3_250_000.0}),
        ("waking", {"own_soc": 0.0}),
        ("waking", {"odometer": 0.0}),
    ],
)
def test_what_the_vehicle_says_of_itself_half_asleep_is_not_compared(make, wrong, at):
    """It is not what it said a second before, and no charge flowed, no metre was ridden."""
    scooter = make(soc=0.75)
    e, whole = (estimator(vehicle=scooter.vehicle) for _ in range(2))
    for event in [*scooter.live(30), *scooter.live(400, 10.0)]:
        e.handle(event)
        whole.handle(event)
    events = list(scooter.live(60))
    follow(whole, events, scooter)
    follow(e, told_wrongly(events, 1e9, **wrong) if at == "asleep" else events, scooter)
    scooter.away(7200)
    e, whole = (restarted(each, 7200.0, scooter.vehicle) for each in (e, whole))
    events = list(scooter.live(20))
    rows = follow(e, told_wrongly(events, 3.0, **wrong) if at == "waking" else events, scooter)
    follow(whole, events, scooter)
    right = whole.estimate(scooter.time)
    assert worst(rows) < 3
    assert rows[-1][1].soc == pytest.approx(right.soc, abs=0.01)
    assert rows[-1][1].soc_sd == pytest.approx(right.soc_sd, rel=0.2)


def test_an_odometer_tells_what_was_ridden():
    scooter, e = Scooter(soc=0.75), estimator()
    follow(e, heard(scooter.live(30), own_soc=False), scooter)
    follow(e, heard(scooter.live(400, 10.0), own_soc=False), scooter)
    scooter.away(120, 10.0)
    e, without = restarted(e, 120.0), restarted(e, 120.0)
    events = list(heard(scooter.live(3, 10.0), own_soc=False))
    follow(e, events, scooter)
    follow(without, heard(events, odometer=False), scooter)
    told, untold = e.estimate(scooter.time), without.estimate(scooter.time)
    assert told.soc_sd < 0.7 * untold.soc_sd
    assert abs(told.soc - scooter.soc) < 0.01


def test_twenty_one_power_cuts_cost_little():
    """Each loses up to a second that was not yet saved, and two while the daemon starts."""
    scooter, whole, e = Scooter(soc=0.8, seed=3), estimator(), estimator()
    errors = []
    for cut in range(22):
        e = restarted(e, 3.0) if cut else e
        for event in scooter.live(40, 10.0 if cut else 0.0):
            e.handle(event)
            whole.handle(event)
        now, truth = scooter.time, scooter.soc
        for event in scooter.live(3.0, 10.0):
            whole.handle(event)
        errors.append(abs(e.estimate(now).soc - truth) - abs(whole.estimate(now).soc - truth))
    assert errors[-1] < 0.003
    assert e.estimate(now).soc_sd < 1.5 * whole.estimate(now).soc_sd


# --- slow messages --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("declared", [True, False])
def test_messages_every_three_seconds_are_integrated_over_three_seconds(declared):
    groups = [Group(g.message, g.roles, 3.0 if declared else None) for g in GROUPS]
    scooter, e = Scooter(soc=0.8, period=3.0), estimator(groups)
    often, other = Scooter(soc=0.8), estimator()
    follow(other, often.live(60), often)
    _, usual = follow(other, often.live(1400, 11.0), often)[-1]
    begin = scooter.distance
    follow(e, scooter.live(60), scooter)
    rows = follow(e, scooter.live(1400, 11.0), scooter)
    _, end = rows[-1]
    assert end.distance == pytest.approx(scooter.distance - begin, rel=0.03)
    assert abs(end.soc - usual.soc) < 0.015  # of sampling; a sd is as much
    assert worst(rows) < 3
    assert not end.reasons & Reason.SIGNALS_SLOW
    assert end.range is not None
    knows(e, scooter)
    knows(other, often)
    _, end = follow(e, scooter.live(300, 5.0), scooter)[-1]
    _, usual = follow(other, often.live(300, 5.0), often)[-1]
    assert end.soc_sd > 1.2 * usual.soc_sd  # what flows between two samples is not known


def test_slower_than_the_limit_is_refused_and_said():
    groups = [Group(g.message, g.roles, None) for g in GROUPS]
    scooter, e = Scooter(soc=0.8, period=8.0), estimator(groups)
    rows = follow(e, scooter.live(600, 10.0), scooter)
    assert rows[-1][1].reasons & Reason.SIGNALS_SLOW
    assert rows[-1][1].state is State.INVALID


def test_a_message_that_becomes_slow_is_noticed_and_forgiven():
    scooter, e = Scooter(soc=0.8), estimator()
    follow(e, scooter.live(100, 10.0), scooter)
    scooter.period = 8.0
    rows = follow(e, scooter.live(100, 10.0), scooter)
    assert rows[-1][1].reasons & Reason.SIGNALS_SLOW
    scooter.period = 0.1
    rows = follow(e, scooter.live(100, 10.0), scooter)
    assert not rows[-1][1].reasons & Reason.SIGNALS_SLOW
    assert rows[-1][1].range is not None


def test_messages_that_come_in_bursts_are_integrated_over_their_long_gaps():
    scooter, e, whole = Scooter(soc=0.8), estimator(), estimator()
    begin = scooter.distance
    for event in scooter.live(90):
        e.handle(event)
        whole.handle(event)
    knows(e, scooter)
    knows(whole, scooter)
    rows, usual = [], []
    for number in range(200):  # two samples 0.1 s apart, then 4 s of silence
        if number == 20:
            knows(e, scooter)
            knows(whole, scooter)
        burst = list(scooter.live(0.2, 10.0))
        rows += follow(e, burst, scooter)
        usual += follow(whole, burst, scooter)
        follow(whole, scooter.live(3.9, 10.0), scooter)
    _, end = rows[-1]
    assert end.distance == pytest.approx(scooter.distance - begin, rel=0.1)
    assert worst(rows) < 3
    assert rows[1][1].soc_sd > 1.6 * usual[1][1].soc_sd  # the first gap: nobody knows yet that it is none
    assert end.soc_sd > 1.08 * usual[-1][1].soc_sd  # later: what flows between two samples is not known


@pytest.mark.parametrize(("seconds", "speed"), [(20.0, 10.0), (20.0, 24.0)])
def test_what_flows_while_nothing_is_heard_is_not_known(seconds, speed):
    scooter, e = Scooter(soc=0.7, seed=1), estimator()
    follow(e, scooter.live(60), scooter)
    knows(e, scooter)
    scooter.away(seconds, speed)
    assert worst(follow(e, scooter.live(1.0, speed), scooter)) < 3


@pytest.mark.parametrize("told", [True, False])
def test_the_wait_for_a_first_voltage_counts_as_age(told):
    scooter, e = Scooter(soc=0.75), estimator()
    follow(e, heard(scooter.live(400, 10.0), own_soc=told, odometer=told), scooter)
    waited, aged, young = restarted(e, 3.0), restarted(e, 60.0), restarted(e, 3.0)
    waited.pack.wait(57.0)
    scooter.away(60, 10.0)
    events = list(heard(scooter.live(3, 10.0), own_soc=told, odometer=told))
    sds = []
    for each in (waited, aged, young):
        follow(each, events, scooter)
        sds.append(each.estimate(scooter.time).soc_sd)
    assert sds[0] == pytest.approx(sds[1])
    assert sds[2] != pytest.approx(sds[1], rel=0.2)
    assert abs(waited.estimate(scooter.time).soc - scooter.soc) < 3 * sds[0]


@pytest.mark.parametrize("age", [-5.0, float("nan"), float("inf"), -1e9])
def test_an_age_that_is_none_is_not_known(age):
    scooter, e = Scooter(soc=0.75), estimator()
    follow(e, scooter.live(60), scooter)
    e, unknown = restarted(e, age), restarted(e, None)
    events = list(scooter.live(30))
    rows = follow(e, events, scooter)
    assert worst(rows) < 3
    assert rows == follow(unknown, events, scooter)


@pytest.mark.parametrize("temperature", [-20.0, -10.0])
@pytest.mark.parametrize("volts", [2.4, 2.8, 3.1])
def test_a_first_state_of_charge_is_within_the_table(temperature, volts):
    soc, sd = soc_from_voltage(BATTERY, volts, 2.0, temperature, 0.8, 0.8)
    assert -0.02 <= soc <= 1.02
    assert 0 < sd <= 0.5


def test_a_sensor_that_twitches_at_standstill_is_no_motion():
    scooter, e = Scooter(soc=0.75), estimator()
    follow(e, scooter.live(20), scooter)
    follow(e, scooter.live(540, 10.0), scooter)
    follow(e, scooter.live(130), scooter)
    duration = e.forecaster.learner._segment.duration
    twitching = ((t, g, (4.0,) if g == MOTOR and t % 60 < 0.1 else v) for t, g, v in scooter.live(1200))
    follow(e, twitching, scooter)
    assert e.forecaster.learner._segment.duration == duration


def test_a_charge_that_pauses_says_no_time_until_full():
    scooter, e = Scooter(soc=0.5), estimator()
    follow(e, scooter.live(20), scooter)
    assert follow(e, scooter.live(60, charge=10.9), scooter)[-1][1].time_to_full
    _, row = follow(e, scooter.live(5, charge=0.9), scooter)[-1]  # plugged in, and nothing flows into the pack
    assert row.activity is Activity.CHARGING
    assert row.time_to_full is None
    _, row = follow(e, scooter.live(65, charge=0.9), scooter)[-1]
    assert row.activity is Activity.PARKED
    assert row.range_full is None


@pytest.mark.parametrize("shown", [1.0, 3.0], ids=["plugged in", "not available"])
def test_a_plug_without_a_current_is_no_charge(shown):
    scooter, e = Scooter(soc=0.17), estimator()
    told = ((t, g, (v[0], shown) if g == OTHERS else v) for t, g, v in scooter.live(200))
    rows = follow(e, told, scooter)
    assert {row.activity for _, row in rows[2:]} == {Activity.PARKED}
    assert rows[-1][1].range_full is None


def test_a_plug_is_believed_where_no_current_is_known():
    scooter, e = Scooter(soc=0.17), estimator([GROUPS[MOTOR], GROUPS[OTHERS]])
    for t, group, values in scooter.live(200):
        if group in (MOTOR, OTHERS):
            e.handle((t, int(group == OTHERS), (values[0], 1.0) if group == OTHERS else values))
    assert e.estimate(t).activity is Activity.CHARGING


@pytest.mark.parametrize("start", [0.2, 0.6])
def test_a_charge_says_when_it_will_be_full_and_how_far_that_goes(start):
    """Against the truth of a charger that holds 10 A and then the voltage of a full cell."""
    scooter, e = Scooter(soc=start), estimator()
    follow(e, scooter.live(20), scooter)
    follow(e, scooter.live(600, 10.0), scooter)
    _, ridden = follow(e, scooter.live(60), scooter)[-1]
    begin = scooter.soc
    _, row = follow(e, scooter.live(300, charge=10.9), scooter)[-1]
    assert row.activity is Activity.CHARGING
    assert row.charge_power == pytest.approx(10.0 * row.pack_voltage, rel=0.03)
    constant = (1 - scooter.soc) * scooter.capacity / 10.0 * 3600
    assert constant < row.time_to_full < constant + 3600  # the voltage of a full cell holds it up at the end
    assert begin < scooter.soc
    scooter.soc = 1.0
    knows(e, scooter)
    _, after = follow(e, scooter.live(60, 8.0), scooter)[-1]
    assert row.range_full == pytest.approx(after.range, rel=0.03)
    assert (after.charge_power, after.time_to_full, after.range_full) == (None, None, None)
    assert ridden.range_full is None


def test_a_state_of_charge_begun_anew_ends_what_was_held_back_of_the_range():
    """As of a pack that was swapped: no gap of the one before; what the filter learns by and by leaves it."""
    scooter, e = Scooter(), estimator()
    follow(e, scooter.live(300, 10.0), scooter)
    smoother = e.forecaster.smoother
    smoother.gap = 4000.0
    follow(e, scooter.live(1, 10.0), scooter)
    assert smoother.gap > 3000
    scooter.soc = 0.3
    e.pack.state = e.pack.state._replace(soc=0.3)
    follow(e, scooter.live(2, 10.0), scooter)
    assert abs(smoother.gap) < 300


def test_a_long_stop_is_parking_and_a_bus_that_falls_silent_then_is_asleep():
    scooter, e = Scooter(), estimator()
    follow(e, scooter.live(20), scooter)
    follow(e, scooter.live(200, 10.0), scooter)
    scooter.speed = 0.0
    rows = follow(e, scooter.live(180), scooter)
    assert rows[30][1].activity is Activity.STANDING
    assert rows[-1][1].activity is Activity.PARKED
    assert e.estimate(scooter.time + 30).activity is Activity.ASLEEP
    follow(e, scooter.live(60, 10.0), scooter)
    assert e.estimate(scooter.time + 30).activity is Activity.UNKNOWN  # the bus broke on the ride


@pytest.mark.parametrize("role", ["key", "contactor"])
def test_without_key_or_contactor_a_stop_is_parking_at_once(role):
    groups = [*GROUPS, Group("Switch", (role,), 1.0)]
    scooter, e = Scooter(), estimator(groups)
    follow(e, scooter.live(60, 10.0), scooter)
    scooter.speed = 0.0
    for t, group, values in scooter.live(10):
        e.handle((t, group, values))
        if group == OTHERS:
            e.handle((t + 0.001, len(GROUPS), (0.0,)))
    assert e.estimate(scooter.time).activity is Activity.PARKED


def test_joined_mid_ride_it_says_so_until_a_rest_shows_the_state_of_charge():
    scooter, e = Scooter(seed=7), estimator()
    scooter.away(700, 11.0)
    scooter.speed = 11.0
    rows = follow(e, scooter.live(120, 11.0), scooter)
    assert {row.activity for _, row in rows[10:30]} == {Activity.JOINED}
    scooter.speed = 0.0
    follow(e, scooter.live(3600), scooter)
    rows = follow(e, scooter.live(20, 11.0), scooter)
    assert rows[-1][1].activity is Activity.RIDING


@pytest.mark.parametrize("leap", [200.0, 3000.0, 86_400.0])
def test_a_clock_that_was_set_under_way_is_no_gap(leap):
    """The odometer goes on, so nothing was missed."""

    def ridden(leap):
        scooter, e = Scooter(soc=0.8), estimator()
        follow(e, scooter.live(20), scooter)
        follow(e, scooter.live(420, 10.0), scooter)
        scooter.time += leap
        return e, follow(e, scooter.live(400, 10.0), scooter)[-1][1]

    (e, end), (_, usual) = ridden(leap), ridden(0.0)
    assert e.gap_time == 0.0
    assert end.soc == pytest.approx(usual.soc, abs=0.001)
    assert end.soc_sd == pytest.approx(usual.soc_sd, rel=0.05)
    assert end.distance == pytest.approx(usual.distance, abs=30)
    assert end.range == pytest.approx(usual.range, rel=0.01)
    assert not end.reasons & ~usual.reasons


@pytest.mark.parametrize("ridden", [10.0, 0.0])
def test_a_gap_on_the_way_is_a_gap(ridden):
    scooter, e = Scooter(soc=0.8), estimator()
    follow(e, scooter.live(20), scooter)
    follow(e, scooter.live(400, 10.0 if ridden else 0.0), scooter)
    scooter.away(600, ridden)
    follow(e, scooter.live(100, 10.0), scooter)
    assert e.gap_time == pytest.approx(600, abs=5)


@pytest.mark.parametrize("make", [Scooter, flat_pack])
def test_a_current_that_shows_nothing_while_the_bus_is_awake_is_no_better_known_than_the_load(make):
    """Many sensors show small currents as 0; of a pack with a flat voltage nothing corrects it."""
    scooter = make(soc=0.9, offset=0.0)
    e = estimator(vehicle=scooter.vehicle)
    follow(e, scooter.live(30), scooter)
    follow(e, scooter.live(300, 10.0), scooter)
    knows(e, scooter)
    scooter.period = 1.0
    events = ((t, g, (v[0], 0.0, None) if g == PACK else v) for t, g, v in scooter.live(5 * 3600) if g != INVERTER)
    rows = follow(e, events, scooter)
    assert worst(rows) < 1.3
    assert rows[100][1].soc_sd < 0.2 * rows[-1][1].soc_sd or make is Scooter
