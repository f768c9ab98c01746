"""JSON from types, and the meaning of its keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from gz_onboard.discovery.judgement import Errors, Gain, Report
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
    gain = Gain(("ride",), apart=False, power=Errors(3.0, 2.0, 1.0, (0.1, 0.2)))
    written = to_json(Report("none", [], [], None, [], {}, gain))
    assert isinstance(written, dict)
    assert list(written) == ["version", *descriptions(Report)]
    assert written["gain"] == {
        "holdout": ["ride"],
        "apart": False,
        "power": {"before": 3.0, "control": 2.0, "after": 1.0, "ci95": [0.1, 0.2]},
    }
