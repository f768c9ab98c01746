"""One definition of first-order relaxation, for a step and for a ride."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.offline.series import relaxation
from gz_onboard.physics.functions import decay_over, mean_response, relaxed

steps = st.lists(st.tuples(st.floats(-5, 5), st.floats(0, 1)), min_size=1, max_size=30)


@given(steps, st.floats(-5, 5))
def test_a_ride_is_its_steps(rows, start):
    x, one_by_one = start, []
    for target, decay in rows:
        x = relaxed(x, target, decay)
        one_by_one.append(x)
    targets, decays = zip(*rows, strict=True)
    before = np.array([start, *one_by_one[:-1]])
    assert relaxation(np.array(targets), np.array(decays), start) == pytest.approx(np.array(one_by_one), abs=1e-13)
    assert relaxation(np.array(targets), np.array(decays), start, before=True) == pytest.approx(before, abs=1e-13)
    assert relaxed(before, np.array(targets), np.array(decays)) == pytest.approx(one_by_one)


@given(st.floats(0.01, 100), st.floats(1, 1000), st.floats(-1, 1), st.floats(-1, 1))
def test_two_half_steps_are_one(dt, time_constant, x, target):
    half = decay_over(dt / 2, time_constant)
    whole = relaxed(x, target, decay_over(dt, time_constant))
    assert relaxed(relaxed(x, target, half), target, half) == pytest.approx(whole, abs=1e-12)


def test_it_is_the_solution_of_the_equation():
    assert relaxed(1.0, 0.0, decay_over(30.0, 60.0)) == pytest.approx(exp(-0.5))
    assert relaxation(np.full(600, 2.0), np.full(600, decay_over(1.0, 60.0)))[-1] == pytest.approx(2.0 * (1 - exp(-10)))


@given(st.floats(0.01, 50.0))
def test_the_mean_over_a_load_is_that_of_its_steps(time_constant):
    fine = decay_over(10.0 / 2000, time_constant)
    values = relaxation(np.ones(2000), np.full(2000, fine))
    assert mean_response(decay_over(10.0, time_constant)) == pytest.approx(np.mean(values), abs=2e-3 + 0.3 * (1 - fine))


def test_no_steps_have_no_values():
    assert len(relaxation(np.zeros(0), np.zeros(0), 1.0)) == 0


def test_the_mean_over_a_load_at_its_limits():
    assert mean_response(0.0) == 1.0
    assert mean_response(1.0) == 0.0
