"""The displayed range: smooth, and near the forecast."""

from __future__ import annotations

import json

import numpy as np
import pytest

from gz_onboard.estimator.forecast import FORECAST, RangeSmoother

KNOWN = 1e6  # m: much was ridden
LENGTH, STEP = FORECAST.length_m, FORECAST.held


def restored(smoother):
    return RangeSmoother.restored(json.loads(json.dumps(smoother.snapshot())))


def shown(raw, ridden, known=KNOWN, smoother=None):
    """What is shown of the forecasts `raw` [m], `ridden` [m] before each."""
    smoother = smoother or RangeSmoother()
    found = []
    for forecast, way in zip(raw, ridden, strict=True):
        found.append(smoother.follow(forecast, 90.0 * forecast, known, way))
    return np.array(found)


def test_a_forecast_that_holds_is_shown_as_it_is():
    ridden = np.full(3000, 10.0)
    raw = 50_000 - np.cumsum(ridden)
    assert shown(raw, ridden) == pytest.approx(raw, abs=1e-6)


def test_a_real_change_is_followed_within_three_lengths():
    ridden = np.full(4000, 10.0)
    at = np.cumsum(ridden)
    raw = np.where(at < 5000, 60_000 - at, 58_000 - at)  # 2 km are lost at 5 km
    error = (shown(raw, ridden) - raw)[1:]
    assert error[at[1:] >= 5000 + LENGTH][0] < 2000 * 0.37
    assert np.all(error[at[1:] > 5000 + 3 * LENGTH] < 100)


def test_a_better_forecast_does_not_let_the_range_rise():
    """10 km more within one: who rides sees no rise, and in the end all of it; while little is known it shows soon."""
    ridden = np.full(4000, 10.0)
    at = np.cumsum(ridden)
    raw = np.interp(at, [5000, 6000], [50_000, 60_000]) - at
    settled = shown(raw, ridden)
    assert np.diff(settled).max() <= 0
    assert settled[-1] == pytest.approx(raw[-1], rel=0.01)
    assert shown(raw, ridden, known=1000.0)[at >= 9000][0] == pytest.approx(raw[at >= 9000][0], rel=0.01)


def test_what_is_drawn_or_charged_at_standstill_shows_at_once():
    """And fifty metres near empty are fifty of a full charge, in place of a third of it."""
    smoother = RangeSmoother(-2000.0)
    assert shown([40_000.0, 38_000.0, 60_000.0], np.zeros(3), smoother=smoother) == pytest.approx(
        [38_000, 36_000, 58_000]
    )
    smoother = RangeSmoother(50.0)
    assert shown([150.0, 60_000.0], np.zeros(2), smoother=smoother) == pytest.approx([200, 60_050])


def standing(raws, drawn=0.0):
    """What is shown at standstill of the forecasts `raws` [m], with `drawn` of the energy taken before each."""
    smoother, energy, found = RangeSmoother(), 1e6, []
    for raw in raws:
        found.append(smoother.follow(raw, energy, KNOWN, 0.0, drawn * energy))
        energy *= 1 - drawn
    return found, smoother


def test_what_a_rest_shows_waits_for_the_riding_to_come():
    """Of a forecast that falls by 4 % at standstill only what was drawn shows; riding closes the gap."""
    found, smoother = standing(np.linspace(40_000, 38_400, 100), 1e-4)
    assert found[-1] == pytest.approx(40_000 * (1 - 1e-4) ** 99)
    later = shown(38_400 - np.arange(10.0, 12_010, 10), np.full(1200, 10.0), smoother=smoother)
    assert later[-1] == pytest.approx(38_400 - 12_000, rel=0.01)
    assert np.abs(np.diff(later)).max() < 15


def test_a_restart_keeps_what_was_shown():
    smoother = RangeSmoother()
    ridden = np.full(500, 10.0)
    before = shown(42_000 + 800 * np.sin(np.arange(500) / 50) - np.cumsum(ridden), ridden, smoother=smoother)[-1]
    raw = 42_000 + 800 * np.sin(499 / 50) - 5000
    assert restored(smoother).follow(raw, 90.0 * raw, KNOWN, 0.0) == pytest.approx(before)


@pytest.mark.parametrize("restarted", [False, True])
@pytest.mark.parametrize("gap", [15_000.0, -8000.0])
def test_of_a_pack_found_nearly_empty_no_gap_of_a_full_one_is_shown(gap, restarted):
    """Held back over a long way, or swapped for one with a seventh of the energy: the gap was not to this forecast."""
    smoother = RangeSmoother(gap)
    smoother.follow(40_000.0, 4e6, KNOWN, 0.0)
    if restarted:
        smoother = restored(smoother)
    else:
        smoother.show_next()
    assert abs(smoother.follow(6000.0, 6e5, KNOWN, 0.0) / 6000 - 1) < (0.4 if restarted else 1e-6)


def test_it_is_right_when_empty():
    ridden = np.full(2000, 10.0)
    left = 20_000 - np.cumsum(ridden)
    found = shown(left, ridden, smoother=RangeSmoother(4000.0))
    assert np.all(np.abs(found - left)[left < 1000] < 50)
    assert found[-1] < 1


def test_a_worse_forecast_is_told_in_time():
    """8 km less within one, of 60: no kilometre takes off two, and it is told half way; 5 km, of 11: sooner."""
    ridden = np.full(4000, 10.0)
    at = np.cumsum(ridden)
    raw = np.interp(at, [3000, 4000], [60_000, 52_000]) - at
    found = shown(raw, ridden)
    assert np.diff((found + at)[::100]).min() > -910
    assert np.all((found / raw)[raw < 35_000] < 1.03)
    raw = np.interp(at, [3000, 4000], [15_000, 10_000]) - at
    near = shown(np.maximum(raw, 1.0), ridden)
    assert near[at >= 6000][0] < 1.4 * 4000
    assert np.all((near / np.maximum(raw, 1.0))[(raw < 3000) & (raw > 100)] < 1.25)
