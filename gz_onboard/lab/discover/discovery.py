"""Baseline and discovery: what a healthy vehicle shows, and what a set of rides shows beyond it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.errors import InputError
from gz_onboard.lab.discover.channels import BY_NAME, usable, voltage_timing
from gz_onboard.lab.discover.curves import with_inflation
from gz_onboard.lab.discover.gain import measure_gain
from gz_onboard.lab.discover.grid import Ride
from gz_onboard.lab.discover.linear import (
    LinearRide,
    Noise,
    Normal,
    Posterior,
    fit_mixed,
    learn_noise,
    linearise,
    normal,
    spread_out,
    trimmed,
)
from gz_onboard.lab.discover.mixed_model import MixedModel, initial, restore
from gz_onboard.lab.discover.prior import FIXED, LOG, WEATHER
from gz_onboard.lab.discover.result import Report
from gz_onboard.lab.discover.search import Search, evidence
from gz_onboard.lab.discover.selection import linearised_about
from gz_onboard.lab.discover.uncalibrated import NOTE, without_baseline
from gz_onboard.lab.discover.verdict import reach
from gz_onboard.physics.parameters import Parameters, Value, declared_parameters
from gz_onboard.simulation.samples import Samples
from gz_onboard.vehicle import Vehicle

WEIGHT = 1.0  # rides that the scatter before any healthy ride is worth
WEATHER_WEIGHT = 4.0  # the same of the wind's: a few calm days do not promise more of them
ROUNDS = 3
LEAST = 0.6
Progress = Callable[[str], None]
LATENCY = "pack_voltage_latency"


def baseline(
    vehicle: Vehicle,
    healthy: Sequence[Samples],
    folder: Path | None = None,
    progress: Progress | None = None,
    workers: int = 1,
) -> Vehicle:
    """`vehicle` as `healthy` rides show it: parameters refitted within their calibration, and the null statistics.

    Needs three rides. Raises InputError for rides that cannot be used.
    """
    if len(healthy) < 3:
        raise InputError(f"{len(healthy)} healthy rides: three are the least that tell how rides differ")
    mixed = initial(vehicle, folder)
    mixed = learn(mixed, [mixed.ride(samples) for samples in healthy], progress or (lambda _: None), workers)
    return adopted(vehicle, mixed)


def adopted(vehicle: Vehicle, mixed: MixedModel) -> Vehicle:
    """`vehicle` with the values and standard deviations of its own parameters that `mixed` has learned."""
    known = dict(vehicle.parameters.known)
    sd = np.sqrt(np.diag(mixed.prior)) * mixed.scale
    at = mixed.unit_value(mixed.mean)
    declared = declared_parameters(vehicle.model.effects)
    model = {name for effect in vehicle.model.effects for name in effect.keywords}
    for name, s in zip(mixed.names, sd, strict=True):
        if name in known and (name in model or not known[name].source.startswith("prior:")):
            old = known[name]
            wide = float(s * (old.value if name in LOG else 1.0))
            source = f"{old.source}; refitted on {mixed.healthy} healthy rides"
            bounds = declared[name]
            known[name] = Value(float(np.clip(at[name], bounds.low, bounds.high)), wide, old.unit, "measured", source)
    learned = replace(vehicle, parameters=Parameters(known, vehicle.parameters.correlations))
    return replace(learned, healthy=replace(mixed, vehicle=learned))


def _linearised(job: tuple[Ride, MixedModel]) -> LinearRide:
    ride, mixed = job
    line = linearise(ride, mixed.values, mixed.names, mixed.scale, mixed.system)
    wide = np.sqrt(np.diag(mixed.prior)) + 3 * np.sqrt(mixed.scatter)
    for parameter in [parameter for cause in usable_causes(mixed) for parameter in cause.parameters]:
        (i,) = mixed.index([parameter.name])
        wide[i] += max(10 * float(np.sqrt(mixed.scatter[i])), 3 * parameter.prior_sd / float(mixed.scale[i]))
    line = trimmed(line, mixed.noise, mixed.mean, wide)
    return spread_out(line, mixed.noise, mixed.mean, wide) if mixed.healthy else line


def linearise_all(
    rides: Sequence[Ride], mixed: MixedModel | Sequence[MixedModel], workers: int = 1
) -> list[LinearRide]:
    """All rides at a model, or each at its own, in `workers` processes."""
    states = [mixed] * len(rides) if isinstance(mixed, MixedModel) else mixed
    jobs = list(zip(rides, states, strict=True))
    if workers < 2 or len(rides) < 2:
        return [_linearised(job) for job in jobs]
    with ProcessPoolExecutor(workers) as pool:
        return list(pool.map(_linearised, jobs))


def learn(mixed: MixedModel, rides: Sequence[Ride], progress: Progress, workers: int = 1) -> MixedModel:
    """`mixed` as `rides` of the healthy vehicle teach it: common part and noise first, then the scatter of rides.

    In this order, for a scatter that is free while the noise is learned takes what is noise for its own.
    """
    noise = mixed.noise
    values, first = dict(mixed.values), mixed.mean
    shift = np.zeros(len(mixed.names))
    for i in range(ROUNDS):
        progress(f"healthy rides, round {i + 1} of {ROUNDS}")
        lines = linearise_all(rides, replace(mixed, values=values, mean=first - shift, noise=noise), workers)
        normals = [normal(line, noise) for line in lines]
        post = fit_mixed(normals, first - shift, mixed.prior, mixed.scatter, WEIGHT, mixed.free, 0)
        noise = learned_noise(mixed, lines, post, noise)
        shift = shift + post.mean
        values = mixed.unit_value(shift)
    progress("scatter between healthy rides")
    lines = linearise_all(rides, replace(mixed, values=values, mean=first - shift, noise=noise), workers)
    normals = [normal(line, noise) for line in lines]
    weight = np.array([WEATHER_WEIGHT if name in WEATHER else WEIGHT for name in mixed.names])
    post = fit_mixed(normals, first - shift, mixed.prior, mixed.scatter, weight, mixed.free, 120)
    after = replace(
        mixed,
        values=values,
        mean=post.mean,
        prior=post.covariance,
        scatter=post.scatter,
        noise=noise,
        healthy=len(rides),
    )
    before = replace(after, mean=first - shift, prior=mixed.prior)
    folds = left_out(before, normals)
    return replace(after, inflation=inflation(folds, normals), shapes=with_inflation(after, folds, lines, normals))


def learned_noise(mixed: MixedModel, lines: Sequence[LinearRide], post: Posterior, noise: Noise) -> Noise:
    """`noise` as the residuals show it, each ride at its own parameters; of the cells at its own start alone, for there
    what differs between rides is the circuit's lack, and would be taken for knowledge.
    """
    starts = np.array([name in FIXED for name in mixed.names])
    free = learn_noise(lines, post.mean + post.own, noise)
    held = learn_noise(lines, post.mean + post.own * starts, noise)
    return {name: (held if name == "cell_voltage" else free)[name] for name in free}


def left_out(before: MixedModel, normals: Sequence[Normal], size: int = 2) -> list[tuple[MixedModel, list[int]]]:
    """What is learned without each `size` of the rides, and which those are."""
    folds = []
    for start in range(0, len(normals), size):
        held = list(range(start, min(start + size, len(normals))))
        rest = [n for i, n in enumerate(normals) if i not in held]
        if len(rest) >= 2:
            post = fit_mixed(rest, before.mean, before.prior, before.scatter, WEIGHT, before.free, 0)
            folds.append((replace(before, mean=post.mean, prior=post.covariance), held))
    return folds


def inflation(folds: Sequence[tuple[MixedModel, list[int]]], normals: Sequence[Normal]) -> dict[str, float]:
    """By how much the score of each cause is too high on healthy rides that the rest did not learn from.

    Mean of chi-squared over the folds, with a prior of 1 worth one fold; at least `LEAST`.
    """
    total: dict[str, list[float]] = {}
    for mixed, held in folds:
        e = evidence(mixed, [normals[i] for i in held])
        for cause in usable_causes(mixed):
            index = mixed.index(cause.names)
            total.setdefault(cause.name, []).append(e.gain(index) / len(index))
    return {name: max(LEAST, (1 + sum(x)) / (1 + len(x))) for name, x in total.items()}


def coarse(mixed: MixedModel, rides: Sequence[Ride]) -> Array:
    """Where to linearise first, (p,) in scales: at the delay of the voltage that fits best of a grid, for a delay of
    more than the time between two frames is no linear change.
    """
    offset = np.zeros(len(mixed.names))
    mine = [ride for ride in rides if usable(BY_NAME["voltage_timing"], ride, mixed.system)]
    if LATENCY not in mixed.names or not mine:
        return offset
    i = mixed.names.index(LATENCY)
    healthy = mixed.unit_value(mixed.mean)
    spread = {
        late: sum(float(np.mean(np.abs(voltage_timing(r, {**healthy, LATENCY: late}, mixed.system)))) for r in mine)
        for late in (healthy[LATENCY] + 0.1 * k for k in range(-10, 11))
    }
    best = min(spread, key=lambda late: spread[late])
    if abs(best - healthy[LATENCY]) > 0.15:
        offset[i] = (best - healthy[LATENCY]) / mixed.scale[i]
    return offset


def usable_causes(mixed: MixedModel) -> list:  # type: ignore[type-arg]
    """The candidates whose parameters some channel depends on."""
    return [c for c in mixed.causes if set(c.names) <= set(mixed.names)]


def discover(
    vehicle: Vehicle,
    rides: Sequence[Samples],
    seed: int = 0,
    folder: Path | None = None,
    progress: Progress | None = None,
    workers: int = 1,
    holdout: Sequence[str] | None = None,
) -> Report:
    """What `rides` show that `vehicle` does not: shown, named, measured. See `Report`.

    seed: of the bootstrap over rides held out. holdout: names of rides that only the gain is measured on, in no choice
    and no fit; without any each ride in turn is left out of the fit. workers: processes.
    Raises InputError where no ride can be used.
    """
    say = progress or (lambda _: None)
    mixed = restore(vehicle, folder)
    notes: list[str] = []
    found: list[Ride] = []
    for samples in rides:
        try:
            ride = mixed.ride(samples)
        except InputError as error:
            notes.append(str(error))
            continue
        if ride.distance < 300:
            notes.append(f"ride {ride.name}: {ride.distance:.0f} m; less than 300 m tell nothing")
            continue
        found.append(ride)
    if not found:
        raise InputError("no ride can be used: " + "; ".join(notes or ["none given"]))
    apart = [ride for ride in found if holdout and ride.name in holdout]
    found = [ride for ride in found if not (holdout and ride.name in holdout)]
    if not found:
        raise InputError("every ride is held out: none is left to look into")
    say(f"{len(found)} rides, {len(mixed.names)} parameters")
    if not mixed.healthy:
        notes.append(NOTE)
        mixed = without_baseline(mixed, found, lambda some, at: linearise_all(some, at, workers))
    report = reach(mixed, notes, say, lambda s: linearise_all(found, s, workers), coarse(mixed, found))
    say("gain on rides held out")
    assert report.at is not None
    held = linearised_about(mixed, report.at, lambda s: linearise_all(apart, s, workers)) if apart else []
    report.gain = measure_gain(report, seed, held)
    if report.unknown is not None and report.causes and not report.unknown["denies"]:
        without_curve(report, measure_gain(replace(report, unknown=None), seed, held))
    return report


def without_curve(report: Report, gain: dict[str, Any]) -> None:
    """Drop the curve beside the causes of `report` if `gain`, which is without it, is better in what it is about."""
    assert report.unknown is not None
    channel, quantity = report.unknown["channel"], report.unknown["quantity"]
    metric = "voltage" if channel == "cell_voltage" else "power"
    if metric in gain and gain[metric]["after"] <= report.gain[metric]["after"]:
        report.unknown, report.gain = None, gain
        report.advice.pop()  # the last is on what has no name
        report.notes.append(
            f"what {channel} leaves over {quantity} beside the causes is no better known on rides held out: left alone"
        )


__all__ = ["Array", "Search", "adopted", "baseline", "discover", "learn", "left_out"]
