"""Large changes are not linear: causes are sought about what they change, again and again, until it stays."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.discover.candidates import Candidate
from gz_onboard.lab.discover.linear import Linear, Normal, normal
from gz_onboard.lab.discover.search import Search, evidence
from gz_onboard.lab.discover.state import State
from gz_onboard.lab.discover.terms import LOG

AGAIN = 5  # times at most
Linearised = Callable[[State | Sequence[State]], list[Linear]]


def about(state: State, offset: Array, linearised: Linearised) -> list[Linear]:
    """The rides linearised at `offset` in scales, (p,) or one for each, (rides, p); their residuals as seen from the
    values of `state`.
    """
    if offset.ndim == 1:
        moved = replace(state, values=state.unit_value(offset)) if np.any(offset) else state
        return [line.seen_from(offset) for line in linearised(moved)]
    lines = linearised([replace(state, values=state.unit_value(own)) for own in offset])
    return [line.seen_from(own) for line, own in zip(lines, offset, strict=True)]


@dataclass(frozen=True)
class Known:
    """What the search for causes goes by."""

    state: State
    causes: Sequence[Candidate]
    shares: dict[str, dict[str, float]]
    limit: float
    linearised: Linearised


@dataclass(frozen=True)
class Converged:
    """The causes chosen, linearised about what they change: `offset` (p,), in scales."""

    state: State
    lines: list[Linear]
    normals: list[Normal]
    search: Search
    chosen: tuple[str, ...]
    offset: Array

    @property
    def change(self) -> Array:
        """Of the parameters by the causes, (p,)."""
        change = np.zeros(len(self.state.mean))
        index = self.search.index(self.chosen)
        change[index] = self.search.evidence.estimate(index)
        return change


def converged(known: Known, lines: list[Linear], start: Array, own: Array) -> Converged:
    """The causes that explain `lines`, found about `start`, then about what they change, until it stays.

    own: what is each ride's own and stays, (p,) or (rides, p) in scales.
    """
    state, offset = known.state, start

    def searched(lines: list[Linear], offset: Array) -> Converged:
        normals = [normal(line, state.noise) for line in lines]
        search = Search(state, evidence(state, normals), known.causes, known.shares)
        return Converged(state, lines, normals, search, search.select(known.limit).names, offset)

    now = searched(lines, offset)
    for _ in range(AGAIN):
        if not now.chosen:
            break
        before, offset = offset, now.change
        for name in now.chosen:
            for i in now.search.place[name]:
                offset[i] = kept(state, i, offset[i])
        now = searched(about(state, offset + own, known.linearised), offset)
        if np.all(np.abs(offset - before) < 0.03 * np.abs(offset) + 1e-9):
            break
    return now


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
