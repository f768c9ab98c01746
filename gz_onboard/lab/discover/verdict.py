"""From evidence to a verdict: which causes, how sure, what could stand in, what has no name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import t as student

from gz_onboard.arrays import Array
from gz_onboard.lab.discover.acceptance import accept, within_bounds
from gz_onboard.lab.discover.candidates import Candidate
from gz_onboard.lab.discover.constancy import splits
from gz_onboard.lab.discover.curves import curve_forms
from gz_onboard.lab.discover.energy import energy_share, residual_sizes
from gz_onboard.lab.discover.linear import LinearRide, normal
from gz_onboard.lab.discover.mixed_model import MixedModel
from gz_onboard.lab.discover.prior import LOG
from gz_onboard.lab.discover.result import Cause, Report
from gz_onboard.lab.discover.search import Evidence, Search, evidence
from gz_onboard.lab.discover.selection import Linearised, SearchProblem, linearised_about, select_causes
from gz_onboard.lab.discover.unexplained import RIDES, unexplained
from gz_onboard.lab.discover.winds import NAME as WIND
from gz_onboard.lab.discover.winds import about_winds, own_winds

FALSE_ALARMS = 0.05  # of sets of healthy rides, all candidates and curves together
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


def tries(e: Evidence, index: Sequence[int]) -> float:
    """How many independent tries the columns at `index` are, look-alikes being one (Li & Ji 2005, eq. 5)."""
    inner = e.information[np.ix_(index, index)]
    size = np.sqrt(np.maximum(np.diag(inner), 1e-12))
    values = np.abs(np.linalg.eigvalsh(inner / np.outer(size, size)))
    return float(np.sum((values >= 1) + (values - np.floor(values))))


def threshold(mixed: MixedModel, tried: float) -> float:
    """The chi-squared of one cause that healthy rides exceed with `FALSE_ALARMS`, among `tried`.

    Student's t, for the scatter between rides is known from the healthy rides alone; Šidák over the candidates.
    """
    one = 1 - (1 - FALSE_ALARMS) ** (1 / tried)
    return float(student.ppf(1 - one / 2, mixed.freedom) ** 2)


def reach(
    mixed: MixedModel, notes: list[str], say: Callable[[str], None], linearised: Linearised, start: Array
) -> Report:
    """The verdict. linearised: each ride at its model. start (p,): where to linearise first, in scales."""
    lines = linearised_about(mixed, start, linearised)
    normals = [normal(line, mixed.noise) for line in lines]
    e = evidence(mixed, normals)
    causes = seen(mixed, e, notes)
    channels = {name for line in lines for name in line.tables}
    proportions = sum(form.straight and form.channel in channels for form in curve_forms())
    limit = threshold(mixed, tries(e, [i for c in causes for i in mixed.index(c.names)]) + proportions)
    shares = channel_shares(mixed, lines, causes)
    say(f"{len(causes)} candidates")
    known = SearchProblem(mixed, causes, shares, limit, linearised)
    still = np.zeros_like(start)
    now, known, told = accept(known, select_causes(known, lines, start, still), lines, start, still)
    winds = own_winds(now) if WIND in now.search.place and WIND not in now.chosen else None
    if winds is not None and winds.score > limit:
        now = about_winds(known, winds, start, [line.ride for line in lines])
        known = replace(known, mixed=now.mixed, causes=list(now.search.causes.values()))
        now, known, more = accept(known, now, now.lines, start, winds.blown)
        told += more
    notes += told
    mixed, lines, normals, search, chosen = now.mixed, now.lines, now.normals, now.search, now.chosen
    say("curves over quantities")
    change = now.change
    constancy = splits(mixed, lines, normals, search.place, chosen, change) if chosen else []
    unknown = unexplained(mixed, search, lines, normals, chosen, change, constancy, limit)
    if unknown is not None:
        chosen = tuple(name for name in chosen if name not in unknown["denies"])
    every = Search(mixed, search.evidence, causes, shares)
    found = causes_of(mixed, search, chosen, lines)
    sets = [
        able for s in search.alternatives(chosen, MARGIN, LEAST * limit) if len(able := likely(search, chosen, s)) > 1
    ]
    scores = {name: every.step([n for n in chosen if n != name], name) for name in every.causes}
    if winds is not None:
        scores[WIND] = max(scores.get(WIND, 0.0), winds.score)
        if winds.score > limit:
            (wind,) = causes_of(mixed, every, [*chosen, WIND], lines)[-1:]
            found = [*found, replace(wind, evidence=round(winds.score, 2), varies=True)]
            notes.append("the wind differed from ride to ride: " + winds.words)
    verdict = "none"
    if unknown is not None and not found:
        verdict = "unknown"
    elif sets:
        verdict = "ambiguous"
    elif found:
        verdict = "cause"
    ranking = sorted(((name, round(score, 2)) for name, score in scores.items()), key=lambda pair: -pair[1])
    return Report(
        verdict,
        found,
        sets,
        unknown,
        ranking,
        residual_sizes(lines),
        {},
        advice(search, sets, unknown),
        notes,
        isolability(every),
        limit,
        constancy=constancy,
        mixed=mixed,
        at=now.offset,
        lines=list(lines),
        normals=normals,
    )


def channel_shares(
    mixed: MixedModel, lines: Sequence[LinearRide], causes: Sequence[Candidate]
) -> dict[str, dict[str, float]]:
    """Of each cause, by channel, its share of what could be seen of it."""
    found = {}
    for cause in causes:
        index = mixed.index(cause.names)
        seen_in: dict[str, float] = {}
        for line in lines:
            for name, table in line.tables.items():
                noise = float(np.hypot(*mixed.noise[name][:2]))
                seen_in[name] = seen_in.get(name, 0.0) + float(np.sum((table.a[:, index] / noise) ** 2))
        whole = sum(seen_in.values()) or 1.0
        found[cause.name] = {name: value / whole for name, value in seen_in.items()}
    return found


def seen(mixed: MixedModel, e: Evidence, notes: list[str]) -> list[Candidate]:
    """The candidates that these rides can say anything of; the others go into `notes`."""
    found, blind = [], []
    for cause in mixed.causes:
        if not set(cause.names) <= set(mixed.names):
            blind.append(cause.name)
            continue
        index = mixed.index(cause.names)
        if np.any(np.diag(e.information)[index] < 1e-4):
            blind.append(cause.name)
        else:
            found.append(cause)
    if blind:
        notes.append("these rides say nothing of " + ", ".join(blind))
    return found


def causes_of(mixed: MixedModel, search: Search, chosen: Sequence[str], lines: Sequence[LinearRide]) -> list[Cause]:
    """The chosen causes with values and intervals."""
    if not chosen:
        return []
    index = search.index(chosen)
    estimate = search.evidence.estimate(index)
    covariance = search.evidence.covariance(index)
    quantile = float(student.ppf(0.975, max(mixed.healthy + 3, 4)))
    result, at = [], 0
    for name in chosen:
        cause = search.causes[name]
        rows = []
        evidence_ = search.step([n for n in chosen if n != name], name)
        inflation = mixed.inflation.get(name, 1.0)
        change = np.zeros(len(mixed.mean))
        for parameter in cause.parameters:
            i = index[at]
            healthy = own_value(mixed, parameter.name)
            x = float(estimate[at])
            shape = DISCREPANCY * (
                1 + sum(more * search.shares.get(name, {}).get(channel, 0.0) for channel, more in LUMPED.items())
            )
            sd = float(np.hypot(np.sqrt(covariance[at, at] * inflation), shape * x))
            change[i] = x
            step = float(mixed.scale[i])
            if parameter.name in LOG:
                ends = [healthy * np.exp(step * (x + s * quantile * sd)) for s in (0, -1, 1)]
            else:
                ends = [healthy + step * (x + s * quantile * sd) for s in (0, -1, 1)]
            ends = [float(np.clip(end, parameter.low, parameter.high)) for end in ends]  # nothing that cannot be
            rows.append((parameter.name, float(ends[0]), (float(ends[1]), float(ends[2])), float(ends[0] - healthy)))
            at += 1
        first = rows[0]
        result.append(
            Cause(
                name,
                first[0],
                first[1],
                cause.parameters[0].unit,
                first[2],
                first[3],
                energy_share(mixed, lines, change),
                round(evidence_, 2),
                tuple((n, v, ci) for n, v, ci, _ in rows[1:]),
            )
        )
    return result


def likely(search: Search, chosen: Sequence[str], group: Sequence[str]) -> list[str]:
    """Those of `group`, stand-ins of its first, whose parameters could be what they would have to be."""
    rest = [name for name in chosen if name != group[0]]
    found = []
    for name in group:
        index = search.index([*rest, name])
        k = len(search.place[name])
        change = search.evidence.estimate(index)[-k:]
        sd = np.sqrt(np.diag(search.evidence.covariance(index)))[-k:]
        if within_bounds(search.mixed, search.causes[name], change.tolist(), sd.tolist()):
            found.append(name)
    return found


def own_value(mixed: MixedModel, name: str) -> float:
    """The healthy vehicle's value of a parameter: that of its file, 0 for an effect that its model lacks."""
    absent = {
        n
        for c in mixed.causes
        if c.effect and c.effect.name not in {x.name for x in mixed.vehicle.model.effects}
        for n in c.names
    }
    return 0.0 if name in absent else float(mixed.vehicle.parameters[name])


