"""Which causes: forward selection with exchange, what could stand in for what, and what no name explains.

All questions are asked of one pair of matrices (`Evidence`), so that trying a set of causes costs a few microseconds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as fisher
from scipy.stats import t as student

from gz_onboard.arrays import Array
from gz_onboard.discovery.candidates import Candidate
from gz_onboard.discovery.linear import Normal, Population, marginal
from gz_onboard.discovery.mixed_model import MixedModel

RIDGE = 1e-6  # information of any change, in scales: none is without bounds
MOST_CAUSES, EXCHANGES = 3, 3  # that are named together; rounds of exchanging each for what explains more
ALIKE = 0.6  # cosine of two columns, all that is common or random taken off
BEND = 0.02  # of a cause's evidence: no effect has exactly the form of the real one, and others take up what is left


@dataclass(frozen=True)
class Evidence:
    """What rides say of changes of the parameters, all that is common or random between rides integrated out.

    information (p, p), score (p,): the log likelihood of changes δ is δᵀ·score − δᵀ·information·δ/2.
    """

    information: Array
    score: Array

    def estimate(self, index: Sequence[int]) -> Array:
        """The likeliest changes of the parameters at `index`, in scales; the others do not change."""
        i = list(index)
        return np.asarray(np.linalg.solve(self.information[np.ix_(i, i)] + RIDGE * np.eye(len(i)), self.score[i]))

    def covariance(self, index: Sequence[int]) -> Array:
        """Of the estimate."""
        i = list(index)
        return np.asarray(np.linalg.inv(self.information[np.ix_(i, i)] + RIDGE * np.eye(len(i))))

    def profiled(self, index: Sequence[int], fixed: Sequence[int], ridge: float = 0.0) -> tuple[Array, Array]:
        """(information (k, k), score (k,)) of the parameters at `index` once those at `fixed` are fitted beside them.

        ridge: added to the information of those at `index`.
        """
        i, f = list(index), list(fixed)
        inner, score = self.information[np.ix_(i, i)] + ridge * np.eye(len(i)), self.score[i]
        if not f:
            return inner, score
        cross = np.linalg.solve(
            self.information[np.ix_(f, f)] + RIDGE * np.eye(len(f)),
            np.column_stack([self.information[np.ix_(f, i)], self.score[f]]),
        )
        across = self.information[np.ix_(i, f)]
        return inner - across @ cross[:, :-1], score - across @ cross[:, -1]

    def gain(self, index: Sequence[int]) -> float:
        """Twice the rise of the log likelihood by free changes of the parameters at `index`."""
        return float(self.score[list(index)] @ self.estimate(index)) if len(index) else 0.0


def evidence(healthy: Population, normals: Sequence[Normal]) -> Evidence:
    """Of the rides' `normals`, against what is known of the `healthy` vehicle."""
    parts = [marginal(ride, healthy.scatter) for ride in normals]
    m = sum((part.n for part in parts), np.zeros_like(healthy.prior))
    c = sum((part.b for part in parts), np.zeros(len(healthy.mean)))
    e = c - m @ healthy.mean
    k = np.linalg.inv(np.linalg.inv(healthy.prior) + m)
    return Evidence(m - m @ k @ m, e - m @ k @ e)


