"""``gz-onboard report``: pictures no finer than a screen, one page of several rides, and what has no place in it."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from math import inf, nan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gz_onboard as gz
from gz_onboard.cli import main
from gz_onboard.estimator.load_model import Ledger
from gz_onboard.lab import report_page
from gz_onboard.lab.report_ride import path_of
from gz_onboard.lab.report_svg import GRAIN, axis_of, band, draw_map, line, stretches
from gz_onboard.lab.why import Why
from gz_onboard.offline.samples import Samples
from gz_onboard.recording.logs import read_frames
from tests.support import LOGS, write_log

VALUES = st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60)


def corners(path: str) -> list[tuple[int, int]]:
    return [(int(x), int(y)) for x, y in re.findall(r"[ML](-?\d+) (-?\d+)", path)]


@given(VALUES, st.booleans())
def test_an_axis_holds_its_values(values, zero):
    axis = axis_of(values, zero=zero)
    assert axis.low < axis.high
    step = axis.ticks[1] - axis.ticks[0]
    assert all(axis.low - 0.06 * step <= value <= axis.high + 0.06 * step for value in values)
    assert 2 <= len(axis.ticks) <= 9
    assert len({axis.text(tick) for tick in axis.ticks}) == len(axis.ticks)
    assert not zero or axis.low <= 0 <= axis.high


@pytest.mark.parametrize("values", [[], [nan], [inf, nan], [0.0], [7.0], [-3.0, -3.0]])
def test_an_axis_of_next_to_nothing(values):
    axis = axis_of(values)
    assert axis.low < axis.high
    assert axis.ticks


@settings(max_examples=10)
@given(st.lists(st.floats(0, 50), min_size=2, max_size=20))
def test_a_long_line_is_thinned_and_keeps_its_peaks(some):
    values = [value for value in some for _ in range(12_000 // len(some))]
    x = [float(i) for i in range(len(values))]
    across, up = axis_of(x, whole=False), axis_of(values)
    found = corners(line(x, values, across, up))
    assert len(found) <= 4 * (GRAIN + 1)
    assert [at for at, _ in found] == sorted(at for at, _ in found)
    heights = [GRAIN - round(up.at(value)) for value in values]
    assert {min(heights), max(heights)} <= {y for _, y in found}
    assert (found[0][1], found[-1][1]) == (heights[0], heights[-1])


def test_a_change_by_a_sensor_that_is_left_out_is_not_called_riding():
    change = Why(250.0, 46.2, 110.4, {"riding": 54.8, "unexplained": 6.0, "speed": 3.4}, ["pack_voltage"])
    text = report_page._changes([change, replace(change, forgotten=[])])
    named, plain = re.findall("<td>([^<]*)</td></tr>", text)
    assert named == "pack voltage left out, what it taught forgotten +60.8, speed +3.4"
    assert plain == "riding to come +54.8, unexplained +6.0, speed +3.4"


def test_what_is_not_known_breaks_a_line_and_a_band():
    x, y = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [1.0, 2.0, nan, 3.0, nan, 1.0]
    axis, up = axis_of(x, whole=False), axis_of(y)
    assert line(x, y, axis, up).count("M") == 3
    assert "h0" in line(x, y, axis, up)  # one value alone is a dot
    drawn = band(x, [v - 0.1 for v in y], [v + 0.1 for v in y], axis, up)
    assert (drawn.count("M"), drawn.count("z")) == (3, 3)


def test_a_short_stretch_is_seen():
    assert stretches([(10.0, 0.01), (50.0, 25.0)], axis_of([0.0, 100.0])) == "M100 0h1v1000h-1zM500 0h250v1000h-250z"


def test_a_map_keeps_shape_and_scale():
    """A square kilometre at 60 degrees north: twice as many degrees wide as high."""
    side = 1000 / 111_200
    drawn = draw_map([[(60.0, 10.0), (60.0, 10.0 + 2 * side), (60.0 + side, 10.0 + 2 * side)]], "")
    way, *_, bar = re.findall(r' d="([^"]*)"', drawn.svg)
    (x0, y0), (x1, y1), (x2, y2) = corners(way)
    assert x1 - x0 == pytest.approx(y1 - y2, rel=0.01)  # north is up
    assert (y0, x2) == (y1, x1)
    assert drawn.bar == 200
    assert float(bar.split("h")[1]) == pytest.approx((x1 - x0) / 5, abs=1)


@given(st.lists(st.tuples(st.floats(-89, 89), st.floats(-180, 180)), min_size=2, max_size=5))
def test_a_map_of_anything_is_within_its_frame(way):
    svg = draw_map([way], "").svg
    tall = int(re.findall(r'viewBox="0 0 1000 (\d+)"', svg)[0])
    assert all(0 <= x <= GRAIN and 0 <= y <= tall for x, y in corners(svg.split('class="bar"')[0]))


def test_the_path_has_holes_where_there_is_no_fix():
    time = np.arange(60.0)
    columns = {
        "latitude": (time, 50.0 + 1e-4 * time),
        "longitude": (time, np.full(60, 8.0)),
        "gps_fix": (time, np.where((time >= 20) & (time < 40), 0.0, 3.0)),
    }
    path = path_of(Samples("ride", columns))
    assert [len(run) for run in path] == [20, 20]
    assert path[1][0] == pytest.approx((50.004, 8.0))
    assert path_of(Samples("ride", {"latitude": columns["latitude"]})) == []


def test_several_rides_are_one_page_and_one_that_cannot_be_used_stops_no_other(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("none.log").write_text("noise\n" * 100)
    rides = [str(LOGS / "coastdown.blf"), "none.log", str(LOGS / "calibration" / "coastdown_02.blf")]
    assert main(["report", *rides, "--jobs", "1", "--quiet"]) == 2
    said = capsys.readouterr()
    assert said.out == "rides.html\n"
    assert "none.log" in said.err
    text = Path("rides.html").read_text()
    assert re.findall(r'<section class="ride" id="([^"]*)"><h2>(\w+)', text) == re.findall(
        r'<a href="#([^"]*)">(\w+)</a>', text
    )
    assert text.count("<section") == 2
    assert text.count('class="map"') == 2
    assert str(LOGS) not in text  # the page may be sent to somebody
    assert main(["report", rides[0], "--quiet", "--no-path", "-o", "nowhere.html"]) == 0
    assert "map" not in re.findall(r'class="(\w+)', Path("nowhere.html").read_text())
    assert main(["report", rides[0], "--quiet"]) == 0
    section = re.findall(r"<section.*?</section>", Path("coastdown.html").read_text(), re.DOTALL)
    assert section[0] in text  # the same log, the same bytes


def test_a_log_of_several_names_is_one_ride_and_that_is_said(tmp_path, monkeypatch, caplog, capsys):
    monkeypatch.chdir(tmp_path)
    frames = next(read_frames(LOGS / "coastdown.blf"))
    for name, part in (("one.log", frames[:-1]), ("other.log", frames[1:])):
        write_log(Path(name), part)
    shutil.copy("one.log", "copy.log")
    Path("link.log").symlink_to("one.log")
    given = ["one.log", "one.log", "copy.log", "link.log", str(tmp_path / "one.log"), "other.log"]
    said = [
        "one.log: is given twice; it counts once",
        "copy.log: is the same log as one.log; it counts once",
        "link.log: is the same log as one.log; it counts once",
        f"{tmp_path}/one.log: is the same log as one.log; it counts once",
    ]
    assert main(["report", *given, "--quiet", "--jobs", "1"]) == 0
    assert "<h1>2 rides</h1>" in Path("rides.html").read_text()
    assert caplog.messages == said
    caplog.clear()
    assert [ride.name for ride in gz.report(given).rides] == ["one", "other"]
    assert caplog.messages == said


@pytest.mark.parametrize(("lines", "titles"), [(2, ["Speed"]), (400, ["Speed"])])
def test_a_ride_of_which_little_is_known(tmp_path, lines, titles):
    """The speed alone."""
    rows = "".join(f"{i / 10},30\n" for i in range(lines))
    (tmp_path / "ride.csv").write_text(f"time [s],speed [km/h]\n{rows}")
    assert main(["report", str(tmp_path / "ride.csv"), "-o", str(tmp_path / "ride.html"), "--quiet"]) == 0
    text = (tmp_path / "ride.html").read_text()
    assert re.findall(r"<figcaption><b>([^<]*)", text) == titles
    assert "nan" not in text
    assert "None" not in text


def test_a_ledger_is_there_even_when_it_is_empty():
    assert Ledger()  # or none would be kept
