"""Means, integrals and bends of a series."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.arrays import bends, block_means, held_at, held_integral, running_mean, stretches

TIME, VALUES = np.array([0.0, 1.0, 3.0]), np.array([2.0, 5.0, 7.0])


def test_means():
    assert block_means(np.arange(7.0), 3) == pytest.approx([1.0, 4.0])
    assert running_mean(np.array([0.0, 3.0, 6.0, 0.0]), 3) == pytest.approx([1.0, 3.0, 3.0, 2.0])


@given(st.lists(st.floats(-100, 100), min_size=1, max_size=30), st.integers(0, 40))
def test_a_running_mean_keeps_shape_and_bounds(values, half):
    smooth = running_mean(np.array(values), min(2 * half + 1, len(values) // 2 * 2 + 1))
    assert len(smooth) == len(values)
    assert min(values) - 1e-9 <= min(smooth) <= max(smooth) <= max(values) + 1e-9


def test_stretches():
    assert stretches([True, False, False, True, True]) == [(0, 1), (3, 5)]
    assert stretches(np.array([], dtype=bool)) == stretches([False]) == []


def test_what_is_held():
    assert held_at(np.array([-1.0, 0.0, 0.9, 1.0, 9.0]), TIME, VALUES).tolist() == [2.0, 2.0, 2.0, 5.0, 7.0]
    assert held_integral(TIME, VALUES) == pytest.approx([0.0, 2.0, 12.0])


def test_a_line_does_not_bend():
    nodes = np.array([0.0, 0.1, 0.4, 0.5])
    assert bends(nodes) @ (3 * nodes + 1) == pytest.approx([0.0, 0.0], abs=1e-12)
    assert bends(nodes) @ np.array([0.0, 1.0, 0.0, 0.0]) == pytest.approx([-1.0, 0.25])