def isolability(search: Search) -> dict[str, Any]:
    """What could be told apart at all. signatures: of each candidate the channels that depend on it (Krysander & Frisk
    2008). same_signature: those that only the form of what they do separates, no matter how much is measured.
    look_alikes: pairs that these rides can hardly separate, by the cosine of what they do once nuisances are out.
    """
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
            if scale > 0 and abs(cosine := information[i, j] / scale) > 0.8:
                pairs.append([a, b, round(float(cosine), 3)])
    return {
        "signatures": signatures,
        "same_signature": [group for group in groups.values() if len(group) > 1],
        "look_alikes": sorted(pairs, key=lambda p: -abs(p[2])),
    }


def advice(search: Search, sets: Sequence[Sequence[str]], unknown: dict[str, Any] | None) -> list[str]:
    """What to ride next."""
    lines = []
    for group in sets:
        lines.append(
            f"To tell {', '.join(group)} apart: " + " ".join(search.causes[name].shown_by for name in group[:2])
        )
    if unknown is not None:
        lines.append(
            f"Ride one and the same way several times: what {unknown['channel']} leaves differs from ride to ride."
            if unknown["quantity"] == RIDES
            else f"Ride over the whole span of {unknown['quantity']} with all else the same, twice: what "
            f"{unknown['channel']} leaves goes with it, or with what changes along with it."
        )
    return lines


__all__ = ["own_value", "reach", "threshold"]
