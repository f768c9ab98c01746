"""Two kinds of pack, as new and of unknown age, each believed by how well it explains what was seen (Bayes)."""

from __future__ import annotations

from math import exp, sqrt
from typing import NamedTuple


class Belief(NamedTuple):
    """What of ψ is used: its mean and variance, and what it makes of the filter's SOC."""

    inverse: float
    variance: float
    soc_shift: float
    soc_variance: float  # beside the filter's; may be negative


class Kinds(NamedTuple):
    """Before anything is learned: the probability that a pack is as new, and the sd of ψ of both kinds."""

    as_new: float
    new_sd: float
    old_sd: float

    @property
    def variance(self) -> float:
        """Of ψ, of a pack of either kind: what the filter's ψ begins with."""
        return self.as_new * self.new_sd**2 + (1 - self.as_new) * self.old_sd**2

    def belief(self, inverse: float, variance: float, with_soc: float) -> Belief:
        """For the filter's ψ, its variance and its covariance with SOC.

        The filter's ψ began with mean and variance of both. Where that of a kind is elsewhere, SOC is so too.
        """
        told = max(1 / variance - 1 / self.variance, 0.0)  # information beyond the prior's
        off = (inverse - 1) / variance
        narrow, wide = 1 + self.new_sd**2 * told, 1 + self.old_sd**2 * told
        odds = self.as_new / (1 - self.as_new)
        if told > 0:
            odds *= sqrt(wide / narrow) * exp(-off * off / told * (1 / narrow - 1 / wide) / 2)
        as_new = odds / (1 + odds)
        new_variance, old_variance = self.new_sd**2 / narrow, self.old_sd**2 / wide
        new, old = 1 + off * new_variance, 1 + off * old_variance
        mean = as_new * new + (1 - as_new) * old
        both = as_new * (new_variance + (new - mean) ** 2) + (1 - as_new) * (old_variance + (old - mean) ** 2)
        moves = with_soc / variance
        return Belief(mean, both, moves * (mean - inverse), moves * moves * (both - variance))
