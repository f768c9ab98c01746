"""Routes: grade and curvature of roads made here, the speed they are ridden with, and what is refused."""

import math
import random
from bisect import bisect_right
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.errors import InputError
from gz_onboard.routes.route import Route, read_route, speed_profile

METRES_NORTH = 111_035.0  # of a degree at 40.3° on WGS 84, and of one east:
METRES_EAST = 85_010.0


def write(folder: Path, text: str) -> Path:
    file = folder / "way.route.csv"
    file.write_text(text, encoding="utf-8")
    return file


def at(way, name, distance):
    """A quantity of `way` at `distance` [m]: between points on a line, of a limit that of the point before."""
    values = getattr(way, name)
    if name == "speed_limit":
        return values[max(bisect_right(way.distance, distance) - 1, 0)]
    return float(np.interp(distance, way.distance, values))


def road(folder, points, header="distance_m,altitude_m"):
    return read_route(write(folder, header + "\n" + "".join(",".join(map(repr, p)) + "\n" for p in points)))


def degrees(east, north):
    return 40.3 + north / METRES_NORTH, -83.5 + east / METRES_EAST


def circle(radius, step, turns=1.0, side=1):
    """Points of a circle, begun northward; to the left with side 1, to the right with -1."""
    count = round(turns * math.tau * radius / step)
    for i in range(count + 1):
        angle = turns * math.tau * i / count
        east, north = side * radius * (math.cos(angle) - 1), radius * math.sin(angle)
        yield (*degrees(east, north), 100.0)


POSITIONS = "latitude_deg,longitude_deg,altitude_m"


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(("radius", "step"), [(50.0, 5.0), (50.0, 1.0), (50.0, 20.0), (15.0, 3.0), (400.0, 20.0)])
def test_circle_has_its_curvature_all_round(tmp_path, radius, step, side):
    way = road(tmp_path, circle(radius, step, side=side), POSITIONS)
    assert way.length == pytest.approx(math.tau * radius, rel=0.01)
    assert way.curvature == pytest.approx([side / radius] * len(way.curvature), rel=0.03)


def test_heading_is_clockwise_from_north_and_goes_round(tmp_path):
    way = road(tmp_path, circle(100.0, 5.0, turns=2.5, side=-1), POSITIONS)
    for distance in (150.0, 400.0, 900.0):
        assert at(way, "heading", distance) == pytest.approx(distance / 100.0, abs=0.01)
    east = road(tmp_path, [(*degrees(20.0 * i, 0.0), 0.0) for i in range(9)], POSITIONS)
    assert at(east, "heading", 70.0) == pytest.approx(math.pi / 2, abs=1e-3)
    assert east.curvature == pytest.approx([0.0] * 9, abs=1e-6)


@given(slope=st.floats(-0.1, 0.1), start=st.floats(-100, 1000), spacing=st.sampled_from([1.0, 7.0, 20.0, 500.0]))
def test_even_hill_has_its_grade_everywhere(tmp_path_factory, slope, start, spacing):
    points = [(start + spacing * i, 4000 + start + slope * spacing * i) for i in range(60)]
    way = road(tmp_path_factory.mktemp("hill"), points)
    assert way.grade == pytest.approx([slope] * 60, abs=1e-9)
    assert way.curvature == (0.0,) * 60


