"""Following a route: noise, leaving and rejoining, loops, out and back, no receiver."""

from __future__ import annotations

import math
import random
from itertools import pairwise

import pytest

from gz_onboard.estimator.route import CONFIG, RoutePosition
from gz_onboard.routes.route import Route

NORTH, EAST = 111_200.0, 111_200.0 * math.cos(math.radians(40.3))
STEP = 10.0  # m each second


def route(points, step=20.0):
    """A route through corners (east, north) [m], with a point each `step`."""
    way = []
    for (x0, y0), (x1, y1) in pairwise(points):
        count = round(math.dist((x0, y0), (x1, y1)) / step)
        way += [(x0 + (x1 - x0) * k / count, y0 + (y1 - y0) * k / count) for k in range(count)]
    way.append(points[-1])
    none = (0.0,) * len(way)
    return Route(
        "way",
        tuple(step * i for i in range(len(way))),
        none,
        none,
        none,
        none,
        tuple(40.3 + y / NORTH for _, y in way),
        tuple(8.0 + x / EAST for x, _ in way),
    )


def ride(position, points, noise=0.0, seed=0):
    """Along corners (east, north) at `STEP` a second; gives where it thinks it is, or None, each second."""
    way, rng, seen = route(points, STEP), random.Random(seed), []
    for i in range(1, len(way.distance)):
        y, x = way.latitude[i], way.longitude[i]
        course = math.atan2((x - way.longitude[i - 1]) * EAST, (y - way.latitude[i - 1]) * NORTH)
        fix = y + rng.gauss(0, noise) / NORTH, x + rng.gauss(0, noise) / EAST
        position.update(STEP, fix, course)
        seen.append(position.along if position.on else None)
    return seen


STRAIGHT = [(0, 0), (0, 2000), (1500, 2000)]


@pytest.mark.parametrize("noise", [0.0, 8.0])
def test_it_follows_and_ends(noise):
    position = RoutePosition(route(STRAIGHT))
    seen = ride(position, STRAIGHT, noise)
    for i, along in enumerate(seen[:-5], start=1):
        assert along == pytest.approx(STEP * i, abs=5 + 3 * noise)
    assert not position.on  # at its end there is nothing of it left
    assert position.along == 3500.0


def test_a_wrong_odometer_is_mended_by_fixes():
    position = RoutePosition(route(STRAIGHT))
    for i in range(1, 150):
        position.update(0.93 * STEP, (40.3 + STEP * i / NORTH, 8.0), 0.0)
        assert position.along == pytest.approx(STEP * i, abs=20)


def test_leaving_is_said_and_rejoining_goes_on_where_it_is():
    position = RoutePosition(route([(0, 0), (0, 4000)]))
    detour = [(0, 0), (0, 1000), (400, 1000), (400, 2000), (0, 2000), (0, 3000)]
    seen = ride(position, detour)
    assert seen[99] == pytest.approx(1000, abs=5)
    off = seen.index(None)
    assert STEP * (off - 99) <= CONFIG.off + CONFIG.leaving + 2 * STEP
    again = next(i for i in range(off, len(seen)) if seen[i] is not None)
    assert STEP * again <= 1000 + 400 + 1000 + 400 + CONFIG.staying + 40
    assert seen[-1] == pytest.approx(3000, abs=5)
    assert all(along is None for along in seen[off:again])


def test_out_and_back_does_not_jump():
    corners = [(0, 0), (0, 1500), (1, 0)]
    seen = ride(RoutePosition(route(corners)), corners, noise=3.0)
    for i, along in enumerate(seen[:-5], start=1):
        assert along == pytest.approx(STEP * i, abs=25)


def test_a_loop_ridden_twice_goes_on_counting():
    lap = [(0, 0), (0, 500), (500, 500), (500, 0), (0, 0)]
    corners = [*lap, *lap[1:]]
    seen = ride(RoutePosition(route(corners)), corners, noise=3.0)
    for i, along in enumerate(seen[:-5], start=1):
        assert along == pytest.approx(STEP * i, abs=40)


def test_it_can_be_joined_anywhere():
    position = RoutePosition(route(STRAIGHT))
    seen = ride(position, [(300, 800), (0, 800), (0, 1900)])
    assert seen[5] is None
    assert seen[-1] == pytest.approx(1900, abs=5)


def test_a_tunnel_is_bridged():
    position = RoutePosition(route([(0, 0), (0, 4000)]))
    ride(position, [(0, 0), (0, 1000)])
    for _ in range(100):
        position.update(0.97 * STEP, None, None)
    assert ride(position, [(0, 2000), (0, 3000)])[-1] == pytest.approx(3000, abs=5)
