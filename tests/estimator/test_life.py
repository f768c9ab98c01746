"""Ordinary life: standing, charging, joining a ride, restarts, power cuts, slow messages."""

from __future__ import annotations

import json
from math import exp

import pytest

from gz_onboard.events import Activity, Cause, Group, Reason, State
from tests.estimator.life import (
    BATTERY,
    GROUPS,
    INVERTER,
    MOTOR,
    OTHERS,
    PACK,
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
    assert e.forecaster.learner.auxiliaries.mean == pytest.approx(355.0, abs=20)


def test_a_plug_that_says_yes_for_ever_does_not_stop_the_learning():
    scooter, e = Scooter(), estimator()
    stuck = ((t, g, (v[0], 1.0) if g == 4 else v) for t, g, v in scooter.live(900, 10.0))
    rows = follow(e, stuck, scooter)
    assert rows[-1][1].activity is Activity.RIDING
    assert not rows[-1][1].reasons & Reason.PRIOR_RIDING


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


# --- a ride ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_the_true_state_of_charge_is_within_three_sd_all_the_way(seed):
    scooter, e = Scooter(seed=seed, soc=0.35 + 0.15 * seed, offset=0.1), estimator()
    rows = follow(e, scooter.live(900, 9.0), scooter)
    assert worst(rows) < 3
    assert rows[-1][1].soc_sd < 0.03
    assert rows[-1][1].state is State.VALID


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ({"version": 99}, "version"),
        ({"key": "other"}, "other"),
        ({"soc": 7.0}, "not from 0 to 1"),
        ({"soc_variance": 2e-9}, "impossible"),
        ({"soc_variance": None}, "damaged"),
        ({"soc_variance": 0.3}, "damaged"),
        ({"error_variance": float("inf")}, "damaged"),
        ({"riding": {}}, "damaged"),
        ({"soc": float("nan")}, "state.soc is nan"),
        ({"consumption": -1e300}, "damaged"),
        ({"odometer": 1e308}, "damaged"),
        ({"current": 1e200}, "damaged"),
        ({"own_soc": 1e200}, "damaged"),
        ({"gyro_bias": [0.0, 0.5]}, "damaged"),
        ({"v1": float("nan")}, "damaged"),
        ({"cell_effects": {}}, "damaged"),
    ],
)
def test_a_snapshot_that_does_not_fit_is_refused(damage, said):
    scooter, e = Scooter(), estimator()
    follow(e, scooter.live(60, 9.0), scooter)
    with pytest.raises(ValueError, match=said):
        estimator().restore({**e.snapshot("key"), **damage}, "key", 5.0)


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


# --- restarts -------------------------------------------------------------------------------------------------------

AWAY = [  # s, m/s, A
    (590, 10.0, 0.0),
    (1200, 10.0, 0.0),
    (600, 0.0, 10.0),  # charged by 5 %
    (7200, 0.0, 3.5),
    (7200, 0.0, 0.0),
    (20, 11.0, 0.0),
    (3, 11.0, 0.0),
]
LESS_TOLD = [("all", False), ("neither", True), ("no own", True)]


PACKS = pytest.mark.parametrize("make", [Scooter, flat_pack])
"""Of a flat pack no rest repairs within seconds what a restart has taken up wrongly."""


@PACKS
@pytest.mark.parametrize(
    ("seconds", "speed", "charge", "told", "clock"),
    [
        *((*away, "all", True) for away in AWAY),
        *((*away, told, clock) for away in AWAY[1:5:2] for told, clock in LESS_TOLD),
    ],
)
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
    assert end.activity is Activity.RIDING, "what was saved is of before this ride: none was joined"
    assert end.soc_sd < ((0.6 if make is Scooter else 0.7) if clock and seconds <= 60 else 1.2) * without.soc_sd
    assert without.reasons & Reason.PRIOR_RIDING
    assert not end.reasons & Reason.PRIOR_RIDING  # what a kilometre costs is known at once, whatever has flowed
    assert end.consumption_expected_sd < without.consumption_expected_sd