@pytest.mark.parametrize(("wavelength", "kept"), [(400.0, 0.774), (800.0, 0.940), (2000.0, 0.990)])
def test_rolling_hills_keep_the_documented_part_of_their_grade(tmp_path, wavelength, kept):
    k = math.tau / wavelength
    way = road(tmp_path, [(2.0 * i, 0.04 / k * math.sin(k * 2.0 * i)) for i in range(2001)])
    middle = [g for d, g in zip(way.distance, way.grade, strict=True) if 200 < d < way.length - 200]
    assert max(middle) == pytest.approx(0.04 * kept, rel=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_altitude_noise_makes_no_spikes(tmp_path, seed):
    noise = random.Random(seed)
    way = road(tmp_path, [(20.0 * i, 300.0 + 0.02 * 20.0 * i + noise.gauss(0, 1.0)) for i in range(500)])
    errors = [g - 0.02 for g in way.grade]
    assert max(map(abs, errors)) < 0.025  # a difference of neighbours reaches 0.2
    assert math.sqrt(sum(e * e for e in errors) / len(errors)) < 0.006


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("altitude_m\n0\n1\n", "needs column distance_m, or latitude_deg and longitude_deg"),
        ("latitude_deg,altitude_m\n0,0\n1,0\n", "has latitude_deg alone"),
        ("distance_km,altitude_m\n0,0\n1,0\n", r":1: unknown column 'distance_km' \(did you mean 'distance_m'\?\)"),
        ("distance_m,altitude_m,speed_limit_mph\n0,0,1\n1,0,1\n", r"unknown column 'speed_limit_mph' \(did you mean"),
        ("distance_m,altitude_m\n0,0\n20,0\n20,0\n", r":4: distance_m: 20 m does not increase"),
        ("distance_m,altitude_m\n0,0\n20,nan\n", r":3: altitude_m: must be a finite number"),
        ("distance_m,altitude_m\n0,0\n20,99999\n", r":3: altitude_m: 99999 m is outside -500 to 9000 m"),
        ("distance_m,altitude_m\n0,0\n0.02,1\n0.04,2\n", r":2: altitude_m: a grade of 5000 % is no road's"),
        ("distance_m,altitude_m,speed_limit_kmh\n0,0,30\n20,0,0\n", r":3: speed_limit_kmh: 0 km/h is outside"),
        ("distance_m,altitude_m,speed_limit_mps\n0,0,30\n20,0,130\n", r":3: speed_limit_mps: 130 m/s is outside"),
        ("distance_m,altitude_m,speed_limit_mps,speed_limit_kmh\n0,0,3,3\n9,0,3,3\n", "must have one speed limit"),
        ("distance_m,altitude_m,curvature_1pm\n0,0,0\n20,0,50\n", r":3: curvature_1pm: 50 1/m is outside"),
        (POSITIONS + "\n91,0,0\n92,0,0\n", r":2: latitude_deg: 91 deg is outside"),
        (POSITIONS + "\n40,8,0\n40,8.001,0\n40,8.001,0\n", r":4: latitude_deg, longitude_deg: the same position"),
        ("distance_m," + POSITIONS + "\n0,40,8,0\n0.1,40.001,8,0\n", r"distance_m covers 0 m, .* 111 m; is distance_m"),
    ],
)
def test_route_refused(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_route(write(tmp_path, text))


def speed_at(profile, distance):
    """The speed at `distance` [m] of a ride with constant acceleration between points."""
    return math.sqrt(np.interp(distance, profile[0], np.square(profile[1])))


def duration(profile):
    distance, speed = map(np.array, profile)
    return np.sum(2 * np.diff(distance) / (speed[1:] + speed[:-1]))


def made(spacings, curvatures, limits):
    distance = [0.0]
    for spacing in spacings:
        distance.append(distance[-1] + spacing)
    n = len(distance)
    zero = (0.0,) * n
    return Route("made", tuple(distance), zero, tuple(curvatures[:n]), zero, tuple(limits[:n]))


@st.composite
def routes(draw):
    n = draw(st.integers(2, 12))
    return made(
        draw(st.lists(st.floats(0.5, 300), min_size=n - 1, max_size=n - 1)),
        draw(st.lists(st.floats(-0.15, 0.15), min_size=n, max_size=n)),
        draw(st.lists(st.one_of(st.floats(1, 40), st.just(math.inf)), min_size=n, max_size=n)),
    )


@given(way=routes(), a_y=st.floats(0.5, 8), a=st.floats(0.2, 4), b=st.floats(0.2, 6), where=st.floats(0, 1))
def test_no_limit_is_exceeded_anywhere(way, a_y, a, b, where):
    profile = speed_profile(way, lateral_acceleration=a_y, acceleration=a, deceleration=b)
    distance = where * way.length
    speed = speed_at(profile, distance)
    assert speed <= at(way, "speed_limit", distance) * (1 + 1e-9)
    assert speed**2 * abs(at(way, "curvature", distance)) <= a_y * (1 + 1e-9)
    assert profile[1][0] == profile[1][-1] == 0.0
    for (d0, v0), (d1, v1) in pairwise(zip(*profile, strict=True)):
        change = (v1 * v1 - v0 * v0) / (2 * (d1 - d0))
        assert -b * (1 + 1e-6) - 1e-9 <= change <= a * (1 + 1e-6) + 1e-9


def test_straight_road_is_a_trapezium():
    profile = speed_profile(made([500.0] * 2, [0.0] * 3, [10.0] * 3), acceleration=1.0, deceleration=2.0)
    assert duration(profile) == pytest.approx(1000 / 10 + 10 / 2 + 5 / 2, abs=0.3)
    assert speed_at(profile, 18.0) == pytest.approx(6.0, abs=0.01)
    assert speed_at(profile, 500.0) == 10.0
    assert speed_at(profile, 991.0) == pytest.approx(6.0, abs=0.01)


def test_bend_is_ridden_with_the_lateral_acceleration_allowed_and_braked_for_in_time():
    way = made([20.0] * 50, [0.0] * 25 + [0.04] * 5 + [0.0] * 21, [13.0] * 51)
    profile = speed_profile(way)
    slow = math.sqrt(2.5 / 0.04)
    assert speed_at(profile, 540.0) == pytest.approx(slow)
    assert min(speed_at(profile, float(d)) for d in range(100, 900)) == pytest.approx(slow)
    assert speed_at(profile, 455.0) == pytest.approx(13.0)
    assert speed_at(profile, 465.0) < 13.0  # (13² − 7.9²)/(2·1.5) is 36 m, to where the bend is tightest, 495 m
