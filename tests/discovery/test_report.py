"""The page of a discovery, and what it shows: residuals before and after the causes, over quantities."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gz_onboard.discovery.breakdown import (
    COVARIATES,
    before_and_after,
    binned,
    edges,
    outlying_rides,
    pooled,
    share_over,
)
from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.constancy import likeness
from gz_onboard.discovery.detectability import (
    HEALTHY_MOST,
    implausible_rides,
    judge_remaining_error,
    limits,
    missing_residuals,
)
from gz_onboard.discovery.gain import summarised
from gz_onboard.discovery.grid import since_change
from gz_onboard.discovery.linear import normal
from gz_onboard.discovery.mixed_model import MixedModel, initial, linearise_all
from gz_onboard.discovery.page import body, write_report
from gz_onboard.discovery.result import (
    Errors,
    FoundCause,
    Gain,
    Isolability,
    Report,
    ResidualSize,
    Score,
    Split,
    Unknown,
)
from gz_onboard.discovery.summary import summary
from gz_onboard.discovery.uncalibrated import prior_of_file
from gz_onboard.discovery.verdict import Discovery
from gz_onboard.offline.samples import Samples, read_samples
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
def found(samples: Samples) -> Discovery:
    return reported(initial(read_vehicle("reference")), samples)


def reported(mixed: MixedModel, samples: Samples) -> Discovery:
    mixed = replace(mixed, prior=prior_of_file(mixed))
    lines = linearise_all([mixed.ride(samples)], mixed)
    cause = FoundCause(
        "rolling_resistance", "rolling_resistance_constant", 0.015, "1", (0.014, 0.016), 0.003, 0.1, 50.0
    )
    knots = tuple((float(v), float(v - 5), 0.5) for v in range(0, 16, 3))
    unknown = Unknown("road_force", "speed", False, "m/s", 40.0, 40.0, knots, share=0.03)
    ranking = [Score(c.name, 1.0) for c in mixed.causes]
    gain = Gain(("a<b", "c"), power=Errors(9.0, 8.0, 7.0, (0.5, 1.5)))
    report = Report(
        "unknown",
        [cause],
        [["rolling_resistance", "dragging_brake"]],
        unknown,
        ranking,
        {},
        gain,
        ["Ride <more>."],
        ["a note"],
        Isolability({}, [], [("aero_drag_area", "drivetrain_drag", 0.91)]),
        15.0,
    )
    found = Discovery(report, mixed, np.zeros(len(mixed.names)), lines, [normal(line, mixed.noise) for line in lines])
    report.limits = limits(found)
    return found


def test_after_is_before_less_what_the_cause_does(found: Discovery):
    mixed = found.mixed
    (before,), (after,) = before_and_after(found)
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


def test_a_quantity_that_was_not_measured_is_not_made_up(found: Discovery):
    (line,) = found.lines
    ride = line.ride
    bare = replace(ride, signals={k: v for k, v in ride.signals.items() if k not in ("rate_z", "gps_course")})
    less = replace(line, ride=bare)
    for name in COVARIATES:
        x, y = pooled([less], "road_force", name)
        assert len(x) == len(y)
        assert (len(x) == 0) == (name in ("lateral_acceleration", "heading")), name


def unseen(figure: object, name: str) -> str:
    """No picture, where the words are what is asked for."""
    return ""


def test_the_page_says_it_all(found: Discovery, tmp_path: Path):
    sizes = {"road_force": ResidualSize(0.1, 0.1, 0.1, 1, 0.1, 0.1)}
    write_report(replace(found, report=replace(found.report, residuals=sizes)), tmp_path / "out.html", "svg")
    text = (tmp_path / "out.html").read_text()
    beside = {file.name for file in tmp_path.glob("out.*.svg")}
    assert beside >= {"out.overview.svg", "out.ranking.svg", "out.unknown.svg", "out.road_force.svg"}
    said = (
        "none of the candidates",
        "rolling_resistance_constant",
        "0.014 to 0.016",
        "+10.0%",
        "+0.91",
        "Ride &lt;more&gt;.",
        "a note",
        "a&lt;b",
        "Unexplained residual",
        "+0.5 to +1.5",
        "dragging brake",
    )
    for words in said:
        assert words in text, words
    assert "<script" not in text
    pictures = re.findall(r'src="data:image/webp;base64,([A-Za-z0-9+/=]{500,})"', text)
    assert len(pictures) == len(set(pictures)) >= 4
    assert len(text) < 500_000
    assert text.count("<details") >= sum(name in found.lines[0].tables for name in CHANNEL)


def test_limits_shrink_with_the_rides(found: Discovery):
    twice = replace(found, lines=found.lines * 2, normals=found.normals * 2)
    one, two = (limits(r) for r in (found, twice))
    inf = float("inf")
    assert all((two[name].change or inf) <= (one[name].change or inf) for name in one)
    assert (two["auxiliary_load"].change or inf) < 0.9 * (one["auxiliary_load"].change or inf)
    assert 0.01 < (one["rolling_resistance"].energy_share or inf) < 1


def test_a_ride_of_another_vehicle_is_suspected(found: Discovery):
    assert implausible_rides(found.lines) == []
    (line,) = found.lines
    signals = {**line.ride.signals, "gps_speed": 1.35 * line.ride.signals["gps_speed"]}
    (said,) = implausible_rides([replace(line, ride=replace(line.ride, signals=signals))])
    assert "coastdown: GPS speed is 1.3" in said


def missed(share: float, drawn: float | None = None) -> Gain:
    """Of the range; or of the energy, with what was drawn a metre [J/m], where the range is not known."""
    errors = Errors(0.2, 0.1, share * (drawn or 1.0), (0.0, 0.02))
    return Gain(consumption=errors) if drawn else Gain(range=errors)


@pytest.mark.parametrize("of_range", [True, False])
def test_what_is_missed_on_rides_held_out_is_judged(found: Discovery, of_range: bool):
    (line,) = found.lines
    drawn = None if of_range else line.ride.energy / line.ride.distance

    def judged(gain: Gain, verdict: str = "none") -> Report:
        report = replace(found.report, gain=gain, notes=[], advice=[], causes=[], verdict=verdict)
        judge_remaining_error(replace(found, report=report))
        return report

    assert judged(Gain(note="one ride: nothing to hold out")).verdict == "none"
    small, some, much = (missed(share, drawn) for share in (0.02, HEALTHY_MOST - 0.001, HEALTHY_MOST + 0.011))
    assert (judged(small).verdict, judged(small).notes) == ("none", [])
    assert (judged(some).verdict, len(judged(some).notes)) == ("none", 1)
    assert judged(much).verdict == "inconclusive" and judged(much).advice
    assert f"9% of the {'range' if of_range else 'energy'} is missed" in judged(much).notes[0]
    assert judged(much, "unknown").verdict == "unknown" and judged(much, "unknown").notes


def test_a_change_has_its_unit_and_what_differs_from_ride_to_ride_is_said(found: Discovery):
    load = FoundCause("auxiliary_load", "auxiliary_power", 58.7, "W", (57.0, 60.0), 15.1, 0.02, 99.0, varies=True)
    ratios = {"ride a": (-0.93, 5.6), "ride b": (0.6, 2.1), "ride c": (0.5, 1.6), "time": (0.9, 12.0)}
    splits = [Split("auxiliary_load", name, *row) for name, row in ratios.items()]
    ranking = [Score("capacity_fade", 74.8), Score("auxiliary_load", 99.0), Score("headwind", 14.96)]
    report = replace(found.report, causes=[load], constancy=splits, ranking=ranking, threshold=15.0)
    text, page = (summary(replace(found, report=report)), body(replace(found, report=report), unseen))
    assert "change +15.1 W" in text and "+15.1 W" in page
    assert all("differs from ride to ride (-0.93 to +0.60 of its mean)" in said for said in (text, page))
    assert "capacity_fade 74.8 (rejected), auxiliary_load 99.0, headwind 15.0;" in text
    assert [likeness(split) for split in splits] == ["cannot tell", "cannot tell", "alike", "differs"]


def test_one_ride_held_out_has_no_interval(found: Discovery):
    rng = np.random.default_rng(0)
    errors = summarised([(9.0, 8.0, 7.0)], rng)
    assert errors == Errors(9.0, 8.0, 7.0, None)
    assert summarised([(9.0, 8.0, 7.0), (9.0, 8.0, 6.0)], rng).ci95 == (1.0, 2.0)
    report = replace(found.report, gain=Gain(("a",), power=errors))
    for text in body(replace(found, report=report), unseen), summary(replace(found, report=report)):
        assert "one ride: no interval" in text


def test_what_one_ride_alone_shows_is_said(found: Discovery):
    mixed = found.mixed
    assert outlying_rides(found) == []
    far = np.zeros(len(mixed.names))
    far[mixed.names.index("soc_start")] = 12.0
    lines = [line.seen_from(far) for line in found.lines]
    (said,) = outlying_rides(replace(found, lines=lines, normals=[normal(line, mixed.noise) for line in lines]))
    assert "coastdown is an outlier" in said
    assert "soc start +1" in said


def test_what_the_rides_lack_is_said(samples: Samples):
    lacking = ("accel_x", "rate_z", "gps_speed", "gps_course", "gps_altitude")
    less = replace(samples, columns={k: v for k, v in samples.columns.items() if k not in lacking})
    bare = reported(initial(read_vehicle("reference")), less)
    said = " ".join(missing_residuals(bare))
    assert "no ride has accel_x: no road force there" in said
    assert "no residual over lateral acceleration" in said
    assert {name for name, limit in limits(bare).items() if limit.change is None} >= {
        "rolling_resistance",
        "tyre_radius",
    }
    assert "not by these rides" in body(bare, unseen)
