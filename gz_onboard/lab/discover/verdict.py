"""From evidence to a verdict: which causes, how sure, what could stand in, what has no name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import t as student

from gz_onboard.lab.discover.candidates import Candidate
from gz_onboard.lab.discover.channels import over_blocks
from gz_onboard.lab.discover.constancy import RIDE, Split, splits
from gz_onboard.lab.discover.grid import Array
from gz_onboard.lab.discover.linear import Linear, normal
from gz_onboard.lab.discover.result import Cause, Report
from gz_onboard.lab.discover.search import Evidence, Search, evidence, one_degree
from gz_onboard.lab.discover.shapes import QUANTITIES, Curve, columns, names, shape_evidence
from gz_onboard.lab.discover.state import State
from gz_onboard.lab.discover.terms import LOG, stepped

FALSE_ALARMS = 0.05  # of sets of healthy rides, all candidates and curves together
AGAIN = 5  # times at most that all is linearised about what was found: large changes are not linear
LEFT = 0.1  # of what causes explain: a curve beside them that takes less is the bend of a large effect
CURVE = 1.5  # a curve's evidence over that of a cause: there are many, and their knots are chosen by eye
UNLIKE = 0.5  # of a cause's effect in a channel: a curve beside it that takes more is not the cause's bend
RIVAL = 0.25  # of the evidence for the causes of its channel: a curve beside them that has more is no bend
UNLIKE_LEFT = 0.004  # of what causes explain: less is not worth the doubt
CLEAR = 4.0  # standard deviations of a curve's coefficient that counts
DISCREPANCY = 0.05  # of a change, sd: the form of an effect is not exactly the real one's
LUMPED = {"cell_voltage": 1, "voltage_timing": 1, "motor_temperature": 3, "inverter_temperature": 3,
          "cell_temperature": 3}  # fmt: skip
"""Channels whose model is a circuit or a network of lumps: by how much more than that they err, in shares of it."""
BETTER = 15.0  # of chi-squared, each further knot taken off with 2, by which a curve in a cause's place beats it
LEAST = 0.4  # of the threshold, by which a stand-in must explain something itself
MARGIN = 6.0  # of chi-squared within which another cause explains as well: a likelihood ratio of 20


def tries(e: Evidence, index: Sequence[int]) -> float:
    """How many independent tries the columns at `index` are, look-alikes being one (Li & Ji 2005, eq. 5)."""
    inner = e.information[np.ix_(index, index)]
    size = np.sqrt(np.maximum(np.diag(inner), 1e-12))
    values = np.abs(np.linalg.eigvalsh(inner / np.outer(size, size)))
    return float(np.sum((values >= 1) + (values - np.floor(values))))


def threshold(state: State, tried: float) -> float:
    """The chi-squared of one cause that healthy rides exceed with `FALSE_ALARMS`, among `tried`.

    Student's t, for the scatter between rides is known from the healthy rides alone; Šidák over the candidates.
    """
    one = 1 - (1 - FALSE_ALARMS) ** (1 / tried)
    freedom = max(2 * (state.healthy + 3), 8)
    return float(student.ppf(1 - one / 2, freedom) ** 2)


def reach(
    state: State, notes: list[str], say: Callable[[str], None], linearised: Callable[[State], list[Linear]],
    start: Array,
) -> Report:  # fmt: skip
    """The verdict. linearised: the rides at a state. start (p,): where to linearise first, in scales."""

    lines = about(state, start, linearised)
    normals = [normal(line, state.noise) for line in lines]
    e = evidence(state, normals)
    causes = seen(state, e, notes)
    limit = threshold(state, tries(e, [i for c in causes for i in state.index(c.names)]))
    shares = channel_shares(state, lines, causes)
    search = Search(state, e, causes, shares)
    say(f"{len(causes)} candidates")
    choice = search.select(limit)
    offset = start
    chosen = choice.names
    for _ in range(AGAIN):
        if not chosen:
            break
        before = offset
        index = search.index(chosen)
        target = np.zeros(len(offset))
        target[index] = search.evidence.estimate(index)
        offset = target
        for name in chosen:
            for i in search.place[name]:
                offset[i] = kept(state, i, offset[i])
        lines = about(state, offset, linearised)
        normals = [normal(line, state.noise) for line in lines]
        e = evidence(state, normals)
        search = Search(state, e, causes, shares)
        chosen = search.select(limit).names
        if np.all(np.abs(offset - before) < 0.03 * np.abs(offset) + 1e-9):
            break
    say("curves over quantities")
    change = np.zeros(len(state.mean))
    change[search.index(chosen)] = search.evidence.estimate(search.index(chosen))
    constancy = splits(state, lines, normals, search.place, chosen, change) if chosen else []
    unknown = unexplained(state, search, lines, normals, chosen, change, constancy, limit)
    if unknown is not None:
        chosen = tuple(name for name in chosen if name not in unknown["denies"])
    found = causes_of(state, search, chosen, lines)
    sets = [list(s) for s in search.stand_ins(chosen, MARGIN, LEAST * limit)]
    scores = {c.name: search.step([n for n in chosen if n != c.name], c.name) for c in causes}
    if "headwind" in search.place and "headwind" not in chosen:
        score, words = own_winds(state, lines, normals, search.place["headwind"], change)
        scores["headwind"] = max(scores["headwind"], score)
        if score > limit:
            (wind,) = causes_of(state, search, [*chosen, "headwind"], lines)[-1:]
            found = [*found, replace(wind, evidence=round(score, 2))]
            notes.append("the wind differed from ride to ride: " + words)
    verdict = "none"
    if unknown is not None and not found:
        verdict = "unknown"
    elif sets:
        verdict = "ambiguous"
    elif found:
        verdict = "cause"
    ranking = sorted(((name, round(score, 2)) for name, score in scores.items()), key=lambda pair: -pair[1])
    return Report(
        verdict, found, sets, unknown, ranking, sizes(lines), {}, advice(search, sets, unknown), notes,
        isolability(search), limit, constancy=constancy, state=state, at=offset, lines=list(lines),
        normals=normals,
    )  # fmt: skip


def about(state: State, offset: Array, linearised: Callable[[State], list[Linear]]) -> list[Linear]:
    """The rides linearised at `offset` (p,) in scales, their residuals as seen from the values of `state`."""
    moved = replace(state, values=state.unit_value(offset)) if np.any(offset) else state
    return [line.seen_from(offset) for line in linearised(moved)]


def own_winds(
    state: State, lines: Sequence[Linear], normals: Sequence[Any], index: Sequence[int], change: Array
) -> tuple[float, str]:
    """(evidence that the winds of these rides are more than healthy ones show, whatever their directions; in words).

    change (p,): what causes explain. A wind blows as it likes on another day, so that a common vector misses it.
    """
    w = list(index)
    rest = [i for i in range(len(state.mean)) if i not in w]
    spread = state.prior + np.diag(state.scatter)
    inside = np.zeros_like(spread)
    inside[np.ix_(rest, rest)] = np.linalg.inv(spread[np.ix_(rest, rest)])
    mean = state.mean + change
    total, words = 0.0, []
    for line, ride in zip(lines, normals, strict=True):
        if np.any(np.diag(ride.n)[w] < 1e-6):
            continue
        covariance = np.linalg.inv(inside + ride.n)
        wind = (covariance @ (ride.b + inside @ mean))[w] - mean[w]
        total += float(wind @ np.linalg.solve(spread[np.ix_(w, w)] + covariance[np.ix_(w, w)], wind))
        north, east = (wind * state.scale[w]).tolist()
        words.append(
            f"{line.ride.name} {np.hypot(north, east):.1f} m/s from {np.degrees(np.arctan2(east, north)) % 360:.0f}°"
        )
    return one_degree(total, 2 * len(words)) if words else 0.0, ", ".join(words)


def channel_shares(state: State, lines: Sequence[Linear], causes: Sequence[Candidate]) -> dict[str, dict[str, float]]:
    """Of each cause, by channel, its share of what could be seen of it."""
    found = {}
    for cause in causes:
        index = state.index(cause.names)
        seen_in: dict[str, float] = {}
        for line in lines:
            for name, table in line.tables.items():
                noise = float(np.hypot(*state.noise[name][:2]))
                seen_in[name] = seen_in.get(name, 0.0) + float(np.sum((table.a[:, index] / noise) ** 2))
        whole = sum(seen_in.values()) or 1.0
        found[cause.name] = {name: value / whole for name, value in seen_in.items()}
    return found


def kept(state: State, i: int, x: float) -> float:
    """A change `x` of the parameter at `i`, in scales, that stays within the bounds of what it is, and does not take
    more than two thirds of it at once.
    """
    name, value = state.names[i], state.values[state.names[i]]
    bounds = next((p for c in state.causes for p in c.parameters if p.name == name), None)
    if name in LOG or bounds is None:
        return x
    low = max(bounds.low, value / 3) if bounds.low > 0 else bounds.low
    moved = float(np.clip(value + x * float(state.scale[i]), low, bounds.high))
    return (moved - value) / float(state.scale[i])


def seen(state: State, e: Evidence, notes: list[str]) -> list[Candidate]:
    """The candidates that these rides can say anything of; the others go into `notes`."""
    found, blind = [], []
    for cause in state.causes:
        if not set(cause.names) <= set(state.names):
            blind.append(cause.name)
            continue
        index = state.index(cause.names)
        if np.any(np.diag(e.information)[index] < 1e-4):
            blind.append(cause.name)
        else:
            found.append(cause)
    if blind:
        notes.append("these rides say nothing of " + ", ".join(blind))
    return found


def causes_of(state: State, search: Search, chosen: Sequence[str], lines: Sequence[Linear]) -> list[Cause]:
    """The chosen causes with values and intervals."""
    if not chosen:
        return []
    index = search.index(chosen)
    estimate = search.evidence.estimate(index)
    covariance = search.evidence.covariance(index)
    quantile = float(student.ppf(0.975, max(state.healthy + 3, 4)))
    result, at = [], 0
    for name in chosen:
        cause = search.causes[name]
        rows = []
        evidence_ = search.step([n for n in chosen if n != name], name)
        inflation = state.inflation.get(name, 1.0)
        change = np.zeros(len(state.mean))
        for parameter in cause.parameters:
            i = index[at]
            healthy = own_value(state, parameter.name)
            x = float(estimate[at])
            own = DISCREPANCY * (
                1 + sum(more * search.shares.get(name, {}).get(channel, 0.0) for channel, more in LUMPED.items())
            )
            sd = float(np.hypot(np.sqrt(covariance[at, at] * inflation), own * x))
            change[i] = x
            step = float(state.scale[i])
            if parameter.name in LOG:
                ends = [healthy * np.exp(step * (x + s * quantile * sd)) for s in (0, -1, 1)]
            else:
                ends = [healthy + step * (x + s * quantile * sd) for s in (0, -1, 1)]
            rows.append((parameter.name, float(ends[0]), (float(ends[1]), float(ends[2])), float(ends[0] - healthy)))
            at += 1
        first = rows[0]
        result.append(Cause(
            name, first[0], first[1], cause.parameters[0].unit, first[2], first[3],
            energy_share(state, lines, change), round(evidence_, 2),
            tuple((n, v, ci) for n, v, ci, _ in rows[1:]),
        ))  # fmt: skip
    return result


def own_value(state: State, name: str) -> float:
    """The healthy vehicle's value of a parameter: that of its file, 0 for an effect that its model lacks."""
    absent = {n for c in state.causes if c.effect and c.effect.name not in
              {x.name for x in state.vehicle.model.effects} for n in c.names}  # fmt: skip
    return 0.0 if name in absent else float(state.vehicle.parameters[name])


