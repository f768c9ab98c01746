"""P10 and P90 of energy and consumption together."""

from __future__ import annotations

from math import exp

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.estimator.interval import DECILE, deciles


def test_each_alone_is_its_own_distribution():
    assert deciles(4e6, 3e5, 2e5, 0.0) == pytest.approx((4e6 - DECILE * 3e5, 4e6 + DECILE * 2e5))
    assert deciles(4e6, 0.0, 0.0, 0.01) == pytest.approx((4e6 * exp(-DECILE * 0.1), 4e6 * exp(DECILE * 0.1)))
    assert deciles(0.0, 3e5, 2e5, 0.01) == deciles(-1e4, 3e5, 2e5, 0.01) == (0.0, DECILE * 2e5)


@given(st.floats(1.0, 1e7), st.floats(1e3, 1e6), st.floats(1e3, 1e6), st.floats(0, 1))
def test_nothing_jumps_as_the_battery_empties(energy, down, up, variance):
    """A thousandth less energy moves both by little, of what is left or of its error; and P10 <= energy <= P90."""
    p10, p90 = deciles(energy, down, up, variance)
    assert p10 <= energy <= p90
    less = deciles(0.999 * energy, down, up, variance)
    assert p10 - less[0] == pytest.approx(0, abs=0.02 * (energy + down))
    assert p90 - less[1] == pytest.approx(0, abs=0.01 * p90)
