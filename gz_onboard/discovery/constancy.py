"""Does a named cause act alike wherever it should? What stands in for something without a name does not.

The columns of a cause are split in two by a quantity, left bends and right ones, early and late, slow and fast, and the
difference of the halves becomes a parameter of its own, the `ratio` to their mean: 0 for the cause itself, ±1 for what
acts in one half only (a test of the constancy of a coefficient: Chow 1960; Hansen 1992). Real causes differ a little
between halves, more so from ride to ride; only what no such difference explains counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.blocks import over_blocks
from gz_onboard.discovery.grid import Ride
from gz_onboard.discovery.linear import LinearChannel, LinearRide, Normal
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.result import Split
from gz_onboard.discovery.search import evidence
from gz_onboard.discovery.selection import Selection

RATIO_SD, RIDE_SD = 0.15, 0.25  # of a real cause: on all rides, and from ride to ride
RATIO = 0.5  # beyond which half of the cause is missing in one of the halves
CHI2 = 9.0  # three standard deviations
BEND = 0.3  # m/s² of lateral acceleration, from which on a bend is one
UNSEEN = 1e-6  # information of a ratio, below which nothing shows it


Sign = Callable[[Ride, LinearChannel, Array], Array]


def _side(ride: Ride, table: LinearChannel, effect: Array) -> Array:
    """+1 in left bends, -1 in right ones, 0 on the straight."""
    return np.asarray(np.tanh(over_blocks(table.channel, ride.quantities["lateral_acceleration"])[table.used] / BEND))


def _halves(name: str) -> Sign:
    """-1 below a value of the quantity, +1 above it, half of the cause's own squared effect on either side."""

    def sign(ride: Ride, table: LinearChannel, effect: Array) -> Array:
        at = over_blocks(table.channel, ride.quantities[name])[table.used]
        order = np.argsort(at)
        half = np.cumsum(effect[order] ** 2)
        return np.asarray(np.sign(at - at[order][np.searchsorted(half, half[-1] / 2)]))

    return sign


def _of_ride(mine: Ride) -> Sign:
    """1 in one ride, 0 in the others."""
    return lambda ride, table, effect: np.full(len(effect), 1.0 if ride is mine else 0.0)


SPLITS: Mapping[str, Sign] = {"lateral_acceleration": _side, "time": _halves("time"), "speed": _halves("speed")}
RIDE_PREFIX = "ride "  # before a ride's name, where the split is that ride against the others


def unequal(split: Split) -> bool:
    """Whether it is not the same cause in both halves."""
    return abs(split.ratio) > RATIO and split.chi2 > CHI2


def likeness(split: Split) -> str:
    """Whether the halves are alike, in a word or two."""
    return "differs" if unequal(split) else "alike" if abs(split.ratio) <= RATIO else "cannot tell"


def varying(constancy: Sequence[Split], cause: str) -> str:
    """In words, that a cause differs from ride to ride, and by how much where each was held against the others."""
    ratios = [s.ratio for s in constancy if s.cause == cause and s.quantity.startswith(RIDE_PREFIX)]
    return f"differs from ride to ride{f' ({min(ratios):+.2f} to {max(ratios):+.2f} of its mean)' if ratios else ''}"


def splits(now: Selection) -> list[Split]:
    """Of each of the causes chosen, by every quantity of `SPLITS`, and each ride against the others."""
    found = []
    for name in now.chosen:
        tests = dict(SPLITS)
        if len(now.lines) > 2 and not now.search.causes[name].varies:
            tests |= {f"{RIDE_PREFIX}{line.ride.name}": _of_ride(line.ride) for line in now.lines}
        for quantity, sign in tests.items():
            estimate = _split(now, now.search.place[name], sign)
            if estimate is not None:
                found.append(Split(name, quantity, *estimate))
    return found


def _split(now: Selection, index: Sequence[int], sign: Sign) -> tuple[float, float] | None:
    """(ratio, its chi-squared) of the halves of what the parameters at `index` do; None if nothing shows it."""
    mixed, p = now.mixed, len(now.mixed.mean)
    fixed = now.search.index(now.chosen)
    change = now.change[index]
    rides = [_extended(line, n, mixed, index, change, sign) for line, n in zip(now.lines, now.normals, strict=True)]
    healthy = mixed.bordered(np.zeros(1), np.full((1, 1), RATIO_SD**2), np.full(1, RIDE_SD**2))
    inner, score = evidence(healthy, rides).profiled([p], fixed)
    if inner[0, 0] <= UNSEEN:
        return None
    return float(score[0] / inner[0, 0]), float(score[0] * score[0] / inner[0, 0])


def _extended(
    line: LinearRide, normal: Normal, mixed: MixedModel, index: Sequence[int], change: Array, sign: Sign
) -> Normal:
    """`normal` with one more column: what the cause does, times the sign."""
    more = normal.padded(1)
    for name, table in line.tables.items():
        effect = table.a[:, index] @ change
        if np.any(effect):
            split = effect * sign(line.ride, table, effect)
            more = more.with_columns(table, mixed.noise[name], split[:, None], table.touched)
    return more
