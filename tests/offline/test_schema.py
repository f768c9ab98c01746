"""JSON from types, and the meaning of its keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from gz_onboard.discovery.result import (
    Errors,
    FoundCause,
    Gain,
    Isolability,
    Limit,
    ParameterEstimate,
    Report,
    ResidualSize,
    Score,
    Split,
    Unknown,
)
from gz_onboard.reports.results import OPTIONAL, descriptions, to_json


@dataclass(frozen=True)
class Inner:
    """With a key that is left out."""

    at: tuple[float, int]
    name: Annotated[str | None, OPTIONAL, "what it is called"] = None


@dataclass(frozen=True)
class Outer:
    """Of every kind."""

    rows: Annotated[tuple[Inner, ...], "the rows"]
    by_name: dict[str, list[bool]]
    missing: float | None = None


def test_what_is_none_is_null_or_left_out():
    value = Outer((Inner((1.0, 2)), Inner((3.0, 4), "a")), {"x": [True]})
    assert to_json(value) == {
        "rows": [{"at": [1.0, 2]}, {"at": [3.0, 4], "name": "a"}],
        "by_name": {"x": [True]},
        "missing": None,
    }
    assert descriptions(Outer) == {"rows": "the rows"}


def test_the_report_of_a_discovery_has_the_keys_that_it_explains():
    interval = (0.1, 0.2)
    report = Report(
        "ambiguous",
        [
            FoundCause(
                "headwind",
                "wind_north",
                3.0,
                "m/s",
                interval,
                3.0,
                0.1,
                30.0,
                True,
                {"wind_east": ParameterEstimate(1.0, interval)},
            )
        ],
        [["a", "b"]],
        Unknown("road_force", "speed", False, "m/s", 40.0, 41.0, ((1.0, 2.0, 0.5),), ("a",), 0.03),
        [Score("a", 1.0)],
        {"road_force": ResidualSize(0.1, 0.2, 0.3, 4, 0.5, 0.6)},
        Gain(("ride",), apart=False, power=Errors(3.0, 2.0, 1.0, interval)),
        ["advice"],
        [],
        Isolability({"a": ["road_force"]}, [["a", "b"]], [("a", "b", 0.9)]),
        15.0,
        [Split("a", "time", 0.1, 2.0)],
        None,
        {"a": Limit("wind_north", "m/s", None, None)},
    )
    written = to_json(report)
    assert isinstance(written, dict)
    assert list(written) == ["version", *descriptions(Report)]
    assert written["gain"] == {
        "holdout": ["ride"],
        "apart": False,
        "power": {"before": 3.0, "control": 2.0, "after": 1.0, "ci95": [0.1, 0.2]},
    }
    (cause,) = report.causes
    assert list(cause.parameters) == ["wind_north", "wind_east"]