def power_of(table_name: str, line: Linear, values: Array) -> Array | None:
    """What a residual of a channel is worth at the pack's terminals [W], over its blocks."""
    table = line.tables[table_name]
    real = values * table.unit
    if table_name == "road_force":
        return np.asarray(real * over_blocks(table.channel, line.ride.quantities["speed"])[table.used])
    if table_name in ("inverter_power", "auxiliary"):
        return np.asarray(real)
    if table_name == "pack_balance" and "pack_voltage" in line.ride.signals:
        return np.asarray(real * over_blocks(table.channel, line.ride.signals["pack_voltage"])[table.used])
    return None


def energy_share(state: State, lines: Sequence[Linear], change: Array) -> float:
    """The part of the energy drawn that `change` (p,) of the parameters makes, over these rides."""
    more = drawn = 0.0
    for line in lines:
        drawn += energy(line)
        for name in line.tables:
            power = power_of(name, line, -(line.tables[name].a @ change) * -1.0)
            if power is not None and len(power):
                more += float(np.mean(power)) * share_of_time(line, name)
    return more / drawn if drawn else 0.0


def energy(line: Linear) -> float:
    """What the pack gave over the ride [J]."""
    s = line.ride.signals
    volts, amperes = (
        ("pack_voltage", "pack_current") if "pack_current" in s else ("inverter_voltage", "inverter_current")
    )
    if amperes not in s or volts not in s:
        return float(np.sum(np.abs(s["motor_current"] * line.ride.quantities["motor_speed"]))) * 0.045
    return float(np.sum(s[volts] * s[amperes])) * 0.1


