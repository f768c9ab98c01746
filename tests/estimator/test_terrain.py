"""How far roads climb for good is learned from net climbs, and widens the interval where they do."""

from __future__ import annotations

from math import sqrt

import pytest

from gz_onboard.estimator.consumption import CONSUMPTION, Terrain

NEW = Terrain()
RATE, STRETCH, SEGMENT = CONSUMPTION.terrain_rate, CONSUMPTION.stretch_m, CONSUMPTION.segment_m


def ridden(climbs: list[float], terrain: Terrain = NEW, unseen: float = 0.0) -> Terrain:
    """After stretches that climb by so many metres each."""
    for climb in climbs:
        for _ in range(int(STRETCH / SEGMENT)):
            terrain = terrain.ridden(SEGMENT, climb * SEGMENT / STRETCH, unseen * SEGMENT)
    return terrain


def test_level_roads_are_learned_as_such():
    assert ridden([1.0, -1.0] * 10).rate < RATE / 5


def test_mountains_are_learned_within_some_stretches():
    found = ridden([150.0, -100.0, 120.0])
    assert found.rate == pytest.approx((150**2 + 100**2 + 120**2) / 3 / STRETCH, rel=0.5)
    assert found.rate > 30 * RATE


def test_on_a_short_way_a_slope_goes_on():
    assert sqrt(Terrain().variance(200.0)) == pytest.approx(2 * sqrt(Terrain().variance(100.0)))
    assert Terrain().variance(2 * STRETCH) == pytest.approx(2 * Terrain().variance(STRETCH))
