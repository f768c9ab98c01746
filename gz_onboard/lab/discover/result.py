"""What a discovery found: the report and its JSON."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from gz_onboard.arrays import Array
from gz_onboard.lab.discover.constancy import Split
from gz_onboard.lab.discover.linear import LinearRide, Normal
from gz_onboard.lab.discover.mixed_model import MixedModel

SCHEMA = 1
VERDICTS = {
    "cause": "something differs from the model, and it has a name",
    "none": "nothing is wrong that these rides could show",
    "ambiguous": "something differs, and these rides cannot tell which of several",
    "unknown": "something differs that is none of the candidates",
}
METRICS = {
    "power": ("power, rms", 1.0, "W"),
    "energy_per_way": ("consumption", 1 / 3.6, "Wh/km"),
    "range": ("range", 100.0, "%"),
    "voltage": ("voltage of a cell", 1e3, "mV"),
}
"""Of the gain: what it says, factor and unit."""


@dataclass(frozen=True)
class Cause:
    """A cause that was named. value: of the parameter once accepted; change: over the healthy one's."""

    name: str
    parameter: str
    value: float
    unit: str
    ci95: tuple[float, float]
    change: float
    energy_share: float
    evidence: float  # chi-squared with one degree of freedom that leaving it out costs
    others: tuple[tuple[str, float, tuple[float, float]], ...] = ()  # further parameters: name, value, interval
    varies: bool = False  # from ride to ride: what these show promises nothing for the next, and no model is extended

    def to_json(self) -> dict[str, Any]:
        """As a JSON object."""
        return {
            "name": self.name,
            "parameter": self.parameter,
            "value": self.value,
            "unit": self.unit,
            "ci95": list(self.ci95),
            "change": self.change,
            "energy_share": self.energy_share,
            "evidence": self.evidence,
            "varies": self.varies,
            "parameters": {self.parameter: {"value": self.value, "ci95": list(self.ci95)}}
            | {name: {"value": value, "ci95": list(ci)} for name, value, ci in self.others},
        }


@dataclass
class Report:
    """What was found; the fields up to `advice` are those of the JSON."""

    verdict: str  # cause, none, ambiguous, unknown
    causes: list[Cause]
    ambiguous: list[list[str]]
    unknown: dict[str, Any] | None
    ranking: list[tuple[str, float]]
    residuals: dict[str, dict[str, float]]
    gain: dict[str, Any]
    advice: list[str]
    notes: list[str]
    isolability: dict[str, Any]
    threshold: float
    constancy: list[Split] = field(default_factory=list)
    extended_model: str | None = None
    mixed: MixedModel | None = field(default=None, repr=False)
    at: Array | None = field(default=None, repr=False)  # where the rides are linearised, in scales, (p,)
    lines: list[LinearRide] = field(default_factory=list, repr=False)
    normals: list[Normal] = field(default_factory=list, repr=False)

    def to_json(self) -> dict[str, Any]:
        """The contract's keys; numbers plain."""
        return {
            "schema": SCHEMA,
            "verdict": self.verdict,
            "causes": [cause.to_json() for cause in self.causes],
            "ambiguous": self.ambiguous,
            "unknown": self.unknown,
            "ranking": [{"name": name, "score": score} for name, score in self.ranking],
            "residuals": self.residuals,
            "gain": self.gain,
            "extended_model": self.extended_model,
            "advice": self.advice,
            "notes": self.notes,
            "isolability": self.isolability,
            "threshold": self.threshold,
            "constancy": [
                {"cause": s.cause, "quantity": s.quantity, "ratio": s.ratio, "chi2": s.chi2} for s in self.constancy
            ],
        }
