"""From the causes found to a verdict: how sure, what could stand in, what has no name."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.acceptance import carries_over, within_bounds
from gz_onboard.discovery.blocks import depends
from gz_onboard.discovery.candidates import Candidate
from gz_onboard.discovery.channels import CHANNELS, Channel
from gz_onboard.discovery.constancy import splits
from gz_onboard.discovery.energy import energy_share, residual_sizes
from gz_onboard.discovery.linear import LinearRide, Normal
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.prior import stepped
from gz_onboard.discovery.result import (
    CONSTANT,
    RIDE_TO_RIDE,
    FoundCause,
    Gain,
    Isolability,
    ParameterEstimate,
    Report,
    Score,
    Unknown,
)
from gz_onboard.discovery.search import Search
from gz_onboard.discovery.selection import SearchProblem
from gz_onboard.discovery.strain import advice as strain_advice
from gz_onboard.discovery.strain import strain_of
from gz_onboard.discovery.unexplained import unexplained
from gz_onboard.discovery.winds import Winds, search_causes
from gz_onboard.discovery.wording import Say
from gz_onboard.errors import brief

DISCREPANCY = 0.05  # of a change, sd: the form of an effect is not exactly the real one's
LUMPED = {
    "cell_voltage": 1,
    "voltage_timing": 1,
    "motor_temperature": 3,
    "inverter_temperature": 3,
    "cell_temperature": 3,
}
"""Channels whose model is a circuit or a network of lumps: by how much more than that they err, in shares of it."""
LEAST = 0.4  # of the threshold, by which a stand-in must explain something itself
MARGIN = 6.0  # of chi-squared within which another cause explains as well: a likelihood ratio of 20
LOOK_ALIKE = 0.8  # cosine of what two candidates do


@dataclass
class Discovery:
    """A report, and what it was reached on: the rides linearised about `at` (p,), in scales of `mixed`."""

    report: Report
    mixed: MixedModel
    at: Array
    lines: list[LinearRide]
    normals: list[Normal]

    __repr__ = brief


def conclude(problem: SearchProblem, notes: list[str], say: Say) -> Discovery:
    """The verdict, its gain and its limits still open. notes: so far. say: takes the step that begins."""
    say(f"{len(problem.causes)} candidates")
    searched = search_causes(problem)
    now, winds = searched.selection, searched.winds
    say("curves over quantities")
    constancy = splits(now)
    unknown = unexplained(now, constancy, problem.limit)
    chosen = tuple(name for name in now.chosen if unknown is None or name not in unknown.denies)
    every = Search(now.mixed, now.search.evidence, problem.causes, problem.shares)
    found = [replace(c, varies=not carries_over(now, c.name)) for c in causes_of(now.search, chosen, now.lines)]
    sets = alternatives(now.search, chosen, problem.limit)
    scores = {name: every.part(chosen, name) for name in every.causes}
    notes = [*notes, *unseen(problem), *map(str, searched.rejected)]
    if winds is not None:
        scores[winds.cause.name] = max(scores.get(winds.cause.name, 0.0), winds.score)
        if winds.score > problem.limit:
            found = [*found, wind_cause(every, chosen, winds, now.lines)]
            notes.append("the wind differed from ride to ride: " + winds.words)
    strain = strain_of(now, chosen, searched.rejected, scores, problem.limit)
    ranking = sorted((Score(name, round(score, 2)) for name, score in scores.items()), key=lambda row: -row.score)
    report = Report(
        verdict=verdict_of(found, sets, unknown is not None or strain is not None),
        causes=found,
        ambiguous=sets,
        unknown=unknown,
        ranking=ranking,
        residuals=residual_sizes(now.lines),
        gain=Gain(),
        advice=[*([strain_advice(strain)] if strain else []), *advice(now.search, sets, unknown)],
        notes=notes,
        isolability=separability(every),
        threshold=problem.limit,
        constancy=constancy,
        strain=strain,
    )
    return Discovery(report, now.mixed, now.offset, now.lines, now.normals)


def verdict_of(found: Sequence[FoundCause], sets: Sequence[Sequence[str]], more: bool) -> str:
    """One of `result.VERDICTS`. more: something differs that has no name."""
    if more and not found:
        return "unknown"
    if sets:
        return "ambiguous"
    return "cause" if found else "none"


def unseen(problem: SearchProblem) -> list[str]:
    """A note on the candidates that are not identifiable, and one on each that no ride has the sensors for."""
    mixed = problem.mixed
    blind = [cause for cause in mixed.causes if cause not in problem.causes]
    there = {name for line in problem.lines for name in line.tables}
    lacking = [cause for cause in blind if not there & {c.name for c in showing(mixed, cause)}]
    notes = [f"{c.name} was not looked for: it needs {', or '.join(needs(mixed, c)) or 'a battery'}" for c in lacking]
    rest = [cause.name for cause in blind if cause not in lacking]
    verb = "is" if len(rest) == 1 else "are"
    return [*([f"{', '.join(rest)} {verb} not identifiable from these rides"] if rest else []), *notes]


def showing(mixed: MixedModel, cause: Candidate) -> list[Channel]:
    """The channels that depend on `cause`."""
    return [channel for channel in CHANNELS if set(cause.names) & depends(channel, mixed.system.effects)]


def needs(mixed: MixedModel, cause: Candidate) -> tuple[str, ...]:
    """What would show `cause`: of each channel its roles, the shortest first."""
    sets = {
        " and ".join((*channel.roles, *channel.fed_by))
        + (f" each {channel.apart:g} s or more often" if channel.apart < math.inf else "")
        for channel in showing(mixed, cause)
    }
    return tuple(sorted(sets, key=lambda text: (text.count(" and "), text)))


def causes_of(search: Search, chosen: Sequence[str], lines: Sequence[LinearRide]) -> list[FoundCause]:
    """The chosen causes with values and intervals."""
    mixed = search.mixed
    result = []
    for name, (own, variance) in search.fitted(chosen).items() if chosen else ():
        change = np.zeros(len(mixed.mean))
        change[search.place[name]] = own
        rows = intervals(search, name, own, np.sqrt(variance * mixed.inflation.get(name, 1.0)))
        first = search.causes[name].parameters[0]
        value, ci95 = rows[first.name].value, rows[first.name].ci95
        score = round(search.part(chosen, name), 2)
        more = value - mixed.healthy_value(first.name)
        share = energy_share(lines, change)
        result.append(FoundCause(name, first.name, value, first.unit, ci95, more, share, score, parameters=rows))
    return result


def intervals(search: Search, name: str, change: Array, sd: Array) -> dict[str, ParameterEstimate]:
    """The parameters of a cause that change by `change` (k,) [scales], known within `sd` beside the `DISCREPANCY`."""
    mixed = search.mixed
    shares = search.shares.get(name, {})
    form = DISCREPANCY * (1 + sum(more * shares.get(channel, 0.0) for channel, more in LUMPED.items()))
    rows = {}
    for parameter, i, x, s in zip(search.causes[name].parameters, search.place[name], change, sd, strict=True):
        healthy, step = mixed.healthy_value(parameter.name), float(mixed.scale[i])
        wide = mixed.quantile * float(np.hypot(s, form * x))
        at = (float(x), float(x) - wide, float(x) + wide)
        ends = [stepped(parameter.name, healthy, step * y) for y in at]
        value, low, high = (float(np.clip(y, parameter.low, parameter.high)) for y in ends)  # nothing that cannot be
        rows[parameter.name] = ParameterEstimate(value, (low, high), parameter.unit)
    return rows


def wind_cause(every: Search, chosen: Sequence[str], winds: Winds, lines: Sequence[LinearRide]) -> FoundCause:
    """The winds as a cause, of the vector that they have in common."""
    (wind,) = causes_of(every, [*chosen, winds.cause.name], lines)[-1:]
    return replace(wind, evidence=round(winds.score, 2), varies=True)


def alternatives(search: Search, chosen: Sequence[str], limit: float) -> list[list[str]]:
    """Of each cause chosen that others could stand in for: itself and these, if their parameters can be what they would
    have to be.
    """
    sets = []
    for group in search.alternatives(chosen, MARGIN, LEAST * limit):
        rest = [name for name in chosen if name != group[0]]
        fits = [(name, *search.fitted([*rest, name])[name]) for name in group]
        sets.append([n for n, x, v in fits if within_bounds(search.mixed, search.causes[n], x, np.sqrt(v))])
    return [group for group in sets if len(group) > 1]


def separability(search: Search) -> Isolability:
    """What could be told apart at all, of all candidates that the rides show."""
    signatures = {
        name: sorted(c for c, share in search.shares.get(name, {}).items() if share > 0) for name in search.place
    }
    groups: dict[tuple[str, ...], list[str]] = {}
    for name, channels in signatures.items():
        groups.setdefault(tuple(channels), []).append(name)
    information = search.evidence.information
    pairs = []
    keys = list(search.place)
    for a_at, a in enumerate(keys):
        for b in keys[a_at + 1 :]:
            i, j = search.place[a][0], search.place[b][0]
            scale = np.sqrt(abs(information[i, i] * information[j, j]))
            if scale > 0 and abs(cosine := information[i, j] / scale) > LOOK_ALIKE:
                pairs.append((a, b, round(float(cosine), 3)))
    alike = [group for group in groups.values() if len(group) > 1]
    return Isolability(signatures, alike, sorted(pairs, key=lambda p: -abs(p[2])))


def advice(search: Search, sets: Sequence[Sequence[str]], unknown: Unknown | None) -> list[str]:
    """What to ride next."""
    lines = []
    for group in sets:
        lines.append(
            f"To tell {', '.join(group)} apart: " + " ".join(search.causes[name].shown_by for name in group[:2])
        )
    if unknown is not None:
        lines.append(
            f"Ride one and the same way several times: what {unknown.channel} leaves differs from ride to ride."
            if unknown.quantity == RIDE_TO_RIDE
            else f"Stand with the vehicle switched on, and ride at several steady speeds, for minutes each: a constant "
            f"{unknown.channel} is one at all of them. A current sensor whose zero is off would show one too."
            if unknown.quantity == CONSTANT
            else f"Ride over the whole span of {unknown.quantity} with all else the same, twice: what "
            f"{unknown.channel} leaves goes with it, or with what changes along with it."
        )
    return lines
