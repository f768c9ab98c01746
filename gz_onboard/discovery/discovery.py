"""Discovery: what a set of rides shows beyond what is known of the vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.baseline_file import restore
from gz_onboard.discovery.blocks import usable
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.detectability import judge_remaining_error, limits
from gz_onboard.discovery.gain import measure_gain
from gz_onboard.discovery.grid import STEP, Ride
from gz_onboard.discovery.mixed_model import MixedModel, linearise_all
from gz_onboard.discovery.residuals import voltage_timing
from gz_onboard.discovery.result import Gain
from gz_onboard.discovery.selection import linearised_about, search_problem
from gz_onboard.discovery.uncalibrated import NOTE, without_baseline
from gz_onboard.discovery.unexplained import in_words
from gz_onboard.discovery.verdict import Discovery, conclude
from gz_onboard.discovery.wording import Say
from gz_onboard.errors import InputError
from gz_onboard.offline.samples import Samples
from gz_onboard.vehicle import Vehicle

SHORTEST = 300.0  # m: shorter rides show nothing
LATENCY = "pack_voltage_latency"
LATENCY_STEPS = 10  # of the grid of time, to either side, that a delay is sought in
LINEAR_LATENCY = 0.15  # s: a delay up to which the step of the voltage is linear in it


def discover(
    vehicle: Vehicle,
    rides: Sequence[Samples],
    seed: int = 0,
    folder: Path | None = None,
    progress: Say | None = None,
    workers: int = 1,
    holdout: Sequence[str] | None = None,
) -> Discovery:
    """What `rides` show that `vehicle` does not: shown, named, measured.

    seed: of the bootstrap over rides held out. folder: with effects of the user's own. progress: takes the step that
    begins. workers: processes. holdout: names of rides that only the gain is measured on, in no choice and no fit;
    without any each ride in turn is left out of the fit. Raises InputError where no ride can be used.
    """
    say = progress or (lambda _: None)
    mixed = restore(vehicle, folder)
    found, notes = read_all(mixed, rides)
    apart = [ride for ride in found if holdout and ride.name in holdout]
    found = [ride for ride in found if not (holdout and ride.name in holdout)]
    if not found:
        raise InputError("every ride is held out: none is left to look into")
    say(f"{len(found)} rides, {len(mixed.names)} parameters")
    if not mixed.healthy:
        notes.append(NOTE)
        mixed = without_baseline(mixed, found, workers)
    problem = search_problem(mixed, first_offset(mixed, found), lambda at: linearise_all(found, at, workers))
    discovery = conclude(problem, notes, say)
    say("gain on rides held out")
    held = linearised_about(mixed, discovery.at, lambda at: linearise_all(apart, at, workers)) if apart else []
    report = discovery.report
    report.gain = measure_gain(discovery, seed, held)
    if report.unknown is not None and report.causes and not report.unknown.denies:
        plain = replace(discovery, report=replace(report, unknown=None))
        drop_curve(discovery, measure_gain(plain, seed, held))
    judge_remaining_error(discovery)
    report.limits = limits(discovery)
    return discovery


def read_all(mixed: MixedModel, rides: Sequence[Samples]) -> tuple[list[Ride], list[str]]:
    """The rides on the grid, and why others cannot be used. InputError if none can."""
    found: list[Ride] = []
    notes: list[str] = []
    for samples in rides:
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
    """Where to linearise first, (p,) in scales: at the delay of the voltage that fits best of a grid, for a delay of
    more than the time between two frames is no linear change.
    """
    offset = np.zeros(len(mixed.names))
    mine = [ride for ride in rides if usable(CHANNEL["voltage_timing"], ride, mixed.system)]
    if LATENCY not in mixed.names or not mine:
        return offset
    i = mixed.names.index(LATENCY)
    healthy = mixed.values_at(mixed.mean)
    spread = {
        late: sum(float(np.mean(np.abs(voltage_timing(r, {**healthy, LATENCY: late}, mixed.system)))) for r in mine)
        for late in (healthy[LATENCY] + STEP * k for k in range(-LATENCY_STEPS, LATENCY_STEPS + 1))
    }
    best = min(spread, key=lambda late: spread[late])
    if abs(best - healthy[LATENCY]) > LINEAR_LATENCY:
        offset[i] = (best - healthy[LATENCY]) / mixed.scale[i]
    return offset


def drop_curve(found: Discovery, gain: Gain) -> None:
    """Take out the curve beside the causes of `found` if `gain`, which is without it, is better in what it is about."""
    report = found.report
    assert report.unknown is not None
    channel = report.unknown.channel
    metric = "voltage" if channel == "cell_voltage" else "power"
    without, with_it = gain.errors.get(metric), report.gain.errors.get(metric)
    if without is not None and with_it is not None and without.after <= with_it.after:
        report.notes.append(
            f"{in_words(report.unknown)} beside the causes is no better known on rides held out: left alone"
        )
        report.unknown, report.gain = None, gain
        report.advice.pop()  # the last is on what has no name
