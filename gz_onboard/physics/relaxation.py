"""First-order relaxation, dx/dt = (target - x)/τ: an RC pair, an effect with memory.

Exact for a target that holds over a step. An RC pair has the target R·I (Lord 2016, eq. 2.22). The functions take
floats, or numpy arrays of one shape.
"""

from __future__ import annotations

from math import exp, log
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from gz_onboard.arrays import Array

T = TypeVar("T")
FORGOTTEN = 1e-20  # of a value: what is left of it is less than a number of its size can show


def decay_over(dt: float, time_constant: float) -> float:
    """The factor by which the distance from the target shrinks in `dt` [s]; `time_constant` in s."""
    return exp(-dt / time_constant)


def relaxed(x: T, target: T, decay: T) -> T:
    """`x` after a step over which it decays by `decay` towards `target`; x and target in one unit."""
    return decay * x + (1 - decay) * target  # type: ignore[operator,no-any-return]


def relaxation(targets: Array, decays: Array, start: float = 0.0, before: bool = False) -> Array:
    """The values (n,) at the ends of all steps from `start` on; targets, decays: (n,).

    before: those at the beginnings of the steps. What a step leaves of the one before is carried over 1, 2, 4, ...
    steps, in whole arrays (Hillis & Steele 1986).
    """
    import numpy as np

    values, left, steps = (1 - decays) * targets, decays.copy(), 1
    values[:1] += decays[:1] * start
    while steps < len(values) and left[steps:].max() > FORGOTTEN:
        values[steps:] += left[steps:] * values[:-steps]
        left[steps:] *= left[:-steps]
        steps *= 2
    return np.concatenate(([start], values[:-1])) if before else values


def mean_response(left: float) -> float:
    """What of a load a first-order lag shows in the mean over it: 1 - τ/T·(1 - left), with left = exp(-T/τ).

    left: the share of what relaxes that is left after the load, of duration T.
    """
    if left >= 1:
        return 0.0
    return 1 + (1 - left) / log(left) if left > 0 else 1.0
