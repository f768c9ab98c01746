"""Results as JSON, their keys, tables."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

from gz_onboard.discovery.judgement import Errors, Gain, Report
from gz_onboard.errors import InputError
from gz_onboard.reports.page import Failed, Subheading, html_table, markdown_table
from gz_onboard.reports.results import OPTIONAL, clock, descriptions, number, text_rows, times, to_json, write_json

NAN = float("nan")


@dataclass(frozen=True)
class Inner:
    value: float


@dataclass(frozen=True)
class Outer:
    first: Annotated[float, "the first"]
    second: Annotated[list[Inner], "the second"]
    third: str = ""
    fourth: Annotated[str | None, OPTIONAL, "left out where it is None"] = None


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (Outer(NAN, [Inner(1.0)]), {"first": None, "second": [{"value": 1.0}], "third": ""}),
        (Outer(1.0, [], fourth="a"), {"first": 1.0, "second": [], "third": "", "fourth": "a"}),
        (np.array([[1.0, NAN], [np.inf, 2.0]]), [[1.0, None], [None, 2.0]]),
        ({1: (np.float64(0.1), np.int64(3), np.bool_(True))}, {"1": [0.1, 3, True]}),
        (Path("a/b"), "a/b"),
        (None, None),
    ],
)
def test_what_json_has_of_a_value(value, expected):
    found = to_json(value)
    assert found == expected
    assert json.loads(json.dumps(found, allow_nan=False)) == expected


def test_a_result_comes_after_its_version(tmp_path, capsys):
    write_json("-", 3, Outer(0.5, []))
    text = capsys.readouterr().out
    assert list(json.loads(text)) == ["version", "first", "second", "third"]
    write_json(str(tmp_path / "x.json"), 3, Outer(0.5, []))
    assert (tmp_path / "x.json").read_text() == text
    write_json(None, 3, {})
    assert not capsys.readouterr().out
    with pytest.raises(InputError, match="cannot be written"):
        write_json("/dev/null/x", 3, {})


def test_numbers_as_text():
    assert number(None, ".1f", "km") == "–"
    assert number(1.25, ".1f", "V", 2.0) == "2.5 V"
    assert clock(3725.4) == "1 h 2 min 05 s"
    assert times(None, 2.0) is None
    assert text_rows("head", [("a", "1"), ("", "2")]) == f"head\n  {'a':17} 1\n  {'':17} 2"


def test_the_same_table_as_html_and_markdown():
    heads = ["ride", "%"]
    rows: list[list[str]] = [[Subheading("speed <")], ["a", "1.0"], ["b", Failed("9.0")]]
    page = html_table(heads, rows, [1])
    assert "<th colspan=2>speed &lt;</th>" in page
    assert "<td class=bad>9.0</td>" in page
    assert "<td class=n>1.0</td>" in page
    assert markdown_table(heads, rows) == "| ride | % |\n| --- | --- |\n| *speed <* |  |\n| a | 1.0 |\n| b | **9.0** |"


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
