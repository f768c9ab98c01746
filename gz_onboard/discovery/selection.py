"""The search for causes as one problem, and its answer.

Large changes are not linear: causes are sought about what they change, again and again, until it stays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from gz_onboard.arrays import Array
from gz_onboard.discovery.candidates import Candidate
from gz_onboard.discovery.curve_forms import curve_forms
from gz_onboard.discovery.linear import LinearRide, Normal
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.prior import LOG_SCALED
from gz_onboard.discovery.search import Evidence, Search, evidence

MAX_ROUNDS = 5
SETTLED = 0.03  # of a change: no further round for less
MOST = 3  # a parameter does not fall to less than one part in so many at once
FALSE_ALARMS = 0.05  # of sets of healthy rides, all candidates and curves together
VISIBLE = 1e-4  # information per scale squared, from which on rides say something of a parameter
Linearised = Callable[[MixedModel | Sequence[MixedModel]], list[LinearRide]]


def linearised_about(mixed: MixedModel, offset: Array, linearised: Linearised) -> list[LinearRide]:
    """The rides linearised at `offset` in scales, (p,) or one for each, (rides, p); their residuals as seen from the
    values of `mixed`.
    """
    if offset.ndim == 1:
        moved = replace(mixed, values=mixed.values_at(offset)) if np.any(offset) else mixed
        return [line.seen_from(offset) for line in linearised(moved)]
    lines = linearised([replace(mixed, values=mixed.values_at(own)) for own in offset])
    return [line.seen_from(own) for line, own in zip(lines, offset, strict=True)]


@dataclass(frozen=True)
class SearchProblem:
    """What the search for causes goes by.

    causes: those that the rides can say anything of. shares: see `channel_shares`. limit: the score that a cause must
    have. linearised: the rides at a model. start (p,): where they are linearised first, in scales, as `lines` are.
    own: what is each ride's own beside the causes and stays, (p,) or (rides, p) in scales.
    """

    mixed: MixedModel
    causes: Sequence[Candidate]
    shares: dict[str, dict[str, float]]
    limit: float
    linearised: Linearised
    start: Array
    lines: list[LinearRide]
    own: Array


def search_problem(mixed: MixedModel, start: Array, linearised: Linearised) -> SearchProblem:
    """The search for the candidates of `mixed`, in rides linearised first at `start` (p,), in scales."""
    lines = linearised_about(mixed, start, linearised)
    e = evidence(mixed, mixed.normals(lines))
    usable = mixed.usable_causes
    causes = [c for c in usable if not np.any(np.diag(e.information)[mixed.index(c.names)] < VISIBLE)]
    channels = {name for line in lines for name in line.tables}
    proportions = sum(form.straight and form.channel in channels for form in curve_forms(mixed.sizes))
    limit = threshold(mixed, tries(e, mixed.index_of(causes)) + proportions)
    shares = channel_shares(mixed, lines, causes)
    return SearchProblem(mixed, causes, shares, limit, linearised, start, lines, np.zeros_like(start))


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
                weighted = table.a[:, index] / mixed.noise[name].sd
                seen_in[name] = seen_in.get(name, 0.0) + float(np.sum(weighted**2))
        whole = sum(seen_in.values()) or 1.0
        found[cause.name] = {name: value / whole for name, value in seen_in.items()}
    return found


@dataclass(frozen=True)
class Selection:
    """The causes chosen, linearised about what they change: `offset` (p,), in scales."""

    mixed: MixedModel
    lines: list[LinearRide]
    normals: list[Normal]
    search: Search
    chosen: tuple[str, ...]
    offset: Array

    @property
    def change(self) -> Array:
        """Of the parameters by the causes, (p,)."""
        change = np.zeros(len(self.mixed.mean))
        index = self.search.index(self.chosen)
        change[index] = self.search.evidence.estimate(index)
        return change


def select_causes(problem: SearchProblem) -> Selection:
    """The causes that explain the rides, found about the start, then about what they change, until it stays."""
    mixed, offset = problem.mixed, problem.start

    def searched(lines: list[LinearRide], offset: Array) -> Selection:
        normals = mixed.normals(lines)
        search = Search(mixed, evidence(mixed, normals), problem.causes, problem.shares)
        return Selection(mixed, lines, normals, search, search.select(problem.limit), offset)

    now = searched(problem.lines, offset)
    for _ in range(MAX_ROUNDS):
        if not now.chosen:
            break
        before, offset = offset, now.change
        for name in now.chosen:
            for i in now.search.place[name]:
                offset[i] = limited_step(mixed, i, offset[i])
        now = searched(linearised_about(mixed, offset + problem.own, problem.linearised), offset)
        if np.all(np.abs(offset - before) < SETTLED * np.abs(offset) + 1e-9):
            break
    return now


def limited_step(mixed: MixedModel, i: int, x: float) -> float:
    """A change `x` of the parameter at `i`, in scales, that stays within the bounds of what it is, and does not take
    more than two thirds of it at once.
    """
    name, value = mixed.names[i], mixed.values[mixed.names[i]]
    bounds = next((p for c in mixed.causes for p in c.parameters if p.name == name), None)
    if name in LOG_SCALED or bounds is None:
        return x
    low = max(bounds.low, value / MOST) if bounds.low > 0 else bounds.low
    moved = float(np.clip(value + x * float(mixed.scale[i]), low, bounds.high))
    return (moved - value) / float(mixed.scale[i])
