"""The gain on whole rides held out of the fit: before, with the present parameters refitted, and extended."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gz_onboard.arrays import Array
from gz_onboard.lab.discover.cross_validation import extended_mean, start_equations, with_curve, with_own_start, without
from gz_onboard.lab.discover.curves import CurveForm
from gz_onboard.lab.discover.energy import energy, pack_power, share_of_time
from gz_onboard.lab.discover.linear import LinearRide, fit_mixed, normal
from gz_onboard.lab.discover.result import Report
from gz_onboard.lab.discover.unexplained import RIDES

WHOLE = {"pack_voltage", "pack_current"}  # without which no one knows what a ride took out of the pack


def measure_gain(report: Report, seed: int, apart: Sequence[LinearRide] = ()) -> dict[str, Any]:
    """Errors of rides that were not fitted, with `report`'s causes and without.

    apart: rides that had no part in `report`, linearised where it is. Without any, each ride of the report is held out
    in turn; the choice of the causes is then shared.
    """
    mixed = report.mixed
    assert mixed is not None
    lines = [*report.lines, *apart]
    normals = [*report.normals, *(normal(line, mixed.noise) for line in apart)]
    if len(lines) < 2:
        return {"holdout": [], "note": "one ride: nothing to hold out"}
    names = [line.ride.name for line in lines]
    known = len(report.lines)
    folds = [list(range(known, len(lines)))] if apart else [[i] for i in range(known)]
    rows: dict[str, list[tuple[float, float, float]]] = {}
    causes = [c for c in mixed.causes if c.name in {found.name for found in report.causes if not found.varies}]
    form = form_of(report.unknown) if report.unknown is not None else None
    for fold in folds:
        rest = [n for i, n in enumerate(normals) if i not in fold]
        if not rest or not fold:
            continue
        control = fit_mixed(rest, mixed.mean, mixed.prior, mixed.scatter, 1.0, mixed.free, 0).mean
        after, curve = control, np.zeros(0)
        if form is not None:
            fitted = [(line, n) for i, (line, n) in enumerate(zip(lines, normals, strict=True)) if i not in fold]
            after, curve = with_curve(mixed, fitted, causes, form)
        elif causes:
            after = extended_mean(mixed, rest, causes)
        for i in fold:
            shown = lines[i] if form is None else without(lines[i], form, curve)
            models = ((lines[i], mixed.mean), (lines[i], control), (shown, after))
            triple = [
                errors(line, with_own_start(mixed, start_equations(mixed, line), theta)) for line, theta in models
            ]
            for metric in triple[0]:
                rows.setdefault(metric, []).append(tuple(t[metric] for t in triple))  # type: ignore[arg-type]
    result: dict[str, Any] = {"holdout": [names[i] for fold in folds for i in fold], "apart": bool(apart)}
    rng = np.random.default_rng(seed)
    for metric, triples in rows.items():
        table = np.array(triples)
        before, control_, after_ = table.mean(axis=0)
        draws = rng.integers(0, len(table), (400, len(table)))
        saved = (table[:, 1] - table[:, 2])[draws].mean(axis=1)
        result[metric] = {
            "before": float(before),
            "control": float(control_),
            "after": float(after_),
            "ci95": [float(np.quantile(saved, 0.025)), float(np.quantile(saved, 0.975))],
        }
    return result


def form_of(unknown: dict[str, Any]) -> CurveForm | None:
    """The curve of what has no name; None if it is one of rides."""
    if unknown["quantity"] == RIDES:
        return None
    return CurveForm(unknown["channel"], unknown["quantity"], unknown["straight"])


def errors(line: LinearRide, theta: Array) -> dict[str, float]:
    """Of one ride with parameters `theta` (p,): rms power [W], energy per way [J/m], cell voltage [V], range [1]."""
    more, square = 0.0, 0.0
    found: dict[str, float] = {}
    for name, table in line.tables.items():
        rest = table.y - table.a @ theta
        power = pack_power(name, line, rest)
        if power is not None and len(power):
            more += float(np.mean(power)) * share_of_time(line, name)
            square += float(np.mean(power**2))
        if name == "cell_voltage":
            found["voltage"] = float(np.sqrt(np.mean(rest**2)))
    found["power"] = float(np.sqrt(square))
    found["energy_per_way"] = abs(more) / max(line.ride.distance, 1.0)
    model = energy(line) - more
    if line.ride.have >= WHOLE and model > 0:
        found["range"] = abs(more) / model
    return found


__all__ = ["errors", "measure_gain"]
