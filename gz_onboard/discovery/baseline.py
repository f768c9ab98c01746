"""The baseline: parameters and scatter by rides of the healthy vehicle, and the files that keep them."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from gz_onboard.calibration.result import Found, Result
from gz_onboard.calibration.vehicle_file import copied_effects, write_vehicle
from gz_onboard.constants import WH_PER_KM
from gz_onboard.discovery.channels import CHANNEL, ChannelNoise
from gz_onboard.discovery.curves import with_inflation
from gz_onboard.discovery.grid import Ride
from gz_onboard.discovery.judgement import errors
from gz_onboard.discovery.mixed_model import (
    HealthyCurve,
    LinearRide,
    MixedModel,
    Statistics,
    initial,
    learn_noise,
    linearise_all,
)
from gz_onboard.discovery.parameters import GIVEN_SCATTER, LOG_SCALED, VEHICLE
from gz_onboard.discovery.search import with_own_start
from gz_onboard.errors import InputError
from gz_onboard.model.parameters import Parameters, Value, declared_parameters
from gz_onboard.priors import ENTERED, FAR, overrun, stop_at
from gz_onboard.recording.recording import Recording
from gz_onboard.vehicle import Vehicle

LEAST_RIDES = 3


@dataclass(frozen=True)
class BaselineConfig:
    """How a baseline is learned, and when it is believed."""

    rounds: int = 3  # of parameters and noise in turn
    scatter_rounds: int = 120  # of expectation and maximisation
    weight: float = 1.0  # rides that the scatter before any healthy ride is worth
    weather_weight: float = 4.0  # the same of the wind: a few calm days do not promise more of them
    least_inflation: float = 0.6
    unmeasured: float = 0.8  # of the sd before: a guess that is no surer was not measured
    outlying: float = 12.0  # times the usual scatter: of eight healthy rides 5 at most, with a current 30 % wrong 61
    least_checked: int = 5  # rides, to hold two out at a time


BASELINE = BaselineConfig()


@dataclass(frozen=True)
class Learned:
    """A model learned from healthy rides.

    before: linearised there, with prior knowledge; after: with theirs. lines: the rides there. folds: models learned
    without some of them, and which these are. usual_scatter (p,): variances between rides, in scales, before any.
    """

    before: MixedModel
    after: MixedModel
    lines: Sequence[LinearRide]
    folds: Sequence[tuple[MixedModel, list[int]]]
    usual_scatter: np.ndarray


def baseline(
    vehicle: Vehicle,
    healthy: Sequence[Recording],
    folder: Path | None = None,
    progress: Callable[[str], None] = lambda _: None,
    workers: int = 1,
) -> Vehicle:
    """`vehicle` as `healthy` rides show it: parameters refitted within their calibration, and statistics of the rides.

    Rides on a roller and coast-downs are left out, as far as they say so; three others are needed. Raises InputError
    for rides that cannot be used, that contradict the file, or that predict each other's energy worse than it does.
    """
    roads = [r for r in healthy if "roller_speed" not in r.columns and r.facts.get("kind") != "coastdown"]
    others = [ride.name for ride in healthy if all(ride is not road for road in roads)]
    notes = [f"left out, as no rides on a road: {', '.join(others)}"] if others else []
    if len(roads) < LEAST_RIDES:
        raise InputError(
            "; ".join([f"{len(roads)} healthy rides: three are the least that tell how they differ", *notes])
        )
    mixed = initial(vehicle, folder)
    learned = learn(mixed, [mixed.ride(samples) for samples in roads], progress, workers)
    check_against_file(learned)
    checked = "\nnote: ".join([check_held_out(learned), *rides_apart(learned), *notes])
    return adopted(vehicle, replace(learned.after, checked=checked), mixed)


def adopted(vehicle: Vehicle, mixed: MixedModel, before: MixedModel) -> Vehicle:
    """`vehicle` with the values and standard deviations that `mixed` has learned.

    A guess of which the rides say hardly more than was known `before` stays one.
    """
    known, declared = dict(vehicle.parameters.known), declared_parameters(vehicle.model.effects)
    model = {name for effect in vehicle.model.effects for name in effect.term.parameters}
    at, sd = mixed.values_at(mixed.mean), np.sqrt(np.diag(mixed.prior)) * mixed.scale
    for i, (name, s) in enumerate(zip(mixed.names, sd, strict=True)):
        if name not in known or (name not in model and known[name].source.startswith("prior:")):
            continue
        old = known[name]
        if old.status == "guess" and s > BASELINE.unmeasured * float(np.sqrt(before.prior[i, i]) * before.scale[i]):
            continue
        wide = float(s * (old.value if name in LOG_SCALED else 1.0))
        value = float(np.clip(at[name], declared[name].low, declared[name].high))
        source = f"{old.source}; refitted on {mixed.healthy} healthy rides"
        known[name] = Value(value, wide, old.unit, "measured", source)
    learned = replace(vehicle, parameters=Parameters(known))
    return replace(learned, healthy=replace(mixed, vehicle=learned))


def learn(
    mixed: MixedModel, rides: Sequence[Ride], progress: Callable[[str], None] = lambda _: None, workers: int = 1
) -> Learned:
    """`mixed` as `rides` of the healthy vehicle teach it: common part and noise first, then the scatter of rides.

    In this order, for a scatter that is free while the noise is learned would absorb noise.
    """
    now, shift = mixed, np.zeros(len(mixed.names))
    starts = np.array([name in GIVEN_SCATTER for name in now.names])
    for i in range(BASELINE.rounds):
        progress(f"healthy rides, round {i + 1} of {BASELINE.rounds}")
        lines = linearise_all(rides, now, workers)
        post = now.fit(lines)
        noise = learn_noise(lines, post.mean + post.own, now.noise)
        # of the cells each ride has its own start alone: other differences between rides are errors of the circuit
        noise["cell_voltage"] = learn_noise(lines, post.mean + post.own * starts, now.noise)["cell_voltage"]
        shift = shift + post.mean
        now = replace(mixed, values=mixed.values_at(shift), mean=mixed.mean - shift, noise=noise)
    progress("scatter between healthy rides")
    lines = linearise_all(rides, now, workers)
    weather = {name for cause in mixed.causes if cause.varies for name in cause.names}
    weight = np.where(np.isin(mixed.names, list(weather)), BASELINE.weather_weight, BASELINE.weight)
    post = now.fit(lines, weight, now.free, BASELINE.scatter_rounds)
    before = replace(now, scatter=post.scatter, healthy=len(rides))
    after = replace(before, mean=post.mean, prior=post.covariance)
    folds = []
    for start in range(0, len(lines), 2):
        held = list(range(start, min(start + 2, len(lines))))
        rest = [line for i, line in enumerate(lines) if i not in held]
        if len(rest) >= 2:
            post = before.fit(rest)
            folds.append((replace(before, mean=post.mean, prior=post.covariance), held))
    after = replace(after, inflation=inflation(folds, lines), shapes=with_inflation(after, folds, lines))
    return Learned(before, after, lines, folds, mixed.scatter)


def inflation(folds: Sequence[tuple[MixedModel, list[int]]], lines: Sequence[LinearRide]) -> dict[str, float]:
    """How much too high the score of each cause is on healthy rides that the rest did not learn from.

    Mean of chi-squared over the folds, with a prior of 1 worth one fold.
    """
    total: dict[str, list[float]] = {}
    for mixed, held in folds:
        evidence = mixed.evidence(lines[i] for i in held)
        for cause in mixed.usable_causes:
            index = mixed.index(cause.names)
            total.setdefault(cause.name, []).append(evidence.gain(index) / len(index))
    return {name: max(BASELINE.least_inflation, (1 + sum(x)) / (1 + len(x))) for name, x in total.items()}


# --- whether it is believed -----------------------------------------------------------------------------------------


def check_against_file(learned: Learned) -> None:
    """InputError if a parameter moved beyond `FAR` from the file, naming the channel that causes it.

    In its standard deviation and the scatter between rides. Terms of a loss curve from a bench are not judged one by
    one: they can replace each other.
    """
    before, after = learned.before, learned.after
    known, payload = before.vehicle.parameters.known, payload_known(learned)
    sd = np.sqrt(np.diag(before.prior) + learned.usual_scatter)
    for i in before.index({"payload_mass"} & set(before.names)):
        sd[i] = np.hypot(payload.sd / before.scale[i], np.sqrt(learned.usual_scatter[i]))
    far = np.abs(after.mean - before.mean) / sd
    found = [i for i in sorted(_judged(before), key=lambda i: -far[i]) if far[i] > FAR]
    rows = []
    for i in found[:3]:  # one bad signal may move dozens
        name, old = before.names[i], known[before.names[i]]
        new = after.values_at(after.mean)[name]
        step = float(after.scale[i]) * (new if name in LOG_SCALED else 1.0)
        channel, without = pulling(learned, i)
        if name == "payload_mass":  # the mass entered counts, and is corrected by as much
            new, without = (value + payload.value - old.value for value in (new, without))
            old = payload
        pulled = f"{channel} ({', '.join(CHANNEL[channel].roles)}) pulls it there, without which it is {without:.4g}"
        if not 1 / 1.5 < (used := sd[i] * step) / max(old.sd, 1e-12) < 1.5:
            pulled = f"one is {used:.2g} {old.unit} here, for a vehicle on the road, from ride to ride; {pulled}"
        rows.append(overrun(name, old, (new, float(np.sqrt(after.prior[i, i])) * step), float(far[i]), pulled))
    if more := len(found) - len(rows):
        rows.append(f"and {more} more")
    stop_at(rows)


def payload_known(learned: Learned) -> Value:
    """The payload before the rides: as entered with them, else as in the file."""
    known = learned.before.vehicle.parameters.known["payload_mass"]
    entered = [line.ride.payload for line in learned.lines]
    given = [mass for mass in entered if mass is not None]
    if len(given) < len(entered) or not given:
        return known
    sd = VEHICLE["payload_mass"].healthy_sd or known.sd
    return replace(known, value=float(np.mean(given)), sd=sd, status=ENTERED, source="entered")


def _judged(before: MixedModel) -> list[int]:
    """The places of the parameters of the file that are no terms of a loss curve from a bench."""
    known, declared = before.vehicle.parameters.known, declared_parameters(before.vehicle.model.effects)
    return [i for i, name in enumerate(before.names) if name in known and not declared[name].bench]


def pulling(learned: Learned, i: int) -> tuple[str, float]:
    """(the channel without which the parameter at `i` is nearest to the file's, its value without it)."""
    before, without = learned.before, {}
    for channel in sorted({name for line in learned.lines for name in line.tables}):
        rest = ([name for name in line.tables if name != channel] for line in learned.lines)
        rides = [Statistics.of(x.tables, before.noise, names) for x, names in zip(learned.lines, rest, strict=True)]
        without[channel] = before.fit(rides).mean
    best = min(without, key=lambda channel: abs(without[channel][i] - before.mean[i]))
    return best, before.values_at(without[best])[before.names[i]]


def rides_apart(learned: Learned) -> list[str]:
    """A sentence on each ride in which a parameter of the file is far from that of the others."""
    before = learned.before
    own = before.fit(learned.lines).own
    own = own - np.median(own, axis=0)  # the mean has moved towards a ride that is far
    sd = np.sqrt(learned.usual_scatter)
    judged = [i for i in _judged(before) if sd[i] > 0]
    found = []
    for line, row in zip(learned.lines, own, strict=True):
        i = max(judged, key=lambda i: abs(row[i] / sd[i]))
        if (far := abs(row[i] / sd[i])) > BASELINE.outlying:
            found.append(
                f"{line.ride.name} is an outlier: {before.names[i]} is {far:.0f} times as far from the others as rides "
                "usually are; is it healthy, and are its signals right?"
            )
    return found


def check_held_out(learned: Learned) -> str:
    """How well the energy of rides held out is predicted by the file and by the other rides, in words.

    InputError if the others predict it worse, by more than the standard error of the difference.
    """
    rows = []
    if len(learned.lines) >= BASELINE.least_checked:
        for fold, held in learned.folds:
            for line in (learned.lines[i] for i in held):
                models = (learned.before, fold)
                rows.append([errors(line, with_own_start(m, line, m.mean))["consumption"] for m in models])
    if not rows or not np.any(rows):
        least = BASELINE.least_checked
        return f"not checked on rides held out: {len(learned.lines)} rides, {least} with their energy are needed"
    old, new = np.array(rows).T / WH_PER_KM
    more = new - old
    text = (
        f"energy of rides held out: {old.mean():.2f} Wh/km missed by the file before, {new.mean():.2f} by the baseline "
        f"of the others ({len(rows)} rides)"
    )
    if more.mean() > more.std(ddof=1) / np.sqrt(len(more)):
        raise InputError(f"{text}: worse. Nothing is written; are these rides of this vehicle, and its signals right?")
    return text


# --- files ----------------------------------------------------------------------------------------------------------


def restore(vehicle: Vehicle, folder: Path | None = None) -> MixedModel:
    """The model of `vehicle` by healthy rides, or by its file alone. folder: with effects of the user's own."""
    if isinstance(vehicle.healthy, MixedModel):
        return vehicle.healthy
    mixed = initial(vehicle, folder)
    return load(mixed, vehicle.healthy) if isinstance(vehicle.healthy, Path) else mixed


def write_baseline(vehicle: Vehicle, base: Path, out: Path) -> None:
    """Write `vehicle`, as `baseline` gave it, to `out` after the file `base`, and its statistics next to it."""
    mixed = vehicle.healthy
    assert isinstance(mixed, MixedModel)
    known = {name: value for name, value in vehicle.parameters.known.items() if "refitted on" in value.source}
    found = {name: Found(value.value, value.sd, value.unit, value.source) for name, value in known.items()}
    keys = copied_effects(vehicle.model.effects, out) | saved_beside(mixed, out)
    maker = f"gz-onboard discover --baseline, from {base.name}"
    write_vehicle(base, [Result("baseline", parameters=found)], out, maker, keys)


def saved_beside(mixed: MixedModel, out: Path) -> dict[tuple[str, ...], object]:
    """Write the statistics of healthy rides next to the vehicle file `out`; gives the keys of it that name them."""
    file = out.with_suffix(".healthy.npz")
    save(mixed, file)
    return {("healthy", "file"): file.name, ("healthy", "rides"): int(mixed.healthy)}


def accepted_into(mixed: MixedModel, found: Mapping[str, Found]) -> MixedModel:
    """`mixed` of the vehicle after these parameters were `found`, each known by its standard deviation."""
    mean, prior = mixed.mean.copy(), mixed.prior.copy()
    for name in set(found) & set(mixed.names):
        (i,) = mixed.index([name])
        value = found[name]
        mean[i] = prior[i, :] = prior[:, i] = 0.0
        prior[i, i] = (value.sd / (float(mixed.scale[i]) * (value.value if name in LOG_SCALED else 1.0))) ** 2
    return replace(mixed, mean=mean, prior=prior, values=mixed.values | {n: f.value for n, f in found.items()})


_TABLES = ("values", "noise", "inflation")


def save(mixed: MixedModel, file: Path) -> None:
    """Write the statistics of healthy rides to an npz file."""
    arrays = {name: getattr(mixed, name) for name in ("names", "scale", "mean", "prior", "scatter", "healthy")}
    for key in _TABLES:
        table = getattr(mixed, key)
        arrays |= {f"{key}_names": np.array(list(table)), key: np.array(list(table.values()))}
    for i, shape in enumerate(mixed.shapes.values()):
        arrays |= {f"shape_{i}_{key}": value for key, value in vars(shape).items()}
    with file.open("wb") as stream:
        np.savez_compressed(stream, shape_names=np.array(list(mixed.shapes)), **arrays)


def load(mixed: MixedModel, file: Path) -> MixedModel:
    """`mixed` of a vehicle with the statistics in the npz `file`; InputError for one of another model."""
    try:
        with np.load(file) as data:
            names = [str(name) for name in data["names"]]
            if not set(names) <= set(mixed.names):
                raise InputError(f"{file}: was learned for another model list; run discover --baseline again")
            # candidates that came after it, such as a user's own, keep their prior
            at = mixed.index(names)
            mean, scatter, scale = mixed.mean.copy(), mixed.scatter.copy(), mixed.scale.copy()
            mean[at], scatter[at], scale[at] = data["mean"], data["scatter"], data["scale"]
            prior = mixed.prior.copy()
            prior[at, :] = 0.0
            prior[:, at] = 0.0
            prior[np.ix_(at, at)] = data["prior"]
            tables = {k: dict(zip(data[f"{k}_names"].tolist(), data[k].tolist(), strict=True)) for k in _TABLES}
            shapes = {
                str(name): HealthyCurve(
                    data[f"shape_{i}_mean"], data[f"shape_{i}_covariance"], float(data[f"shape_{i}_inflation"])
                )
                for i, name in enumerate(data["shape_names"])
            }
            return replace(
                mixed,
                mean=mean,
                prior=prior,
                scatter=scatter,
                scale=scale,
                healthy=int(data["healthy"]),
                values=mixed.values | tables["values"],
                noise=dict(mixed.noise) | {name: ChannelNoise(*row) for name, row in tables["noise"].items()},
                inflation=tables["inflation"],
                shapes=shapes,
            )
    except (OSError, ValueError, KeyError, EOFError, BadZipFile, zlib.error) as error:
        raise InputError(f"{file}: cannot be read as statistics of healthy rides: {error}") from error
