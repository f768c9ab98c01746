"""The report of a calibration."""

from __future__ import annotations

import html
import json
import re

import numpy as np
import pytest

from gz_onboard.calibration.report import VERSION, document, plus_minus, text, write_report
from gz_onboard.calibration.result import Curve, Fit, Found, Panel, PlotLine, Result
from gz_onboard.reports.results import write_json

NAN = float("nan")


def a_result() -> Result:
    x = np.linspace(0, 1, 20001)
    return Result(
        "coast",
        {"drag_area": Found(0.5, 0.03, "m²", "runs <1> & 2"), "mass": Found(100, 0.0, "kg", "sheet")},
        {"battery.r0": Curve({"soc": np.array([0, 1.0])}, np.array([0.1, 0.2]), np.array([NAN, 0.1]), "ohm", "pulse")},
        [(("drag_area", "mass"), np.array([[4.0, 1.0], [1.0, 1.0]]))],
        [Fit("speed", "m/s", 0.1, 0.3, 0.99, 12, True, "two runs"), Fit("x", "V", 0.1, 0.3, None, 3, False, "y")],
        ["the slope: ± 3 %"],
        ["a note"],
        [Panel("Speed", "t [s]", "v [m/s]", (PlotLine("measured", x, np.sin(x), "."), PlotLine("model", x, x)))] * 3,
    )


def test_the_page_needs_nothing_else_and_says_all(tmp_path):
    pages = [tmp_path / "r.html", tmp_path / "s.html"]
    for file in pages:
        write_report(file, "A & B", [a_result()])
    page = pages[0].read_text()
    assert all(link.startswith(("#", "data:image")) for link in re.findall(r'(?:src|href)="([^"]*)"', page))
    words = html.unescape(re.sub(r"<[^>]+>", " ", page))
    for said in ("A & B", "0.500 ± 0.030", "runs <1> & 2", "two runs (held out)", "0.9900", "+0.50", "± 3 %", "a note"):
        assert said in words
    assert "<img" in page and len(page) < 100_000
    assert page == pages[1].read_text()


def test_json_holds_no_nan(capsys):
    write_json("-", VERSION, document([a_result()], "v.toml", None))
    written = capsys.readouterr().out
    assert "NaN" not in written
    read = json.loads(written)
    (procedure,) = read["procedures"]
    assert read["version"] == 1
    said = {"value": 0.5, "sd": 0.03, "unit": "m²", "source": "runs <1> & 2", "channel": ""}
    assert procedure["parameters"]["drag_area"] == said
    assert procedure["curves"]["battery.r0"]["sd"] == [None, 0.1]
    assert procedure["correlation"] == [{"parameters": ["drag_area", "mass"], "value": [[1, 0.5], [0.5, 1]]}]
    assert [fit["held_out"] for fit in procedure["fits"]] == [True, False]
    assert procedure["refusals"] == ["the slope: ± 3 %"]


def test_text():
    lines = text(a_result()).splitlines()
    assert lines[0] == "coast"
    assert "  drag_area = 0.500 ± 0.030 m²" in lines
    assert "  not identified: the slope: ± 3 %" in lines


@pytest.mark.parametrize(
    ("value", "sd", "expected"),
    [
        (0.5, 0.03, "0.500 ± 0.030"),
        (12000, 1500, "12000 ± 1500"),
        (1e-7, 1e-8, "1e-07 ± 1e-08"),
        (2, 0, "2"),
        (2, NAN, "2"),
    ],
)
def test_as_many_digits_as_are_known(value, sd, expected):
    assert plus_minus(value, sd) == expected