def share_of_time(line: Linear, channel: str) -> float:
    """The time [s] for which a channel's mean holds: the ride, or that part of it in which it moves."""
    whole = len(line.ride.time) * 0.1
    if channel == "road_force":
        return float(np.mean(np.abs(line.ride.quantities["speed"]) > 2.0)) * whole
    return whole


def unexplained(
    state: State, search: Search, lines: Sequence[Linear], normals: Sequence[Any], chosen: Sequence[str],
    change: Array, constancy: Sequence[Split], limit: float,
) -> dict[str, Any] | None:  # fmt: skip
    """The curve that explains most beside the causes chosen, and which of them it `denies`, as they are none; None if
    no curve is significant.

    change (p,): of the parameters by the causes. A curve denies causes if it takes back, or adds, half or more of what
    they do somewhere in a channel that names them, if it has a quarter of their evidence beside them, if it explains
    much more than one of them in its place, or if `constancy` finds one unequal. What else was found must then stand
    without what is denied.
    """
    index = search.index(chosen)
    total = search.evidence.gain(index)
    best: dict[str, Any] | None = None
    for pair in names():
        curve = shape_evidence(state, lines, normals, pair, index)
        if curve is None:
            continue
        inflation = state.shapes[pair].inflation if pair in state.shapes else 1.0
        score = one_degree(curve.chi2 / inflation, curve.k)
        if score < CURVE * limit:
            continue
        channel = pair.partition(" over ")[0]
        mine = [name for name in chosen if search.shares.get(name, {}).get(channel, 0.0) > 0.3]
        theirs = sum(search.step([other for other in chosen if other != name], name) for name in mine)
        unlike = unlike_causes(curve, inflation, *weight(state, lines, channel, change))
        unlike = unlike or bool(mine and curve.chi2 / inflation > RIVAL * theirs)
        if chosen and curve.chi2 < (UNLIKE_LEFT if unlike else LEFT) * total:
            continue
        if best is None or (unlike, score) > (bool(best["denies"]), best["score"]):
            best = described(pair, curve, score) | {"denies": mine if unlike else []}
    if best is None or not best["denies"]:
        best = instead(state, search, lines, normals, chosen) or best
    unequal = [s for s in constancy if s.unequal]
    if unequal and (best is None or not best["denies"]):
        worst = max(unequal, key=lambda s: s.chi2)
        best = halves(state, lines, normals, worst) or of_rides(state, lines, change, worst, constancy)
    if best is None:
        return None
    if best["denies"]:
        denied = dict.fromkeys([*best["denies"], *(s.cause for s in unequal)])
        left = [name for name in chosen if name not in denied]  # what was found beside it must stand without it
        least = max(limit, LEFT * best["chi2"])
        denied |= dict.fromkeys(n for n in left if search.step([m for m in left if m != n], n) < least)
        best["denies"] = list(denied)
    if "share" not in best:
        best["share"] = shape_share(lines, best)
    return best


