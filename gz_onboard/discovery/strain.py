"""What would have to be for nothing to be wrong: what no name was given to and yet cannot be.

Two things explain rides away without a cause. A candidate whose evidence asks for a value that it cannot have is not
named. And parameters that no cause is named after move in each fit, as far as the rides pull them: none of many perhaps
beyond what is known of it, and yet together they take most of the energy. Then something is wrong, with the vehicle,
its file or a signal, and the rides do not say with which.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gz_onboard.discovery.acceptance import Rejected
from gz_onboard.discovery.energy import energy_share
from gz_onboard.discovery.mixed_model import MixedModel
from gz_onboard.discovery.prior import EACH_RIDES_OWN, NUISANCE, stepped
from gz_onboard.discovery.result import Impossible, Refitted, Strain
from gz_onboard.discovery.selection import Selection
from gz_onboard.discovery.wording import with_unit

FAR_BEYOND = 10.0  # times the threshold: of a candidate that cannot be, the score that is no chance
MOST_REFITTED = 0.25  # of the energy: healthy rides of the trial's scooter refit a tenth against its file alone
SMALLEST, MOST_SAID = 0.02, 4  # of the energy; parameters that are listed


def strain_of(
    now: Selection, chosen: Sequence[str], rejected: Sequence[Rejected], scores: Mapping[str, float], limit: float
) -> Strain | None:
    """What these rides ask of the model beside the causes `chosen`, if it is more than can be; None if not.

    rejected: candidates that are no causes; scores: of each candidate beside the causes; limit: that a cause must have.
    """
    cannot = [impossible(now, row, scores[row.name]) for row in rejected if row.impossible]
    cannot = [row for row in cannot if row.score > FAR_BEYOND * limit]
    share, rows = refitted(now, chosen)
    far = abs(share) > MOST_REFITTED
    return Strain(share, tuple(rows) if far else (), tuple(cannot)) if far or cannot else None


def impossible(now: Selection, rejected: Rejected, score: float) -> Impossible:
    """What `rejected` would have to be, and take."""
    mixed = now.mixed
    (cause,) = (cause for cause in mixed.causes if cause.name == rejected.name)
    index, whole = mixed.index(cause.names), np.zeros(len(mixed.names))
    whole[index] = rejected.change
    first = cause.parameters[0]
    value = stepped(first.name, mixed.values[first.name], float(whole[index[0]] * mixed.scale[index[0]]))
    share = energy_share(now.lines, whole)
    return Impossible(cause.name, first.name, value, first.unit, (first.low, first.high), score, share)


def refitted(now: Selection, chosen: Sequence[str]) -> tuple[float, list[Refitted]]:
    """(the share of the energy that parameters beside the causes take once refitted, those that take most of it).

    Not those of sensors and of the start, which are each ride's own.
    """
    mixed = now.mixed
    causes = now.search.index(chosen)
    post = mixed.freed(causes).fit(now.normals)
    judged = [i for i, name in enumerate(mixed.names) if i not in causes and name not in EACH_RIDES_OWN]
    whole = sum(line.ride.energy for line in now.lines) or 1.0
    rows, total = [], 0.0
    for i in judged:
        share = 0.0
        for line, own in zip(now.lines, post.own, strict=True):
            move = np.zeros(len(mixed.names))
            move[i] = post.mean[i] + own[i] - mixed.mean[i]
            share += energy_share([line], move) * line.ride.energy / whole
        total += share
        if abs(share) > SMALLEST:
            rows.append(described(mixed, i, float(post.mean[i] - mixed.mean[i]), share))
    return total, sorted(rows, key=lambda row: -abs(row.energy_share))[:MOST_SAID]


def described(mixed: MixedModel, i: int, move: float, share: float) -> Refitted:
    """The parameter at `i` after a `move` [scales] that takes `share` of the energy."""
    name, known = mixed.names[i], mixed.vehicle.parameters
    unit = NUISANCE[name].unit if name in NUISANCE else known.known[name].unit if name in known.known else ""
    stated = name in NUISANCE or (name in known.known and not known.known[name].source.startswith("prior:"))
    before = mixed.values_at(mixed.mean)[name]
    return Refitted(name, before, stepped(name, before, move * float(mixed.scale[i])), unit, share, stated)


def in_words(strain: Strain) -> list[str]:
    """What cannot be, a sentence each."""
    found = [
        f"{row.name} (score {row.score:.0f}, {row.energy_share:+.1%} of the energy) would explain the rides "
        f"with {row.parameter} = {with_unit(row.value, row.unit)}, and is from {row.bounds[0]:g} to {row.bounds[1]:g}"
        for row in strain.impossible
    ]
    if strain.refitted:
        each = "; ".join(
            f"{row.parameter} {row.known:.4g} to {with_unit(row.value, row.unit)}, {row.energy_share:+.1%}"
            f"{'' if row.stated else ' (not in the vehicle file)'}"
            for row in strain.refitted
        )
        found.append(
            f"what no cause is named after took {strain.energy_share:+.1%} of the energy in the refit, which is "
            f"implausible: {each}"
        )
    return found


def advice(strain: Strain) -> str:
    """What to do about it."""
    guessed = ", ".join(row.parameter for row in strain.refitted if not row.stated)
    missing = f"Give what the file does not say ({guessed}). " if guessed else ""
    return (
        f"{missing}Vehicle, vehicle file or a signal: these rides cannot tell which is wrong. A wrong unit, sign or "
        "scale is found by `gz-onboard vehicle check`."
    )
