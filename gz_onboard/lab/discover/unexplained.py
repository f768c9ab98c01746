"""What has no name: curves beside the causes found, and what shows that these are none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.discover.acceptance import with_observed_scatter
from gz_onboard.lab.discover.constancy import RIDE, Split
from gz_onboard.lab.discover.cross_validation import Fold, folds, improves
from gz_onboard.lab.discover.curves import QUANTITIES, CurveFit, CurveForm, curve_forms, fit_curve
from gz_onboard.lab.discover.energy import curve_energy_share, energy_share
from gz_onboard.lab.discover.linear import LinearRide
from gz_onboard.lab.discover.mixed_model import MixedModel
from gz_onboard.lab.discover.search import Search, one_degree

RIDES = "ride"  # the quantity of what differs from ride to ride
LEFT = 0.1  # of what causes explain: a curve beside them that takes less is the bend of a large effect
CURVE = 1.5  # a curve's evidence over that of a cause: their knots are chosen by eye; lines count as tries instead
UNLIKE = 0.5  # of a cause's effect in a channel: a curve beside it that takes more is not the cause's bend
RIVAL = 0.25  # of the evidence for the causes of its channel: a curve beside them that has more is no bend
UNLIKE_LEFT = 0.004  # of what causes explain: less is not worth the doubt
CLEAR = 4.0  # standard deviations of a curve's coefficient that counts
BETTER = 15.0  # of chi-squared, each further knot taken off with 2, by which a curve in a cause's place beats it


def unexplained(
    mixed: MixedModel,
    search: Search,
    lines: Sequence[LinearRide],
    normals: Sequence[Any],
    chosen: Sequence[str],
    change: Array,
    constancy: Sequence[Split],
    limit: float,
) -> dict[str, Any] | None:
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
    for form in curve_forms():
        curve = fit_curve(mixed, lines, normals, form, index)
        if curve is None:
            continue
        inflation = curve_inflation(mixed, form)
        score = one_degree(curve.chi2 / inflation, curve.k, mixed.freedom)
        if score < limit * (1.0 if form.straight else CURVE):
            continue
        mine = [name for name in chosen if search.shares.get(name, {}).get(form.channel, 0.0) > 0.3]
        theirs = sum(search.step([other for other in chosen if other != name], name) for name in mine)
        unlike = contradicts_causes(curve, inflation, *weight(mixed, lines, form.channel, change))
        unlike = unlike or bool(mine and curve.chi2 / inflation > RIVAL * theirs)
        if chosen and curve.chi2 < (UNLIKE_LEFT if unlike else LEFT) * total:
            continue
        if best is not None and (unlike, score) <= (bool(best["denies"]), best["score"]):
            continue
        rest = [name for name in chosen if not (unlike and name in mine)]
        if curve_is_accepted(mixed, search, lines, normals, form, rest, limit):
            best = described(form, curve, score) | {"denies": mine if unlike else []}
    if best is None or not best["denies"]:
        best = rival_curve(mixed, search, lines, normals, chosen, limit) or best
    unequal = [s for s in constancy if s.unequal]
    if unequal and (best is None or not best["denies"]):
        worst = max(unequal, key=lambda s: s.chi2)
        best = curve_over_split(mixed, lines, normals, worst) or ride_to_ride(mixed, lines, change, worst, constancy)
    if best is None:
        return None
    if best["denies"]:
        denied = dict.fromkeys([*best["denies"], *(s.cause for s in unequal)])
        left = [name for name in chosen if name not in denied]  # what was found beside it must stand without it
        least = max(limit, LEFT * best["chi2"])
        denied |= dict.fromkeys(n for n in left if search.step([m for m in left if m != n], n) < least)
        best["denies"] = list(denied)
    if "share" not in best:
        best["share"] = curve_energy_share(lines, best)
    return best


def curve_is_accepted(
    mixed: MixedModel,
    search: Search,
    lines: Sequence[LinearRide],
    normals: Sequence[Any],
    form: CurveForm,
    rest: Sequence[str],
    limit: float,
) -> bool:
    """Whether the curve `form` beside the causes `rest` is more than what differs between these rides, and mends its
    channel on rides held out of the fit.
    """
    curve = fit_curve(with_observed_scatter(mixed, normals), lines, normals, form, search.index(rest), own=True)
    if curve is None:
        return False
    score = one_degree(curve.chi2 / curve_inflation(mixed, form), curve.k, mixed.freedom)
    if score < limit * (1.0 if form.straight else CURVE):
        return False
    causes = [search.causes[name] for name in rest]
    return len(lines) < 2 or improves(
        folds(mixed, lines, normals, Fold(causes, form), Fold(causes)), {form.channel: 1.0}
    )


def rival_curve(
    mixed: MixedModel,
    search: Search,
    lines: Sequence[LinearRide],
    normals: Sequence[Any],
    chosen: Sequence[str],
    limit: float,
) -> dict[str, Any] | None:
    """The curve that explains much better than one of the causes chosen what that one explains, in its own channel."""
    best: dict[str, Any] | None = None
    most = BETTER
    for name in chosen:
        rest = [other for other in chosen if other != name]
        own = search.step(rest, name)
        for form in curve_forms():
            if search.shares.get(name, {}).get(form.channel, 0.0) < 0.3:
                continue
            curve = fit_curve(mixed, lines, normals, form, search.index(rest))
            if curve is None:
                continue
            inflation = curve_inflation(mixed, form)
            ahead = curve.chi2 / inflation - 2 * (curve.k - 1) - own * max(mixed.inflation.get(name, 1.0), 1.0)
            if ahead > max(most, UNLIKE_LEFT * own) and curve_is_accepted(
                mixed, search, lines, normals, form, rest, limit
            ):
                most = ahead
                best = described(form, curve, one_degree(curve.chi2 / inflation, curve.k, mixed.freedom)) | {
                    "denies": [name]
                }
    return best


def ride_to_ride(
    mixed: MixedModel, lines: Sequence[LinearRide], change: Array, worst: Split, constancy: Sequence[Split]
) -> dict[str, Any]:
    """What no cause is that acts in some rides and not in others: by how much more or less in each."""
    channels = {name for line in lines for name in line.tables}
    channel = max(channels, key=lambda name: weight(mixed, lines, name, change)[1])
    mine = [s for s in constancy if s.cause == worst.cause and s.quantity.startswith(RIDE)]
    rows = [[float(i), s.ratio, abs(s.ratio) / max(s.chi2, 1e-9) ** 0.5] for i, s in enumerate(mine)]
    share = energy_share(mixed, lines, change)
    return {
        "channel": channel,
        "quantity": RIDES,
        "straight": False,
        "unit": "",
        "score": worst.chi2,
        "chi2": worst.chi2,
        "curve": rows,
        "denies": [worst.cause],
        "share": share,
    }


def curve_inflation(mixed: MixedModel, form: CurveForm) -> float:
    """By how much the chi-squared of `form` is too high on healthy rides that were left out."""
    shape = mixed.shapes.get(form.name)
    return shape.inflation if shape else 1.0


def described(form: CurveForm, curve: CurveFit, score: float) -> dict[str, Any]:
    """The curve for the report."""
    knots, unit = QUANTITIES[form.quantity]
    rows = zip(knots, curve.values.tolist(), curve.sd.tolist(), strict=True)
    return {
        "channel": form.channel,
        "quantity": form.quantity,
        "straight": form.straight,
        "unit": unit,
        "score": score,
        "chi2": curve.chi2,
        "curve": [list(row) for row in rows],
    }


def contradicts_causes(curve: CurveFit, inflation: float, size: float, share: float) -> bool:
    """Whether what is left beside the causes, of `size` in this channel and `share` of the evidence for them, is no
    mere bend of what they do.
    """
    value, sd = curve.contrasts()
    certain = (np.abs(value) > CLEAR * sd * inflation**0.5) & (curve.weights > 0.02)
    return bool(share > 0.3 and size > 0 and np.any(np.abs(value)[certain] > UNLIKE * size))


def weight(mixed: MixedModel, lines: Sequence[LinearRide], channel: str, change: Array) -> tuple[float, float]:
    """(what `change` (p,) of the parameters makes in `channel`, rms where it acts [unit]; the channel's share of the
    evidence for it).
    """
    parts, here, everywhere = [np.zeros(1)], 0.0, 0.0
    for line in lines:
        for name, table in line.tables.items():
            effect = table.a @ change
            strength = float(np.sum((effect / np.hypot(*mixed.noise[name][:2])) ** 2))
            everywhere += strength
            if name == channel:
                here += strength
                parts.append(np.abs(effect * table.unit))
    effect = np.concatenate(parts)
    acting = effect[effect > 0.1 * effect.max()]
    if effect.max() < 1e-9 or not len(acting):
        return 0.0, 0.0
    return float(np.sqrt(np.mean(acting**2))), here / everywhere


def curve_over_split(
    mixed: MixedModel, lines: Sequence[LinearRide], normals: Sequence[Any], split: Split
) -> dict[str, Any] | None:
    """The curve over the quantity of `split`, with no cause named, in the channel where it has most to say."""
    best: dict[str, Any] | None = None
    for form in curve_forms():
        if form.quantity != split.quantity or form.straight:
            continue
        curve = fit_curve(mixed, lines, normals, form, [])
        if curve is None:
            continue
        score = one_degree(curve.chi2 / curve_inflation(mixed, form), curve.k, mixed.freedom)
        if best is None or score > best["score"]:
            best = described(form, curve, score) | {"denies": [split.cause]}
    return best
