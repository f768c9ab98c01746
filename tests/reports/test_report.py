"""``gz-onboard report``: one page of several rides, sensors that are left out, rides of which little is known."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gz_onboard.cli import main
from gz_onboard.estimation.report import changed_by, path_of
from gz_onboard.estimation.summary import Why
from gz_onboard.estimator.load_model import Ledger
from tests.support import LOGS


def test_a_sensor_left_out_takes_with_it_what_it_taught():
    change = Why(250.0, 46.2, 110.4, {"riding": 54.8, "unexplained": 6.0, "speed": 3.4}, ["pack_voltage"])
    left_out = changed_by(change)
    assert left_out == {"speed": 3.4, "pack voltage left out, what it taught forgotten": pytest.approx(60.8)}
    assert changed_by(replace(change, forgotten=[])) == {"riding to come": 54.8, "unexplained": 6.0, "speed": 3.4}


def test_the_path_has_holes_where_there_is_no_fix():
    time = np.arange(60.0)
    columns = {
        "latitude": (time, 50.0 + 1e-4 * time),
        "longitude": (time, np.full(60, 8.0)),
        "gps_fix": (time, np.where((time >= 20) & (time < 40), 0.0, 3.0)),
    }
    path = path_of(columns)
    assert [len(run) for run in path] == [20, 20]
    assert path[1][0] == pytest.approx((50.004, 8.0))
    assert path_of({"latitude": columns["latitude"]}) == []


def test_several_rides_are_one_page_and_one_that_cannot_be_used_stops_no_other(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("none.log").write_text("noise\n" * 100)
    rides = [
        str(LOGS / "coastdown.blf"),
        str(LOGS / "coastdown.blf"),
        "none.log",
        str(LOGS / "calibration" / "coastdown_02.blf"),
    ]
    assert main(["report", *rides, "--jobs", "1", "--quiet"]) == 2
    said = capsys.readouterr()
    assert said.out == "rides.html\n"
    assert "none.log" in said.err
    text = Path("rides.html").read_text()
    sections = re.findall(r'<section class="ride" id="([^"]*)"><h2>(\w+)', text)
    assert len(sections) == 2
    assert sections == re.findall(r'<a href="#([^"]*)">(\w+)</a>', text)
    assert text.count('aria-label="the path, north up"') == 2
    assert str(LOGS) not in text  # the page may be sent to somebody
    assert main(["report", rides[0], "--quiet", "--no-path", "-o", "nowhere.html"]) == 0
    assert "north up" not in Path("nowhere.html").read_text()
    assert main(["report", rides[0], "--quiet"]) == 0
    section = re.findall(r"<section.*?</section>", Path("coastdown.html").read_text(), re.DOTALL)
    assert section[0] in text  # the same log, the same bytes


@pytest.mark.parametrize("lines", [2, 400])
def test_a_ride_with_a_speed_alone_has_a_page(tmp_path, lines):
    rows = "".join(f"{i / 10},30\n" for i in range(lines))
    (tmp_path / "ride.csv").write_text(f"time [s],speed [km/h]\n{rows}")
    assert main(["report", str(tmp_path / "ride.csv"), "-o", str(tmp_path / "ride.html"), "--quiet"]) == 0
    text = (tmp_path / "ride.html").read_text()
    assert "Over time" in text
    assert "Range over the distance" not in text
    assert not re.search(r"\b(nan|None)\b", text)


def test_an_empty_ledger_is_true():
    assert Ledger()  # or none would be kept
