"""What is believed of two kinds of pack, against the same by brute force on a grid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.estimator.ageing_kinds import RESISTANCE_AGED_SD, TOGETHER, Kinds

KINDS = Kinds(0.5, 0.01, 0.16)
PSI, MORE = np.arange(-0.8, 1.2, 0.0005), np.arange(-1.5, 2.5, 0.01)


def normal(x, variance):
    return np.exp(-(x**2) / variance / 2) / np.sqrt(variance)


def by_force(seen, seen_sd, factor, factor_sd):
    """(P(as new), mean, variance, P10, P90 of ψ) given a direct sight of ψ - 1 and of the resistance."""
    likely = normal(PSI - seen, seen_sd**2)
    new = normal(PSI, KINDS.new_sd**2) * normal(factor - 1, factor_sd**2) * likely
    sds = KINDS.old_sd, RESISTANCE_AGED_SD
    x, y = PSI[:, None] / sds[0], MORE[None, :] / sds[1]
    joint = np.exp(-(x * x - 2 * TOGETHER * x * y + y * y) / 2 / (1 - TOGETHER**2))
    joint /= 2 * np.pi * sds[0] * sds[1] * np.sqrt(1 - TOGETHER**2)
    old = (joint * normal(factor - 1 - MORE, factor_sd**2)).sum(axis=1) * 0.01 * likely * np.sqrt(2 * np.pi)
    both = new + old
    mean = (both * PSI).sum() / both.sum()
    below = np.cumsum(both) / both.sum()
    deciles = (PSI[np.searchsorted(below, share)] for share in (0.1, 0.9))
    return new.sum() / both.sum(), mean, (both * (PSI - mean) ** 2).sum() / both.sum(), *deciles


@pytest.mark.parametrize("seen", [(0.0, 0.03), (0.02, 0.05), (0.2, 0.05), (0.3, 0.4), (-0.05, 0.02)])
@pytest.mark.parametrize("resistance", [(1.0, 0.12), (1.3, 0.15), (1.5, 0.12), (1.1, 0.3)])
def test_it_is_what_bayes_theorem_says(seen, resistance):
    """The filter's ψ is a sight of it together with the prior of both kinds as one normal distribution."""
    prior = KINDS.variance
    variance = 1 / (1 / prior + 1 / seen[1] ** 2)
    found = KINDS.belief(1 + variance * seen[0] / seen[1] ** 2, variance, 0.0, resistance)
    _, mean, expected, low, high = by_force(*seen, *resistance)
    assert found.inverse - 1 == pytest.approx(mean, abs=0.001)
    assert found.variance == pytest.approx(expected, rel=0.01, abs=1e-6)
    assert (found.low - 1, found.high - 1) == pytest.approx((low, high), abs=0.0015)


def test_nothing_seen_is_the_prior():
    found = KINDS.belief(1.0, KINDS.variance, 0.0)
    assert (found.inverse, found.variance) == pytest.approx((1.0, KINDS.variance))
    assert found.high - 1 == pytest.approx(1 - found.low)


def test_a_resistance_that_is_known_badly_or_low_tells_next_to_nothing():
    """Tables that are not of this cell, and a pack with less resistance than its file's."""
    assert KINDS.belief(1.0, KINDS.variance, 0.0, (2.0, 5.0)).inverse == pytest.approx(1.0, abs=0.01)
    assert KINDS.belief(1.0, KINDS.variance, 0.0, (0.5, 0.12)).inverse == 1.0


def test_more_resistance_makes_less_capacity_likely():
    inverse = [KINDS.belief(1.0, KINDS.variance, 0.0, (x, 0.12)).inverse for x in (1.0, 1.2, 1.4, 1.6, 2.0)]
    assert inverse == sorted(inverse)
    assert inverse[0] == pytest.approx(1.0)
    assert inverse[3] > 1.15


@settings(deadline=None)
@given(st.floats(0.5, 2.5), st.floats(1e-6, 1.0), st.floats(-0.5, 0.5), st.floats(0.5, 4.0), st.floats(0.01, 1e3))
def test_whatever_is_seen_the_belief_is_a_number(inverse, share, with_soc, factor, sd):
    found = KINDS.belief(inverse, share * KINDS.variance, with_soc, (factor, sd))
    assert np.isfinite(found).all()
    assert found.variance > 0
    assert found.low <= found.high
