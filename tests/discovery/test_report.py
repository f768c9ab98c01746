"""The report: residuals before and after the causes, judgement of errors left, page and summary."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gz_onboard.discovery.channels import CHANNEL
from gz_onboard.discovery.curves import CurveFit, curve_form
from gz_onboard.discovery.judgement import (
    Discovery,
    Errors,
    Gain,
    Isolability,
    ResidualSize,
    Score,
    errors,
    form_error,
    implausible_explanations,
    judge,
    limits,
    missing_residuals,
    outlying_rides,
    relative_size,
    remaining_error,
    summarised,
)
from gz_onboard.discovery.mixed_model import LinearRide, MixedModel, linearise_all, prior_of_file
from gz_onboard.discovery.mixed_model import initial as known_from
from gz_onboard.discovery.report import (
    COVARIATES,
    before_and_after,
    binned,
    body,
    edges,
    pooled,
    share_over,
    summary,
    write_report,
)
from gz_onboard.discovery.search import IMPOSSIBLE, Rejected, Split, search_causes, search_problem
from gz_onboard.model.parameters import Parameters
from gz_onboard.recording.recording import Recording, read_recording
from gz_onboard.vehicle import Vehicle, read_vehicle
from tests.discovery.material import CURVE, cause, discovered, rolling, search_of
from tests.support import LOGS


@pytest.fixture(scope="module")
def mixed() -> MixedModel:
    mixed = known_from(read_vehicle("reference"))
    return replace(mixed, prior=prior_of_file(mixed))


@pytest.fixture(scope="module")
def ride(mixed: MixedModel) -> Recording:
    return read_recording(LOGS / "coastdown.blf", mixed.vehicle)


@pytest.fixture(scope="module")
def line(mixed: MixedModel, ride: Recording) -> LinearRide:
    (line,) = linearise_all([mixed.ride(ride)], mixed)
    return line


@pytest.fixture(scope="module")
def found(mixed: MixedModel, line: LinearRide) -> Discovery:
    sizes = {"road_force": ResidualSize(0.1, 0.1, 0.1, 1, 0.1)}
    found = discovered(
        mixed,
        [line],
        rolling(),
        unknown=CURVE,
        ambiguous=[["rolling_resistance", "dragging_brake"]],
        ranking=[Score(c.name, 1.0) for c in mixed.causes],
        residuals=sizes,
        gain=Gain(("a<b", "c"), power=Errors(9.0, 8.0, 7.0, (0.5, 1.5))),
        advice=["Ride <more>."],
        notes=["a note"],
        isolability=Isolability({}, [("aero_drag_area", "drivetrain_drag", 0.91)]),
        constancy=[Split("rolling_resistance", "time", 0.9, 12.0)],
    )
    order = [row.name for row in found.report.ranking]
    return replace(found, report=replace(found.report, limits=limits(found.search, order)))


# --- bins -----------------------------------------------------------------------------------------------------------

floats = st.floats(-1e3, 1e3)


@given(st.lists(st.tuples(floats, floats), min_size=40, max_size=80))
def test_bins_keep_every_block_and_the_mean(pairs):
    x, y = np.array(pairs).T
    rows = binned(x, y, edges(x))
    if len(rows) and rows[:, 3].sum() == len(x):  # none was too small
        for column, values in ((1, y), (0, x)):
            assert np.average(rows[:, column], weights=rows[:, 3]) == pytest.approx(values.mean(), abs=1e-6)
    assert (rows[:, 3] > 3).all()


def test_the_share_that_goes_with_a_quantity():
    rng = np.random.default_rng(1)
    x, noise = rng.uniform(-3, 3, 4000), rng.normal(size=4000)
    assert share_over(x, noise) < 0.02 and share_over(x, x**2) > 0.9
    assert share_over(x, x**2 / np.std(x**2) + noise) == pytest.approx(0.5, abs=0.06)
    assert share_over(np.ones(100), noise[:100]) == 0.0


# --- content --------------------------------------------------------------------------------------------------------


def test_after_is_before_minus_the_effect_of_the_cause(found: Discovery):
    (before,), (after,) = before_and_after(found)
    (place,) = found.search.mixed.index(["rolling_resistance_constant"])
    for name, table in before.tables.items():
        column, difference = table.a[:, place], table.y - after.tables[name].y
        most = int(np.argmax(np.abs(column)))
        change = difference[most] / column[most] if np.any(column) else 0.0
        assert difference == pytest.approx(column * change)
    assert np.std(after.tables["road_force"].y) <= 1.01 * np.std(before.tables["road_force"].y)


def test_a_quantity_that_was_not_measured_is_not_shown(line: LinearRide):
    signals = {k: v for k, v in line.ride.signals.items() if k not in ("rate_z", "gps_course")}
    less = replace(line, ride=replace(line.ride, signals=signals))
    for name in COVARIATES:
        x, y = pooled([less], "road_force", name)
        assert len(x) == len(y) and (len(x) == 0) == (name in ("lateral_acceleration", "heading")), name


def test_page_and_summary_say_it_all(found: Discovery, tmp_path: Path):
    write_report(found, tmp_path / "out.html")
    page, text = (tmp_path / "out.html").read_text(), " ".join(summary(found).split())
    both = ("no candidate explains", "rolling_resistance_constant", "0.014 to 0.016", "a note", "road force over speed")
    for words in both:
        assert words in page and words in text, words
    for words in ("+4.0%", "+0.91", "Ride &lt;more&gt;.", "a&lt;b", "Unexplained residual", "+0.5 to +1.5", "differs"):
        assert words in page, words
    assert "ambiguous: rolling_resistance, dragging_brake" in text and "gain +0.5 to +1.5" in text
    assert "<script" not in page and 'src="http' not in page and len(page) < 2_000_000
    assert page.count('<svg class="drawn"') >= 4
    assert page.count("<details") >= sum(name in found.search.lines[0].tables for name in CHANNEL)


def test_a_cause_that_differs_from_ride_to_ride_is_said_to(found: Discovery):
    load = cause("auxiliary_load", "auxiliary_power", 58.7, 1.7, 15.1, "W", varies=True)
    ratios = {"ride a": (-0.93, 5.6), "ride b": (0.6, 2.1), "ride c": (0.5, 1.6), "time": (0.9, 12.0)}
    splits = [Split("auxiliary_load", name, *row) for name, row in ratios.items()]
    assert [split.unequal for split in splits] == [False, False, False, True]
    ranking = [Score("capacity_fade", 74.8), Score("auxiliary_load", 99.0), Score("headwind", 14.96)]
    report = replace(found.report, causes=[load], constancy=splits, ranking=ranking, threshold=15.0)
    text, page = (say(replace(found, report=report)) for say in (summary, body))
    assert "change +15.1 W" in text and "+15.1 W" in page
    assert all("differs from ride to ride (-0.93 to +0.60 of its mean)" in said for said in (text, page))
    assert "capacity_fade 74.8 (rejected), auxiliary_load 99.0, headwind 15.0;" in text


def test_one_ride_held_out_has_no_interval(found: Discovery):
    rng = np.random.default_rng(0)
    one = summarised(np.array([[9.0, 8.0, 7.0]]), rng)
    assert one == Errors(9.0, 8.0, 7.0, None)
    assert summarised(np.array([[9.0, 8.0, 7.0], [9.0, 8.0, 6.0]]), rng).ci95 == (1.0, 2.0)
    assert "one ride: no interval" in summary(replace(found, report=replace(found.report, gain=Gain(power=one))))


# --- limits and notes -----------------------------------------------------------------------------------------------


def test_a_curve_is_compared_with_the_causes_effect_in_its_channel(mixed: MixedModel, line: LinearRide):
    """Of a constant of 2 N; a curve of more than a tenth of the effect is no correction of its form."""
    now = replace(search_of(mixed, [line]), chosen=("rolling_resistance",))
    form = curve_form("road_force", "speed")
    k = len(form.knots)
    curve = CurveFit(form, 1.0, 1.0, 1.0, k, np.full(k, 2.0), np.eye(k))
    table = line.tables["road_force"]
    effect = table.a @ now.change * table.unit
    assert np.any(effect)
    found = relative_size(now, curve) * np.sqrt(np.mean((effect / table.unit) ** 2))
    assert found == pytest.approx(2.0 * np.sqrt(np.mean(1 / table.unit**2)))
    assert (2 * form_error({"road_force": 1.0}), 2 * form_error({"cell_voltage": 1.0})) == (0.1, 0.2)


def test_limits_shrink_with_the_rides(mixed: MixedModel, line: LinearRide):
    order = [cause.name for cause in mixed.usable_causes]
    one, two = (limits(search_of(mixed, [line] * n), order) for n in (1, 2))
    inf = float("inf")
    assert all((two[name].change or inf) <= (one[name].change or inf) for name in one)
    assert (two["auxiliary_load"].change or inf) < 0.9 * (one["auxiliary_load"].change or inf)
    assert 0.01 < (one["rolling_resistance"].energy_share or inf) < 1


def test_an_outlying_ride_is_named(mixed: MixedModel, line: LinearRide):
    assert outlying_rides(search_of(mixed, [line]), []) == []
    far = np.zeros(len(mixed.names))
    far[mixed.index(["soc_start"])] = 12.0
    (said,) = outlying_rides(search_of(mixed, [line.seen_from(far)]), [])
    assert "coastdown is an outlier" in said and "soc start +1" in said


def test_missing_sensors_are_said(mixed: MixedModel, ride: Recording):
    lacking = ("accel_x", "rate_z", "gps_speed", "gps_course", "gps_altitude")
    less = replace(ride, columns={k: v for k, v in ride.columns.items() if k not in lacking})
    now = search_of(mixed, linearise_all([mixed.ride(less)], mixed))
    said = " ".join(missing_residuals(now))
    assert "no ride has accel_x: no road force there" in said and "no residual over lateral acceleration" in said


def test_no_error_of_the_range_without_voltage_and_current_of_the_pack(mixed: MixedModel, line: LinearRide):
    assert "range" in errors(line, mixed.mean)
    for role in ("pack_current", "pack_voltage"):
        signals = {name: values for name, values in line.ride.signals.items() if name != role}
        less = replace(line, ride=replace(line.ride, signals=signals))
        assert "range" not in errors(less, mixed.mean)


def test_the_remaining_error_is_of_the_range_else_of_the_energy(line: LinearRide):
    drawn = line.ride.energy / line.ride.distance
    missed = Errors(0.2, 0.1, 0.07, (0.0, 0.02))
    assert remaining_error(Gain(note="one ride: nothing to hold out"), [line])[1] == 0.0
    assert remaining_error(Gain(range=missed), [line]) == ("range", 0.07)
    of_energy = Gain(consumption=replace(missed, after=0.07 * drawn))
    of, share = remaining_error(of_energy, [line])
    assert of == "energy" and share == pytest.approx(0.07)


# --- implausible explanations ---------------------------------------------------------------------------------------


def vague(scooter: Vehicle) -> Vehicle:
    """The scooter by a file that says next to nothing of its motor and its pack, and nothing of its torque."""
    sds = {"torque_constant": 0.5, "motor_copper_resistance": 0.3, "cell_capacity": 5.0, "auxiliary_power": 200.0}
    own = scooter.parameters
    known = {name: replace(value, sd=sds.get(name, value.sd)) for name, value in own.known.items()}
    known["torque_constant"] = replace(known["torque_constant"], source="prior: of another vehicle")
    return replace(scooter, parameters=Parameters(known, own.declared))


@pytest.fixture(scope="module")
def wrong() -> Discovery:
    """A pack current of three times its value, a file that leaves the motor open, and harmless candidates."""
    scooter = read_vehicle("reference")
    mixed, rides = known_from(vague(scooter)), []
    inside = {"inverter_current", "inverter_voltage", "auxiliary_current", "accel_x", "rate_z", "gps_altitude"}
    for name in ("city_14C", "city_34C"):
        ride = read_recording(LOGS / f"{name}.blf", scooter)
        known = {r: (t[t < 250.0], v[t < 250.0]) for r, (t, v) in ride.columns.items() if r not in inside}
        times, values = known["pack_current"]
        rides.append(mixed.ride(replace(ride, columns=known | {"pack_current": (times, 3.0 * values)})))
    problem = search_problem(mixed, linearise_all(rides, mixed), np.zeros(len(mixed.names)))
    harmless = ("cooling_blocked", "regen_loss", "sensor_latency")
    problem = replace(problem, causes={name: c for name, c in problem.causes.items() if name in harmless})
    return judge(problem, search_causes(problem))


def test_a_refit_that_takes_most_of_the_energy_is_implausible(wrong: Discovery):
    report = wrong.report
    assert (report.verdict, report.causes) == ("unknown", [])
    most = report.implausible[0]
    assert most.parameter == "torque_constant" and most.value > 0.9 and most.energy_share > 0.4
    assert "refitted from 0.4523 without a cause; it is not in the vehicle file" in most.why
    text = " ".join(summary(wrong).split())
    assert "No fault" not in text and "implausible: torque_constant = 1." in text
    assert "State the parameters that the file leaves open" in text and "cannot tell which is wrong" in text


def test_a_high_score_of_an_impossible_cause_is_implausible(wrong: Discovery):
    mixed = wrong.search.mixed
    lines = [
        replace(line, statistics=replace(line.statistics, score=line.statistics.information @ mixed.mean))
        for line in wrong.search.lines
    ]  # rides that move nothing
    (i,) = mixed.index(["pack_current_gain"])
    change = np.array([(3.0 - mixed.values["pack_current_gain"]) / mixed.scale[i]])
    gain = Rejected("current_sensor_gain", IMPOSSIBLE, change)
    elsewhere = replace(gain, why="does not foretell rides held out")
    now = search_of(mixed, lines, 17.0)
    for rejected, score, expected in ((gain, 150.0, False), (elsewhere, 267.0, False), (gain, 267.0, True)):
        found = implausible_explanations(replace(now, rejected=(rejected,)), (), {"current_sensor_gain": score})
        assert bool(found) == expected
    (row,) = found
    assert str(row).startswith("pack_current_gain = 3 (") and "current_sensor_gain (score 267) is possible" in str(row)