def test_a_vehicle_that_wakes_with_an_empty_gauge_is_waited_for():
    """Its own state of charge reads 0 for three seconds after a night, as some do while they start."""
    scooter = flat_pack(soc=0.75)
    e = estimator(vehicle=scooter.vehicle)
    follow(e, scooter.live(400, 10.0), scooter)
    scooter.auxiliary = 0.0
    scooter.away(8 * 3600)
    healthy, waking = (restarted(e, 8 * 3600, scooter.vehicle) for _ in range(2))
    begin = scooter.time
    for t, group, values in scooter.live(20):
        healthy.handle((t, group, values))
        waking.handle((t, group, (*values[:2], 0.0) if group == PACK and t < begin + 3 else values))
    right, found = healthy.estimate(scooter.time), waking.estimate(scooter.time)
    assert found.soc == pytest.approx(right.soc, abs=0.005)
    assert found.soc_sd == pytest.approx(right.soc_sd, rel=0.02)


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


def test_a_message_that_becomes_slow_is_noticed_and_forgiven():
    scooter, e = Scooter(soc=0.8), estimator()
    follow(e, scooter.live(100, 10.0), scooter)
    scooter.period = 8.0
    rows = follow(e, scooter.live(100, 10.0), scooter)
    assert rows[-1][1].reasons & Reason.SIGNALS_SLOW
    assert rows[-1][1].state is State.INVALID
    scooter.period = 0.1
    rows = follow(e, scooter.live(100, 10.0), scooter)
    assert not rows[-1][1].reasons & Reason.SIGNALS_SLOW
    assert rows[-1][1].range is not None


@pytest.mark.parametrize("age", [-5.0, float("nan"), float("inf"), -1e9])
def test_an_age_that_is_none_is_not_known(age):
    scooter, e = Scooter(soc=0.75), estimator()
    follow(e, scooter.live(60), scooter)
    e, unknown = restarted(e, age), restarted(e, None)
    events = list(scooter.live(30))
    rows = follow(e, events, scooter)
    assert worst(rows) < 3
    assert rows == follow(unknown, events, scooter)


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


def test_what_was_learned_from_a_doubled_speed_is_unlearned():
    scooter, e = Scooter(soc=0.9), estimator()
    follow(e, scooter.live(60), scooter)
    before = e.forecaster.learner.factor
    doubled = ((t, g, (2 * (v[0] or 0.0),) if g == MOTOR else v) for t, g, v in scooter.live(400, 10.0))
    _, end = follow(e, doubled, scooter)[-1]
    assert "motor_speed" in end.distrusted
    assert end.speed is None
    assert e.forecaster.learner.factor == before


def test_a_speed_of_zero_with_the_current_of_a_drive_is_no_standing():
    scooter, e = Scooter(soc=0.9), estimator()
    follow(e, scooter.live(300, 10.0), scooter)
    dead = ((t, g, (0.0,) if g == MOTOR else v) for t, g, v in scooter.live(60, 10.0))
    rows = follow(e, dead, scooter)
    assert all(row.activity is Activity.UNKNOWN for _, row in rows[15:40])
    assert not e._activity.teaches


def test_a_doubted_current_is_still_compared_with_the_sag_of_the_voltage():
    """It is believed again once it explains the voltage; the current of the model, used meanwhile, proves nothing."""
    scooter, e = Scooter(soc=0.9), estimator()
    events = [event for event in scooter.live(400, 15.0) if event[1] != INVERTER]
    tripled = ((t, g, (v[0], 3 * (v[1] or 0.0), v[2]) if g == PACK and t > 120 else v) for t, g, v in events)
    _, end = follow(e, tripled, scooter)[-1]
    assert "pack_current" in end.distrusted
    assert end.current_modelled
    assert e.electrical.sag.ratio == pytest.approx(1 / 3, rel=0.3)
