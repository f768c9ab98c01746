"""Two kinds of pack, as new and of unknown age, each believed by how well it explains what was seen (Bayes).

What was seen is the filter's ψ and the fitted resistance. Of the packs that are not as new, those with more resistance
have less capacity: both are normal, with the correlation `TOGETHER`.
"""

from __future__ import annotations

from math import erf, exp, inf, isinf, sqrt
from typing import NamedTuple

from gz_onboard.constants import DECILE

RESISTANCE_AGED_SD = 0.42  # of packs that are not as new
TOGETHER = 0.8  # of their ψ and resistance: cells of one kind that were aged in many ways (Schuster et al. 2016)
SURE = 50.0  # logarithm of odds
DECILE_STEPS = 30  # halvings of the interval that a decile is in


class Belief(NamedTuple):
    """What of ψ is used: its mean and variance, and what it makes of the filter's SOC."""

    inverse: float
    variance: float
    soc_shift: float
    soc_variance: float  # beside the filter's; may be negative
    low: float  # P10 of ψ
    high: float  # P90


class Kinds(NamedTuple):
    """Before anything is learned: the probability that a pack is as new, and the sd of ψ of both kinds."""

    as_new: float
    new_sd: float
    old_sd: float

    @property
    def variance(self) -> float:
        """Of ψ, of a pack of either kind: what the filter's ψ begins with."""
        return self.as_new * self.new_sd**2 + (1 - self.as_new) * self.old_sd**2

    def belief(
        self, inverse: float, variance: float, with_soc: float, resistance: tuple[float, float] = (1.0, inf)
    ) -> Belief:
        """For the filter's ψ, its variance and its covariance with SOC; resistance: fitted factor and its sd.

        Less resistance than the file says makes no pack better than new.

        The filter's ψ began with mean and variance of both. Where that of a kind is elsewhere, SOC is so too.
        """
        told = max(1 / variance - 1 / self.variance, 0.0)  # information beyond the prior's
        off = (inverse - 1) / variance
        expected, old_prior, odds = self._by_resistance(resistance)
        new_variance, new, new_evidence = _posterior(0.0, self.new_sd**2, told, off)
        old_variance, old, old_evidence = _posterior(expected, old_prior, told, off)
        odds *= sqrt(new_variance * old_prior / (self.new_sd**2 * old_variance))
        odds *= exp(min(max(new_evidence - old_evidence, -SURE), SURE))
        as_new = odds / (1 + odds)
        mean = as_new * new + (1 - as_new) * old
        both = as_new * (new_variance + (new - mean) ** 2) + (1 - as_new) * (old_variance + (old - mean) ** 2)
        moves = with_soc / variance
        kinds = (as_new, new, sqrt(new_variance)), (1 - as_new, old, sqrt(old_variance))
        low, high = (_quantile(share, *kinds) for share in (0.1, 0.9))
        shift = moves * (1 + mean - inverse)
        return Belief(1 + mean, both, shift, moves * moves * (both - variance), 1 + low, 1 + high)

    def _by_resistance(self, resistance: tuple[float, float]) -> tuple[float, float, float]:
        """(mean and variance of an old pack's ψ less 1, odds of a pack as new) with the resistance alone."""
        odds = self.as_new / (1 - self.as_new)
        if isinf(resistance[1]):
            return 0.0, self.old_sd**2, odds
        more, own = max(resistance[0] - 1, 0.0), resistance[1] ** 2
        aged = RESISTANCE_AGED_SD**2 + own
        gain = TOGETHER * self.old_sd * RESISTANCE_AGED_SD / aged
        odds *= sqrt(aged / own) * exp(min(max(more * more * (1 / aged - 1 / own) / 2, -SURE), SURE))
        return gain * more, self.old_sd**2 - gain * gain * aged, odds


def _posterior(mean: float, variance: float, told: float, off: float) -> tuple[float, float, float]:
    """(variance, mean, logarithm of the evidence less that of its width) of a normal prior and a normal likelihood.

    The likelihood of x goes as exp(off·x - told·x²/2).
    """
    wide = 1 + variance * told
    evidence = (2 * mean * off + variance * off * off - mean * mean * told) / (2 * wide)
    return variance / wide, (mean + variance * off) / wide, evidence


def _quantile(share: float, *kinds: tuple[float, float, float]) -> float:
    """Of a mixture of normal distributions (probability, mean, sd), by halving."""
    ends = [mean + (DECILE if share > 0.5 else -DECILE) * sd for _, mean, sd in kinds]
    low, high = min(ends), max(ends)
    for _ in range(DECILE_STEPS):
        middle = (low + high) / 2
        below = sum(p * (1 + erf((middle - mean) / (sd * sqrt(2)))) / 2 for p, mean, sd in kinds)
        low, high = (middle, high) if below < share else (low, middle)
    return (low + high) / 2
