"""First-order relaxation, dx/dt = (target - x)/τ: an RC pair, an effect with memory.

Exact for a target that holds over a step. An RC pair has the target R·I (Lord 2016, eq. 2.22). The functions take
floats, or numpy arrays of one shape.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import exp, log
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from gz_onboard.arrays import Array

T = TypeVar("T")


def decay_over(dt: float, time_constant: float) -> float:
    """The factor by which the distance from the target shrinks in `dt` [s]; `time_constant` in s."""
    return exp(-dt / time_constant)


def relaxed(x: T, target: T, decay: T) -> T:
    """`x` after a step over which it decays by `decay` towards `target`; x and target in one unit."""
    return decay * x + (1 - decay) * target  # type: ignore[operator,no-any-return]


def relaxation(targets: Iterable[float], decays: Iterable[float], start: float = 0.0) -> list[float]:
    """The values at the ends of all steps, beginning from `start`. Floats: a step is shorter than a call of numpy."""
    x, result = start, []
    for target, decay in zip(targets, decays, strict=True):
        x = relaxed(x, target, decay)
        result.append(x)
    return result


def relaxation_over(targets: Array, decays: Array, start: float = 0.0, before: bool = False) -> Array:
    """`relaxation` of arrays (n,), shape (n,); before: the values at the beginnings of the steps, from `start` on."""
    import numpy as np

    ends = relaxation(targets.tolist(), decays.tolist(), start)
    return np.array([start, *ends[:-1]] if before else ends)


def mean_response(left: float) -> float:
    """What of a load a first-order lag shows in the mean over it: 1 - τ/T·(1 - left), with left = exp(-T/τ).

    left: the share of what relaxes that is left after the load, of duration T.
    """
    if left >= 1:
        return 0.0
    return 1 + (1 - left) / log(left) if left > 0 else 1.0
