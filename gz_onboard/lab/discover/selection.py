"""Large changes are not linear: causes are sought about what they change, again and again, until it stays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.discover.candidates import Candidate
from gz_onboard.lab.discover.linear import LinearRide, Normal, normal
from gz_onboard.lab.discover.mixed_model import MixedModel
from gz_onboard.lab.discover.prior import LOG
from gz_onboard.lab.discover.search import Search, evidence

MAX_ROUNDS = 5  # times at most
Linearised = Callable[[MixedModel | Sequence[MixedModel]], list[LinearRide]]


def linearised_about(mixed: MixedModel, offset: Array, linearised: Linearised) -> list[LinearRide]:
    """The rides linearised at `offset` in scales, (p,) or one for each, (rides, p); their residuals as seen from the
    values of `mixed`.
    """
    if offset.ndim == 1:
        moved = replace(mixed, values=mixed.unit_value(offset)) if np.any(offset) else mixed
        return [line.seen_from(offset) for line in linearised(moved)]
    lines = linearised([replace(mixed, values=mixed.unit_value(own)) for own in offset])
    return [line.seen_from(own) for line, own in zip(lines, offset, strict=True)]


@dataclass(frozen=True)
class SearchProblem:
    """What the search for causes goes by."""

    mixed: MixedModel
    causes: Sequence[Candidate]
    shares: dict[str, dict[str, float]]
    limit: float
    linearised: Linearised


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


def select_causes(known: SearchProblem, lines: list[LinearRide], start: Array, own: Array) -> Selection:
    """The causes that explain `lines`, found about `start`, then about what they change, until it stays.

    own: what is each ride's own and stays, (p,) or (rides, p) in scales.
    """
    mixed, offset = known.mixed, start

    def searched(lines: list[LinearRide], offset: Array) -> Selection:
        normals = [normal(line, mixed.noise) for line in lines]
        search = Search(mixed, evidence(mixed, normals), known.causes, known.shares)
        return Selection(mixed, lines, normals, search, search.select(known.limit).names, offset)

    now = searched(lines, offset)
    for _ in range(MAX_ROUNDS):
        if not now.chosen:
            break
        before, offset = offset, now.change
        for name in now.chosen:
            for i in now.search.place[name]:
                offset[i] = limited_step(mixed, i, offset[i])
        now = searched(linearised_about(mixed, offset + own, known.linearised), offset)
        if np.all(np.abs(offset - before) < 0.03 * np.abs(offset) + 1e-9):
            break
    return now


def limited_step(mixed: MixedModel, i: int, x: float) -> float:
    """A change `x` of the parameter at `i`, in scales, that stays within the bounds of what it is, and does not take
    more than two thirds of it at once.
    """
    name, value = mixed.names[i], mixed.values[mixed.names[i]]
    bounds = next((p for c in mixed.causes for p in c.parameters if p.name == name), None)
    if name in LOG or bounds is None:
        return x
    low = max(bounds.low, value / 3) if bounds.low > 0 else bounds.low
    moved = float(np.clip(value + x * float(mixed.scale[i]), low, bounds.high))
    return (moved - value) / float(mixed.scale[i])
