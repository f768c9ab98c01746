"""What has no name: curves beside the causes found, and what shows that these are none."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from gz_onboard.discovery.acceptance import with_observed_scatter
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.constancy import RIDE_PREFIX, unequal
from gz_onboard.discovery.cross_validation import Fold, held_out, improves, squares
from gz_onboard.discovery.curve_forms import CurveForm, curve_forms
from gz_onboard.discovery.curves import CurveFit, fit_curve
from gz_onboard.discovery.energy import curve_energy_share, energy_share
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.result import CONSTANT, RIDE_TO_RIDE, Split, Unknown
from gz_onboard.discovery.search import one_degree
from gz_onboard.discovery.selection import Selection
from gz_onboard.discovery.wording import readable
from gz_onboard.lab.sizes import Sizes

LEFT = 0.1  # of what causes explain: a curve beside them that takes less is the bend of a large effect
CURVE = 1.5  # a curve's evidence over that of a cause: their knots are chosen by eye; lines count as tries instead
UNLIKE = 0.5  # of a cause's effect in a channel: a curve beside it that takes more is not the cause's bend
RIVAL = 0.25  # of the evidence for the causes of its channel: a curve beside them that has more is no bend
UNLIKE_LEFT = 0.004  # of what causes explain: less is not worth the doubt
CLEAR = 4.0  # standard deviations of a curve's coefficient that counts
OWN_SHARE = 0.3  # of the evidence for a cause: a channel that has more names it
WEIGHTY = 0.02  # of the rides: a knot with less denies nothing
ACTING = 0.1  # of the most that causes do: where they do less they do not act
BETTER = 15.0  # of chi-squared, each further knot taken off with 2, by which a curve in a cause's place beats it


def unexplained(now: Selection, constancy: Sequence[Split], limit: float) -> Unknown | None:
    """The curve that explains most beside the causes chosen, and which of them it `denies`, as they are none; None if
    no curve is significant.

    A curve denies causes if it takes back, or adds, half or more of what they do somewhere in a channel that names
    them, if it has a quarter of their evidence beside them, if it explains much more than one of them in its place, or
    if `constancy` finds one unequal. What else was found must then be significant without what is denied.
    """
    best = best_curve(now, limit)
    if best is None or not best.denies:
        best = rival_curve(now, limit) or best
    uneven = [s for s in constancy if unequal(s)]
    if uneven and (best is None or not best.denies):
        worst = max(uneven, key=lambda s: s.chi2)
        best = curve_over_split(now, worst) or ride_to_ride(now, worst, constancy)
    if best is None:
        return None
    if best.denies:
        search = now.search
        denied = dict.fromkeys([*best.denies, *(s.cause for s in uneven)])
        left = [name for name in now.chosen if name not in denied]  # what else was found must be enough without it
        least = max(limit, LEFT * best.chi2)
        denied |= dict.fromkeys(n for n in left if search.part(left, n) < least)
        best = replace(best, denies=tuple(denied))
    form = form_of(best, now.mixed.sizes)
    if form is None:
        return best
    values = np.array([value for _, value, _ in best.curve])
    return replace(best, share=curve_energy_share(now.lines, form, values))


def curves_beside(
    now: Selection, chosen: Sequence[str], forms: Iterable[CurveForm]
) -> Iterator[tuple[CurveForm, CurveFit]]:
    """Each of `forms` that the rides have, fitted beside the causes `chosen`."""
    for form in forms:
        curve = fit_curve(now.mixed, now.lines, now.normals, form, now.search.index(chosen))
        if curve is not None:
            yield form, curve


def best_curve(now: Selection, limit: float) -> Unknown | None:
    """The curve that explains most beside the causes chosen, and those of its channel if it is no bend of theirs."""
    search, chosen = now.search, now.chosen
    total = search.evidence.gain(search.index(chosen))
    best: Unknown | None = None
    for form, curve in curves_beside(now, chosen, curve_forms(now.mixed.sizes)):
        inflation = curve_inflation(now.mixed, form)
        score = curve_score(now.mixed, form, curve)
        if score < least_score(form, limit):
            continue
        mine = [name for name in chosen if search.shares.get(name, {}).get(form.channel, 0.0) > OWN_SHARE]
        theirs = sum(search.part(chosen, name) for name in mine)
        unlike = contradicts_causes(curve, inflation, *channel_effect(now, form.channel))
        unlike = unlike or bool(mine and curve.chi2 / inflation > RIVAL * theirs)
        if chosen and curve.chi2 < (UNLIKE_LEFT if unlike else LEFT) * total:
            continue
        if best is not None and (unlike, score) <= (bool(best.denies), best.score):
            continue
        rest = [name for name in chosen if not (unlike and name in mine)]
        if curve_is_accepted(now, form, rest, limit):
            best = described(form, curve, score, mine if unlike else [])
    return best


def curve_is_accepted(now: Selection, form: CurveForm, rest: Sequence[str], limit: float) -> bool:
    """Whether the curve `form` beside the causes `rest` is more than what differs between these rides, and mends its
    channel on rides held out of the fit.
    """
    mixed, lines, normals, search = now.mixed, now.lines, now.normals, now.search
    wide = with_observed_scatter(mixed, normals)
    curve = fit_curve(wide, lines, normals, form, search.index(rest), own=True)
    if curve is None or curve_score(mixed, form, curve) < least_score(form, limit):
        return False
    causes = [search.causes[name] for name in rest]
    held = held_out(mixed, lines, normals, Fold(causes, form), Fold(causes))
    return len(lines) < 2 or improves(squares(held), {form.channel: 1.0})


def rival_curve(now: Selection, limit: float) -> Unknown | None:
    """The curve that explains much better than one of the causes chosen what that one explains, in its own channel."""
    mixed, search = now.mixed, now.search
    best: Unknown | None = None
    most = BETTER
    for name in now.chosen:
        rest = [other for other in now.chosen if other != name]
        own = search.step(rest, name)
        shares = search.shares.get(name, {})
        mine = (form for form in curve_forms(mixed.sizes) if shares.get(form.channel, 0.0) >= OWN_SHARE)
        for form, curve in curves_beside(now, rest, mine):
            evidence = curve.chi2 / curve_inflation(mixed, form) - 2 * (curve.k - 1)
            ahead = evidence - own * max(mixed.inflation.get(name, 1.0), 1.0)
            if ahead > max(most, UNLIKE_LEFT * own) and curve_is_accepted(now, form, rest, limit):
                most = ahead
                best = described(form, curve, curve_score(mixed, form, curve), [name])
    return best


def curve_over_split(now: Selection, split: Split) -> Unknown | None:
    """The curve over the quantity of `split`, with no cause named, in the channel where it has most to say."""
    forms = (f for f in curve_forms(now.mixed.sizes) if f.quantity == split.quantity and not f.straight)
    found = [
        described(form, curve, curve_score(now.mixed, form, curve), [split.cause])
        for form, curve in curves_beside(now, [], forms)
    ]
    return max(found, key=lambda curve: curve.score, default=None)


def ride_to_ride(now: Selection, worst: Split, constancy: Sequence[Split]) -> Unknown:
    """What no cause is that acts in some rides and not in others: by how much more or less in each."""
    channels = {name for line in now.lines for name in line.tables}
    channel = max(channels, key=lambda name: channel_effect(now, name)[1])
    mine = [s for s in constancy if s.cause == worst.cause and s.quantity.startswith(RIDE_PREFIX)]
    rows = tuple((float(i), s.ratio, abs(s.ratio) / max(s.chi2, 1e-9) ** 0.5) for i, s in enumerate(mine))
    share = energy_share(now.lines, now.change)
    return Unknown(channel, RIDE_TO_RIDE, False, "", worst.chi2, worst.chi2, rows, (worst.cause,), share)


def form_of(unknown: Unknown, sizes: Sizes) -> CurveForm | None:
    """The curve of what has no name, in a vehicle of `sizes`; None if it is one of rides."""
    if unknown.quantity == RIDE_TO_RIDE:
        return None
    return CurveForm(unknown.channel, unknown.quantity, unknown.straight, sizes)


def curve_inflation(mixed: MixedModel, form: CurveForm) -> float:
    """By how much the chi-squared of `form` is too high on healthy rides that were left out."""
    healthy = mixed.shapes.get(form.name)
    return healthy.inflation if healthy else 1.0


def curve_score(mixed: MixedModel, form: CurveForm, curve: CurveFit) -> float:
    """The evidence for `curve`, on the scale of one degree of freedom."""
    return one_degree(curve.chi2 / curve_inflation(mixed, form), curve.k, mixed.freedom)


def least_score(form: CurveForm, limit: float) -> float:
    """What `form` must have where a cause must have `limit`."""
    return limit * (1.0 if form.straight else CURVE)


def described(form: CurveForm, curve: CurveFit, score: float, denies: Sequence[str]) -> Unknown:
    """The curve for the report, its share of the energy still open."""
    rows = tuple(zip(form.knots.tolist(), curve.values.tolist(), curve.sd.tolist(), strict=True))
    return Unknown(form.channel, form.quantity, form.straight, form.unit, score, curve.chi2, rows, tuple(denies))


def in_words(unknown: Unknown) -> str:
    """What it is that has no name."""
    if unknown.quantity != CONSTANT:
        return f"{readable(unknown.channel)} over {readable(unknown.quantity)}"
    ((_, value, sd),) = unknown.curve
    unit = CHANNEL[unknown.channel].unit
    return f"a constant {readable(unknown.channel)}, {value:+.4g} ± {sd:.2g} {unit} wherever the rides are"


def contradicts_causes(curve: CurveFit, inflation: float, size: float, share: float) -> bool:
    """Whether what is left beside the causes, of `size` in this channel and `share` of the evidence for them, is no
    mere bend of what they do.
    """
    value, sd = curve.contrasts()
    certain = (np.abs(value) > CLEAR * sd * inflation**0.5) & (curve.weights > WEIGHTY)
    return bool(share > OWN_SHARE and size > 0 and np.any(np.abs(value)[certain] > UNLIKE * size))


def channel_effect(now: Selection, channel: str) -> tuple[float, float]:
    """(what the causes chosen make in `channel`, rms where they act [unit]; the channel's share of the evidence)."""
    change = now.change
    parts, here, everywhere = [np.zeros(1)], 0.0, 0.0
    for line in now.lines:
        for name, table in line.tables.items():
            effect = table.a @ change
            strength = float(np.sum((effect / now.mixed.noise[name].sd) ** 2))
            everywhere += strength
            if name == channel:
                here += strength
                parts.append(np.abs(effect * table.unit))
    effect = np.concatenate(parts)
    acting = effect[effect > ACTING * effect.max()]
    if effect.max() < 1e-9 or not len(acting):
        return 0.0, 0.0
    return float(np.sqrt(np.mean(acting**2))), here / everywhere
