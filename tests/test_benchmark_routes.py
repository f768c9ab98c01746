"""The route that the benchmark writes of a road of the tests' plant."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.range_rides import route_of
from gz_onboard.routes.route import read_route
from tests.plant.roads import GRID, plan


@pytest.mark.parametrize("positions", [True, False])
def test_a_written_route_is_the_road(tmp_path, positions):
    way = plan(7, "city", "B", 20.0, 1.0, duration=600.0)
    file = tmp_path / "way.route.csv"
    file.write_text(route_of(way, positions=positions), encoding="utf-8")
    route = read_route(file)
    at = np.array(route.distance)
    assert GRID * len(way.speed) - at[-1] <= 20.0
    road = np.arange(len(way.speed)) * GRID
    heading = way.heading - np.concatenate(([0.0], np.cumsum(way.curvature[:-1]))) * GRID
    if positions:
        assert np.std(np.array(route.heading) - np.interp(at, road, heading)) < 0.2
    else:
        assert np.allclose(route.curvature, np.interp(at, road, way.curvature), atol=1e-5)
    assert np.std(np.array(route.grade) - np.interp(at, road, way.grade)) < 0.008
    limit = np.array(route.speed_limit)
    assert np.all(limit * way.rider.keenness >= np.interp(at, road, way.speed) - 0.01)
