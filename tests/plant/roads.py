"""Roads, weather and riders of a ride, drawn by seed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from gz_onboard.arrays import Array

GRID = 2.0  # m
NOISE_STEP = 0.2  # s
RIDERS = {"A": 62.0, "B": 75.0, "C": 84.0, "D": 93.0, "E": 70.0}
DURATION = (600.0, 900.0)  # s

# straight between bends [m], radius of bends [m], share of junctions with a stop, speed limits [m/s], sharp bends
KINDS = {
    "city": (110.0, (7.0, 16.0), 0.50, (9.0, 11.2), 0.9),
    "suburban": (170.0, (14.0, 60.0), 0.22, (10.5, 12.8), 0.5),
    "mixed": (180.0, (8.0, 45.0), 0.33, (9.5, 12.8), 0.65),
    "arterial": (420.0, (15.0, 120.0), 0.25, (11.5, 13.0), 0.4),
    "oval": (300.0, (28.0, 50.0), 0.02, (11.5, 12.8), 0.0),
}
JOURNEY = "journey"  # over land: through towns and between them in turn, up and down for kilometres
JOURNEY_OF = "city", "arterial"
PART = (4000.0, 14000.0)  # m of each
SLOPE, SLOPE_LENGTH, SLOPE_AFTER = (0.01, 0.035), (1500.0, 6000.0), (3000.0, 12000.0)  # sine, m, m after the one before
HIGHEST = 300.0  # m above or below its begin, from which a journey comes back


@dataclass(frozen=True)
class Rider:
    """How somebody rides."""

    name: str
    mass: float  # kg, with luggage
    acceleration: float  # m/s², the most that is asked for
    braking: float  # m/s²
    lateral: float  # m/s² in bends
    keenness: float  # of the speed limit
    lag: float  # s, of the hand
    preview: float  # s


@dataclass(frozen=True)
class Plan:
    """One ride to be ridden: everything but the scooter."""

    seed: int
    kind: str
    rider: Rider
    duration: float
    ambient: float  # degC
    pressure: float  # Pa
    wind_north: float  # m/s, where it blows from: positive from the north
    wind_east: float
    soc: float
    pack_warmer: float  # K than the air
    motor_warmer: float
    curvature: Array  # 1/m over the way, positive to the left
    grade: Array  # sine of the road's angle
    rough: Array  # how rough it is, 1 in the mean
    speed: Array  # m/s, what limit and bends allow
    stops: Array  # m
    waits: Array  # s
    stop_braking: Array  # of the rider's own
    noise: Array  # (channels, time): unit variance but for the last, which is uniform
    heading: float  # rad at the start, clockwise from north


# Channels of `Plan.noise`.
GUST_ALONG, GUST_ACROSS, SPEED_WISH, BRAKE_HAND, PAD, LOAD, TREMBLE, DECISION = range(8)
_TIMES = (6.0, 6.0, 14.0, 1.5, 40.0, 30.0, 0.3, 0.0)  # s, of each


def make_rider(rng: np.random.Generator, name: str) -> Rider:
    return Rider(
        name,
        RIDERS[name],
        acceleration=rng.uniform(0.9, 1.4),
        braking=rng.uniform(0.85, 1.3),
        lateral=rng.uniform(2.4, 4.2),
        keenness=rng.uniform(0.93, 1.04),
        lag=rng.uniform(0.12, 0.3),
        preview=rng.uniform(0.4, 1.0),
    )


def plan(
    seed: int,
    kind: str,
    rider: str | Rider,
    ambient: float,
    soc: float,
    wind: tuple[float, float] | None = None,
    hilly: float = 1.0,
    duration: float | None = None,
) -> Plan:
    """A ride; `wind` [m/s] from north and east, drawn with 1 m/s standard deviation if not given; duration [s], too."""
    rng = np.random.default_rng([seed, 19])
    person = make_rider(rng, rider) if isinstance(rider, str) else rider
    drawn = float(rng.uniform(*DURATION))
    duration = drawn if duration is None else duration
    way = _journey if kind == JOURNEY else _way
    curvature, speed, stops = way(rng, kind, person, 14.0 * duration)
    own_wind = rng.normal(0, 1.0, 2)
    north, east = own_wind if wind is None else wind
    return Plan(
        seed=seed,
        kind=kind,
        rider=person,
        duration=duration,
        ambient=ambient,
        pressure=98300 * (1 + 0.007 * rng.normal()),
        wind_north=float(north),
        wind_east=float(east),
        soc=soc,
        pack_warmer=float(rng.choice([0.0, 0.0, rng.uniform(0, 5)])),
        motor_warmer=float(rng.choice([0.0, 0.0, rng.uniform(0, 8)])),
        curvature=curvature,
        grade=_hills(rng, len(curvature), hilly) + (_slopes(rng, len(curvature)) if kind == JOURNEY else 0.0),
        rough=_surface(np.random.default_rng([seed, 23]), len(curvature)),
        speed=speed,
        stops=stops,
        waits=np.clip(rng.exponential(14.0, len(stops)), 2.0, 60.0),
        stop_braking=rng.uniform(0.75, 1.3, len(stops)),
        noise=_noises(rng, duration),
        heading=float(rng.uniform(0, 2 * np.pi)),
    )


def _way(rng: np.random.Generator, kind: str, rider: Rider, length: float) -> tuple[Array, Array, Array]:
    straight, radii, stop_share, limits, sharp = KINDS[kind]
    count = int(length / GRID)
    curvature, limit = np.zeros(count), np.full(count, limits[1])
    stops = []
    at, side = 60.0, float(rng.choice([-1.0, 1.0]))
    while at < length - 200:
        end = at + straight * rng.uniform(0.4, 2.0)
        limit[int(at / GRID) : int(end / GRID)] = rng.uniform(*limits)
        if rng.random() < stop_share:
            stops.append(end - 8.0)
        at = end
        if kind == "oval":
            turn, radius = np.pi, rng.uniform(*radii)
        elif rng.random() < sharp:
            turn, radius = rng.uniform(1.1, 1.9), rng.uniform(radii[0], 2 * radii[0])
        else:
            turn, radius = rng.uniform(0.3, 1.6), rng.uniform(2 * radii[0], radii[1] * 1.5)
        sign = side if kind == "oval" or rng.random() < 0.68 else -side
        arc = turn * radius
        curvature[int(at / GRID) : max(int((at + arc) / GRID), int(at / GRID) + 1)] = sign / radius
        at += arc
    curvature = _smooth(_smooth(curvature, 7), 5)
    allowed = np.sqrt(rider.lateral / np.maximum(np.abs(curvature), 1e-4))
    speed = np.minimum(limit * rider.keenness, allowed)
    braking = 0.8 * rider.braking
    for i in range(count - 2, -1, -1):  # what can be braked to in time
        reachable = (speed[i + 1] ** 2 + 2 * braking * GRID) ** 0.5
        if speed[i] > reachable:
            speed[i] = reachable
    return curvature, speed, np.array([*stops, 1e9])


def _journey(rng: np.random.Generator, kind: str, rider: Rider, length: float) -> tuple[Array, Array, Array]:
    """The ways of `JOURNEY_OF` in turn."""
    curvatures, speeds, stops, at, turn = [], [], [], 0.0, int(rng.integers(len(JOURNEY_OF)))
    while at < length:
        curvature, speed, stop = _way(rng, JOURNEY_OF[turn % len(JOURNEY_OF)], rider, float(rng.uniform(*PART)))
        curvatures.append(curvature)
        speeds.append(speed)
        stops.append(at + stop[:-1])
        at, turn = at + GRID * len(curvature), turn + 1
    return np.concatenate(curvatures), np.concatenate(speeds), np.append(np.concatenate(stops), 1e9)


def _smooth(values: Array, width: int) -> Array:
    out: Array = np.convolve(np.pad(values, width // 2, mode="edge"), np.ones(width) / width, "valid")
    return out


def _hills(rng: np.random.Generator, count: int, hilly: float) -> Array:
    """Grade: gentle rises of some hundred metres; the road comes back to its height."""
    x = np.arange(count) * GRID
    grade = np.zeros(count)
    for wavelength, height in ((1900.0, 6.0), (800.0, 2.6), (330.0, 1.0)):
        length = wavelength * rng.uniform(0.7, 1.4)
        grade += (
            hilly
            * height
            * rng.uniform(0.5, 1.3)
            * 2
            * np.pi
            / length
            * np.cos(2 * np.pi * x / length + rng.uniform(0, 2 * np.pi))
        )
    return np.clip(grade, -0.09, 0.09)


def _slopes(rng: np.random.Generator, count: int) -> Array:
    """Grade of long ascents and descents, which come back to their height from `HIGHEST` only."""
    grade, at, height = np.zeros(count), float(rng.uniform(*SLOPE_AFTER)), 0.0
    while at < count * GRID:
        end = at + float(rng.uniform(*SLOPE_LENGTH))
        slope = float(rng.choice([-1.0, 1.0]) * rng.uniform(*SLOPE))
        if slope * height > 0 and abs(height) > HIGHEST:
            slope = -slope
        grade[int(at / GRID) : int(end / GRID)] = slope
        height += slope * (end - at)
        at = end + float(rng.uniform(*SLOPE_AFTER))
    return _smooth(grade, 51)


def _surface(rng: np.random.Generator, count: int) -> Array:
    """Asphalt, patched or cracked, for some hundred metres each; now and then setts."""
    rough = np.ones(count)
    at = 0
    while at < count:
        end = at + int(rng.uniform(120, 600) / GRID)
        rough[at:end] = rng.uniform(1.6, 2.6) if rng.random() < 0.12 else np.exp(rng.normal(-0.1, 0.22))
        at = end
    return rough


def _noises(rng: np.random.Generator, duration: float) -> Array:
    """Ornstein-Uhlenbeck noises of unit variance, a row for each channel."""
    count = int(duration / NOISE_STEP) + 5
    rows = []
    for time in _TIMES:
        if time == 0:
            rows.append(rng.random(count))
            continue
        keep = np.exp(-NOISE_STEP / time)
        white = rng.normal(size=count) * np.sqrt(1 - keep * keep)
        white[0] = rng.normal()
        rows.append(lfilter([1.0], [1.0, -keep], white))
    return np.array(rows)
