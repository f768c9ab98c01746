"""First-order relaxation over a ride and its mean."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.model.functions import mean_response
from gz_onboard.model.series import relaxation

steps = st.lists(st.tuples(st.floats(-5, 5), st.floats(0, 1)), min_size=1, max_size=30)


@given(steps, st.floats(-5, 5))
def test_a_ride_is_its_steps(rows, start):
    x, one_by_one = start, []
    for target, decay in rows:
        x = decay * x + (1 - decay) * target
        one_by_one.append(x)
    targets, decays = zip(*rows, strict=True)
    before = np.array([start, *one_by_one[:-1]])
    assert relaxation(np.array(targets), np.array(decays), start) == pytest.approx(np.array(one_by_one), abs=1e-13)
    assert relaxation(np.array(targets), np.array(decays), start, before=True) == pytest.approx(before, abs=1e-13)


def test_it_is_the_solution_of_the_equation():
    assert relaxation(np.full(600, 2.0), np.full(600, exp(-1 / 60)))[-1] == pytest.approx(2.0 * (1 - exp(-10)))


@given(st.floats(0.01, 50.0))
def test_the_mean_over_a_load_is_that_of_its_steps(time_constant):
    fine = exp(-10.0 / 2000 / time_constant)
    values = relaxation(np.ones(2000), np.full(2000, fine))
    assert mean_response(exp(-10.0 / time_constant)) == pytest.approx(np.mean(values), abs=2e-3 + 0.3 * (1 - fine))
