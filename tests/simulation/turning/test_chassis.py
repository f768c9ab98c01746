"""Energy, symmetry, limits and convergence of the three chassis models."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from math import isfinite, radians, tan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.model.effects import cornering_drag
from gz_onboard.simulation.turning.leaning import Leaning
from gz_onboard.simulation.turning.machine import RoadConditions, step
from gz_onboard.simulation.turning.planar import Planar
from gz_onboard.simulation.turning.straight import Straight
from gz_onboard.simulation.turning.study import coast_down
from gz_onboard.simulation.turning.tyre import ideal_of
from tests.simulation.turning.reference import held

G = 9.80665
CHASSIS = [Straight, Planar, Leaning]


def ride(chassis, state, steer, drive, road, seconds, dt=0.005):
    """(final state, energy by name) with a fixed handlebar and a fixed drive."""
    energy: dict[str, float] = {}
    for _ in range(round(seconds / dt)):
        state, part = step(lambda s: chassis.rates(s, steer, drive, road), state, dt)
        for name, value in part.items():
            energy[name] = energy.get(name, 0.0) + value
    return state, energy


@pytest.mark.parametrize("kind", CHASSIS)
@settings(max_examples=15, deadline=None)
@given(
    speed=st.floats(3, 14),
    bend=st.floats(-0.3, 0.3),
    drive=st.floats(-200, 200),
    grade=st.floats(-0.1, 0.1),
    wind=st.floats(-5, 5),
)
def test_energy_closes(machine, kind, speed, bend, drive, grade, wind):
    chassis = kind(machine)
    road = RoadConditions(grade, wind)
    start = chassis.start(speed)
    steer = bend * G * machine.wheelbase / speed**2  # at most 0.3 g, if the speed were to stay
    end, energy = ride(chassis, start, steer, drive, road, 1.5)
    through = sum(abs(value) for value in energy.values())
    gained = chassis.energy(end) - chassis.energy(start)
    assert gained + sum(energy.values()) == pytest.approx(0, abs=1e-4 * through + 1e-9)


@pytest.mark.parametrize("kind", CHASSIS)
@pytest.mark.parametrize("roll", [0.0, 10.0, 30.0])
def test_energy_of_a_coast_down_closes(machine, kind, roll):
    run = coast_down(kind(machine), radians(roll))
    for i in (len(run.time) // 2, len(run.time) - 1):
        lost = sum(run.lost[i].values())
        assert run.kinetic[0] - run.kinetic[i] == pytest.approx(lost, rel=1e-8)


@pytest.mark.parametrize("kind", [Planar, Leaning])
def test_without_roll_all_are_the_straight_model(machine, kind):
    straight, other = coast_down(Straight(machine), 0.0), coast_down(kind(machine), 0.0)
    assert other.time[-1] == straight.time[-1]
    for ours, theirs in zip(other.seen[::200], straight.seen[::200], strict=True):
        for name in ("speed", "acceleration", "load_front", "load_rear", "rolling_radius", "lean", "slip_front"):
            assert ours[name] == pytest.approx(theirs[name], rel=1e-12, abs=1e-12)


@pytest.mark.parametrize("drive", [0.0, 150.0, -300.0, None])
def test_loads_pitch_as_in_the_straight_model(machine, drive):
    """Eqs. 3.5 to 3.7, on a hill and against wind: the planar model solves them with its tyres."""
    road = RoadConditions(0.08, 4.0)
    straight = Straight(machine).rates(Straight(machine).start(9.0), 0.0, drive, road).seen
    for kind in (Planar, Leaning):
        seen = kind(machine).rates(kind(machine).start(9.0), 0.0, drive, road).seen
        for name in ("load_front", "load_rear", "acceleration", "drive"):
            assert seen[name] == pytest.approx(straight[name], rel=1e-12)
    weight = machine.mass * G * (1 - 0.08**2) ** 0.5
    assert straight["load_front"] + straight["load_rear"] == pytest.approx(weight)
    drag = 0.5 * RoadConditions().air_density * machine.drag_area * 13**2
    push = machine.mass * (straight["acceleration"] + 0.08 * G) + drag
    rear = (weight * (machine.wheelbase - machine.cg_to_rear) + push * machine.cg_height) / machine.wheelbase
    assert straight["load_rear"] == pytest.approx(rear)


@pytest.mark.parametrize("kind", [Planar, Leaning])
def test_left_and_right_are_alike(machine, kind):
    left, right = held(kind(machine), radians(-15), 9.0), held(kind(machine), radians(15), 9.0)
    assert left.seen["yaw_rate"] > 0 > right.seen["yaw_rate"]
    assert left.seen["lean"] <= 0 <= right.seen["lean"]
    for name in ("yaw_rate", "steer", "slip_front", "slip_rear", "side_front", "lean"):
        assert left.seen[name] == pytest.approx(-right.seen[name], rel=1e-9)
    assert left.seen["drive"] == pytest.approx(right.seen["drive"], rel=1e-9)


@pytest.mark.parametrize("kind", CHASSIS)
def test_half_the_step_changes_nothing(machine, kind):
    whole, half = (coast_down(kind(machine), radians(20), slow=8.0, dt=dt) for dt in (0.01, 0.005))
    for distance in (10.0, 30.0, 60.0):
        lost = [run.at_distance(distance, [sum(x.values()) for x in run.lost]) for run in (whole, half)]
        assert lost[0] == pytest.approx(lost[1], rel=1e-6)
    assert whole.at_speed(9.0, "load_front") == pytest.approx(half.at_speed(9.0, "load_front"), rel=1e-5)


@pytest.mark.parametrize("kind", [Planar, Leaning])
@pytest.mark.parametrize("speed", [35.0, 45.0, 80.0])
def test_fast_it_stays_finite_at_ten_milliseconds(machine, kind, speed):
    """Slip settles within the relaxation length: in 2 ms at 80 m/s, faster than a step of 10 ms can follow."""
    chassis = kind(replace(machine, drag_area=0.0))  # whose moment would lift the front wheel
    steer = 0.3 * G * machine.wheelbase / speed**2
    coarse, fine = (ride(chassis, chassis.start(speed), steer, None, RoadConditions(), 2.0, dt) for dt in (0.01, 0.001))
    assert all(isfinite(value) for value in coarse[0])
    assert coarse[0][2] == pytest.approx(fine[0][2], rel=1e-3)
    assert 0.1 * G < coarse[0][2] * speed < 1.2 * G  # it turns, no harder than its tyres hold
    assert coarse[1]["sideslip"] == pytest.approx(fine[1]["sideslip"], rel=1e-3)


def test_runge_kutta_converges_with_the_fourth_power(machine):
    chassis = Leaning(machine)
    start = chassis.start(10.0)
    steps = (0.02, 0.01, 0.0025)
    ends = [ride(chassis, start, 0.02, -20.0, RoadConditions(), 1.0, dt)[0] for dt in steps]
    errors = [max(abs(x - y) for x, y in zip(end, ends[-1], strict=True)) for end in ends[:2]]
    assert errors[0] / errors[1] > 10


@pytest.mark.parametrize("roll", [2.0, 4.0, 8.0])
def test_planar_loss_is_the_closed_form(machine, roll):
    """P = u·(m·a_y)²·(s_f²/C_αf + s_r²/C_αr), the slip of small angles, for each axle with the load it has."""
    seen = held(Planar(machine), radians(roll), 10.0)
    lateral = seen.seen["lateral_acceleration"]
    share = machine.cg_to_rear / machine.wheelbase
    stiff_f = machine.front.cornering_stiffness * seen.seen["load_front"]
    stiff_r = machine.rear.cornering_stiffness * seen.seen["load_rear"]
    expected = 10.0 * (machine.mass * lateral) ** 2 * (share**2 / stiff_f + (1 - share) ** 2 / stiff_r)
    tolerance = 0.002 + 0.2 * (lateral / G) ** 2  # the magic formula bends, and steer turns the forces
    assert seen.power["sideslip"] == pytest.approx(expected, rel=tolerance)
    compliance = share / machine.front.cornering_stiffness + (1 - share) / machine.rear.cornering_stiffness
    drag = cornering_drag.term(10.0, machine.mass, lateral, cornering_compliance=compliance)
    assert drag * 10.0 == pytest.approx(expected, rel=0.01)  # the effect has the static loads


@pytest.mark.parametrize("kind", [Planar, Leaning])
def test_turning_loss_grows_with_the_square_of_lateral_acceleration(machine, kind):
    def loss(roll):
        rates = held(kind(machine), radians(roll), 10.0)
        return rates.power["sideslip"] + rates.power["twisting"], rates.seen["lateral_acceleration"]

    (small, a), (great, b) = loss(1.0), loss(3.0)
    assert great / small == pytest.approx((b / a) ** 2, rel=0.02)


def test_side_force_by_slip_or_by_camber(machine):
    """A leaning machine slips less, by about what camber carries; with camber stiffness 1 it hardly slips at all."""
    planar, leaning = (held(kind(machine), radians(15), 9.0).seen for kind in (Planar, Leaning))
    assert abs(leaning["slip_rear"]) < 0.25 * abs(planar["slip_rear"])
    assert leaning["lateral_acceleration"] == pytest.approx(planar["lateral_acceleration"], rel=1e-6)
    assert leaning["side_front"] + leaning["side_rear"] == pytest.approx(
        planar["side_front"] + planar["side_rear"], rel=0.01
    )
    full = replace(machine, crown=1e-6, rear=replace(machine.rear, camber_stiffness=1.0))
    assert abs(held(Leaning(full), radians(5), 9.0).seen["slip_rear"]) < 1e-3


@pytest.mark.parametrize("roll", [5.0, 15.0, 30.0])
def test_lean_is_the_one_that_the_rider_asks_for(machine, roll):
    rates = held(Leaning(machine), radians(roll), 9.0)
    assert rates.seen["lean"] == pytest.approx(radians(roll), rel=1e-5)
    ideal = ideal_of(radians(roll), machine.crown, machine.cg_height)
    assert -rates.seen["lateral_acceleration"] == pytest.approx(G * tan(ideal), rel=1e-5)
    loads = rates.seen["plane_load_front"] + rates.seen["plane_load_rear"]
    assert loads == pytest.approx(machine.mass * (G**2 + rates.seen["lateral_acceleration"] ** 2) ** 0.5, rel=0.005)
    assert rates.seen["rolling_radius"] < machine.wheel_radius


def test_no_lean_effects_without_twisting_arm_and_crown(machine):
    thin = replace(
        machine, front=replace(machine.front, twisting_arm=0.0), rear=replace(machine.rear, twisting_arm=0.0)
    )
    rates = held(Leaning(thin), radians(20), 9.0)
    assert rates.power["twisting"] == 0
    assert rates.power["rolling"] > 1.04 * machine.rolling(9.0) * machine.mass * G * 9.0


@pytest.mark.parametrize("kind", CHASSIS)
@pytest.mark.parametrize("steer", [0.0, 0.3, -0.6])
def test_comes_to_rest_without_chatter(machine, kind, steer):
    """Braked to a stop in a bend, then left alone: finite all the way, still at the end."""
    chassis = kind(machine)
    state = chassis.start(3.0)
    for _ in range(6000):
        braking = -300.0 * min(1.0, max(-1.0, state[0] / 0.2))
        state, _ = step(partial(chassis.rates, steer=steer, drive=braking, road=RoadConditions()), state, 0.005)
        assert all(isfinite(value) for value in state)
    assert abs(state[0]) < 1e-6
    if kind is not Straight:
        assert abs(state[1]) < 1e-6
        assert abs(state[2]) < 1e-6


@pytest.mark.parametrize("kind", [Planar, Leaning])
def test_starts_from_standstill_with_the_steering_turned(machine, kind):
    state, energy = ride(kind(machine), kind(machine).start(0.0), 0.2, 100.0, RoadConditions(), 5.0)
    assert state[0] > 1
    assert state[2] > 0  # to the left, where it steers
    assert all(isfinite(value) for value in (*state, *energy.values()))


def test_path_is_a_circle_in_a_steady_turn(machine):
    chassis = Planar(machine)
    state, _ = ride(chassis, chassis.start(6.0), 0.1, None, RoadConditions(), 5.0)
    rate, speed = state[2], (state[0] ** 2 + state[1] ** 2) ** 0.5
    after, _ = ride(chassis, state, 0.1, None, RoadConditions(), 3.14159265358979 / rate)
    across = ((after[3] - state[3]) ** 2 + (after[4] - state[4]) ** 2) ** 0.5
    assert across == pytest.approx(2 * speed / rate, rel=2e-3)


@pytest.mark.parametrize("drive", [0.0, 200.0, None])
def test_loads_in_a_turn_balance_pitch(machine, drive):
    """Eq. 3.7 with what the ground pushes along the machine, m·(du/dt - v·r) and the drag, side forces included."""
    chassis, road = Planar(machine), RoadConditions(0.05, 2.0)
    state = (9.0, 0.2, 0.6, 0.0, 0.0, 0.0, 0.06, 0.04)
    rates = chassis.rates(state, 0.35, drive, road)
    drag, slope = machine.resistance(9.0, road)
    push = machine.mass * (rates.change[0] - 0.2 * 0.6) + drag + slope
    front = (machine.weight(road) * machine.cg_to_rear - push * machine.cg_height) / machine.wheelbase
    assert rates.seen["load_front"] == pytest.approx(front, rel=1e-12)


def test_distance_is_the_one_ridden(machine):
    run = coast_down(Straight(machine), 0.0)
    assert run.distance[-1] == pytest.approx(run.states[-1][1] - run.states[0][1], rel=1e-6)