def instead(
    state: State, search: Search, lines: Sequence[Linear], normals: Sequence[Any], chosen: Sequence[str]
) -> dict[str, Any] | None:
    """The curve that explains much better than one of the causes chosen what that one explains, in its own channel."""
    best: dict[str, Any] | None = None
    most = BETTER
    for name in chosen:
        rest = [other for other in chosen if other != name]
        own = search.step(rest, name)
        for pair in names():
            channel = pair.partition(" over ")[0]
            if search.shares.get(name, {}).get(channel, 0.0) < 0.3:
                continue
            curve = shape_evidence(state, lines, normals, pair, search.index(rest))
            if curve is None:
                continue
            inflation = state.shapes[pair].inflation if pair in state.shapes else 1.0
            ahead = curve.chi2 / inflation - 2 * (curve.k - 1) - own * max(state.inflation.get(name, 1.0), 1.0)
            if ahead > max(most, UNLIKE_LEFT * own):
                most = ahead
                best = described(pair, curve, one_degree(curve.chi2 / inflation, curve.k)) | {"denies": [name]}
    return best


def of_rides(
    state: State, lines: Sequence[Linear], change: Array, worst: Split, constancy: Sequence[Split]
) -> dict[str, Any]:
    """What no cause is that acts in some rides and not in others: by how much more or less in each."""
    channels = {name for line in lines for name in line.tables}
    channel = max(channels, key=lambda name: weight(state, lines, name, change)[1])
    mine = [s for s in constancy if s.cause == worst.cause and s.quantity.startswith(RIDE)]
    rows = [[float(i), s.ratio, abs(s.ratio) / max(s.chi2, 1e-9) ** 0.5] for i, s in enumerate(mine)]
    return {"channel": channel, "quantity": "ride", "unit": "", "score": worst.chi2, "chi2": worst.chi2, "curve": rows,
            "denies": [worst.cause], "share": energy_share(state, lines, change)}  # fmt: skip


