"""A discovery: rides in, report out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.baseline import restore
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.grid import STEP, Ride
from gz_onboard.discovery.judgement import Discovery, judge
from gz_onboard.discovery.mixed_model import MixedModel, linearise_all, linearised_about, without_baseline
from gz_onboard.discovery.residuals import voltage_timing
from gz_onboard.discovery.search import search_causes, search_problem
from gz_onboard.errors import InputError, nearest
from gz_onboard.recording.recording import Recording
from gz_onboard.vehicle import Vehicle

SHORTEST = 300.0  # m: shorter rides show nothing
LINEAR_LATENCY = 0.15  # s: a delay up to which the step of the voltage is linear in it


def discover(
    vehicle: Vehicle,
    rides: Sequence[Recording],
    seed: int = 0,
    folder: Path | None = None,
    progress: Callable[[str], None] = lambda _: None,
    workers: int = 1,
    holdout: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> Discovery:
    """Find the differences between `rides` and `vehicle`, and name their causes.

    seed: of the bootstrap over rides held out. folder: with effects of the user's own. progress: takes the step that
    begins. workers: processes. holdout: names of rides that only the gain is measured on; without any each ride in
    turn is left out of the fit. notes: for the report. Raises InputError if no ride can be used.
    """
    known_rides(holdout, [ride.name for ride in rides])
    mixed = restore(vehicle, folder)
    usable, unusable = read_all(mixed, rides)
    notes = [*notes, *unusable]
    held_out = [ride for ride in usable if ride.name in holdout]
    found = [ride for ride in usable if ride.name not in holdout]
    for some, use in ((found, "fitted"), (held_out, "held out")):
        if not some and (holdout or use == "fitted"):
            raise InputError(f"no ride that was to be {use} can be used: {'; '.join(unusable)}")
    progress(f"{len(found)} rides, {len(mixed.names)} parameters")
    if not mixed.healthy:
        notes.append(
            "no healthy rides are known of this vehicle (--baseline): it is compared with its file, whose model is "
            "taken at its word, and the rate of false alarms is not calibrated"
        )
        lines = linearise_all(found, mixed, workers)
        mixed = without_baseline(mixed, lines)
        lines = [line.weighed(mixed) for line in lines]
    offset = first_offset(mixed, found)
    if mixed.healthy or np.any(offset):
        lines = linearised_about(found, mixed, offset, workers)
    problem = search_problem(mixed, lines, offset, workers)
    progress(f"{len(problem.causes)} candidates")
    now = search_causes(problem)
    held_out_lines = linearised_about(held_out, now.mixed, now.offset, workers) if held_out else []
    progress("curves over quantities, and gain on rides held out")
    return judge(problem, now, notes, seed, held_out_lines)


def known_rides(holdout: Sequence[str], names: Sequence[str]) -> None:
    """InputError if not all of the rides to be held out are among those called `names`, or none is left."""
    for name in holdout:
        if name not in names:
            raise InputError(f"holdout: no ride is called {name!r}{nearest(name, names)}")
    if holdout and set(holdout) >= set(names):
        raise InputError("holdout: no ride is left to be fitted")


def read_all(mixed: MixedModel, rides: Sequence[Recording]) -> tuple[list[Ride], list[str]]:
    """The rides on the grid, and why others cannot be used. InputError if none can."""
    found: list[Ride] = []
    notes: list[str] = []
    for samples in rides:
        if "roller_speed" in samples.columns:
            notes.append(f"{samples.name}: is a ride on a roller; left out")
            continue
        try:
            ride = mixed.ride(samples)
        except InputError as error:
            notes.append(str(error))
            continue
        if ride.distance < SHORTEST:
            notes.append(f"ride {ride.name}: {ride.distance:.0f} m; less than {SHORTEST:.0f} m are too short")
            continue
        found.append(ride)
    if not found:
        raise InputError("no ride can be used: " + "; ".join(notes or ["none given"]))
    return found, notes


def first_offset(mixed: MixedModel, rides: Sequence[Ride]) -> Array:
    """Where to linearise first, (p,) in scales: at the likeliest delay of the voltage within a second.

    A delay of more than the time between two frames is no linear change.
    """
    offset, latency = np.zeros(len(mixed.names)), "pack_voltage_latency"
    mine = [ride for ride in rides if CHANNEL["voltage_timing"].usable(ride, mixed.system)]
    if latency not in mixed.names or not mine:
        return offset
    (i,) = mixed.index([latency])
    healthy = mixed.values_at(mixed.mean)
    spread = {
        late: sum(float(np.mean(np.abs(voltage_timing(r, {**healthy, latency: late}, mixed.system)))) for r in mine)
        for late in (healthy[latency] + STEP * k for k in range(-10, 11))
    }
    best = min(spread, key=lambda late: spread[late]) - healthy[latency]
    if abs(best) > LINEAR_LATENCY:
        offset[i] = best / mixed.scale[i]
    return offset
