"""Whether a baseline may be believed: no parameter far from what was known, no energy worse on rides held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.constants import WH_PER_KM
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.cross_validation import start_equations, with_own_start
from gz_onboard.discovery.gain import errors
from gz_onboard.discovery.linear import LinearRide, normal
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.prior import HEALTHY_SD, LOG_SCALED
from gz_onboard.errors import InputError
from gz_onboard.lab.overrun import ENTERED, FAR, overrun, stop_at
from gz_onboard.model.parameters import Value, declared_parameters

APART = 12.0  # times what differs between rides: of eight healthy rides 5 at most, of a current 30 % wrong in one 61
LEAST_RIDES = 5  # to hold two out at a time and learn from the others
PAYLOAD = "payload_mass"
ALIKE = 1.5  # times: standard deviations that differ by more are said
MOST_SAID = 3  # parameters: one bad signal may pull dozens


@dataclass(frozen=True)
class Learned:
    """What healthy rides taught. before: at the values that they led to, with what was known without them; after: with
    them. lines: the rides there. folds: what is learned without some of them, and which these are. usual_scatter (p,):
    between rides, as a variance in scales, before any.
    """

    before: MixedModel
    after: MixedModel
    lines: Sequence[LinearRide]
    folds: Sequence[tuple[MixedModel, list[int]]]
    usual_scatter: Array


def check_against_file(learned: Learned) -> None:
    """InputError if a parameter of the vehicle file is led beyond `FAR` from where the file has it, in its sd and in
    what differs between rides, naming the channel that leads it there.

    Terms of a loss curve from a bench are not judged one by one: they stand in for each other.
    """
    before, after = learned.before, learned.after
    known = before.vehicle.parameters.known
    payload = payload_known(learned)
    sd = np.sqrt(np.diag(before.prior) + learned.usual_scatter)
    if PAYLOAD in before.names:
        (i,) = before.index([PAYLOAD])
        sd[i] = np.hypot(payload.sd / before.scale[i], np.sqrt(learned.usual_scatter[i]))
    far = np.abs(after.mean - before.mean) / sd
    found = [i for i in sorted(_judged(before), key=lambda i: -far[i]) if far[i] > FAR]
    rows = []
    for i in found[:MOST_SAID]:
        name, old = before.names[i], known[before.names[i]]
        new = after.values_at(after.mean)[name]
        unit_step = float(after.scale[i]) * (new if name in LOG_SCALED else 1.0)
        wide = float(np.sqrt(after.prior[i, i])) * unit_step
        channel, without = pulling(learned, i)
        if name == PAYLOAD:  # what was entered counts, and is corrected by as much
            new, without = (value + payload.value - old.value for value in (new, without))
            old = payload
        pulled = f"{channel} ({', '.join(CHANNEL[channel].roles)}) pulls it there, without which it is {without:.4g}"
        if not 1 / ALIKE < (used := sd[i] * unit_step) / max(old.sd, 1e-12) < ALIKE:
            pulled = f"one is {used:.2g} {old.unit} here, for a vehicle on the road, from ride to ride; {pulled}"
        rows.append(overrun(name, old, (new, wide), float(far[i]), pulled))
    if more := len(found) - len(rows):
        rows.append(f"and {more} more")
    stop_at(rows)


def payload_known(learned: Learned) -> Value:
    """The payload before the rides: as entered with them, within what that is known to; else as the file has it."""
    before = learned.before
    known, entered = before.vehicle.parameters.known[PAYLOAD], [line.ride.payload for line in learned.lines]
    given = [mass for mass in entered if mass is not None]
    if len(given) < len(entered) or not given:
        return known
    return replace(known, value=float(np.mean(given)), sd=HEALTHY_SD[PAYLOAD], status=ENTERED, source="entered")


def _judged(before: MixedModel) -> list[int]:
    """Where the parameters of the file are that are no terms of a loss curve from a bench."""
    known, declared = before.vehicle.parameters.known, declared_parameters(before.vehicle.model.effects)
    return [i for i, name in enumerate(before.names) if name in known and not declared[name].bench]


def rides_apart(learned: Learned) -> list[str]:
    """Rides in which a parameter of the file is more than `APART` usual scatters from the others, a sentence each."""
    before = learned.before
    own = before.fit(before.normals(learned.lines)).own
    own = own - np.median(own, axis=0)  # the mean has moved towards a ride that is far
    sd = np.sqrt(learned.usual_scatter)
    judged = [i for i in _judged(before) if sd[i] > 0]
    found = []
    for line, row in zip(learned.lines, own, strict=True):
        i = max(judged, key=lambda i: abs(row[i] / sd[i]))
        if (far := abs(row[i] / sd[i])) > APART:
            found.append(
                f"{line.ride.name} is an outlier: {before.names[i]} is {far:.0f} times as far from the others as rides "
                "usually are; is it healthy, and are its signals right?"
            )
    return found


def pulling(learned: Learned, i: int) -> tuple[str, float]:
    """(the channel without which the parameter at `i` is nearest to the file's, its value without it)."""
    before, file = learned.before, learned.before.mean[i]
    channels = sorted({name for line in learned.lines for name in line.tables})
    without = {}
    for channel in channels:
        rest = [normal(line, before.noise, [n for n in line.tables if n != channel]) for line in learned.lines]
        without[channel] = before.fit(rest).mean
    best = min(channels, key=lambda channel: abs(without[channel][i] - file))
    return best, before.values_at(without[best])[before.names[i]]


def check_held_out(learned: Learned) -> str:
    """How well the energy of rides is known that were held out, two at a time, by the file before and by what the
    others taught, in words; InputError if it is worse, by more than the standard error of the difference.
    """
    rows = []
    if len(learned.lines) >= LEAST_RIDES:
        for fold, held in learned.folds:
            for line in (learned.lines[i] for i in held):
                start = start_equations(fold, line)
                models = (learned.before, fold)
                rows.append([errors(line, with_own_start(m, start, m.mean))["consumption"] for m in models])
    if not rows or not np.any(rows):
        return f"not checked on rides held out: {len(learned.lines)} rides, {LEAST_RIDES} with their energy are needed"
    old, new = np.array(rows).T / WH_PER_KM
    more = new - old
    text = (
        f"energy of rides held out: {old.mean():.2f} Wh/km missed by the file before, {new.mean():.2f} by what the "
        f"others taught ({len(rows)} rides)"
    )
    if more.mean() > more.std(ddof=1) / np.sqrt(len(more)):
        raise InputError(f"{text}: worse. Nothing is written; are these rides of this vehicle, and its signals right?")
    return text
