"""Each ride's own wind. It blows as it likes on another day, so that one vector common to the rides misses it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.acceptance import Rejected, accept
from gz_onboard.discovery.candidates import Candidate
from gz_onboard.discovery.search import one_degree
from gz_onboard.discovery.selection import SearchProblem, Selection, linearised_about, select_causes
from gz_onboard.model.effect import MOVING

UNSEEN = 1e-6  # information per scale squared, below which a ride says nothing of its wind
SIDE = 0.5  # of (wind over speed)²: what side wind and gusts change of drag, in the mean over all directions


@dataclass(frozen=True)
class Winds:
    """Each ride's own wind: evidence that they are more than healthy rides show; in words; what they move, (rides, p)
    in scales, at `index`.
    """

    cause: Candidate
    score: float
    words: str
    blown: Array
    index: list[int]


@dataclass(frozen=True)
class Searched:
    """What the search found: the causes, the winds if these are no common cause, and what was rejected."""

    selection: Selection
    winds: Winds | None
    rejected: list[Rejected]


def search_causes(problem: SearchProblem) -> Searched:
    """The causes of `problem` that are accepted; beside each ride's own wind, if these are more than healthy ones."""
    now, problem, rejected = accept(problem, select_causes(problem))
    wind = next((cause for cause in now.search.causes.values() if cause.varies), None)
    winds = own_winds(now, wind) if wind is not None and wind.name not in now.chosen else None
    if winds is not None and winds.score > problem.limit:
        windy = with_winds(problem, winds)
        now = select_causes(windy)
        now, _, more = accept(replace(windy, lines=now.lines), now)
        rejected = rejected + more
    return Searched(now, winds, rejected)


def own_winds(now: Selection, wind: Candidate) -> Winds:
    """The winds beside the causes. One blows as it likes on another day, so that a common vector misses it."""
    mixed, change = now.mixed, now.change
    w = list(now.search.place[wind.name])
    blown = np.zeros((len(now.lines), len(mixed.mean)))
    rest = [i for i in range(len(mixed.mean)) if i not in w]
    spread = mixed.prior + np.diag(mixed.scatter)
    inside = np.zeros_like(spread)
    inside[np.ix_(rest, rest)] = np.linalg.inv(spread[np.ix_(rest, rest)])
    mean = mixed.mean + change
    total, words = 0.0, []
    for i, (line, ride) in enumerate(zip(now.lines, now.normals, strict=True)):
        if np.any(np.diag(ride.n)[w] < UNSEEN):
            continue
        covariance = np.linalg.inv(inside + ride.n)
        own = (covariance @ (ride.b + inside @ mean))[w] - mean[w]
        total += float(own @ np.linalg.solve(spread[np.ix_(w, w)] + covariance[np.ix_(w, w)], own))
        blown[i, w] = own
        north, east = (own * mixed.scale[w]).tolist()
        words.append(
            f"{line.ride.name} {np.hypot(north, east):.1f} m/s from {np.degrees(np.arctan2(east, north)) % 360:.0f}°"
        )
    score = one_degree(total, 2 * len(words), mixed.freedom) if words else 0.0
    return Winds(wind, score, ", ".join(words), blown, w)


def with_winds(problem: SearchProblem, winds: Winds) -> SearchProblem:
    """The search beside the `winds`, each ride about its own: their square is not linear in them, and would be taken
    for a load. So would side wind and gusts, which no channel shows: what else the effect reads of the model, the drag
    area, is as unsure as they can make it.
    """
    mixed, w = problem.mixed, winds.index
    scatter = mixed.scatter.copy()
    scatter[w] = np.maximum(scatter[w], np.mean(winds.blown[:, w] ** 2, axis=0))
    rides = (np.abs(line.ride.quantities["speed"]) for line in problem.lines)
    speeds = np.array([np.mean(speed[speed > MOVING]) for speed in rides])
    square = np.sum((winds.blown[:, w] * mixed.scale[w]) ** 2, axis=1) / speeds**2
    for i in mixed.index([name for name in winds.cause.reads if name in mixed.names]):
        scatter[i] += np.mean((SIDE * square * mixed.values[mixed.names[i]] / mixed.scale[i]) ** 2)
    windy = replace(mixed, scatter=scatter)
    lines = linearised_about(windy, problem.start + winds.blown, problem.linearised)
    causes = [cause for cause in problem.causes if cause.name != winds.cause.name]
    return replace(problem, mixed=windy, causes=causes, lines=lines, own=winds.blown)
