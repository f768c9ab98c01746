"""The page of a discovery, and what it shows: residuals before and after the causes, over quantities."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.lab.discover.breakdown import (
    QUANTITIES,
    QuantityReader,
    before_and_after,
    binned,
    edges,
    outlying_rides,
    pooled,
    share_over,
    since_change,
)
from gz_onboard.lab.discover.channels import BY_NAME
from gz_onboard.lab.discover.detectability import implausible_rides, limits, missing_residuals, remaining_range_error
from gz_onboard.lab.discover.discovery import linearise_all
from gz_onboard.lab.discover.linear import normal
from gz_onboard.lab.discover.mixed_model import MixedModel, initial
from gz_onboard.lab.discover.page import page
from gz_onboard.lab.discover.result import Cause, Report
from gz_onboard.lab.discover.uncalibrated import prior_of_file
from gz_onboard.simulation.samples import Samples, read_samples
from gz_onboard.vehicle import read_vehicle
from tests.support import LOGS

floats = st.floats(-1e3, 1e3)


@given(st.lists(st.tuples(floats, floats), min_size=40, max_size=80))
def test_bins_keep_every_block_and_the_mean(pairs):
    x, y = np.array(pairs).T
    rows = binned(x, y, edges(x))
    if len(rows) and rows[:, 3].sum() == len(x):  # none was too small
        assert np.average(rows[:, 1], weights=rows[:, 3]) == pytest.approx(y.mean(), abs=1e-6)
        assert np.average(rows[:, 0], weights=rows[:, 3]) == pytest.approx(x.mean(), abs=1e-6)
    assert (rows[:, 3] > 3).all()


def test_the_share_that_goes_with_a_quantity():
    rng = np.random.default_rng(1)
    x, noise = rng.uniform(-3, 3, 4000), rng.normal(size=4000)
    assert share_over(x, noise) < 0.02
    assert share_over(x, x**2) > 0.9
    both = x**2 / np.std(x**2) + noise
    assert share_over(x, both) == pytest.approx(0.5, abs=0.06)
    assert share_over(np.ones(100), noise[:100]) == 0.0


@settings(max_examples=30)
@given(st.integers(20, 400), st.floats(11, 100), st.integers(1, 100))
def test_time_since_the_current_changed(at, jump, before):
    current = np.zeros(at + before)
    current[at:] = jump
    since = since_change(current)
    assert (since[:at] == 60.0).all()  # never before
    assert since[at] == 0.0
    last = max(0, before - 1 - 4)  # the change is seen for half a second
    assert since[-1] == pytest.approx(0.1 * last)


@pytest.fixture(scope="module")
def samples() -> Samples:
    return read_samples(LOGS / "coastdown.blf", read_vehicle("reference"))


@pytest.fixture(scope="module")
def report(samples: Samples) -> Report:
    return reported(initial(read_vehicle("reference")), samples)


def reported(mixed: MixedModel, samples: Samples) -> Report:
    mixed = replace(mixed, prior=prior_of_file(mixed))
    lines = linearise_all([mixed.ride(samples)], mixed)
    cause = Cause("rolling_resistance", "rolling_resistance_constant", 0.015, "1", (0.014, 0.016), 0.003, 0.1, 50.0)
    knots = [[float(v), float(v - 5), 0.5] for v in range(0, 16, 3)]
    unknown = {
        "channel": "road_force",
        "quantity": "speed",
        "unit": "m/s",
        "share": 0.03,
        "score": 40.0,
        "curve": knots,
        "denies": [],
    }
    ranking = [(c.name, 1.0) for c in mixed.causes]
    gain = {"holdout": ["a<b", "c"], "power": {"before": 9.0, "control": 8.0, "after": 7.0, "ci95": [0.5, 1.5]}}
    return Report(
        "unknown",
        [cause],
        [["rolling_resistance", "dragging_brake"]],
        unknown,
        ranking,
        {},
        gain,
        ["Ride <more>."],
        ["a note"],
        {"look_alikes": [["aero_drag_area", "drivetrain_drag", 0.91]]},
        15.0,
        mixed=mixed,
        lines=lines,
        normals=[normal(line, mixed.noise) for line in lines],
    )


def test_after_is_before_less_what_the_cause_does(report: Report):
    mixed = report.mixed
    assert mixed is not None
    (before,), (after,) = before_and_after(report)
    place = mixed.names.index("rolling_resistance_constant")
    for name, table in before.tables.items():
        column = table.a[:, place]
        difference = table.y - after.tables[name].y
        if np.any(column):
            change = difference[np.argmax(np.abs(column))] / column[np.argmax(np.abs(column))]
            assert difference == pytest.approx(column * change)
        else:
            assert difference == pytest.approx(0.0)
    assert np.std(after.tables["road_force"].y) <= 1.01 * np.std(before.tables["road_force"].y)


def test_a_quantity_that_was_not_measured_is_not_made_up(report: Report):
    mixed = report.mixed
    assert mixed is not None
    (line,) = report.lines
    ride = line.ride
    bare = replace(ride, signals={k: v for k, v in ride.signals.items() if k not in ("rate_z", "gps_course")})
    over = QuantityReader(mixed)
    less = replace(line, ride=bare)
    for name in QUANTITIES:
        x, y, _ = pooled([less], "road_force", name, over)
        assert len(x) == len(y)
        assert (len(x) == 0) == (name in ("lateral_acceleration", "heading")), name


def test_the_page_says_it_all(report: Report):
    text = page(
        replace(
            report,
            residuals={
                "road_force": dict.fromkeys(
                    ("mean", "rms", "autocorrelation", "blocks", "energy_share", "range_share"), 0.1
                )
            },
        )
    )
    said = (
        "none of the candidates",
        "rolling_resistance_constant",
        "0.014 to 0.016",
        "+10.0%",
        "+0.91",
        "Ride &lt;more&gt;.",
        "a note",
        "a&lt;b",
        "What has no name",
        "+0.5 to +1.5",
        "dragging brake",
    )
    for words in said:
        assert words in text, words
    assert "<script" not in text
    assert len(re.findall(r'<img alt="" src="data:image/png;base64,[A-Za-z0-9+/=]{500,}"', text)) >= 4
    assert text.count("<details") >= sum(name in report.lines[0].tables for name in BY_NAME)


def test_limits_shrink_with_the_rides(report: Report):
    twice = replace(report, lines=report.lines * 2, normals=report.normals * 2)
    one, two = ({limit.name: limit for limit in limits(r)} for r in (report, twice))
    assert all(two[name].change <= one[name].change for name in one)
    assert two["auxiliary_load"].change < 0.9 * one["auxiliary_load"].change
    assert 0.01 < one["rolling_resistance"].share < 1


def test_a_ride_of_another_vehicle_is_suspected(report: Report):
    assert implausible_rides(report) == []
    (line,) = report.lines
    signals = {**line.ride.signals, "gps_speed": 1.35 * line.ride.signals["gps_speed"]}
    (said,) = implausible_rides(replace(report, lines=[replace(line, ride=replace(line.ride, signals=signals))]))
    assert "coastdown: GPS speed is 1.3" in said


def test_a_range_that_is_still_missed_is_said(report: Report):
    errors = {"before": 0.2, "control": 0.1, "after": 0.09, "ci95": [0.0, 0.02]}
    (said,) = remaining_range_error(replace(report, gain={"range": errors}))
    assert "9% of the range is missed" in said
    assert remaining_range_error(replace(report, gain={"range": {**errors, "after": 0.02}})) == []
    assert remaining_range_error(replace(report, gain={"note": "one ride: nothing to hold out"})) == []


def test_what_one_ride_alone_shows_is_said(report: Report):
    mixed = report.mixed
    assert mixed is not None
    assert outlying_rides(report) == []
    far = np.zeros(len(mixed.names))
    far[mixed.names.index("soc_start")] = 12.0
    lines = [line.seen_from(far) for line in report.lines]
    (said,) = outlying_rides(replace(report, lines=lines, normals=[normal(line, mixed.noise) for line in lines]))
    assert "coastdown alone differs" in said
    assert "soc start +1" in said


def test_what_the_rides_lack_is_said(samples: Samples):
    lacking = ("accel_x", "rate_z", "gps_speed", "gps_course", "gps_altitude")
    less = replace(samples, columns={k: v for k, v in samples.columns.items() if k not in lacking})
    bare = reported(initial(read_vehicle("reference")), less)
    said = " ".join(missing_residuals(bare))
    assert "no ride has accel_x: no road force there" in said
    assert "no residual over lateral acceleration" in said
    assert {limit.name for limit in limits(bare) if limit.change == float("inf")} >= {
        "rolling_resistance",
        "tyre_radius",
    }
    assert "not by these rides" in page(bare)
