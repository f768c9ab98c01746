"""Types of numpy arrays for signatures, whose docstrings give shape and unit, and operations on them."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


def block_means(values: Array, count: int) -> Array:
    """Means over `count` values each, shape (len(values) // count,); a shorter rest at the end is left out."""
    means: Array = values[: len(values) // count * count].reshape(-1, count).mean(axis=1)
    return means


def running_mean(values: Array, width: int) -> Array:
    """The mean of `width` (odd) values about each, the first and last held beyond the ends; shape as `values`."""
    sums = np.cumsum(np.concatenate(([0.0], np.pad(values, width // 2, mode="edge"))))
    smooth: Array = ((sums[width:] - sums[:-width]) / width)[: len(values)]
    return np.pad(smooth, (0, len(values) - len(smooth)), mode="edge")


def held_at(at: Array, time: Array, values: Array) -> Array:
    """The last of `values` (n,) at `time` (n,) before each of `at` (m,), shape (m,); the first before there is one."""
    held: Array = values[np.clip(np.searchsorted(time, at, side="right") - 1, 0, len(values) - 1)]
    return held


def held_integral(time: Array, values: Array) -> Array:
    """The integral of `values`, each held from its `time` to the next, up to each time; all (n,)."""
    return np.concatenate([[0.0], np.cumsum(np.diff(time) * values[:-1])])


def stretches(true: Mask | Sequence[bool]) -> list[tuple[int, int]]:
    """(first, one beyond the last) index of each stretch of `true` (n,) in which it is."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], np.asarray(true, dtype=int), [0]))))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def bends(nodes: Array) -> Array:
    """Return a matrix (n - 2, n): a line through the neighbours minus the value, at each inner one of n `nodes`."""
    width = np.diff(nodes)
    share = width[1:] / (width[:-1] + width[1:])
    result = np.zeros((len(nodes) - 2, len(nodes)))
    for k, w in enumerate(share.tolist()):
        result[k, k : k + 3] = w, -1.0, 1 - w
    return result
