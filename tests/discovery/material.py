"""Reports, rides and models that several tests of the discovery share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gz_onboard.discovery.judgement import Discovery, FoundCause, ParameterEstimate, Report, Unknown
from gz_onboard.discovery.judgement import Gain as NoGain
from gz_onboard.discovery.mixed_model import LinearRide, MixedModel
from gz_onboard.discovery.search import Search

KNOTS = ((0.0, -4.0, 1.0), (4.0, 1.0, 1.0), (8.0, 6.0, 2.0), (12.0, 2.0, 1.0))
CURVE = Unknown("road_force", "speed", False, "m/s", 40.0, 40.0, KNOTS, share=0.03)


def cause(
    name: str, parameter: str, value: float, half: float, change: float, unit: str = "1", **more: object
) -> FoundCause:
    """A cause with an interval of `half` to either side of its value."""
    ci95 = (value - half, value + half)
    found = FoundCause(name, parameter, value, unit, ci95, change, 0.04, 70.0)
    estimates = {parameter: ParameterEstimate(value, ci95, unit)}
    return replace(found, **{"parameters": estimates, **more})  # type: ignore[arg-type]


def cornering() -> FoundCause:
    return cause("cornering_drag", "cornering_compliance", 0.25, 0.05, 0.25, "rad")


def rolling() -> FoundCause:
    return cause("rolling_resistance", "rolling_resistance_constant", 0.015, 0.001, 0.0033)


def search_of(mixed: MixedModel, lines: list[LinearRide], limit: float = 15.0) -> Search:
    """A search in `lines` that has chosen nothing."""
    causes = {c.name: c for c in mixed.usable_causes}
    none = np.zeros(len(mixed.names))
    return Search(mixed, lines, causes, {name: {} for name in causes}, limit, none, none)


def discovered(mixed: MixedModel, lines: list[LinearRide], *causes: FoundCause, **more: object) -> Discovery:
    """A discovery of `causes`; more: fields of the report."""
    verdict = "unknown" if more.get("unknown") else "cause"
    report = Report(verdict, list(causes), [], None, [], {}, NoGain(), threshold=15.0)
    return Discovery(replace(report, **more), search_of(mixed, lines))  # type: ignore[arg-type]
