"""The baseline: what rides of the healthy vehicle show of it, and how they differ from each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gz_onboard.discovery.baseline_check import Learned, check_against_file, check_held_out, rides_apart
from gz_onboard.discovery.curves import with_inflation
from gz_onboard.discovery.grid import Ride
from gz_onboard.discovery.linear import LinearRide, Noise, Normal, Posterior, learn_noise
from gz_onboard.discovery.mixed_model import MixedModel, initial, linearise_all
from gz_onboard.discovery.prior import GIVEN_SCATTER, LOG_SCALED
from gz_onboard.discovery.search import evidence
from gz_onboard.discovery.wording import Say
from gz_onboard.errors import InputError
from gz_onboard.model.parameters import Parameters, Value, declared_parameters
from gz_onboard.offline.samples import Samples
from gz_onboard.vehicle import Vehicle

WEIGHT = 1.0  # rides that the scatter before any healthy ride is worth
WEATHER_WEIGHT = 4.0  # the same of the wind's: a few calm days do not promise more of them
ROUNDS = 3
SCATTER_ROUNDS = 120  # of expectation and maximisation
LEAST = 0.6  # of an inflation
LEAST_RIDES = 3
HARDLY = 0.8  # of the standard deviation that was known: a guess that is no surer was not measured


def baseline(
    vehicle: Vehicle,
    healthy: Sequence[Samples],
    folder: Path | None = None,
    progress: Say | None = None,
    workers: int = 1,
) -> Vehicle:
    """`vehicle` as `healthy` rides show it: parameters refitted within their calibration, and the null statistics.

    Needs three rides. Raises InputError for rides that cannot be used, that contradict the file, or that foretell each
    other's energy worse than it does (`baseline_check`).
    """
    if len(healthy) < LEAST_RIDES:
        raise InputError(f"{len(healthy)} healthy rides: three are the least that tell how rides differ")
    mixed = initial(vehicle, folder)
    learned = learn(mixed, [mixed.ride(samples) for samples in healthy], progress or (lambda _: None), workers)
    check_against_file(learned)
    checked = "\nnote: ".join([check_held_out(learned), *rides_apart(learned)])
    return adopted(vehicle, replace(learned.after, checked=checked), mixed)


def adopted(vehicle: Vehicle, mixed: MixedModel, before: MixedModel) -> Vehicle:
    """`vehicle` with the values and standard deviations of its own parameters that `mixed` has learned. A guess of
    which the rides say hardly more than was known `before` stays one.
    """
    known = dict(vehicle.parameters.known)
    sd = np.sqrt(np.diag(mixed.prior)) * mixed.scale
    at = mixed.values_at(mixed.mean)
    declared = declared_parameters(vehicle.model.effects)
    model = {name for effect in vehicle.model.effects for name in effect.term.parameters}
    for name, s in zip(mixed.names, sd, strict=True):
        if name in known and (name in model or not known[name].source.startswith("prior:")):
            old = known[name]
            i = mixed.names.index(name)
            if old.status == "guess" and s > HARDLY * float(np.sqrt(before.prior[i, i]) * before.scale[i]):
                continue
            wide = float(s * (old.value if name in LOG_SCALED else 1.0))
            source = f"{old.source}; refitted on {mixed.healthy} healthy rides"
            bounds = declared[name]
            known[name] = Value(float(np.clip(at[name], bounds.low, bounds.high)), wide, old.unit, "measured", source)
    learned = replace(vehicle, parameters=Parameters(known))
    return replace(learned, healthy=replace(mixed, vehicle=learned))


def learn(mixed: MixedModel, rides: Sequence[Ride], progress: Say, workers: int = 1) -> Learned:
    """`mixed` as `rides` of the healthy vehicle teach it: common part and noise first, then the scatter of rides.

    In this order, for a scatter that is free while the noise is learned takes what is noise for its own.
    """
    now = mixed
    shift = np.zeros(len(mixed.names))
    for i in range(ROUNDS):
        progress(f"healthy rides, round {i + 1} of {ROUNDS}")
        lines = linearise_all(rides, now, workers)
        post = now.fit(now.normals(lines))
        noise = learned_noise(lines, post, now)
        shift = shift + post.mean
        now = replace(mixed, values=mixed.values_at(shift), mean=mixed.mean - shift, noise=noise)
    progress("scatter between healthy rides")
    lines = linearise_all(rides, now, workers)
    normals = now.normals(lines)
    weather = {name for cause in mixed.causes if cause.varies for name in cause.names}
    weight = np.array([WEATHER_WEIGHT if name in weather else WEIGHT for name in mixed.names])
    post = now.learned_scatter(normals, weight, SCATTER_ROUNDS)
    before = replace(now, scatter=post.scatter, healthy=len(rides))
    after = replace(before, mean=post.mean, prior=post.covariance)
    folds = left_out(before, normals)
    after = replace(after, inflation=inflation(folds, normals), shapes=with_inflation(after, folds, lines, normals))
    return Learned(before, after, lines, folds, mixed.scatter)


def learned_noise(lines: Sequence[LinearRide], post: Posterior, now: MixedModel) -> Noise:
    """The noise of `now` as the residuals show it, each ride at its own parameters; of the cells at its own start
    alone, for there what differs between rides is the circuit's lack, and would be taken for knowledge.
    """
    starts = np.array([name in GIVEN_SCATTER for name in now.names])
    free = learn_noise(lines, post.mean + post.own, now.noise)
    held = learn_noise(lines, post.mean + post.own * starts, now.noise)
    return {name: (held if name == "cell_voltage" else free)[name] for name in free}


def left_out(before: MixedModel, normals: Sequence[Normal], size: int = 2) -> list[tuple[MixedModel, list[int]]]:
    """What is learned without each `size` of the rides, and which those are."""
    folds = []
    for start in range(0, len(normals), size):
        held = list(range(start, min(start + size, len(normals))))
        rest = [n for i, n in enumerate(normals) if i not in held]
        if len(rest) >= 2:
            post = before.fit(rest)
            folds.append((replace(before, mean=post.mean, prior=post.covariance), held))
    return folds


def inflation(folds: Sequence[tuple[MixedModel, list[int]]], normals: Sequence[Normal]) -> dict[str, float]:
    """By how much the score of each cause is too high on healthy rides that the rest did not learn from.

    Mean of chi-squared over the folds, with a prior of 1 worth one fold; at least `LEAST`.
    """
    total: dict[str, list[float]] = {}
    for mixed, held in folds:
        e = evidence(mixed, [normals[i] for i in held])
        for cause in mixed.usable_causes:
            index = mixed.index(cause.names)
            total.setdefault(cause.name, []).append(e.gain(index) / len(index))
    return {name: max(LEAST, (1 + sum(x)) / (1 + len(x))) for name, x in total.items()}
