"""Logs as the daemon writes them, of rides that are only told, a row in five seconds."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gz_onboard.can.logfile import LogFile
from gz_onboard.estimator.energy_counter import EnergyCounter
from gz_onboard.estimator.pack_age import LearnedFactor
from gz_onboard.events import Activity, Estimate, State
from gz_onboard.log_rows import ESTIMATE_TOPIC, STATUS_TOPIC, declare, estimate_row, learned_row, ride_row
from tests.support import S

SPEED = 10.0  # m/s
STEP = 5  # s
VOLTAGE, CURRENT = 50.0, 20.0  # 27.8 Wh/km
NOON = 1_718_449_200 * S  # 2024-06-15 11:00 UTC


@dataclass
class Told:
    """What happens for some seconds."""

    activity: Activity
    seconds: int
    state: State = State.VALID
    capacity: float = 1.0
    rider: str = ""


def ride(seconds: int = 600, **more: Any) -> Told:
    return Told(Activity.RIDING, seconds, **more)


def stand(seconds: int, activity: Activity = Activity.PARKED) -> Told:
    return Told(activity, seconds)


def write_log(
    file: Path,
    told: Iterable[Told],
    start_ns: int = NOON,
    *,
    begin: tuple[float, float] = (0.0, 0.0),
    clock: Callable[[float], int] | None = None,
    vehicle: str = "scooter",
    old: bool = False,
    soc: float = 0.9,
) -> Path:
    """Write a log of the daemon.

    begin: time [s] and distance [m] that the daemon has run and ridden before. clock: the log's time [ns] of each
    second, if it is not `start_ns` and on. old: without what the status says of the ride. soc: at the start.
    """
    time, distance = begin[0] + 1 - STEP, begin[1]  # the first estimate comes after a second
    clock = clock or (lambda t: start_ns + round((t - begin[0]) * S))
    with file.open("wb") as stream:
        log = LogFile(stream, clock(begin[0]), {"vehicle": vehicle, "vehicle_key": f"{vehicle}|14s"})
        declare(log, ())
        drawn = EnergyCounter(STEP)
        for part in told:
            moving = part.activity is Activity.RIDING
            for _ in range(part.seconds // STEP):
                time, distance = time + STEP, distance + (SPEED * STEP if moving else 0.0)
                estimate = Estimate(
                    time,
                    part.state,
                    activity=part.activity,
                    distance=distance,
                    pack_voltage=VOLTAGE,
                    pack_current=CURRENT if moving else 0.0,
                    soc=soc - distance / 50_000,
                    soc_sd=0.01,
                    range=45_000 - distance,
                    range_p10=40_000 - distance,
                    range_p90=50_000 - distance,
                )
                drawn.add(estimate)
                log.sample(ESTIMATE_TOPIC, clock(time), estimate_row(estimate))
                learned = {
                    "capacity": LearnedFactor(part.capacity, 0.02, 0.5),
                    "resistance": LearnedFactor(1.1, 0.05, 0.5),
                }
                row = {"ride": ride_row(estimate, drawn, 20.0, part.rider), "learned": learned_row(learned)}
                log.sample(STATUS_TOPIC, clock(time), {} if old else row)
        log.close()
    return file
