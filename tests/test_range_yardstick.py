"""The estimators that the range is held against, and the scores of an estimate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from benchmarks.range_rides import Truth
from benchmarks.range_yardstick import RESERVE, Usual, crps, jumps


def test_the_mean_of_25_km_forgets_and_that_of_the_trip_does_not():
    usual = Usual(capacity=6e6, rated_range=50_000.0)
    for power in (1000.0, 2000.0):  # 100 and 200 J/m, 30 km each
        for _ in range(3000):
            usual.ride(power, 10.0, 1.0)
    ranges = usual.ranges(0.65)
    assert ranges["rolling"] == pytest.approx(0.65 * 6e6 / 200)
    assert ranges["rolling_reserve"] == pytest.approx((0.65 - RESERVE) * 6e6 / 200)
    assert ranges["trip"] == pytest.approx(0.65 * 6e6 / 150)
    assert usual.ranges(0.1)["rolling_reserve"] == 0.0


def test_score_of_a_normal_distribution():
    ten = 1.2815515655446004
    for off in (0.0, 0.7, -2.0):  # in standard deviations: Gneiting & Raftery 2007, eq. 21
        exact = off * (2 * norm.cdf(off) - 1) + 2 * norm.pdf(off) - 1 / np.sqrt(np.pi)
        assert crps(10.0, 10.0 - ten, 10.0 + ten, 10.0 + off) == pytest.approx(exact, rel=0.02)


def test_a_forecast_that_falls_with_the_way_does_not_jump():
    distance = np.arange(0.0, 20_000.0, 50.0)
    calm = 40_000.0 - distance
    assert jumps(distance, calm) == pytest.approx(np.zeros(19), abs=1e-6)
    calm[200:] += 1500.0
    assert sorted(jumps(distance, calm))[-1] == pytest.approx(1500.0, rel=0.05)


def test_who_knows_all_but_the_height_errs_by_what_it_stores():
    """100 J/m, of which a climb over the second half stores 20: half way that half looks a fifth cheaper."""
    time = np.arange(0.0, 1001.0)
    way = 10.0 * time
    truth = Truth(time, way, 1 - time / 1000, 100.0 * way, 20.0 * np.maximum(way - 5000.0, 0.0))
    assert truth.but_for_height(500.0) == pytest.approx(5000.0 / 0.8)
    assert truth.but_for_height(0.0) == pytest.approx(10_000.0 / 0.9)
