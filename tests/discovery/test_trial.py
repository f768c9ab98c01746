"""Hidden effects and healthy scooters: a small blind trial of a plant that is not the package's model, fixed seeds.

The large ones are `make trial` and ``python -m benchmarks.trial --healthy 100`` (docs/results/trial.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.trial import (
    LACKS,
    MARK,
    Row,
    alarm,
    discovered,
    healthy_document,
    interval,
    judge,
    reported,
    right,
    with_section,
)
from benchmarks.trial import summary as counted
from gz_onboard.discovery import judgement, search
from gz_onboard.discovery.baseline import baseline
from gz_onboard.discovery.grid import Ride
from gz_onboard.discovery.judgement import VERDICTS
from gz_onboard.discovery.mixed_model import LinearRide, MixedModel, Statistics
from gz_onboard.discovery.search import (
    Rejected,
    Search,
    Split,
    carries_over,
    improves,
    with_observed_scatter,
    within_bounds,
    worsened,
)
from gz_onboard.recording.recording import Recording
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.discovery.material import search_of
from tests.plant import cases as plant

FIRST, CASES = 200_000, 8
RIDE = Ride("made up", np.zeros(0), {}, {}, 0.25, None)
SCOOTER = FIRST // plant.CASES_OF_A_SCOOTER


@pytest.fixture(scope="module")
def ridden() -> tuple[list[Recording], list[plant.Case]]:
    """The healthy rides and the cases: in one batch, which is cheap."""
    healthy, cases = plant.trial([SCOOTER], range(FIRST, FIRST + CASES))
    return healthy[SCOOTER], cases


@pytest.fixture(scope="module")
def base(ridden) -> Vehicle:
    return baseline(read_vehicle("reference"), ridden[0])


@pytest.fixture(scope="module")
def rows(base: Vehicle, ridden) -> list[Row]:
    return [judge(base, replace(case, twins=[])) for case in ridden[1]]


def test_the_small_trial_is_passed(rows):
    assert {row["verdict"] for row in rows} <= set(VERDICTS)
    assert {row["kind"] for row in rows} > {"healthy", "one"}  # else the seeds would test too little
    assert [row["seed"] for row in rows if row["kind"] == "healthy" and row["verdict"] != "none"] == []
    clear = [(row, t) for row in rows if row["kind"] != "unknown" for t in row["truths"] if t["clear"]]
    found = [t["name"] in reported(row) for row, t in clear]
    assert clear and sum(found) >= 0.75 * len(found), [(row["seed"], t["name"], reported(row)) for row, t in clear]
    assert sum(right(row, t) for row, t in clear) >= 0.5 * len(found)
    unknown = [row for row in rows if row["kind"] == "unknown"]
    assert sum(bool(reported(row)) for row in unknown) <= len(unknown) / 2


def test_drag_on_rough_roads_is_found_over_vibration_and_mended(base):
    (case,) = plant.draw_many([FIRST + 9], "unknown", ("rough_drag",), truths=False)
    report = discovered(base, case.rides)
    assert (report["verdict"], report["causes"]) == ("unknown", [])
    assert (report["unknown"]["channel"], report["unknown"]["quantity"]) == ("road_force", "vibration")
    gain = report["gain"]["consumption"]
    assert gain["after"] < 0.6 * gain["control"]  # on rides that the curve was not fitted to


def test_windy_days_are_named_but_no_model_is_extended_with_them(base):
    report = discovered(base, plant.windy(FIRST + 9, 4.5))
    assert [(cause["name"], cause["varies"]) for cause in report["causes"]] == [("headwind", True)]
    assert any("from ride to ride" in note for note in report["notes"])
    for metric in ("power", "consumption", "range"):
        assert report["gain"][metric]["after"] == report["gain"][metric]["control"]


def test_winds_that_hardly_show_leave_it_inconclusive(base):
    """Too few rides for a name, and yet their energy is missed by more than that of healthy ones."""
    report = discovered(base, plant.windy(FIRST + 9, 3.5)[:2])
    assert (report["verdict"], report["causes"], report["unknown"]) == ("inconclusive", [], None)
    assert report["gain"]["range"]["after"] > 0.08
    assert any("is missed on rides held out" in note for note in report["notes"])
    assert any("there and back" in line for line in report["advice"])


def test_a_cause_that_some_rides_do_not_have_varies(base, ridden, monkeypatch):
    (case, *_) = (case for case in ridden[1] if case.kind == "one" and case.truths[0].clear)
    monkeypatch.setattr(judgement, "splits", lambda now: [Split(name, "ride a", -0.9, 20.0) for name in now.chosen])
    report = discovered(base, case.rides)
    assert report["causes"] and all(cause["varies"] for cause in report["causes"])
    errors = [metric for metric in report["gain"].values() if isinstance(metric, dict)]
    assert errors and all(metric["after"] == metric["control"] for metric in errors)


def test_a_healthy_scooter_of_strangers_is_left_alone():
    """Cold, nearly empty, where its baseline hardly went; against the file it has only what the model lacks."""
    first, (later,) = plant.healthy(6, [34])
    known = read_vehicle("reference")
    report = discovered(baseline(known, first), later)
    assert (report["verdict"], report["causes"], report["unknown"]) == ("none", [], None)
    report = discovered(known, later)
    assert reported(report) <= LACKS["file"] and report["unknown"] is None


# --- acceptance -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["resistance_growth", "current_sensor_gain", "capacity_fade", "cornering_drag"])
def test_an_impossible_value_is_no_cause(mixed: MixedModel, name: str):
    """Beyond its bounds by more than its uncertainty: a resistance factor of -1.2, a gain of 0.2."""
    (cause,) = (c for c in mixed.causes if c.name == name)
    parameter = cause.parameters[0]
    (i,) = mixed.index([parameter.name])
    low, high = ((bound - mixed.values[parameter.name]) / mixed.scale[i] for bound in (parameter.low, parameter.high))
    far = abs(high - low)
    assert within_bounds(mixed, cause, [0.9 * low + 0.1 * high], [1e-6])
    for beyond in (low - 0.2 * far, high + 0.2 * far):
        assert not within_bounds(mixed, cause, [beyond], [0.05 * far])
        assert within_bounds(mixed, cause, [beyond], [0.15 * far])  # it may well be inside


def rides_at(mixed: MixedModel, name: str, values: list[float]) -> list[LinearRide]:
    """Rides that show nothing but the parameter `name`, each so many scales from its mean."""
    (i,) = mixed.index([name])
    rides = []
    for value in values:
        n, b = np.zeros((len(mixed.names),) * 2), np.zeros(len(mixed.names))
        n[i, i], b[i] = 100.0, 100.0 * (mixed.mean[i] + value)
        rides.append(LinearRide(None, {}, Statistics(n, b)))  # type: ignore[arg-type]
    return rides


def test_differences_between_rides_widen_the_scatter_and_a_common_change_does_not(mixed: MixedModel):
    known = replace(mixed, healthy=8)
    (i,) = known.index(["resistance_cold"])
    common, apart = (
        with_observed_scatter(known, rides_at(known, "resistance_cold", values))
        for values in ([4.0, 4.0, 4.0, 4.0], [-4.0, 4.0, -4.0, 4.0])
    )
    assert common.scatter[i] == pytest.approx(known.scatter[i], rel=0.05)
    assert apart.scatter[i] > 3 * known.scatter[i]
    assert (apart.scatter >= known.scatter).all()


def test_a_rejected_common_wind_leaves_the_winds_of_each_ride(mixed: MixedModel, monkeypatch):
    rides = [replace(line, ride=RIDE) for line in rides_at(mixed, "wind_north", [6.0, -6.0])]
    (east,) = mixed.index(["wind_east"])
    for line in rides:
        line.statistics.information[east, east] = 100.0
    problem = search_of(mixed, rides, limit=1e6)
    rejected = Rejected("headwind", "differs from ride to ride as much as it is", np.zeros(2))
    rest = {name: cause for name, cause in problem.causes.items() if name != "headwind"}
    monkeypatch.setattr(search, "accepted", lambda problem: replace(problem, causes=rest, rejected=(rejected,)))
    found = search.search_causes(problem)
    assert found.winds is not None and found.winds.score > 10


def test_the_first_offset_stays_while_causes_are_linearised(mixed: MixedModel, monkeypatch):
    delay, load = mixed.index(["pack_voltage_latency", "auxiliary_power"])
    offset = np.zeros(len(mixed.names))
    offset[delay] = 5.0
    now = replace(search_of(mixed, rides_at(mixed, "auxiliary_power", [40.0, 40.0])), offset=offset)
    monkeypatch.setattr(Search, "choose", lambda _: ("auxiliary_load",))
    monkeypatch.setattr(Search, "moved", lambda now, offset: replace(now, offset=offset))
    moved = now.selected().offset
    assert moved[delay] == 5.0 and moved[load] > 1.0


def models(**squares: tuple[float, float, float]) -> tuple[tuple[LinearRide, np.ndarray], ...]:
    """A ride held out of which models before, with the control and after leave these mean squares, by channel."""

    def left(at: int) -> LinearRide:
        tables = {
            name: type("Table", (), {"y": np.full(4, v[at] ** 0.5), "a": np.zeros((4, 1))})()
            for name, v in squares.items()
        }
        return LinearRide(None, tables, None)  # type: ignore[arg-type]

    return tuple((left(at), np.zeros(1)) for at in range(3))


def test_a_cause_must_predict_its_own_channel_better_than_a_refit(mixed: MixedModel, monkeypatch):
    shares = {"cell_voltage": 0.9, "auxiliary": 0.05}
    helps = models(cell_voltage=(4.0, 3.0, 2.0), auxiliary=(1.0, 1.0, 9.0))
    worse = models(cell_voltage=(4.0, 3.0, 3.5), auxiliary=(1.0, 1.0, 0.1))
    assert improves([helps, helps], shares)  # type: ignore[list-item]
    assert not improves([worse, worse], shares)  # type: ignore[list-item]
    assert not improves([models(cell_voltage=(2.0, 9.0, 3.0))], shares)  # type: ignore[list-item]
    # better on the whole, by the voltage's steps; the voltage itself is worse, so that it does not carry over
    shares = {"voltage_timing": 0.8, "cell_voltage": 0.19, "gps_speed": 0.01}
    first, second = (
        models(voltage_timing=(4.0, 4.0, 1.0), cell_voltage=(3.0, 1.5, x), gps_speed=(1.0, 1.0, 9.0))
        for x in (1.0, 3.5)
    )
    both = [first, second]
    assert improves(both, shares)  # type: ignore[arg-type]
    expected = {"voltage_timing": np.log(1 / 4), "cell_voltage": np.log(4.5 / 3)}
    assert worsened(both, shares) == pytest.approx(expected)  # type: ignore[arg-type]
    now = replace(search_of(mixed, rides_at(mixed, "payload_mass", [0.0, 0.0])), shares={"resistance_growth": shares})
    for held, carried in ((both, False), (both[:1], True)):
        monkeypatch.setattr(search, "held_out_with", lambda *_, held=held: held)
        assert carries_over(now, "resistance_growth") is carried


# --- the counting itself --------------------------------------------------------------------------------------------


def row(kind: str, hidden: str, verdict: str, causes: list[str], sets: list[list[str]], **more: object) -> Row:
    truth = {"name": hidden, "clear": True, "change": [1.0], "share": 0.1}
    names = [{"name": name} for name in causes]
    made = {"seed": 1, "kind": kind, "truths": [truth] if hidden else [], "verdict": verdict, "ranking": []}
    return made | {"causes": names, "ambiguous": sets, "accepted": [], "unknown": None, **more}


def test_the_trial_counts_right():
    lines = counted(
        [
            row("healthy", "", "none", [], []),
            row("healthy", "", "cause", ["headwind"], []),
            row("one", "headwind", "cause", ["headwind"], []),
            row("one", "headwind", "cause", ["aero_drag_area", "headwind"], []),
            row("one", "headwind", "none", [], []),
            row("look-alike", "dragging_brake", "ambiguous", [], [["dragging_brake", "rolling_resistance"]]),
            row("unknown", "resonance", "unknown", [], []),
            row("unknown", "resonance", "ambiguous", [], [["headwind", "aero_drag_area"]]),
        ]
    )
    for start, share in (
        ("false alarms on healthy rides", "1 of 2, 50 %"),
        ("clear effects: top cause", "2 of 4, 50 %"),
        ("clear effects: in the reported set", "3 of 4"),
        ("clear effects: nothing found", "1 of 4"),
        ("unknown effects: not given a wrong name", "1 of 2"),
        ("cases with an effect: a name too many", "1 of 4"),
    ):
        (line,) = (text for name, text in lines.items() if name.startswith(start))
        assert line.startswith(share), start
    assert interval(8, 10) == pytest.approx((0.490, 0.943), abs=1e-3)  # Wilson 1927; Brown, Cai & DasGupta 2001


def test_alarms_on_healthy_sets_are_counted_right():
    curve = {"channel": "cell_voltage", "quantity": "soc"}
    for against, causes, more, expected in (
        ("baseline", [], {}, False),
        ("baseline", ["cornering_drag"], {}, True),  # a baseline has learned it
        ("file", ["cornering_drag"], {}, False),
        ("file", ["cornering_drag", "ocv_hysteresis"], {}, True),
        ("baseline", [], {"unknown": curve}, True),
        ("baseline", [], {"verdict": "inconclusive"}, True),
    ):
        assert alarm(row("healthy", "", "cause", causes, [], against=against) | more) is expected
    made = [("baseline", []), ("baseline", ["headwind"]), ("file", [])]
    text = healthy_document([row("healthy", "", "cause", c, [], against=a) for a, c in made], 7, "abc")
    assert "| baseline of eight rides | 1 of 2, 50 %" in text and "| the vehicle file alone | 0 of 1, 0 %" in text
    once = with_section("# Trial\n\nText.\n\n## By strength\n\nrows\n", text)
    assert once.index(MARK) < once.index("## By strength") and with_section(once, text) == once
