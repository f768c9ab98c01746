"""Each ride's own wind. It blows as it likes on another day, so that one vector common to the rides misses it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.discover.grid import MOVING, Ride
from gz_onboard.lab.discover.search import one_degree
from gz_onboard.lab.discover.selection import SearchProblem, Selection, linearised_about, select_causes

NAME = "headwind"
AREA = "drag_area"
SIDE = 0.5  # of (wind over speed)²: what side wind and gusts change of the drag area, in the mean over all directions


@dataclass(frozen=True)
class Winds:
    """Each ride's own wind: evidence that they are more than healthy rides show; in words; what they move, (rides, p)
    in scales, at `index`.
    """

    score: float
    words: str
    blown: Array
    index: list[int]


def own_winds(now: Selection) -> Winds:
    """The winds beside the causes. One blows as it likes on another day, so that a common vector misses it."""
    mixed, change = now.mixed, now.change
    w = list(now.search.place[NAME])
    blown = np.zeros((len(now.lines), len(mixed.mean)))
    rest = [i for i in range(len(mixed.mean)) if i not in w]
    spread = mixed.prior + np.diag(mixed.scatter)
    inside = np.zeros_like(spread)
    inside[np.ix_(rest, rest)] = np.linalg.inv(spread[np.ix_(rest, rest)])
    mean = mixed.mean + change
    total, words = 0.0, []
    for i, (line, ride) in enumerate(zip(now.lines, now.normals, strict=True)):
        if np.any(np.diag(ride.n)[w] < 1e-6):
            continue
        covariance = np.linalg.inv(inside + ride.n)
        wind = (covariance @ (ride.b + inside @ mean))[w] - mean[w]
        total += float(wind @ np.linalg.solve(spread[np.ix_(w, w)] + covariance[np.ix_(w, w)], wind))
        blown[i, w] = wind
        north, east = (wind * mixed.scale[w]).tolist()
        words.append(
            f"{line.ride.name} {np.hypot(north, east):.1f} m/s from {np.degrees(np.arctan2(east, north)) % 360:.0f}°"
        )
    return Winds(one_degree(total, 2 * len(words), mixed.freedom) if words else 0.0, ", ".join(words), blown, w)


def about_winds(known: SearchProblem, winds: Winds, start: Array, rides: Sequence[Ride]) -> Selection:
    """The causes beside the `winds`, each ride about its own: their square is not linear in them, and would be taken
    for a load. So would side wind and gusts, which no channel shows: the drag area is as unsure as they can make it.
    """
    mixed, w = known.mixed, winds.index
    scatter = mixed.scatter.copy()
    scatter[w] = np.maximum(scatter[w], np.mean(winds.blown[:, w] ** 2, axis=0))
    if AREA in mixed.names:
        (i,) = mixed.index([AREA])
        speeds = np.array([np.mean(speed[speed > MOVING]) for speed in (np.abs(r.quantities["speed"]) for r in rides)])
        square = np.sum((winds.blown[:, w] * mixed.scale[w]) ** 2, axis=1) / speeds**2
        scatter[i] += np.mean((SIDE * square * mixed.values[AREA] / mixed.scale[i]) ** 2)
    windy = replace(known, mixed=replace(mixed, scatter=scatter), causes=[c for c in known.causes if c.name != NAME])
    return select_causes(
        windy, linearised_about(windy.mixed, start + winds.blown, known.linearised), start, winds.blown
    )