def described(pair: str, curve: Curve, score: float) -> dict[str, Any]:
    """The curve for the report."""
    channel, _, quantity = pair.partition(" over ")
    knots, unit = QUANTITIES[quantity]
    rows = zip(knots, curve.values.tolist(), curve.sd.tolist(), strict=True)
    return {"channel": channel, "quantity": quantity, "unit": unit, "score": score, "chi2": curve.chi2,
            "curve": [list(row) for row in rows]}  # fmt: skip


def unlike_causes(curve: Curve, inflation: float, size: float, share: float) -> bool:
    """Whether what is left beside the causes, of `size` in this channel and `share` of the evidence for them, is no
    mere bend of what they do.
    """
    value, sd = curve.contrasts()
    certain = (np.abs(value) > CLEAR * sd * inflation**0.5) & (curve.weights > 0.02)
    return bool(share > 0.3 and size > 0 and np.any(np.abs(value)[certain] > UNLIKE * size))


def weight(state: State, lines: Sequence[Linear], channel: str, change: Array) -> tuple[float, float]:
    """(what `change` (p,) of the parameters makes in `channel`, rms where it acts [unit]; the channel's share of the
    evidence for it).
    """
    parts, here, everywhere = [np.zeros(1)], 0.0, 0.0
    for line in lines:
        for name, table in line.tables.items():
            effect = table.a @ change
            strength = float(np.sum((effect / np.hypot(*state.noise[name][:2])) ** 2))
            everywhere += strength
            if name == channel:
                here += strength
                parts.append(np.abs(effect * table.unit))
    effect = np.concatenate(parts)
    acting = effect[effect > 0.1 * effect.max()]
    if effect.max() < 1e-9 or not len(acting):
        return 0.0, 0.0
    return float(np.sqrt(np.mean(acting**2))), here / everywhere


