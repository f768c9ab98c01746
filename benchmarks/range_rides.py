"""Rides of the tests' plant until it gives up, as CAN logs, for the range benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array
from tests.plant.cases import stranger
from tests.plant.logs import write_log
from tests.plant.machine import SERIES, scooter
from tests.plant.ride import STEP, Hidden, ride
from tests.plant.roads import KINDS, Plan, plan
from tests.plant.sensors import measure

LONGEST = 11_000.0  # s: more than any full discharge takes
GIVES_UP = 2.8 * SERIES  # V at the terminals
EVERY = 50  # steps of the plant between truths that are kept: each second
AGED = Hidden(capacity_factor=0.8, resistance_factor=1.5)


@dataclass(frozen=True)
class Truth:
    """What happened, once a second; (n,)."""

    time: Array  # s
    distance: Array  # m
    soc: Array


@dataclass(frozen=True)
class Drawn:
    """A full discharge by seed: who rides what, where and in which weather."""

    seed: int
    kind: str
    ambient: float  # degC
    mass: float  # kg, of rider and luggage, which nobody enters
    aged: bool


def draw(seed: int, *, aged: bool = False) -> Drawn:
    """The ride `seed`, before it is ridden."""
    rng = np.random.default_rng([seed, 29])
    kind, ambient = str(rng.choice(sorted(set(KINDS) - {"oval"}))), float(rng.uniform(-5, 35))
    return Drawn(seed, kind, ambient, stranger(np.random.default_rng([seed, 31])).mass, aged)


def ride_until_empty(drawn: Sequence[Drawn], folder: Path) -> list[tuple[Path, Truth]]:
    """Ride them together, write the frames of each into `folder`, and give log and truth of each."""
    roads = [_road(x) for x in drawn]
    ridden = ride(roads, [scooter(x.seed) for x in drawn], [AGED if x.aged else Hidden() for x in drawn], GIVES_UP)
    found = []
    for x, way in zip(drawn, ridden, strict=True):
        log = folder / f"discharge_{x.seed}.blf"
        write_log(measure(way, log.stem), log)
        c, time = way.columns, np.arange(0, len(way.columns["soc"]), EVERY)
        found.append(
            (log, Truth(STEP * time.astype(float), c["distance"][time].astype(float), c["soc"][time].astype(float)))
        )
    return found


def _road(drawn: Drawn) -> Plan:
    rng = np.random.default_rng([drawn.seed, 31])
    person, hilly = stranger(rng), float(rng.uniform(0.2, 1.7))
    seed = 4_000_000_000 + drawn.seed
    return plan(seed, drawn.kind, person, drawn.ambient, 1.0, hilly=hilly, duration=LONGEST)
