"""LateralTyre and lean geometry against definitions, rotations and published figures."""

from __future__ import annotations

from math import asin, atan, cos, degrees, pi, radians, sin, tan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.simulation.turning.tyre import (
    LateralTyre,
    front_camber,
    ground_steer,
    handlebar_of,
    ideal_of,
    lean_of,
    rolling_radius,
)
from tests.simulation.turning.reference import front_wheel

TYRE = LateralTyre(15, camber_stiffness=0.85, friction=1.2, twisting_arm=0.02, relaxation_length=0.15)
angles = st.floats(-0.7, 0.7)
slips = st.floats(-1.5, 1.5)


@given(slip=slips, camber=angles)
def test_side_force_is_odd_and_within_grip(slip, camber):
    force = TYRE.side_force(slip, camber)
    assert abs(force) <= TYRE.friction
    assert TYRE.side_force(-slip, -camber) == -force


def test_side_force_has_its_stiffness_at_small_angles():
    assert TYRE.side_force(1e-5, 0) / 1e-5 == pytest.approx(15, rel=1e-6)
    assert TYRE.side_force(0, 1e-5) / 1e-5 == pytest.approx(0.85, rel=1e-6)


def test_side_force_peaks_at_the_friction():
    peak = max(TYRE.side_force(radians(x / 10), 0) for x in range(400))
    assert peak == pytest.approx(1.2, rel=1e-4)


@pytest.mark.parametrize(("forward", "sideways"), [(10.0, 1.0), (10.0, -1.0), (3.0, 0.4)])
def test_slip_reaches_the_angle_of_its_motion_over_the_relaxation_length(forward, sideways):
    angle = -atan(sideways / forward)
    assert TYRE.slip_rate(angle, forward, sideways) == pytest.approx(0)
    assert TYRE.slip_rate(0.0, forward, sideways) == pytest.approx(angle * forward / 0.15)


def test_slip_at_standstill_is_finite():
    assert TYRE.slip_rate(0.3, 0.0, 0.0) == pytest.approx(-0.3 * 0.5 / 0.15)


@given(ideal=st.floats(-1.0, 1.0), crown=st.floats(0.001, 0.12), height=st.floats(0.4, 0.9))
def test_leaning_machine_is_in_balance_about_its_contact(ideal, crown, height):
    """The resultant of weight and centrifugal force goes through the contact, wherever the crown puts it."""
    lean = lean_of(ideal, crown, height)
    sideways, up = (height - crown) * sin(lean), crown + (height - crown) * cos(lean)
    assert sideways * 1.0 == pytest.approx(up * tan(ideal), abs=1e-12)
    assert ideal_of(lean, crown, height) == pytest.approx(ideal, abs=1e-12)
    assert abs(lean) >= abs(ideal)


def test_published_leans():
    """10 m/s on a circle of 10 m: 45.6 degrees as a thin disc (a worked example of many texts)."""
    ideal = atan(10**2 / (9.80665 * 10))
    assert degrees(ideal) == pytest.approx(45.6, abs=0.05)
    # Cossalter 2006, sec. 4.1: Δφ = asin(t·sin φ_i/(h - t)).
    more = degrees(lean_of(ideal, 0.1, 0.6) - ideal)
    assert more == pytest.approx(degrees(asin(0.1 * sin(ideal) / 0.5)), rel=1e-12)
    assert 8.0 < more < 8.4


@given(handlebar=angles, lean=angles, caster=st.floats(0.1, 0.8))
def test_front_wheel_is_a_turned_and_rolled_wheel(handlebar, lean, caster):
    """Our lean is positive right and our steer positive left; the reference has both positive right."""
    steer, camber = front_wheel(-handlebar, lean, caster)
    assert ground_steer(handlebar, lean, caster) == pytest.approx(-steer, abs=1e-12)
    assert front_camber(handlebar, lean, caster) == pytest.approx(-camber, abs=1e-12)


@given(steer=st.floats(-0.5, 0.5), lean=angles, caster=st.floats(0.1, 0.8))
def test_handlebar_and_ground_steer_are_inverse(steer, lean, caster):
    assert ground_steer(handlebar_of(steer, lean, caster), lean, caster) == pytest.approx(steer, abs=1e-12)


def test_wheel_rolls_on_the_side_of_its_crown():
    assert rolling_radius(0.245, 0.05, 0.0) == 0.245
    assert rolling_radius(0.245, 0.05, pi / 3) == pytest.approx(0.195 + 0.05 * cos(pi / 3))
