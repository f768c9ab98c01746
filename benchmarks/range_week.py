"""Weeks of short rides, each of one rider on one scooter of the tests' plant, as CAN logs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.range_rides import Truth, truth_of
from gz_onboard.constants import HOUR
from tests.plant.cases import stranger
from tests.plant.logs import write_log
from tests.plant.machine import scooter
from tests.plant.ride import Hidden, ride
from tests.plant.roads import Plan, plan
from tests.plant.sensors import measure

RIDES, PER_DAY = 15, 3
KINDS = ("city", "suburban", "mixed", "arterial")
DURATION = 500.0, 1100.0  # s: 4 to 9 km
CHARGED_BELOW, CHARGED_TO = 0.5, (0.8, 1.0)  # SOC at the end of a day, and to where it is charged then
REST = 1.0 * HOUR, 9.0 * HOUR  # between two rides of a day
NIGHT = 12.0 * HOUR
WIND, WIND_CHANGE = 1.5, 1.0  # m/s: sd of the week's, and of each ride's about it


@dataclass(frozen=True)
class Ride:
    """One of a week."""

    week: int
    number: int
    day: int
    away: float  # s since the ride before
    log: Path
    truth: Truth
    energy: float  # J/m at the pack's terminals


class Week:
    """The week `seed`: riders, scooters, roads and times. Each ride begins with the charge that the last one left."""

    def __init__(self, seed: int) -> None:
        self.seed, self.machine = seed, scooter(seed)
        self._rng = rng = np.random.default_rng([seed, 37])
        self._rider, self._hilly = stranger(rng), float(rng.uniform(0.2, 1.7))
        self._ambient, self._kinds = float(rng.uniform(-2, 32)), rng.choice(KINDS, PER_DAY)
        self._wind = rng.normal(0, WIND, 2)
        self._soc = float(rng.uniform(*CHARGED_TO))

    def plan(self, number: int) -> tuple[Plan, float]:
        """(ride `number` of the week, s since the ride before)."""
        rng, trip = self._rng, number % PER_DAY
        away = NIGHT if trip == 0 else float(rng.uniform(*REST))
        north, east = self._wind + rng.normal(0, WIND_CHANGE, 2)
        ambient, duration = self._ambient + float(rng.normal(0, 2.0)), float(rng.uniform(*DURATION))
        kind, seed = str(self._kinds[trip]), 5_000_000_000 + 100 * self.seed + number
        wind = float(north), float(east)
        way = plan(seed, kind, self._rider, ambient, self._soc, wind, self._hilly, duration)
        return replace(way, pack_warmer=0.0), away

    def ended(self, number: int, soc: float) -> None:
        """Ride `number` left that charge."""
        evening = number % PER_DAY == PER_DAY - 1
        self._soc = float(self._rng.uniform(*CHARGED_TO)) if evening and soc < CHARGED_BELOW else soc


def ride_weeks(seeds: Sequence[int], folder: Path) -> Iterator[list[Ride]]:
    """The weeks side by side, ride by ride: the log of each into `folder`."""
    weeks = [Week(seed) for seed in seeds]
    for number in range(RIDES):
        planned = [week.plan(number) for week in weeks]
        ridden = ride([way for way, _ in planned], [week.machine for week in weeks], [Hidden()] * len(weeks))
        found = []
        for week, (_, away), ride_ in zip(weeks, planned, ridden, strict=True):
            log = folder / f"week_{week.seed}_{number:02d}.blf"
            write_log(measure(ride_, log.stem), log)
            week.ended(number, float(ride_.columns["soc"][-1]))
            day, energy = number // PER_DAY, ride_.energy_per_metre
            found.append(Ride(week.seed, number, day, away, log, truth_of(ride_), energy))
        yield found
