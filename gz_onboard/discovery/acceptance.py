"""Which causes are accepted: within their bounds, beyond the scatter of these rides, and right of rides held out.

The spread that healthy rides showed is not that of the healthy world: where they hardly went, and what they happened
not to vary, the next rides show for the first time. So what differs between the rides at hand by more than healthy ones
did widens the scatter, beside a common part that is free; and what was found on some rides must predict the others.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.candidates import Candidate
from gz_onboard.discovery.constancy import RIDE_PREFIX, splits, unequal
from gz_onboard.discovery.cross_validation import Fold, Squares, held_out, improves, squares, worsened
from gz_onboard.discovery.linear import Normal
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.prior import LOG_SCALED
from gz_onboard.discovery.search import Search, evidence
from gz_onboard.discovery.selection import SearchProblem, Selection, select_causes

ROUNDS = 25
SURE = 2.0  # standard deviations: an estimate further beyond a bound is none of its cause
BEYOND = "would be beyond what it can be"
WORSE = 0.1  # ln of a mean square on rides held out: so much is scatter
MAX_REJECTIONS = 6  # names at most that are tried and refused


def with_observed_scatter(mixed: MixedModel, normals: Sequence[Normal]) -> MixedModel:
    """`mixed` with the scatter between rides that these show, where it is more than healthy ones did."""
    if len(normals) < 2:
        return mixed
    found = mixed.widened().learned_scatter(normals, float(mixed.healthy + 1), ROUNDS).scatter
    return replace(mixed, scatter=np.maximum(found, mixed.scatter))


def within_bounds(mixed: MixedModel, cause: Candidate, change: Iterable[float], sd: Iterable[float]) -> bool:
    """Whether the parameters of `cause` can have changed by `change` [scales], known within `sd`."""
    for parameter, x, s in zip(cause.parameters, change, sd, strict=True):
        (i,) = mixed.index([parameter.name])
        if parameter.name in LOG_SCALED:
            continue
        step = float(mixed.scale[i])
        value, spread = mixed.values[parameter.name] + x * step, SURE * s * step
        if not parameter.low - spread <= value <= parameter.high + spread:
            return False
    return True


def without_and_with(now: Selection, name: str) -> Iterator[Squares]:
    """The mean squares of rides held out of the fit, without and with `name` beside the other causes chosen."""
    every = [now.search.causes[n] for n in now.chosen]
    others = [c for c in every if c.name != name]
    return squares(held_out(now.mixed, now.lines, now.normals, Fold(every), Fold(others)))


def predicts_held_out(now: Selection, name: str) -> bool:
    """Whether `name` beside the other causes chosen mends its own channels on rides held out of the fit."""
    return len(now.lines) < 2 or improves(without_and_with(now, name), now.search.shares.get(name, {}))


def carries_over(now: Selection, name: str) -> bool:
    """Whether each channel that shows `name` is known at least as well with it as refitted, on rides held out."""
    if len(now.lines) < 2:
        return True
    return all(more < WORSE for more in worsened(without_and_with(now, name), now.search.shares.get(name, {})).values())


@dataclass(frozen=True)
class Rejected:
    """A candidate that was chosen and is no cause: why, and the change of its parameters, (k,) [scales]."""

    name: str
    why: str
    change: Array

    @property
    def impossible(self) -> bool:
        """Whether its parameters cannot be what they would have to be."""
        return self.why == BEYOND

    def __str__(self) -> str:
        return f"{self.name} {self.why}: not named"


def rejection(now: Selection, limit: float) -> Rejected | None:
    """The least certain of the causes chosen that cannot be accepted; None if all can."""
    mixed, search = now.mixed, now.search
    wide = with_observed_scatter(mixed, now.normals)
    strict = Search(wide, evidence(wide, now.normals), list(search.causes.values()), search.shares)
    # against a file what differs between rides cannot be separated from what its model lacks; a baseline knows it
    parts = [] if mixed.healthy else splits(now)
    uneven = {split.cause for split in parts if unequal(split) and split.quantity.startswith(RIDE_PREFIX)}
    found: list[tuple[float, Rejected]] = []

    def reject(why: str) -> None:
        found.append((score, Rejected(name, why, change)))

    for name, (change, variance) in search.fitted(now.chosen).items():
        score = strict.part(now.chosen, name)
        if not within_bounds(mixed, search.causes[name], change, np.sqrt(variance)):
            reject(BEYOND)
        elif score < limit:
            reject("differs from ride to ride as much as it is")
        elif name in uneven:
            reject("acts in some rides and not in others")
        elif not predicts_held_out(now, name):
            reject("does not foretell rides held out")
    return min(found, key=lambda row: (row[0], row[1].name))[1] if found else None


def accept(problem: SearchProblem, now: Selection) -> tuple[Selection, SearchProblem, list[Rejected]]:
    """`now` searched again without each cause that is rejected, the problem less these, and what was rejected."""
    rejected: list[Rejected] = []
    while now.chosen and len(rejected) < MAX_REJECTIONS:
        bad = rejection(now, problem.limit)
        if bad is None:
            break
        rejected.append(bad)
        problem = replace(problem, causes=[c for c in problem.causes if c.name != bad.name])
        now = select_causes(problem)
    return now, problem, rejected