class Search:
    """The hypotheses over one `Evidence`."""

    def __init__(
        self,
        mixed: MixedModel,
        evidence: Evidence,
        causes: Sequence[Candidate],
        shares: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        self.mixed, self.evidence, self.shares = mixed, evidence, shares or {}
        self.causes = {c.name: c for c in causes}
        self.place = {c.name: mixed.index(c.names) for c in causes}

    def index(self, names: Sequence[str]) -> list[int]:
        """The parameters of the causes `names`."""
        return [i for name in names for i in self.place[name]]

    def fitted(self, names: Sequence[str]) -> dict[str, tuple[Array, Array]]:
        """(changes (k,), variances (k,)) of the parameters of each of `names`, all fitted together, in scales."""
        index = self.index(names)
        ends = np.cumsum([len(self.place[name]) for name in names])[:-1]
        change, variance = self.evidence.estimate(index), np.diag(self.evidence.covariance(index))
        return dict(zip(names, zip(np.split(change, ends), np.split(variance, ends), strict=True), strict=True))

    def allowed(self, names: Sequence[str]) -> bool:
        """Whether each cause of the set changes its parameter in a direction that it can."""
        change = self.evidence.estimate(self.index(names))
        at = 0
        for name in names:
            sign = self.causes[name].sign
            if sign and change[at] * sign < 0:
                return False
            at += len(self.place[name])
        return not self.cancel(self.index(names), change)

    def cancel(self, index: Sequence[int], change: Array) -> bool:
        """Whether two of the changes look alike and work against each other: two faults that hide each other are less
        likely than one that is neither.
        """
        inner = self.evidence.information[np.ix_(index, index)]
        size = np.sqrt(np.maximum(np.diag(inner), 1e-12))
        both = inner / np.outer(size, size) * np.sign(np.outer(change, change))
        np.fill_diagonal(both, 1.0)
        return bool(np.min(both, initial=1.0) < -ALIKE)

    def gain(self, names: Sequence[str]) -> float:
        """Of a set of causes; 0 for one that cannot be."""
        return self.evidence.gain(self.index(names)) if names and self.allowed(names) else 0.0

    def step(self, base: Sequence[str], name: str) -> float:
        """What `name` adds to `base`, over what it adds on healthy rides that were left out: chi-squared if healthy.

        A cause of two parameters is brought to the scale of one: see `one_degree`.
        """
        more = self.gain([*base, name]) - (self.evidence.gain(self.index(base)) if base else 0.0)
        more /= self.mixed.inflation.get(name, 1.0)
        k = len(self.place[name])
        return one_degree(more, k, self.mixed.freedom) if k > 1 else more

    def part(self, chosen: Sequence[str], name: str) -> float:
        """What `name` adds to the others of `chosen`: see `step`."""
        return self.step([other for other in chosen if other != name], name)

    def overlap(self, a: str, b: str) -> float:
        """How much of the evidence for `a` and for `b` comes from the same channels, 0 to 1."""
        mine, theirs = self.shares.get(a, {}), self.shares.get(b, {})
        return sum(min(share, theirs.get(channel, 0.0)) for channel, share in mine.items())

    def bend(self, base: Sequence[str], name: str) -> float:
        """What `name` would add to `base` if it only mended the form of what is there: see `BEND`."""
        return BEND * sum(self.part(base, n) * self.overlap(n, name) for n in base)

    def select(self, threshold: float) -> tuple[str, ...]:
        """Causes one after the other, each exchanged for what explains more together with the rest."""
        chosen: list[str] = []
        while len(chosen) < MOST_CAUSES:
            steps = {n: self.step(chosen, n) for n in self.causes if n not in chosen}
            best = max(steps, key=lambda n: steps[n])
            if steps[best] < max(threshold, self.bend(chosen, best)):
                break
            chosen.append(best)
            for _ in range(EXCHANGES):
                before = list(chosen)
                for old in before:
                    rest = [n for n in chosen if n != old]
                    steps = {n: self.step(rest, n) for n in self.causes if n not in rest}
                    new = max(steps, key=lambda n: steps[n])
                    if steps[new] > steps[old] + 1e-9:
                        chosen[chosen.index(old)] = new
                if chosen == before:
                    break
        for old in list(chosen):
            rest = [n for n in chosen if n != old]
            if rest and self.step(rest, old) < max(threshold, self.bend(rest, old)):
                chosen.remove(old)
        chosen.sort(key=lambda n: -self.part(chosen, n))
        return tuple(chosen)

    def alternatives(self, chosen: Sequence[str], margin: float, least: float) -> list[tuple[str, ...]]:
        """For each of `chosen` the set of causes that explain nearly as much in its place, itself first.

        margin: of chi-squared, on the scale of the less certain of the two. least: that each must score by itself.
        """
        sets = []
        for name in chosen:
            rest = [n for n in chosen if n != name]
            own = self.gain([*rest, name])
            near = {n: self.gain([*rest, n]) for n in self.causes if n not in chosen}
            inflation = self.mixed.inflation
            allowed = {n: margin * max(1.0, inflation.get(n, 1.0), inflation.get(name, 1.0)) for n in near}
            others = sorted(
                (n for n, g in near.items() if g > own - allowed[n] and self.step(rest, n) > least),
                key=lambda n: -near[n],
            )
            if others:
                sets.append((name, *others))
        return sets


def one_degree(chi2: float, k: int, freedom: float) -> float:
    """The square of Student's t that is as unlikely as `chi2` of `k` coefficients, where their common scatter is known
    with so many degrees of `freedom`: a quantile of F, whose tail is the longer the more coefficients there are.
    """
    if chi2 <= 0:
        return 0.0
    near = chi2
    while (log_p := float(fisher.logsf(near / k, k, freedom))) < -500:
        near /= 2  # as far out as this both go in proportion
    return float(student.isf(np.exp(log_p) / 2, freedom)) ** 2 * chi2 / near
