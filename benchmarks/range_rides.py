"""Rides of the tests' plant until it gives up, as CAN logs, for the range benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.signal import lfilter

from gz_onboard.arrays import Array
from tests.plant.cases import stranger
from tests.plant.logs import write_log
from tests.plant.machine import SERIES, G, scooter
from tests.plant.ride import STEP, Hidden, Ridden, ride
from tests.plant.roads import GRID, JOURNEY, KINDS, Plan, plan
from tests.plant.sensors import DEGREE, ORIGIN, measure

LONGEST = 20_000.0  # s: more than any full discharge takes
EMPTY = 0.1  # SOC: no ride ends above it
GIVES_UP = 2.8 * SERIES  # V at the terminals
EVERY = 50  # steps of the plant between truths that are kept: each second
ANOTHER_DAY = 1_000_000  # from a seed to that of a second discharge of the same scooter
HIDDEN = {
    "healthy": Hidden(),
    "journey": Hidden(),
    "aged": Hidden(capacity_factor=0.8, resistance_factor=1.5),
    "punctured": Hidden(late_force=15.0, late_time=2400.0),  # N: a soft tyre rolls with nearly twice the resistance
}
CONDITIONS = "healthy", "aged", "healthy", "punctured", "journey"  # by seed
ROUTE_GRID = 20.0  # m between points of a route
BEFORE_BEND = 30.0  # m around a point, whose fastest is its limit: within, riders brake for bends
MAP_ERROR, MAP_LENGTH = 0.3, 400.0  # m of sd of a map's altitude, m over which its errors are alike
START = 255.0  # m above the sea, of the plant's rides


@dataclass(frozen=True)
class Truth:
    """What happened, once a second; (n,)."""

    time: Array  # s
    distance: Array  # m
    soc: Array
    energy: Array  # J drawn from the pack
    height: Array  # J that height has stored

    def but_for_height(self, time: float | Array) -> Array:
        """The range [m] at `time` [s], a number or (n,), of who knows everything but the height that the way to come
        ends above or below.

        What a climb costs beyond the height is left out: nobody without a route errs by less.
        """
        distance, energy, height = (
            x[-1] - np.interp(time, self.time, x) for x in (self.distance, self.energy, self.height)
        )
        return np.asarray(distance * energy / (energy - height))


@dataclass(frozen=True)
class Drawn:
    """A full discharge by seed: rider, scooter, road and weather."""

    seed: int
    machine: int
    kind: str
    ambient: float  # degC
    mass: float  # kg, of rider and luggage, which nobody enters
    condition: str  # see `HIDDEN`


def draw(seed: int) -> Drawn:
    """The ride `seed`, before it is ridden."""
    rng = np.random.default_rng([seed, 29])
    kind, ambient = str(rng.choice(sorted(set(KINDS) - {"oval"}))), float(rng.uniform(-5, 35))
    mass, condition = stranger(np.random.default_rng([seed, 31])).mass, CONDITIONS[seed % len(CONDITIONS)]
    return Drawn(seed, seed, JOURNEY if condition == JOURNEY else kind, ambient, mass, condition)


def again(drawn: Drawn) -> Drawn:
    """The same scooter on another day: another rider, road and weather."""
    return replace(draw(drawn.seed + ANOTHER_DAY), machine=drawn.machine, condition=drawn.condition)


def ride_until_empty(drawn: Sequence[Drawn], folder: Path) -> list[tuple[Path, Truth]]:
    """Ride them together, write the frames of each into `folder`, and give log and truth of each."""
    roads = [road_of(x) for x in drawn]
    ridden = ride(roads, [scooter(x.machine) for x in drawn], [HIDDEN[x.condition] for x in drawn], GIVES_UP)
    found = []
    for x, way in zip(drawn, ridden, strict=True):
        if (left := way.columns["soc"][-1]) > EMPTY:
            raise RuntimeError(f"ride {x.seed} ended with {left:.0%} of charge: its road is too short")
        log = folder / f"discharge_{x.seed}.blf"
        write_log(measure(way, log.stem), log)
        found.append((log, truth_of(way)))
    return found


def truth_of(ridden: Ridden) -> Truth:
    """What happened on one ride."""
    c, time = ridden.columns, np.arange(0, len(ridden.columns["soc"]), EVERY)
    distance, soc, altitude = (c[name][time].astype(float) for name in ("distance", "soc", "altitude"))
    energy: Array = STEP * np.cumsum(c["pack_voltage"].astype(float) * c["pack_current"].astype(float))
    mass = ridden.machine.mass + ridden.plan.rider.mass + ridden.hidden.luggage
    return Truth(STEP * time.astype(float), distance, soc, energy[time], mass * G * altitude)


def road_of(drawn: Drawn) -> Plan:
    """The road of a ride, its rider and its weather."""
    rng = np.random.default_rng([drawn.seed, 31])
    person, hilly = stranger(rng), float(rng.uniform(0.2, 1.7))
    seed = 4_000_000_000 + drawn.seed
    return plan(seed, drawn.kind, person, drawn.ambient, 1.0, hilly=hilly, duration=LONGEST)


def route_of(way: Plan, *, positions: bool = True) -> str:
    """Return the road as a navigation service knows it, as CSV: position, altitude with its error, speed limit.

    Without `positions` it has the curvature in their place: a ride of the plant strays from the positions of its road
    by up to 100 m in 50 km. The limit is what bends nearby leave of it. Where the rider will have to stop it does not
    know.
    """
    turned = np.concatenate(([0.0], np.cumsum(way.curvature[1:] + way.curvature[:-1]))) * GRID / 2
    heading = way.heading - (turned[1:] + turned[:-1]) / 2
    north, east = (GRID * np.concatenate(([0.0], np.cumsum(f(heading)))) for f in (np.cos, np.sin))
    altitude = START + GRID * np.concatenate(([0.0], np.cumsum(way.grade[:-1])))
    width = int(BEFORE_BEND / GRID)
    around = np.pad(way.speed / way.rider.keenness, width, mode="edge")
    limit = np.lib.stride_tricks.sliding_window_view(around, 2 * width + 1).max(axis=1)
    at = np.arange(0, len(north), int(ROUTE_GRID / GRID))
    rng = np.random.default_rng([way.seed, 37])
    keep = np.exp(-ROUTE_GRID / MAP_LENGTH)
    white = rng.normal(size=len(at)) * MAP_ERROR * np.append(1.0, np.full(len(at) - 1, np.sqrt(1 - keep * keep)))
    altitude = altitude[at] + lfilter([1.0], [1.0, -keep], white)
    latitude = ORIGIN[0] + north[at] / DEGREE
    longitude = ORIGIN[1] + east[at] / (DEGREE * np.cos(np.radians(ORIGIN[0])))
    columns = {"distance_m": (at * GRID, ".0f")}
    if positions:
        columns |= {"latitude_deg": (latitude, ".7f"), "longitude_deg": (longitude, ".7f")}
    else:
        columns["curvature_1pm"] = (way.curvature[at], ".5f")
    columns |= {"altitude_m": (altitude, ".1f"), "speed_limit_mps": (limit[at], ".2f")}
    rows = (
        ",".join(format(value, form) for value, (_, form) in zip(row, columns.values(), strict=True))
        for row in zip(*(values for values, _ in columns.values()), strict=True)
    )
    return "\n".join([",".join(columns), *rows, ""])
