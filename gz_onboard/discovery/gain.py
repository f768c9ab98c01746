"""The gain on whole rides held out of the fit: before, with the present parameters refitted, and extended."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.discovery.cross_validation import Fold, Triple, held_out
from gz_onboard.discovery.energy import channel_energy, pack_power
from gz_onboard.discovery.linear import LinearRide
from gz_onboard.discovery.result import Errors, Gain
from gz_onboard.discovery.unexplained import form_of
from gz_onboard.discovery.verdict import Discovery

WHOLE = {"pack_voltage", "pack_current"}  # without which no one knows what a ride took out of the pack
DRAWS = 400  # of the bootstrap over rides


def measure_gain(found: Discovery, seed: int, apart: Sequence[LinearRide] = ()) -> Gain:
    """Errors of rides that were not fitted, with the causes and the curve of `found` and without.

    seed: of the bootstrap. apart: rides that had no part in `found`, linearised where it is. Without any, each ride of
    it is held out in turn; the choice of the causes is then shared.
    """
    mixed, report = found.mixed, found.report
    lines = [*found.lines, *apart]
    normals = [*found.normals, *mixed.normals(apart)]
    if len(lines) < 2:
        return Gain(note="one ride: nothing to hold out")
    known = len(found.lines)
    folds = [list(range(known, len(lines)))] if apart else [[i] for i in range(known)]
    named = {cause.name for cause in report.causes if not cause.varies}
    form = form_of(report.unknown, mixed.sizes) if report.unknown is not None else None
    after = Fold([cause for cause in mixed.causes if cause.name in named], form)
    rows: dict[str, list[Triple]] = {}
    for models in held_out(mixed, lines, normals, after, Fold(), folds):
        before, control, with_causes = (errors(line, theta) for line, theta in models)
        for metric, value in before.items():
            rows.setdefault(metric, []).append((value, control[metric], with_causes[metric]))
    rng = np.random.default_rng(seed)
    held = tuple(lines[i].ride.name for fold in folds for i in fold)
    of_metric = {metric: summarised(triples, rng) for metric, triples in rows.items()}
    return Gain(held, None, bool(apart), **of_metric)


def summarised(rows: Sequence[Triple], rng: np.random.Generator) -> Errors:
    """The means over rides, and the interval of what is saved by a bootstrap over them; None for one."""
    table = np.array(rows)
    before, control, after = table.mean(axis=0).tolist()
    if len(table) < 2:
        return Errors(before, control, after, None)
    draws = rng.integers(0, len(table), (DRAWS, len(table)))
    saved = (table[:, 1] - table[:, 2])[draws].mean(axis=1)
    return Errors(before, control, after, (float(np.quantile(saved, 0.025)), float(np.quantile(saved, 0.975))))


def errors(line: LinearRide, theta: Array) -> dict[str, float]:
    """Of one ride with parameters `theta` (p,), by the metrics of `Gain`; without those that are not known."""
    more, square = 0.0, 0.0
    found: dict[str, float] = {}
    for name, table in line.tables.items():
        rest = table.y - table.a @ theta
        power = pack_power(name, line, rest)
        if power is not None and len(power):
            more += channel_energy(name, line, rest)
            square += float(np.mean(power**2))
        if name == "cell_voltage":
            found["voltage"] = float(np.sqrt(np.mean(rest**2)))
    found["power"] = float(np.sqrt(square))
    found["consumption"] = abs(more) / max(line.ride.distance, 1.0)
    model = line.ride.energy - more
    if line.ride.have >= WHOLE and model > 0:
        found["range"] = abs(more) / model
    return found