def halves(state: State, lines: Sequence[Linear], normals: Sequence[Any], split: Split) -> dict[str, Any] | None:
    """The curve over the quantity of `split`, with no cause named, in the channel where it has most to say."""
    best: dict[str, Any] | None = None
    for pair in names():
        if not pair.endswith(f" over {split.quantity}"):
            continue
        curve = shape_evidence(state, lines, normals, pair, [])
        if curve is None:
            continue
        score = one_degree(curve.chi2 / (state.shapes[pair].inflation if pair in state.shapes else 1.0), curve.k)
        if best is None or score > best["score"]:
            best = described(pair, curve, score) | {"denies": [split.cause]}
    return best


def shape_share(lines: Sequence[Linear], shape: dict[str, Any]) -> float:
    """The part of the energy drawn that the curve takes."""

    more = drawn = 0.0
    values = np.array([row[1] for row in shape["curve"]])
    for line in lines:
        drawn += energy(line)
        table = line.tables.get(shape["channel"])
        if table is None:
            continue
        c = columns(line.ride, shape["quantity"], table)
        if c is None:
            continue
        power = power_of(shape["channel"], line, c @ values / table.unit)
        if power is not None and len(power):
            more += float(np.mean(power)) * share_of_time(line, shape["channel"])
    return more / drawn if drawn else 0.0


def sizes(lines: Sequence[Linear]) -> dict[str, dict[str, float]]:
    """Of each channel's residual: mean, rms, correlation of neighbours, share of the energy."""
    result: dict[str, dict[str, float]] = {}
    drawn = sum(energy(line) for line in lines)
    for name in sorted({name for line in lines for name in line.tables}):
        tables = [(line, line.tables[name]) for line in lines if name in line.tables]
        y = np.concatenate([table.y for _, table in tables])
        pairs = [(table.y[1:], table.y[:-1]) for _, table in tables]
        late, early = (np.concatenate(side) for side in zip(*pairs, strict=True))
        correlation = float(np.corrcoef(late, early)[0, 1]) if np.std(late) > 0 and np.std(early) > 0 else 0.0
        powers = [power_of(name, line, table.y) for line, table in tables]
        more = sum(float(np.mean(w)) * share_of_time(line, name)
                   for w, (line, _) in zip(powers, tables, strict=True) if w is not None and len(w))  # fmt: skip
        share = more / drawn if drawn else 0.0
        result[name] = {
            "mean": float(y.mean()), "rms": float(np.sqrt(np.mean(y**2))), "autocorrelation": correlation,
            "blocks": len(y), "energy_share": share, "range_share": -share / (1 + share) if share > -1 else 0.0,
        }  # fmt: skip
    return result


def isolability(search: Search) -> dict[str, Any]:
    """What could be told apart at all. signatures: of each candidate the channels that depend on it (Krysander & Frisk
    2008). same_signature: those that only the form of what they do separates, no matter how much is measured.
    look_alikes: pairs that these rides can hardly separate, by the cosine of what they do once nuisances are out.
    """
    signatures = {name: sorted(c for c, share in search.shares.get(name, {}).items() if share > 0)
                  for name in search.place}  # fmt: skip
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
    return {"signatures": signatures, "same_signature": [group for group in groups.values() if len(group) > 1],
            "look_alikes": sorted(pairs, key=lambda p: -abs(p[2]))}  # fmt: skip


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
            if unknown["quantity"] == "ride"
            else f"Ride over the whole span of {unknown['quantity']} with all else the same, twice: what "
            f"{unknown['channel']} leaves goes with it, or with what changes along with it."
        )
    return lines


__all__ = ["reach", "stepped", "threshold"]
